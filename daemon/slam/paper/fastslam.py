"""FastSLAM 1.0 and the paper's filter (eqs. 17-25): poses as particles, each with its own landmark map."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from ceilvo.config import Filter
from ceilvo.daemon.odometry.matching import mutual_nearest
from ceilvo.daemon.slam.paper import curve_fit
from ceilvo.daemon.slam.paper.particle_maps import Candidates, ParticleMaps, fused
from ceilvo.daemon.slam.pose_filter import COUNTERS, effective_size, mean_and_cov, moved, normalised, spread
from ceilvo.daemon.slam.spatial_index import KnownMap
from ceilvo.errors import CeilvoError
from ceilvo.se2 import rotation, transform, wrap_array
from ceilvo.types import NO_LANDMARK, UNLABELLED, Array, Depletion, Ints, Landmarks, Motion, Observations

Redraw = Callable[[Array, Array, int, np.random.Generator], tuple[Array, float] | None]
"""Like curve_fit.redraw: poses, weights, degree, randomness to new poses and the fit's residual, or None."""
OUTLIER_DENSITY_PER_M2 = 0.25
"""An outlier may lie anywhere on 4 m^2."""
OUTLIER_DENSITY_PER_RAD = 2.0 / np.pi
"""A wrong direction may be anywhere in its quarter turn."""
ESS_FLOOR = 0.1
"""Share of the particles that one update must leave effective; the likelihood is tempered until it does."""
CANDIDATE_EXPIRES_UPDATES = 20
CANDIDATE_GATE = 25.0
"""Squared normalised distance at which two sightings cannot be of one feature (5 sigma)."""
DUPLICATE_SHARE = 0.25
"""No landmark is born nearer to one of its kind than this share of the association gate."""
NIS_CAP = 50.0
"""Largest normalised innovation of one observation in the mean: a few false matches are not a lost robot."""
VAR_FLOOR = 1e-12
"""m^2 or rad^2: smaller variances are not believed."""
REGULARISATION = (2e-5, 2e-5, 1e-5)
"""m, m, rad: noise after resampling, so that no cloud ever collapses to a point."""
_LOG_2PI = float(np.log(2.0 * np.pi))


