"""FastSLAM 1.0 and the paper's filter (eqs. 17-25): poses as particles, each with its own landmark map."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ceilvo.config import Filter
from ceilvo.daemon.odometry.matching import mutual_nearest
from ceilvo.daemon.slam.association import (
    DUPLICATE_FRACTION,
    EXPIRES_UPDATES,
    NIS_CAP,
    OUTLIER_DENSITY_PER_M2,
    VAR_FLOOR,
    bounded,
    independent,
    usable,
)
from ceilvo.daemon.slam.paper import curve_fit
from ceilvo.daemon.slam.paper.particle_maps import (
    LOG_2PI,
    Candidates,
    ParticleMaps,
    fused,
    gaussian_log,
    mahalanobis,
    turned,
)
from ceilvo.daemon.slam.pose_filter import (
    COUNTERS,
    checked_motion,
    effective_size,
    mean_and_cov,
    moved,
    normalised,
    spread,
    systematic,
)
from ceilvo.daemon.slam.spatial_index import IndexedMap, landmarks_near, packed
from ceilvo.daemon.slam.upkeep import carried
from ceilvo.errors import CeilvoError
from ceilvo.se2 import transform, wrap_array
from ceilvo.types import NO_LANDMARK, UNLABELLED, Array, FilterHealth, Ints, Landmarks, Motion, Observations

Redraw = Callable[[Array, Array, int, np.random.Generator], tuple[Array, float] | None]
"""Like curve_fit.redraw: poses, weights, degree, randomness to new poses and the fit's residual, or None."""
OUTLIER_DENSITY_PER_RAD = 2.0 / np.pi
"""A wrong direction may be anywhere in its quarter turn."""
ESS_FLOOR = 0.1
"""Share of the particles that one update must leave effective; the likelihood is tempered until it does."""
REGULARISATION = (2e-5, 2e-5, 1e-5)
"""m, m, rad: noise after resampling, so that no cloud ever collapses to a point."""


@dataclass(slots=True)
class FastSlamState:
    """All that a FastSlam remembers.

    Attributes:
        rng: the filter's only source of randomness.
        poses, weights: (N, 3) and (N,).
        maps: a map for each particle.
        candidates: features that are no landmarks yet.
        health: of the last update.
        counters: see pose_filter.COUNTERS.
        known: a map that is not learnt; the particles' maps are then empty.
        mean, cov: (3,) and (3, 3) of the last update, before resampling; None once the particles have moved.
        summary: the map as last shown; None once it has changed.
    """

    rng: np.random.Generator
    poses: Array
    weights: Array
    maps: ParticleMaps
    candidates: Candidates
    health: FilterHealth
    counters: dict[str, int]
    known: IndexedMap | None = None
    mean: Array | None = None
    cov: Array | None = None
    summary: Landmarks | None = None

    @staticmethod
    def of(poses: Array, rng: np.random.Generator, counters: dict[str, int]) -> FastSlamState:
        """Equally weighted poses (N, 3) with empty maps."""
        n = len(poses)
        health = FilterHealth(n, float(n), n, float("nan"), 0.0, 0)
        return FastSlamState(
            rng, poses, np.full(n, 1.0 / n), ParticleMaps.of(n), Candidates(EXPIRES_UPDATES), health, counters
        )


