"""Where am I? A bank of poses that a known map makes compatible with what is seen, weighed until one is left."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ceilvo.daemon.slam.pose_filter import normalised
from ceilvo.daemon.slam.spatial_index import KnownMap
from ceilvo.se2 import compose, wrap_array
from ceilvo.types import Array, Ints, Motion, Observations

MODES = 256
"""Poses kept."""
RING = 72
"""Headings tried around a single landmark."""
TRIED = 6000
"""Poses scored when seeding."""
PAIRS = 4
"""Pairs of features that seed poses; several, because one may be an outlier."""
OUTLIER = 0.05
"""Share of features that no landmark explains; higher than when tracking, for a search must survive surprises."""
OUTLIER_DENSITY_PER_M2 = 0.25
HOPELESS = 1e-9
CONVINCED = 0.999
AGREE_UPDATES = 5
"""Updates in a row that must be convinced of the same pose."""
FORGET, FEW = 0.8, 3.0
"""Poses are given up when the best explains less than half of what the last updates showed: (explained, seen), that
fade by FORGET per update; of fewer features nothing is concluded, for one may be an outlier."""
REGION_M = 6.0
"""How far rivals of a pose are looked for."""
SAME_RAD = 0.3


class Bank:
    """Pose Gaussians (M, 3), (M, 3, 3) with log-weights (M,) on a map that does not change."""

    def __init__(self, known: KnownMap, reach_m: float, rng: np.random.Generator, around: Array | None = None) -> None:
        """On the whole map, or on what lies within REGION_M of a pose."""
        self._map = known
        self._reach = reach_m
        self._rng = rng
        self._region = np.arange(len(known)) if around is None else known.near(around[None, :2], REGION_M)
        self._convinced = 0
        self._champion: Array | None = None
        self._told: Array = np.zeros(2)
        self.mean: Array = np.empty((0, 3))
        self.cov: Array = np.empty((0, 3, 3))
        self.log_weight: Array = np.empty(0)
        self.explained: Array = np.empty(0)

    def __len__(self) -> int:
        return len(self.mean)

    def rival(self, obs: Observations, pose: Array, cov: Array, chance: float) -> None:
        """Begin with a pose that is believed, and with those that a view offers instead of it.

        They were made of the view, so each gets the share of a robot being anywhere that its Gaussian covers.
        """
        self._seed(obs)
        volume = 0.5 * (np.linalg.slogdet(self.cov)[1] + 3.0 * np.log(2.0 * np.pi))
        anywhere = np.log(2.0 * np.pi * np.pi * REGION_M**2)
        self.log_weight = np.append(np.log1p(-chance), np.log(chance) + volume - anywhere)
        self.mean, self.cov = np.concatenate([pose[None], self.mean]), np.concatenate([cov[None], self.cov])
        self.explained = np.zeros(len(self))
        self.update(obs)

    def weight_at(self, pose: Array) -> float:
        """Of the modes at a pose, that is so near that they find the same landmarks."""
        return float(np.sum(normalised(self.log_weight)[self._near(pose)])) if len(self) else 0.0

    def _near(self, pose: Array) -> NDArray[np.bool_]:
        off = self.mean - pose
        near = (np.hypot(off[:, 0], off[:, 1]) < 0.5 * self._reach) & (np.abs(wrap_array(off[:, 2])) < SAME_RAD)
        return np.asarray(near, bool)

    @property
    def agreed(self) -> float:
        """Share of the updates in a row that must be convinced of one pose, 1 when they are."""
        return min(self._convinced / AGREE_UPDATES, 1.0)

    def move(self, motion: Motion) -> None:
        """Compose every pose with the motion."""
        if not len(self):
            return
        if self._champion is not None:
            self._champion = compose(self._champion, motion.prev_from_curr)
        old = self.mean
        self.mean = compose(old, motion.prev_from_curr)
        f = np.tile(np.eye(3), (len(self), 1, 1))
        f[:, 0, 2], f[:, 1, 2] = old[:, 1] - self.mean[:, 1], self.mean[:, 0] - old[:, 0]
        c, s = np.cos(old[:, 2]), np.sin(old[:, 2])
        g = np.zeros_like(f)
        g[:, 0, 0], g[:, 0, 1], g[:, 1, 0], g[:, 1, 1], g[:, 2, 2] = c, -s, s, c, 1.0
        self.cov = f @ self.cov @ f.transpose(0, 2, 1) + g @ motion.cov @ g.transpose(0, 2, 1)

    def update(self, obs: Observations) -> None:
        """Weigh all poses with a view; seed them anew where none explains it."""
        if not len(obs):
            return
        if not len(self):
            self._seed(obs)
        if not len(self):
            return
        self._weigh(obs)
        self._prune()
        best = int(np.argmax(self.log_weight))
        self._told = FORGET * self._told + np.array([self.explained[best], 1.0]) * len(obs)
        if self._told[0] < 0.5 * self._told[1] and self._told[1] > FEW:
            self.mean, self.cov, self.log_weight = self.mean[:0], self.cov[:0], self.log_weight[:0]
            self._convinced, self._told = 0, np.zeros(2)
            return
        same = self._champion is not None and bool(self._near(self._champion)[best])
        self._champion = self.mean[best].copy()
        self._convinced = (self._convinced + 1 if same else 1) if self.weight() > CONVINCED else 0

    def weight(self) -> float:
        """Of the dominant mode; 0 without any."""
        return float(np.max(normalised(self.log_weight))) if len(self) else 0.0

    def best(self) -> tuple[Array, Array]:
        i = int(np.argmax(self.log_weight))
        return self.mean[i].copy(), self.cov[i].copy()

    @property
    def found(self) -> bool:
        """Whether one pose is left and has been for some updates, so well known that tracking can take over."""
        if self._convinced < AGREE_UPDATES:
            return False
        _, cov = self.best()
        return bool(cov[0, 0] + cov[1, 1] < self._reach**2 and cov[2, 2] < 0.1**2)

    # -- weighing

    def _nearest(self, mean: Array, obs: Observations, k: int) -> Ints:
        """(M,) landmark that explains feature k in each pose, -1 for none."""
        if obs.label[k] >= 0:
            return np.full(len(mean), obs.label[k])
        c, s = np.cos(mean[:, 2]), np.sin(mean[:, 2])
        x, y = obs.xy_base_m[k]
        at = np.column_stack([mean[:, 0] + c * x - s * y, mean[:, 1] + s * x + c * y])
        return self._map.nearest(at, np.full(len(mean), obs.kind[k]), self._reach)[0]

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
        nu = self.mean[:, :2] + arm - self._map.landmarks.xy_map_m[label]
        h = np.zeros((len(self), 2, 3))
        h[:, 0, 0] = h[:, 1, 1] = 1.0
        h[:, 0, 2], h[:, 1, 2] = -arm[:, 1], arm[:, 0]
        cross = self.cov @ h.transpose(0, 2, 1)
        total = h @ cross + self._map.landmarks.cov_m2[label]
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
        information = np.linalg.inv(self.cov[order])
        log_weight = self.log_weight[order]
        for i in range(len(order)):
            if not left[i]:
                continue
            off = mean - mean[i]
            off[:, 2] = wrap_array(off[:, 2])
            near = left & (
                (np.einsum("mi,ij,mj->m", off, information[i], off) < 4.0)
                | ((off[:, 0] ** 2 + off[:, 1] ** 2 < 0.05**2) & (np.abs(off[:, 2]) < 0.05))
            )
            near[:i] = False
            log_weight[i] = np.logaddexp.reduce(log_weight[near])
            left &= ~near
            keep.append(i)
        kept = order[keep]
        self.mean, self.cov, self.log_weight = self.mean[kept], self.cov[kept], log_weight[keep]
        self.log_weight = self.log_weight - np.max(self.log_weight)
        self.explained = self.explained[kept]

    # -- seeding

    def _seed(self, obs: Observations) -> None:
        """Poses that put two features, or a single labelled one, on landmarks of their kinds."""
        mean, cov = self._from_pairs(obs)
        if not len(mean):
            mean, cov = self._ring(obs)
        if len(mean) > TRIED:
            pick = self._rng.permutation(len(mean))[:TRIED]
            mean, cov = mean[pick], cov[pick]
        self.mean, self.cov, self.log_weight = mean, cov, np.zeros(len(mean))
        self.explained = np.zeros(len(mean))

    def _candidates(self, obs: Observations, k: int) -> Ints:
        if obs.label[k] >= 0:
            return obs.label[k : k + 1]
        return np.asarray(self._region[self._map.landmarks.kind[self._region] == obs.kind[k]], np.int64)

    def _ring(self, obs: Observations) -> tuple[Array, Array]:
        """All headings around the landmarks that one feature may be."""
        counts = [len(self._candidates(obs, k)) for k in range(len(obs))]
        usable = [k for k in range(len(obs)) if counts[k]]
        if not usable:
            return np.empty((0, 3)), np.empty((0, 3, 3))
        k = min(usable, key=lambda i: (counts[i], float(np.sum(obs.var_m2[i]))))
        at = self._map.landmarks.xy_map_m[self._candidates(obs, k)]
        theta = 2.0 * np.pi * (np.arange(RING) + self._rng.random()) / RING
        poses = np.empty((len(at), RING, 3))
        c, s = np.cos(theta), np.sin(theta)
        x, y = obs.xy_base_m[k]
        poses[:, :, 0] = at[:, :1] - (c * x - s * y)
        poses[:, :, 1] = at[:, 1:] - (s * x + c * y)
        poses[:, :, 2] = wrap_array(theta)
        flat: Array = poses.reshape(-1, 3)
        return flat, self._seed_cov(flat, obs, k, (2.0 * np.pi / RING) ** 2)

    def _seed_cov(self, poses: Array, obs: Observations, k: int, heading_var: float | Array) -> Array:
        """Of a pose that turns about the landmark at feature k."""
        c, s = np.cos(poses[:, 2]), np.sin(poses[:, 2])
        x, y = obs.xy_base_m[k]
        lever = np.column_stack([s * x + c * y, -(c * x - s * y), np.ones(len(poses))])
        cov = np.asarray(lever[:, :, None] * lever[:, None, :] * np.reshape(heading_var, (-1, 1, 1)), np.float64)
        cov[:, :2, :2] += 4.0 * float(np.max(obs.var_m2[k])) * np.eye(2)
        return cov

    def _from_pairs(self, obs: Observations) -> tuple[Array, Array]:
        """Two features and two landmarks as far apart, of the same kinds."""
        counts = np.array([len(self._candidates(obs, k)) for k in range(len(obs))])
        i, j = np.triu_indices(len(obs), 1)
        apart = np.hypot(*(obs.xy_base_m[i] - obs.xy_base_m[j]).T)
        var = np.sum(obs.var_m2[i] + obs.var_m2[j], axis=1)
        sigma = np.sqrt(var)
        good = (counts[i] > 0) & (counts[j] > 0) & (apart > 4.0 * sigma)
        i, j, apart, sigma = i[good], j[good], apart[good], sigma[good]
        cost = np.log(counts[i].astype(np.float64)) + np.log(counts[j]) - 2.0 * np.log(apart / sigma)
        chosen = np.argsort(cost, kind="stable")[:PAIRS]
        found = [self._match(obs, int(i[p]), int(j[p]), float(apart[p]), float(sigma[p])) for p in chosen]
        if not found:
            return np.empty((0, 3)), np.empty((0, 3, 3))
        return np.concatenate([f[0] for f in found]), np.concatenate([f[1] for f in found])

    def _match(self, obs: Observations, i: int, j: int, apart: float, sigma: float) -> tuple[Array, Array]:
        first, second = self._candidates(obs, i), self._candidates(obs, j)
        if len(first) > TRIED // 8:
            first = self._rng.permutation(first)[: TRIED // 8]
        at = self._map.landmarks.xy_map_m
        a, b = self._as_far(first, second, apart, 3.0 * sigma)
        way, seen = at[b] - at[a], obs.xy_base_m[j] - obs.xy_base_m[i]
        theta = wrap_array(np.arctan2(way[:, 1], way[:, 0]) - np.arctan2(seen[1], seen[0]))
        c, s = np.cos(theta), np.sin(theta)
        x, y = obs.xy_base_m[i]
        poses = np.column_stack([at[a, 0] - (c * x - s * y), at[a, 1] - (s * x + c * y), theta])
        return poses, self._seed_cov(poses, obs, i, (sigma / apart) ** 2)

    def _as_far(self, first: Ints, second: Ints, apart: float, tolerance: float) -> tuple[Ints, Ints]:
        """Pairs (P,), (P,) of landmarks whose distance is as seen."""
        at, out_a, out_b = self._map.landmarks.xy_map_m, [], []
        for part in np.array_split(first, max(len(first) * len(second) // 2_000_000, 1)):
            d = np.hypot(at[part, None, 0] - at[None, second, 0], at[part, None, 1] - at[None, second, 1])
            a, b = np.nonzero(np.abs(d - apart) < tolerance)
            out_a.append(part[a])
            out_b.append(second[b])
        return np.concatenate(out_a), np.concatenate(out_b)