class FastSlam:
    """PoseFilter by particles; method "pf" resamples systematically, any other along a fitted curve."""

    def __init__(self, settings: Filter, rng: np.random.Generator, redraw: Redraw = curve_fit.redraw) -> None:
        self._settings = settings
        self._rng = rng
        self._redraw = redraw
        self._counters = dict.fromkeys(COUNTERS, 0)
        self.reset(np.zeros(3), np.zeros((3, 3)))

    def reset(self, pose: Array, cov: Array, landmarks: Landmarks | None = None, known: bool = False) -> None:
        n = self._settings.particles
        if not np.all(np.isfinite(cov)):
            self._poses = self._anywhere(landmarks)
        else:
            self._poses = spread(np.asarray(pose, np.float64), np.asarray(cov, np.float64), n, self._rng)
        self._poses[:, 2] = wrap_array(self._poses[:, 2])
        self._known = KnownMap(landmarks) if known and landmarks is not None and len(landmarks) else None
        self._weights = np.full(n, 1.0 / n)
        self._maps = ParticleMaps(n)
        self._candidates = Candidates(CANDIDATE_EXPIRES_UPDATES)
        self._depletion = Depletion(n, float(n), n, float("nan"), 0.0, 0)
        self._estimate: tuple[Array, Array] | None = None
        self._summary: Landmarks | None = None
        if landmarks is not None and len(landmarks) and self._known is None:
            packed = landmarks.cov_m2.reshape(-1, 4)[:, [0, 1, 3]]
            labels = self._maps.add(
                np.repeat(landmarks.xy_map_m[:, :, None], n, axis=2),
                np.repeat(packed[:, :, None], n, axis=2),
                landmarks.kind,
                landmarks.sightings,
                self._settings.max_landmarks,
                landmarks.ids,
            )
            self._maps.refresh(self._weights, labels)

    def _anywhere(self, landmarks: Landmarks | None) -> Array:
        """(N, 3) poses all over the map."""
        if landmarks is None or not len(landmarks):
            raise CeilvoError("filter: the pose is not known and there is no map; give a finite covariance or a map")
        low, high = np.min(landmarks.xy_map_m, axis=0), np.max(landmarks.xy_map_m, axis=0)
        unit = self._rng.random((self._settings.particles, 3))
        return np.column_stack([low + unit[:, :2] * (high - low), 2.0 * np.pi * unit[:, 2]])

    def predict(self, motion: Motion) -> None:
        if not (np.all(np.isfinite(motion.prev_from_curr)) and np.all(np.isfinite(motion.cov))):
            raise CeilvoError(
                f"filter: motion {motion.prev_from_curr} is not finite, expected metres and radians with a finite "
                "covariance; report a failed motion with its prediction instead"
            )
        self._poses = moved(self._poses, motion, self._rng)
        self._estimate = None

    def update(self, obs: Observations) -> None:
        """Weights by eq. 18 (the motion being the proposal, they grow by the likelihood), then map, then resampling."""
        obs = self._labelled(usable(obs, self._size()))
        self._counters["updates"] += 1
        matched = np.flatnonzero(obs.label >= 0)
        likelihood, unexplained, nis, dof = self._weigh_and_map(obs, matched)
        self._weights = self._tempered(likelihood + self._heading_log_likelihood(obs))
        self._estimate = mean_and_cov(self._poses, self._weights)  # before resampling, which only adds noise
        self._counters["observations"] += len(matched)
        self._counters["outliers"] += int(np.count_nonzero(unexplained))
        self._counters["rejected_updates"] += int(2 * np.count_nonzero(unexplained) > len(matched))
        if self._known is None:
            self._maps.refresh(self._weights, obs.label[matched])
            self._summary = None
            unknown = np.concatenate([np.flatnonzero(obs.label < 0), matched[unexplained]])
            self._consider(obs, unknown, self._estimate[0])
        ess, ancestors, residual = effective_size(self._weights), len(self._weights), float("nan")
        if ess < self._settings.resample_ess_ratio * len(self._weights):
            ancestors, residual = self._resample()
        self._depletion = Depletion(len(self._weights), ess, ancestors, residual, nis, dof)

    def estimate(self) -> tuple[Array, Array, Depletion]:
        if self._estimate is None:
            self._estimate = mean_and_cov(self._poses, self._weights)
        pose, cov = self._estimate
        return pose.copy(), cov.copy(), self._depletion

    def landmarks(self) -> Landmarks:
        if self._known is not None:
            return self._known.landmarks
        if self._summary is None:
            self._summary = self._maps.summary()
        return self._summary

    def particles(self) -> tuple[Array, Array]:
        return self._poses.copy(), self._weights.copy()

    def counters(self) -> Mapping[str, int]:
        return dict(self._counters)

    def _size(self) -> int:
        return len(self._maps) if self._known is None else len(self._known)

    def _labelled(self, obs: Observations) -> Observations:
        """Features whose landmark is left to the filter go to the nearest of their kind at the mean pose."""
        free = np.flatnonzero(obs.label == UNLABELLED)
        if not len(free):
            return obs
        pose, _ = mean_and_cov(self._poses, self._weights)
        xy, gate = transform(pose, obs.xy_base_m[free]), self._settings.association_gate_m
        m = self.landmarks()
        near = np.arange(len(m)) if self._known is None else self._known.near(xy, gate)
        seen, which = mutual_nearest(xy, obs.kind[free], m.xy_map_m[near], m.kind[near], gate)
        label = obs.label.copy()
        label[free] = NO_LANDMARK
        label[free[seen]] = near[which]
        return usable(replace(obs, label=label), self._size())

    def _weigh_and_map(
        self, obs: Observations, matched: NDArray[np.intp]
    ) -> tuple[Array, NDArray[np.bool_], float, int]:
        """Log-likelihood (N,) of the matched observations, which of them the outlier term explains, and their NIS.

        The landmarks of each particle are updated on the way, where they explain what was seen.
        """
        if not len(matched):
            return np.zeros(len(self._weights)), np.zeros(0, bool), 0.0, 0
        labels = obs.label[matched]
        mean, cov = self._maps.gather(labels) if self._known is None else self._known.repeated(labels)
        seen, noise = self._in_map(obs, matched)
        innovation, innovation_cov = seen - mean, cov + noise
        nis = self._nis(innovation, innovation_cov)
        floor = self._settings.outlier_floor
        inlier = np.log1p(-floor) + gaussian_log(innovation, innovation_cov)
        outlier = np.log(floor * OUTLIER_DENSITY_PER_M2) if floor > 0.0 else -np.inf
        wins = inlier > outlier
        explained = wins @ self._weights > 0.5
        if self._known is None:
            new_mean, new_cov = fused(mean, cov, innovation, innovation_cov)
            take = wins[:, None, :]
            self._maps.scatter(labels, np.where(take, new_mean, mean), np.where(take, new_cov, cov))
            self._maps.sightings[labels[explained]] += 1
        variance = 0.5 * float(np.mean((innovation_cov[:, 0] + innovation_cov[:, 2]) @ self._weights))
        count = independent(len(matched), self._settings.feature_independence, obs.common_var_m2 / variance)
        log_likelihood = count / len(matched) * np.sum(np.logaddexp(inlier, outlier), axis=0)
        return log_likelihood, ~explained, nis, 2 * len(matched)

    def _in_map(self, obs: Observations, which: NDArray[np.intp]) -> tuple[Array, Array]:
        """Observations as each particle places them: (K, 2, N) m and their noise (K, 3, N) packed."""
        c, s = np.cos(self._poses[:, 2]), np.sin(self._poses[:, 2])
        x, y = obs.xy_base_m[which, 0, None], obs.xy_base_m[which, 1, None]
        vx, vy = obs.var_m2[which, 0, None], obs.var_m2[which, 1, None]
        seen = np.stack([self._poses[:, 0] + c * x - s * y, self._poses[:, 1] + s * x + c * y], axis=1)
        return seen, np.stack([c * c * vx + s * s * vy, c * s * (vx - vy), s * s * vx + c * c * vy], axis=1)

    def _nis(self, innovation: Array, innovation_cov: Array) -> float:
        """Mean normalised innovation squared per degree of freedom at the mean pose and map.

        The particles' spread of the innovation is the part that pose and map uncertainty have in it.
        """
        mean = innovation @ self._weights
        off = innovation - mean[:, :, None]
        spread_cov = np.stack([off[:, 0] * off[:, 0], off[:, 0] * off[:, 1], off[:, 1] * off[:, 1]], axis=1)
        cov = (innovation_cov + spread_cov) @ self._weights
        return float(np.mean(np.minimum(mahalanobis(mean, cov), NIS_CAP))) / 2.0

    def _heading_log_likelihood(self, obs: Observations) -> Array:
        var = max(obs.heading_var_rad2, VAR_FLOOR) if obs.heading_var_rad2 > 0.0 else np.inf
        if not (np.isfinite(var) and np.isfinite(obs.heading_rad)):
            return np.zeros(len(self._weights))
        off = wrap_array(self._poses[:, 2] - obs.heading_rad)
        floor = self._settings.outlier_floor
        outlier = np.log(floor * OUTLIER_DENSITY_PER_RAD) if floor > 0.0 else -np.inf
        inlier = np.log1p(-floor) - 0.5 * (off * off / var + np.log(var) + _LOG_2PI)
        return np.asarray(np.logaddexp(inlier, outlier), np.float64)

    def _tempered(self, log_likelihood: Array) -> Array:
        """New weights; the likelihood's exponent is lowered until enough particles stay effective."""
        before = np.log(np.maximum(self._weights, 1e-300))
        weights = normalised(before + log_likelihood)
        floor = min(ESS_FLOOR * len(weights), 0.9 * effective_size(self._weights))
        if effective_size(weights) >= floor:
            return weights
        low, high = 0.0, 1.0
        for _ in range(12):
            middle = 0.5 * (low + high)
            weights = normalised(before + middle * log_likelihood)
            low, high = (middle, high) if effective_size(weights) >= floor else (low, middle)
        return normalised(before + low * log_likelihood)

    def _consider(self, obs: Observations, unknown: NDArray[np.intp], pose: Array) -> None:
        """Count sightings of unknown features; those seen often enough become landmarks of every particle."""
        self._candidates.grow_older()
        xy, kind = transform(pose, obs.xy_base_m[unknown]), obs.kind[unknown]
        new = self._not_mapped(xy, kind)
        xy, kind, unknown = xy[new], kind[new], unknown[new]
        cov = _turned(obs.var_m2[unknown], float(pose[2]))
        gate = self._settings.association_gate_m
        seen, which = mutual_nearest(xy, kind, self._candidates.xy, self._candidates.kind, gate)
        off = mahalanobis(xy[seen] - self._candidates.xy[which], cov[seen] + self._candidates.cov[which])
        seen, which = seen[off <= CANDIDATE_GATE], which[off <= CANDIDATE_GATE]
        first = np.setdiff1d(np.arange(len(kind)), seen)
        self._candidates.merge(which, xy[seen], cov[seen])
        self._candidates.append(xy[first], cov[first], kind[first])
        which = np.concatenate([which, np.arange(len(self._candidates) - len(first), len(self._candidates))])
        ready = self._candidates.count[which] >= self._settings.birth_sightings
        if np.any(ready):
            self._give_birth(obs, unknown[np.concatenate([seen, first])[ready]], which[ready], pose)

    def _not_mapped(self, xy: Array, kind: Ints) -> NDArray[np.intp]:
        if not len(self._maps) or not len(kind):
            return np.arange(len(kind))
        known = self.landmarks()
        apart = np.hypot(xy[:, None, 0] - known.xy_map_m[:, 0], xy[:, None, 1] - known.xy_map_m[:, 1])
        apart[kind[:, None] != known.kind] = np.inf
        return np.flatnonzero(np.min(apart, axis=1) > DUPLICATE_SHARE * self._settings.association_gate_m)

    def _give_birth(self, obs: Observations, which_obs: NDArray[np.intp], which: NDArray[np.intp], pose: Array) -> None:
        """Each particle places the feature from its own pose, corrected by what the earlier sightings averaged to."""
        candidates, n = self._candidates, len(self._weights)
        seen, _ = self._in_map(obs, which_obs)
        correction = candidates.xy[which] - transform(pose, obs.xy_base_m[which_obs])
        labels = self._maps.add(
            seen + correction[:, :, None],
            np.repeat(candidates.cov[which][:, :, None], n, axis=2),
            candidates.kind[which],
            candidates.count[which],
            self._settings.max_landmarks,
        )
        self._counters["births"] += len(labels)
        self._maps.refresh(self._weights, labels)
        self._summary = None
        candidates.remove(which)

    def _resample(self) -> tuple[int, float]:
        """Draw equally weighted particles; returns the number of distinct ancestors and the fit's residual."""
        drawn = None
        self._counters["resamplings"] += 1
        if self._settings.method != "pf":
            drawn = self._redraw(self._poses, self._weights, self._settings.fit_degree, self._rng)
            self._counters["fit_failures"] += int(drawn is None)
        if drawn is None:
            ancestors, residual = curve_fit.systematic(self._weights, self._rng), float("nan")
            poses = self._poses[ancestors]
        else:
            poses, residual = drawn
            scale = np.maximum(
                np.sqrt(np.diagonal(mean_and_cov(self._poses, np.full(len(poses), 1 / len(poses)))[1])), 1e-9
            )
            ancestors = curve_fit.nearest(poses, self._poses, scale)
        self._poses = poses + self._rng.standard_normal(poses.shape) * REGULARISATION
        self._poses[:, 2] = wrap_array(self._poses[:, 2])
        self._weights = np.full(len(poses), 1.0 / len(poses))
        self._maps.resample(ancestors)
        return len(np.unique(ancestors)), residual