class FastSlam:
    """PoseFilter by particles; method "pf" resamples systematically, any other along a fitted curve."""

    def __init__(self, settings: Filter, rng: np.random.Generator, redraw: Redraw = curve_fit.redraw) -> None:
        self._settings = settings
        self._redraw = redraw
        self.state = FastSlamState.of(np.zeros((settings.particles, 3)), rng, dict.fromkeys(COUNTERS, 0))
        self.reset(np.zeros(3), np.zeros((3, 3)))

    def reset(self, pose: Array, cov: Array, landmarks: Landmarks | None = None, known: bool = False) -> None:
        n, before = self._settings.particles, self.state
        if not np.all(np.isfinite(cov)):
            poses = self._anywhere(landmarks)
        else:
            poses = spread(np.asarray(pose, np.float64), np.asarray(cov, np.float64), n, before.rng)
        poses[:, 2] = wrap_array(poses[:, 2])
        self.state = state = FastSlamState.of(poses, before.rng, before.counters)
        if landmarks is None or not len(landmarks):
            return
        if known:
            state.known = IndexedMap(landmarks)
            return
        labels = state.maps.add(
            np.repeat(landmarks.xy_map_m[:, :, None], n, axis=2),
            np.repeat(packed(landmarks.cov_m2)[:, :, None], n, axis=2),
            landmarks.crossing_type,
            landmarks.sightings,
            landmarks.ids,
        )
        state.maps.refresh(state.weights, labels)

    def _anywhere(self, landmarks: Landmarks | None) -> Array:
        """(N, 3) poses all over the map."""
        if landmarks is None or not len(landmarks):
            raise CeilvoError("filter: the pose is not known and there is no map; give a finite covariance or a map")
        low, high = np.min(landmarks.xy_map_m, axis=0), np.max(landmarks.xy_map_m, axis=0)
        unit = self.state.rng.random((self._settings.particles, 3))
        return np.column_stack([low + unit[:, :2] * (high - low), 2.0 * np.pi * unit[:, 2]])

    def forget(self, ids: Ints, newborn: bool = False) -> None:
        if self.state.known is None:
            self.state.maps.forget(ids)
            self.state.candidates = Candidates(EXPIRES_UPDATES) if newborn else self.state.candidates
            self.state.summary = None

    def next_id(self) -> int:
        return (self.state.known or self.state.maps).next_id

    def carry(self, first_id: int, there_from_here: Array) -> Landmarks:
        if self.state.known is None and self.next_id() > first_id:  # the particles' maps become one
            self.reset(*self.estimate()[:2], carried(self.landmarks(), first_id, there_from_here))
        return self.landmarks().of(self.landmarks().ids >= first_id)

    def predict(self, motion: Motion) -> None:
        self.state.poses = moved(self.state.poses, checked_motion(motion), self.state.rng)
        self.state.mean = self.state.cov = None

    def update(self, obs: Observations, learnt_from: int = 0) -> None:
        """Weights by eq. 18 (the motion being the proposal, they grow by the likelihood), then map, then resampling."""
        obs = bounded(self._labelled(usable(obs, self.size())), self.state.counters["updates"])
        self.state.counters["updates"] += 1
        matched = np.flatnonzero(obs.label >= 0)
        likelihood, unexplained, nis, dof = self._weigh_and_map(obs, matched, learnt_from)
        self.state.weights = self._tempered(likelihood + self._heading_log_likelihood(obs))
        self.state.mean, self.state.cov = mean_and_cov(self.state.poses, self.state.weights)  # resampling adds noise
        self.state.counters["observations"] += len(matched)
        self.state.counters["outliers"] += int(np.count_nonzero(unexplained))
        self.state.counters["rejected_updates"] += int(2 * np.count_nonzero(unexplained) > len(matched))
        if self.state.known is None:
            self.state.maps.refresh(self.state.weights, obs.label[matched], learnt_from)
            self.state.summary = None
            unknown = np.concatenate([np.flatnonzero(obs.label < 0), matched[unexplained]])
            if self.state.maps.next_id >= learnt_from:
                self._consider(obs, unknown, self.state.mean, learnt_from)
        ess, ancestors, residual = effective_size(self.state.weights), len(self.state.weights), float("nan")
        if ess < self._settings.resample_ess_ratio * len(self.state.weights):
            ancestors, residual = self._resample()
        self.state.health = FilterHealth(len(self.state.weights), ess, ancestors, residual, nis, dof)

    def estimate(self) -> tuple[Array, Array, FilterHealth]:
        s = self.state
        if s.mean is None or s.cov is None:
            s.mean, s.cov = mean_and_cov(s.poses, s.weights)
        return s.mean.copy(), s.cov.copy(), s.health

    def jump(self, pose: Array, cov: Array) -> None:
        self.reset(pose, cov, self.landmarks(), known=self.state.known is not None)

    def size(self) -> int:
        return len(self.state.maps) if self.state.known is None else len(self.state.known)

    def landmarks(self) -> Landmarks:
        if self.state.known is not None:
            return self.state.known.landmarks
        if self.state.summary is None:
            self.state.summary = self.state.maps.summary()
        return self.state.summary

    def particles(self) -> tuple[Array, Array]:
        return self.state.poses.copy(), self.state.weights.copy()

    def counters(self) -> Mapping[str, int]:
        return dict.fromkeys(COUNTERS, 0) | self.state.counters

    def landmarks_near(self, xy_m: Array, reach_m: float) -> tuple[Ints, Landmarks]:
        known = self.state.known
        return landmarks_near(self.landmarks(), xy_m, reach_m) if known is None else known.landmarks_near(xy_m, reach_m)

    def _labelled(self, obs: Observations) -> Observations:
        """Features whose landmark is left to the filter go to the nearest of their kind at the mean pose."""
        free = np.flatnonzero(obs.label == UNLABELLED)
        if not len(free):
            return obs
        pose, _ = mean_and_cov(self.state.poses, self.state.weights)
        xy, gate = transform(pose, obs.xy_base_m[free]), self._settings.association_gate_m
        near, m = self.landmarks_near(xy, gate)
        seen, which = mutual_nearest(xy, obs.crossing_type[free], m.xy_map_m, m.crossing_type, gate)
        label = obs.label.copy()
        label[free] = NO_LANDMARK
        label[free[seen]] = near[which]
        return usable(replace(obs, label=label), self.size())

    def _weigh_and_map(
        self, obs: Observations, matched: NDArray[np.intp], learnt_from: int
    ) -> tuple[Array, NDArray[np.bool_], float, int]:
        """Log-likelihood (N,) of the matched observations, which of them the outlier term explains, and their NIS.

        The landmarks of each particle are updated on the way, where they explain what was seen.
        """
        if not len(matched):
            return np.zeros(len(self.state.weights)), np.zeros(0, bool), 0.0, 0
        labels = obs.label[matched]
        mean, cov = self.state.maps.gather(labels) if self.state.known is None else self.state.known.repeated(labels)
        seen, noise = self._in_map(obs, matched)
        innovation, innovation_cov = seen - mean, cov + noise
        nis = self._nis(innovation, innovation_cov)
        floor = self._settings.outlier_floor
        inlier = np.log1p(-floor) + gaussian_log(innovation, innovation_cov)
        outlier = np.log(floor * OUTLIER_DENSITY_PER_M2) if floor > 0.0 else -np.inf
        wins = inlier > outlier
        explained = wins @ self.state.weights > 0.5
        if self.state.known is None:
            new_mean, new_cov = fused(mean, cov, innovation, innovation_cov)
            learns = self.state.maps.ids[labels] >= learnt_from
            take = (wins & learns[:, None])[:, None, :]
            self.state.maps.scatter(labels, np.where(take, new_mean, mean), np.where(take, new_cov, cov))
            self.state.maps.sightings[labels[explained & learns]] += 1
        variance = 0.5 * float(np.mean((innovation_cov[:, 0] + innovation_cov[:, 2]) @ self.state.weights))
        count = independent(len(matched), self._settings.feature_independence, obs.common_var_m2 / variance)
        log_likelihood = count / len(matched) * np.sum(np.logaddexp(inlier, outlier), axis=0)
        return log_likelihood, ~explained, nis, 2 * len(matched)

    def _in_map(self, obs: Observations, which: NDArray[np.intp]) -> tuple[Array, Array]:
        """Observations as each particle places them: (K, 2, N) m and their noise (K, 3, N) packed."""
        c, s = np.cos(self.state.poses[:, 2]), np.sin(self.state.poses[:, 2])
        x, y = obs.xy_base_m[which, 0, None], obs.xy_base_m[which, 1, None]
        vx, vy = obs.var_m2[which, 0, None], obs.var_m2[which, 1, None]
        seen = np.stack([self.state.poses[:, 0] + c * x - s * y, self.state.poses[:, 1] + s * x + c * y], axis=1)
        return seen, np.stack([c * c * vx + s * s * vy, c * s * (vx - vy), s * s * vx + c * c * vy], axis=1)

    def _nis(self, innovation: Array, innovation_cov: Array) -> float:
        """Mean NIS per degree of freedom at the mean pose and map, whose uncertainty is the particles' spread."""
        mean = innovation @ self.state.weights
        off = innovation - mean[:, :, None]
        spread_cov = np.stack([off[:, 0] * off[:, 0], off[:, 0] * off[:, 1], off[:, 1] * off[:, 1]], axis=1)
        cov = (innovation_cov + spread_cov) @ self.state.weights
        return float(np.mean(np.minimum(mahalanobis(mean, cov), NIS_CAP))) / 2.0

    def _heading_log_likelihood(self, obs: Observations) -> Array:
        var = max(obs.heading_var_rad2, VAR_FLOOR) if obs.heading_var_rad2 > 0.0 else np.inf
        if not (np.isfinite(var) and np.isfinite(obs.heading_rad)):
            return np.zeros(len(self.state.weights))
        off = wrap_array(self.state.poses[:, 2] - obs.heading_rad)
        floor = self._settings.outlier_floor
        outlier = np.log(floor * OUTLIER_DENSITY_PER_RAD) if floor > 0.0 else -np.inf
        inlier = np.log1p(-floor) - 0.5 * (off * off / var + np.log(var) + LOG_2PI)
        return np.asarray(np.logaddexp(inlier, outlier), np.float64)

    def _tempered(self, log_likelihood: Array) -> Array:
        """New weights; the likelihood's exponent is lowered until enough particles stay effective."""
        before = np.log(np.maximum(self.state.weights, 1e-300))
        weights = normalised(before + log_likelihood)
        floor = min(ESS_FLOOR * len(weights), 0.9 * effective_size(self.state.weights))
        if effective_size(weights) >= floor:
            return weights
        low, high = 0.0, 1.0
        for _ in range(12):
            middle = 0.5 * (low + high)
            weights = normalised(before + middle * log_likelihood)
            low, high = (middle, high) if effective_size(weights) >= floor else (low, middle)
        return normalised(before + low * log_likelihood)

    def _consider(self, obs: Observations, unknown: NDArray[np.intp], pose: Array, learnt_from: int) -> None:
        """Count sightings of unknown features; those seen often enough become landmarks of every particle."""
        self.state.candidates.grow_older()
        xy, kind = transform(pose, obs.xy_base_m[unknown]), obs.crossing_type[unknown]
        new = self._not_mapped(xy, kind)
        xy, kind, unknown = xy[new], kind[new], unknown[new]
        cov = turned(obs.var_m2[unknown], float(pose[2]))
        order, which = self.state.candidates.sight(xy, cov, kind, self._settings.association_gate_m)
        ready = self.state.candidates.count[which] >= self._settings.birth_sightings
        if np.any(ready):
            self._give_birth(obs, unknown[order[ready]], which[ready], pose, learnt_from)

    def _not_mapped(self, xy: Array, kind: Ints) -> NDArray[np.intp]:
        if not len(self.state.maps) or not len(kind):
            return np.arange(len(kind))
        known = self.landmarks()
        apart = np.hypot(xy[:, None, 0] - known.xy_map_m[:, 0], xy[:, None, 1] - known.xy_map_m[:, 1])
        apart[kind[:, None] != known.crossing_type] = np.inf
        return np.flatnonzero(np.min(apart, axis=1) > DUPLICATE_FRACTION * self._settings.association_gate_m)

    def _give_birth(self, obs: Observations, which_obs: Ints, which: Ints, pose: Array, learnt_from: int) -> None:
        """Each particle places the feature from its own pose, corrected by what the earlier sightings averaged to."""
        candidates, n = self.state.candidates, len(self.state.weights)
        room = max(self._settings.max_landmarks - self.size(), 0)
        self.state.counters["map_full"] = self.counters()["map_full"] + max(len(which) - room, 0)
        which_obs, which = which_obs[:room], which[:room]
        seen, _ = self._in_map(obs, which_obs)
        correction = candidates.xy[which] - transform(pose, obs.xy_base_m[which_obs])
        labels = self.state.maps.add(
            seen + correction[:, :, None],
            np.repeat(candidates.cov[which][:, :, None], n, axis=2),
            candidates.crossing_type[which],
            candidates.count[which],
        )
        self.state.counters["births"] += len(labels)
        self.state.maps.refresh(self.state.weights, labels, learnt_from)
        self.state.summary = None
        candidates.remove(which)

    def _resample(self) -> tuple[int, float]:
        """Draw equally weighted particles; returns the number of distinct ancestors and the fit's residual."""
        drawn = None
        self.state.counters["resamplings"] += 1
        if self._settings.method != "pf":
            drawn = self._redraw(self.state.poses, self.state.weights, self._settings.fit_degree, self.state.rng)
            self.state.counters["fit_failures"] += int(drawn is None)
        if drawn is None:
            ancestors, residual = systematic(self.state.weights, self.state.rng), float("nan")
            poses = self.state.poses[ancestors]
        else:
            poses, residual = drawn
            scale = np.maximum(
                np.sqrt(np.diagonal(mean_and_cov(self.state.poses, np.full(len(poses), 1 / len(poses)))[1])), 1e-9
            )
            ancestors = curve_fit.nearest(poses, self.state.poses, scale)
        self.state.poses = poses + self.state.rng.standard_normal(poses.shape) * REGULARISATION
        self.state.poses[:, 2] = wrap_array(self.state.poses[:, 2])
        self.state.weights = np.full(len(poses), 1.0 / len(poses))
        self.state.maps.resample(ancestors)
        return len(np.unique(ancestors)), residual
