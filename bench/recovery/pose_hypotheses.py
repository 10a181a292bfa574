"""Poses that a map makes compatible with what is seen, weighed until one is left."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from ceilvo.bench.recovery.pose_search import poses_from_view
from ceilvo.daemon.slam.association import OUTLIER_DENSITY_PER_M2
from ceilvo.daemon.slam.pose_filter import normalised
from ceilvo.daemon.slam.spatial_index import IndexedMap
from ceilvo.se2 import compose, wrap_array
from ceilvo.types import Array, Ints, Motion, Observations

MODES = 256
"""Poses kept; chosen for time. In rooms of 15 m the true one may be dropped before a lamp is seen."""
OUTLIER = 0.05
"""Fraction of features that no landmark explains; higher than when tracking, for a ceiling may have changed."""
_LEAST_VAR = 1e-14
"""Added to variances that may be zero, m^2 and rad^2: of a tenth of a micrometre."""
HOPELESS = 1e-9
"""A pose of less weight is forgotten."""
CONVINCED = 0.999
"""Weight from which an update is convinced of a pose; chosen."""
AGREE_UPDATES = 5
"""Updates in a row that must be convinced of the same pose."""
FORGET, FEW = 0.8, 3.0
"""Poses are given up when the best explains less than half of what the last updates showed: (explained, seen), that
fade by FORGET per update; of fewer features nothing is concluded, for one may be an outlier."""
FOUND_SIGMA_RAD = 0.1
"""A pose with a larger sigma of heading is not found yet; chosen: features at 2 m would be 0.2 m off."""
MERGED_M, MERGED_RAD = 0.05, 0.05
"""Poses nearer to each other have become one; far less than the association gate."""
REGION_M = 6.0
"""How far alternatives to a pose are looked for."""
SAME_RAD = 0.3
"""Headings that differ by less find the same landmarks within the association gate; chosen."""


@dataclass(slots=True)
class PoseHypotheses:
    """Pose Gaussians with log-weights on a map that does not change.

    Attributes:
        map: where the robot is looked for.
        reach_m: a feature within it of a landmark of its type may be that landmark.
        region: labels of the landmarks that seed poses.
        convinced: updates in a row that were convinced of the champion.
        champion: (3,) the pose with most of the weight.
        fading: (2,) features explained and seen, fading by FORGET per update.
        mean, cov, log_weight: (M, 3), (M, 3, 3) and (M,).
        explained: (M,) fraction of the last view that each explains.
    """

    map: IndexedMap
    reach_m: float
    region: Ints
    convinced: int = 0
    champion: Array | None = None
    fading: Array = field(default_factory=lambda: np.zeros(2))
    mean: Array = field(default_factory=lambda: np.empty((0, 3)))
    cov: Array = field(default_factory=lambda: np.empty((0, 3, 3)))
    log_weight: Array = field(default_factory=lambda: np.empty(0))
    explained: Array = field(default_factory=lambda: np.empty(0))

    @staticmethod
    def on(known: IndexedMap, reach_m: float, around: Array | None = None) -> PoseHypotheses:
        """On the whole map, or on what lies within REGION_M of a pose (3,)."""
        region = np.arange(len(known)) if around is None else known.near(around[None, :2], REGION_M)
        return PoseHypotheses(known, reach_m, region)

    def __len__(self) -> int:
        return len(self.mean)

    def challenge(self, obs: Observations, pose: Array, cov: Array, chance: float, rng: np.random.Generator) -> None:
        """Begin with a pose that is believed, and with those that a view offers instead of it.

        They were made of the view, so each gets the fraction of a robot being anywhere that its Gaussian covers.
        """
        self._seed(obs, rng)
        volume = 0.5 * (np.linalg.slogdet(self.cov)[1] + 3.0 * np.log(2.0 * np.pi))
        anywhere = np.log(2.0 * np.pi * np.pi * REGION_M**2)
        self.log_weight = np.append(np.log1p(-chance), np.log(chance) + volume - anywhere)
        self.mean, self.cov = np.concatenate([pose[None], self.mean]), np.concatenate([cov[None], self.cov])
        self.explained = np.zeros(len(self))
        self.update(obs, rng)

    def _seed(self, obs: Observations, rng: np.random.Generator) -> None:
        self.mean, self.cov = poses_from_view(self.map, self.region, obs, rng)
        self.log_weight, self.explained = np.zeros(len(self.mean)), np.zeros(len(self.mean))

    def weight_at(self, pose: Array) -> float:
        """Of the modes at a pose, that is so near that they find the same landmarks."""
        return float(np.sum(normalised(self.log_weight)[self._near(pose)])) if len(self) else 0.0

    def _near(self, pose: Array) -> NDArray[np.bool_]:
        off = self.mean - pose
        near = (np.hypot(off[:, 0], off[:, 1]) < 0.5 * self.reach_m) & (np.abs(wrap_array(off[:, 2])) < SAME_RAD)
        return np.asarray(near, bool)

    @property
    def agreed(self) -> float:
        """Fraction of the updates in a row that must be convinced of one pose, 1 when they are."""
        return min(self.convinced / AGREE_UPDATES, 1.0)

    def move(self, motion: Motion) -> None:
        """Compose every pose with the motion."""
        if not len(self):
            return
        if self.champion is not None:
            self.champion = compose(self.champion, motion.prev_from_curr)
        old = self.mean
        self.mean = compose(old, motion.prev_from_curr)
        f = np.tile(np.eye(3), (len(self), 1, 1))
        f[:, 0, 2], f[:, 1, 2] = old[:, 1] - self.mean[:, 1], self.mean[:, 0] - old[:, 0]
        c, s = np.cos(old[:, 2]), np.sin(old[:, 2])
        g = np.zeros_like(f)
        g[:, 0, 0], g[:, 0, 1], g[:, 1, 0], g[:, 1, 1], g[:, 2, 2] = c, -s, s, c, 1.0
        self.cov = f @ self.cov @ f.transpose(0, 2, 1) + g @ motion.cov @ g.transpose(0, 2, 1)

    def update(self, obs: Observations, rng: np.random.Generator) -> None:
        """Weigh all poses with a view; seed them anew where none explains it."""
        if not len(obs):
            return
        if not len(self):
            self._seed(obs, rng)
        if not len(self):
            return
        self._weigh(obs)
        self._prune()
        best = int(np.argmax(self.log_weight))
        self.fading = FORGET * self.fading + np.array([self.explained[best], 1.0]) * len(obs)
        if self.fading[0] < 0.5 * self.fading[1] and self.fading[1] > FEW:
            self.mean, self.cov, self.log_weight = self.mean[:0], self.cov[:0], self.log_weight[:0]
            self.convinced, self.fading = 0, np.zeros(2)
            return
        same = self.champion is not None and bool(self._near(self.champion)[best])
        self.champion = self.mean[best].copy()
        self.convinced = (self.convinced + 1 if same else 1) if self.weight() > CONVINCED else 0

    def weight(self) -> float:
        """Of the dominant mode; 0 without any."""
        return float(np.max(normalised(self.log_weight))) if len(self) else 0.0

    def best(self) -> tuple[Array, Array]:
        i = int(np.argmax(self.log_weight))
        return self.mean[i].copy(), self.cov[i].copy()

    @property
    def found(self) -> bool:
        """Whether one pose is left and has been for some updates, so well known that tracking can take over."""
        if self.convinced < AGREE_UPDATES:
            return False
        _, cov = self.best()
        return bool(cov[0, 0] + cov[1, 1] < self.reach_m**2 and cov[2, 2] < FOUND_SIGMA_RAD**2)

    # -- weighing

    def _nearest(self, mean: Array, obs: Observations, k: int) -> Ints:
        """(M,) landmark that explains feature k in each pose, -1 for none."""
        if obs.label[k] >= 0:
            return np.full(len(mean), obs.label[k])
        c, s = np.cos(mean[:, 2]), np.sin(mean[:, 2])
        x, y = obs.xy_base_m[k]
        at = np.column_stack([mean[:, 0] + c * x - s * y, mean[:, 1] + s * x + c * y])
        return self.map.nearest(at, np.full(len(mean), obs.crossing_type[k]), self.reach_m)[0]

    def _weigh(self, obs: Observations) -> None:
        """One feature after the other, surest first: evidence and Kalman update of every pose."""
        order = np.argsort(np.sum(obs.var_m2, axis=1), kind="stable")
        explained = np.zeros(len(self))
        for k in order:
            explained += self._absorb(obs, int(k))
        self.explained = explained / max(len(obs), 1)
        if np.isfinite(obs.heading_var_rad2) and obs.heading_var_rad2 > 0.0:
            self._absorb_heading(obs.heading_rad, obs.heading_var_rad2)

    def _absorb(self, obs: Observations, k: int) -> NDArray[np.bool_]:
        label = self._nearest(self.mean, obs, k)
        c, s = np.cos(self.mean[:, 2]), np.sin(self.mean[:, 2])
        x, y = obs.xy_base_m[k]
        vx, vy = obs.var_m2[k]
        arm = np.column_stack([c * x - s * y, s * x + c * y])
        nu = self.mean[:, :2] + arm - self.map.landmarks.xy_map_m[label]
        h = np.zeros((len(self), 2, 3))
        h[:, 0, 0] = h[:, 1, 1] = 1.0
        h[:, 0, 2], h[:, 1, 2] = -arm[:, 1], arm[:, 0]
        cross = self.cov @ h.transpose(0, 2, 1)
        total = h @ cross + self.map.landmarks.cov_m2[label]
        total[:, 0, 0] += c * c * vx + s * s * vy
        total[:, 1, 1] += s * s * vx + c * c * vy
        total[:, 0, 1] += c * s * (vx - vy)
        total[:, 1, 0] += c * s * (vx - vy)
        inverse = np.linalg.inv(total)
        chi2 = np.einsum("mi,mij,mj->m", nu, inverse, nu)
        log_inlier = np.log1p(-OUTLIER) - 0.5 * (chi2 + np.log(np.linalg.det(total))) - np.log(2.0 * np.pi)
        log_outlier = np.log(OUTLIER * OUTLIER_DENSITY_PER_M2)
        log_inlier[label < 0] = -np.inf
        self.log_weight = self.log_weight + np.logaddexp(log_inlier, log_outlier)
        use = log_inlier > log_outlier
        gain = (cross @ inverse) * use[:, None, None]
        self.mean = self.mean - np.einsum("mij,mj->mi", gain, nu)
        self.mean[:, 2] = wrap_array(self.mean[:, 2])
        cov = self.cov - gain @ cross.transpose(0, 2, 1)
        self.cov = 0.5 * (cov + cov.transpose(0, 2, 1))
        return np.asarray(use, bool)

    def _absorb_heading(self, heading: float, var: float) -> None:
        nu = wrap_array(heading - self.mean[:, 2])
        total = self.cov[:, 2, 2] + var
        inlier = np.log1p(-OUTLIER) - 0.5 * (nu * nu / total + np.log(2.0 * np.pi * total))
        outlier = np.log(OUTLIER / (2.0 * np.pi))
        self.log_weight = self.log_weight + np.logaddexp(inlier, outlier)
        gain = self.cov[:, :, 2] / total[:, None] * (inlier > outlier)[:, None]
        self.mean = self.mean + gain * nu[:, None]
        self.mean[:, 2] = wrap_array(self.mean[:, 2])
        self.cov = self.cov - gain[:, :, None] * self.cov[:, None, 2, :]

    def _prune(self) -> None:
        """Forget hopeless poses and put together those that have become one, best first."""
        w = normalised(self.log_weight)
        order = np.argsort(-w, kind="stable")[:MODES]
        order = order[w[order] > HOPELESS]
        mean, left, keep = self.mean[order], np.ones(len(order), bool), []
        information = np.linalg.inv(self.cov[order] + _LEAST_VAR * np.eye(3))
        log_weight = self.log_weight[order]
        for i in range(len(order)):
            if not left[i]:
                continue
            off = mean - mean[i]
            off[:, 2] = wrap_array(off[:, 2])
            near = left & (
                (np.einsum("mi,ij,mj->m", off, information[i], off) < 4.0)
                | ((off[:, 0] ** 2 + off[:, 1] ** 2 < MERGED_M**2) & (np.abs(off[:, 2]) < MERGED_RAD))
            )
            near[:i] = False
            log_weight[i] = np.logaddexp.reduce(log_weight[near])
            left &= ~near
            keep.append(i)
        kept = order[keep]
        self.mean, self.cov, self.log_weight = self.mean[kept], self.cov[kept], log_weight[keep]
        self.log_weight = self.log_weight - np.max(self.log_weight)
        self.explained = self.explained[kept]