def independent(features: int, power: float, correlation: float) -> float:
    """How many independent features K features of one frame are worth.

    K crossings are made of far fewer lines, so they count as K^power; of those a share `correlation` of the variance
    is common to all, which leaves n / (1 + (n - 1) correlation) (Kish's design effect).
    """
    n = float(features**power)
    return n / (1.0 + max(n - 1.0, 0.0) * min(max(correlation, 0.0), 1.0))


def gaussian_log(innovation: Array, cov: Array) -> Array:
    """log N(innovation; 0, cov): (K, 2, ...) and packed (K, 3, ...) to (K, ...)."""
    det = cov[:, 0] * cov[:, 2] - cov[:, 1] * cov[:, 1]
    return np.asarray(-0.5 * (mahalanobis(innovation, cov) + np.log(det)) - _LOG_2PI, np.float64)


def mahalanobis(innovation: Array, cov: Array) -> Array:
    """Squared: (K, 2, ...) and packed (K, 3, ...) to (K, ...)."""
    x, y = innovation[:, 0], innovation[:, 1]
    xx, xy, yy = cov[:, 0], cov[:, 1], cov[:, 2]
    return np.asarray((yy * x * x - 2.0 * xy * x * y + xx * y * y) / (xx * yy - xy * xy), np.float64)


def _turned(var: Array, theta: float) -> Array:
    """(M, 3) packed covariances in map from (M, 2) variances in base."""
    r = rotation(theta)
    return np.column_stack([var @ (r[0] ** 2), var @ (r[0] * r[1]), var @ (r[1] ** 2)])


def usable(obs: Observations, landmarks: int) -> Observations:
    """Without rows that are not finite or have no variance; a landmark seen twice or not there is unknown."""
    good = np.all(np.isfinite(obs.xy_base_m), axis=1) & np.all(np.isfinite(obs.var_m2) & (obs.var_m2 > 0.0), axis=1)
    label = obs.label[good].copy()
    label[(label >= landmarks) | (label < UNLABELLED)] = NO_LANDMARK
    first = np.unique(label, return_index=True)[1]
    repeated = label >= 0
    repeated[first] = False
    label[repeated] = NO_LANDMARK
    return Observations(
        obs.xy_base_m[good],
        np.maximum(obs.var_m2[good], VAR_FLOOR),
        obs.kind[good],
        label,
        obs.heading_rad,
        obs.heading_var_rad2,
        obs.common_var_m2 if np.isfinite(obs.common_var_m2) else 0.0,
    )
