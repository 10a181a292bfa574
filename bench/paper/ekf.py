"""Baseline: joint Kalman filter over pose and landmarks, nearest neighbour within half a tile and a chi-square gate.

Written for the bench alone and as plain as such filters are: one hypothesis, no recovery, no heavy tails. It wants no
labels: the observations of one frame take their nearest landmarks of the same kind by Mahalanobis distance, each
landmark once.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ceilvo.daemon.slam.pose_filter import COUNTERS
from ceilvo.daemon.slam.spatial_index import landmarks_near
from ceilvo.se2 import rotation, transform, wrap
from ceilvo.types import Array, FilterHealth, Ints, Landmarks, Motion, Observations

GATE = 11.83
"""Chi-square of two degrees of freedom, 99.73 %."""
NEAR_M = 0.30
"""A landmark farther away is another one: half a tile."""
NEW_M = 0.40
"""Farther than this from every landmark of its kind an observation is a new one."""
CONFIRMED = 3  # sightings; chosen, usual for nearest neighbour: a single outlier makes no landmark
FORGET_UPDATES = 20  # 4 s; chosen: 1.4 m of the lap, less than the view


class EkfNearestNeighbour:
    """PoseFilter; a landmark is shown from its third sighting, and dropped when not confirmed within 20 updates."""

    state: Any = None
    """It is never stored."""

    def __init__(self, gate: float = GATE) -> None:
        self._gate = gate
        self.reset(np.zeros(3), np.zeros((3, 3)))

    def reset(self, pose: Array, cov: Array, landmarks: Landmarks | None = None, known: bool = False) -> None:
        self._known = known
        count = 0 if landmarks is None else len(landmarks)
        self._x = np.concatenate([pose, np.zeros(2 * count)])
        self._p = np.zeros((len(self._x), len(self._x)))
        self._p[:3, :3] = cov
        self._kind: Ints = np.zeros(count, np.int64)
        self._sightings: Ints = np.full(count, CONFIRMED, np.int64)
        self._age: Ints = np.zeros(count, np.int64)
        self._nis, self._dof = 0.0, 0
        if landmarks is not None and count:
            self._x[3:] = landmarks.xy_map_m.ravel()
            self._kind = landmarks.crossing_type.copy()
            for i, c in enumerate(landmarks.cov_m2):
                self._p[3 + 2 * i : 5 + 2 * i, 3 + 2 * i : 5 + 2 * i] = c

    def predict(self, motion: Motion) -> None:
        c, s = np.cos(self._x[2]), np.sin(self._x[2])
        dx, dy, dt = motion.prev_from_curr
        f = np.array([[1.0, 0.0, -s * dx - c * dy], [0.0, 1.0, c * dx - s * dy], [0.0, 0.0, 1.0]])
        g = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
        self._x[:3] += [c * dx - s * dy, s * dx + c * dy, dt]
        self._x[2] = wrap(self._x[2])
        self._p[:3] = f @ self._p[:3]
        self._p[:, :3] = self._p[:, :3] @ f.T
        self._p[:3, :3] += g @ motion.cov @ g.T

    def update(self, obs: Observations, learnt_from: int = 0) -> None:
        """As PoseFilter.update, but for learnt_from: the rival is never in doubt of its place, and all is learnt."""
        self._age += 1
        self._nis, self._dof = 0.0, 0
        if np.isfinite(obs.heading_var_rad2):
            h = np.zeros((1, len(self._x)))
            h[0, 2] = 1.0
            self._correct(h, np.array([wrap(obs.heading_rad - self._x[2])]), np.array([[obs.heading_var_rad2]]))
        pairs, fresh = self._associate(obs)
        for i, landmark in pairs:
            self._see(obs, i, landmark)
        if not self._known:
            for i in fresh:
                self._add(obs, i)
            self._forget()
        self._nis /= max(self._dof, 1)

    def estimate(self) -> tuple[Array, Array, FilterHealth]:
        return self._x[:3].copy(), self._p[:3, :3].copy(), FilterHealth(1, 1.0, 1, float("nan"), self._nis, self._dof)

    def landmarks(self) -> Landmarks:
        show = np.flatnonzero(self._sightings >= CONFIRMED)
        cov = np.array([self._p[3 + 2 * i : 5 + 2 * i, 3 + 2 * i : 5 + 2 * i] for i in show]).reshape(-1, 2, 2)
        xy = self._x[3:].reshape(-1, 2)[show]
        return Landmarks(show.astype(np.int64), xy, cov, self._kind[show], self._sightings[show])

    def jump(self, pose: Array, cov: Array) -> None:
        self.reset(pose, cov, self.landmarks())

    def forget(self, ids: Ints, newborn: bool = False) -> None:
        """As PoseFilter.forget; the ids of the others change, for they are their places in the list."""
        if not self._known:
            gone = np.isin(np.arange(len(self._kind)), ids) | (newborn & (self._sightings < CONFIRMED))
            self._keep(~gone)

    def next_id(self) -> int:
        return len(self._kind)

    def carry(self, first_id: int, there_from_here: Array) -> Landmarks:
        """Never asked: the rival is never in doubt of its place."""
        raise NotImplementedError

    def size(self) -> int:
        return len(self.landmarks())

    def landmarks_near(self, xy_m: Array, reach_m: float) -> tuple[Ints, Landmarks]:
        return landmarks_near(self.landmarks(), xy_m, reach_m)

    def particles(self) -> tuple[Array, Array]:
        return self._x[None, :3].copy(), np.ones(1)

    def counters(self) -> Mapping[str, int]:
        return dict.fromkeys(COUNTERS, 0)

    def _associate(self, obs: Observations) -> tuple[list[tuple[int, int]], list[int]]:
        """Pairs (observation, landmark), best first, and the observations that are far from all."""
        distance = np.full((len(obs), len(self._kind)), np.inf)
        apart = self._apart(obs)
        for i in range(len(obs)):
            for j in np.flatnonzero(apart[i] < NEAR_M):
                h, innovation, r = self._model(obs, i, int(j))
                s = h @ self._local(int(j)) @ h.T + r
                distance[i, j] = innovation @ np.linalg.solve(s, innovation)
        nearest = np.min(apart, axis=1, initial=np.inf)
        pairs: list[tuple[int, int]] = []
        left = distance.copy()
        while left.size and np.min(left) < self._gate:
            row, column = (int(k) for k in np.unravel_index(np.argmin(left), left.shape))
            pairs.append((row, column))
            left[row], left[:, column] = np.inf, np.inf
        return pairs, [i for i in range(len(obs)) if nearest[i] > NEW_M]

    def _apart(self, obs: Observations) -> Array:
        """(K, L) m between where an observation falls and the landmarks; infinite for another kind."""
        at = transform(self._x[:3], obs.xy_base_m)
        off = at[:, None] - self._x[3:].reshape(-1, 2)
        return np.where(obs.crossing_type[:, None] == self._kind, np.hypot(off[..., 0], off[..., 1]), np.inf)

    def _model(self, obs: Observations, i: int, j: int) -> tuple[Array, Array, Array]:
        """Jacobian (2, 5) by pose and landmark, innovation (2,) and noise (2, 2), in base."""
        turn = rotation(self._x[2]).T
        d = self._x[3 + 2 * j : 5 + 2 * j] - self._x[:2]
        at = turn @ d
        h = np.column_stack([-turn, [at[1], -at[0]], turn])
        return h, obs.xy_base_m[i] - at, np.diag(obs.var_m2[i])

    def _local(self, j: int) -> Array:
        index = [0, 1, 2, 3 + 2 * j, 4 + 2 * j]
        return self._p[np.ix_(index, index)]

    def _see(self, obs: Observations, i: int, j: int) -> None:
        h5, innovation, r = self._model(obs, i, j)
        s = h5 @ self._local(j) @ h5.T + r
        nis = float(innovation @ np.linalg.solve(s, innovation))
        if nis >= self._gate:
            return  # an earlier observation of this frame has moved the estimate
        self._nis, self._dof = self._nis + nis, self._dof + 2
        h = np.zeros((2, len(self._x)))
        h[:, :3], h[:, 3 + 2 * j : 5 + 2 * j] = h5[:, :3], h5[:, 3:]
        self._correct(h, innovation, r)
        self._sightings[j] += 1
        self._age[j] = 0

    def _correct(self, h: Array, innovation: Array, r: Array) -> None:
        ph = self._p @ h.T
        gain = np.linalg.solve(h @ ph + r, ph.T).T
        self._x += gain @ innovation
        self._x[2] = wrap(self._x[2])
        self._p -= gain @ ph.T
        self._p = 0.5 * (self._p + self._p.T)

    def _add(self, obs: Observations, i: int) -> None:
        turn = rotation(self._x[2])
        offset = turn @ obs.xy_base_m[i]
        g = np.column_stack([np.eye(2), [-offset[1], offset[0]]])
        cross = g @ self._p[:3]
        own = g @ self._p[:3, :3] @ g.T + turn @ np.diag(obs.var_m2[i]) @ turn.T
        self._p = np.block([[self._p, cross.T], [cross, own]])
        self._x = np.concatenate([self._x, self._x[:2] + offset])
        self._kind = np.append(self._kind, obs.crossing_type[i])
        self._sightings, self._age = np.append(self._sightings, 1), np.append(self._age, 0)

    def _forget(self) -> None:
        keep = (self._sightings >= CONFIRMED) | (self._age <= FORGET_UPDATES)
        if not np.all(keep):
            self._keep(keep)

    def _keep(self, keep: NDArray[np.bool_]) -> None:
        rows = np.concatenate([np.ones(3, bool), np.repeat(keep, 2)])
        self._x, self._p = self._x[rows], self._p[np.ix_(rows, rows)]
        self._kind, self._sightings, self._age = self._kind[keep], self._sightings[keep], self._age[keep]
