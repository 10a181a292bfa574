"""Landmarks with a spatial index, so that looking at a map costs what is in view."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from ceilvo.types import Array, Ints, Landmarks

CELL_M = 1.0
"""Side of a cell; chosen: a view of 2 m touches about ten."""
_SIDE = 1 << 20
"""Cells are numbered row by row; no building is a million cells wide."""


@dataclass(slots=True)
class IndexedMap:
    """Landmarks in square cells; near() and nearest() look at the cells around a point only.

    Attributes:
        landmarks: the map; it does not change.
        cell_m: side of a cell.
        packed: (L, 3) covariances xx, xy, yy.
    """

    landmarks: Landmarks
    cell_m: float = CELL_M
    packed: Array = field(init=False)
    _order: Ints = field(init=False)
    _sorted: Ints = field(init=False)

    def __post_init__(self) -> None:
        self.packed = packed(self.landmarks.cov_m2)
        cell = self._numbers(self._cells(self.landmarks.xy_map_m))
        self._order = np.argsort(cell, kind="stable").astype(np.int64)
        self._sorted = cell[self._order]

    def __len__(self) -> int:
        return len(self.landmarks)

    def _cells(self, xy: Array) -> Ints:
        return np.floor(np.clip(xy / self.cell_m, -_SIDE / 2, _SIDE / 2 - 1)).astype(np.int64) + _SIDE // 2

    @staticmethod
    def _numbers(cells: Ints) -> Ints:
        return np.asarray(cells[..., 0] * _SIDE + cells[..., 1], np.int64)

    def near(self, xy_m: Array, reach_m: float) -> Ints:
        """Labels, in order, of all landmarks in cells within reach of the box around the points (M, 2)."""
        if not len(xy_m):
            return np.empty(0, np.int64)
        low = self._cells(np.min(xy_m, axis=0) - reach_m)
        high = self._cells(np.max(xy_m, axis=0) + reach_m)
        columns = np.arange(low[0], high[0] + 1)
        if len(columns) > len(self) + 1:
            return np.arange(len(self))
        start = np.searchsorted(self._sorted, columns * _SIDE + low[1], side="left")
        stop = np.searchsorted(self._sorted, columns * _SIDE + high[1], side="right")
        return np.sort(np.concatenate([self._order[a:b] for a, b in zip(start, stop, strict=True)]))

    def nearest(self, xy_m: Array, kind: Ints, reach_m: float) -> tuple[Ints, Array]:
        """For each point (Q, 2) the label of the nearest landmark of its kind (Q,), or -1, and its distance [m]."""
        best, label = np.full(len(xy_m), np.inf), np.full(len(xy_m), -1, np.int64)
        at, kinds = self.landmarks.xy_map_m, self.landmarks.crossing_type
        low, high = self._cells(xy_m - reach_m), self._cells(xy_m + reach_m)
        for column in range(int(np.max(high[:, 0] - low[:, 0], initial=-1)) + 1):
            x = np.minimum(low[:, 0] + column, high[:, 0]) * _SIDE
            start = np.searchsorted(self._sorted, x + low[:, 1], side="left")
            stop = np.searchsorted(self._sorted, x + high[:, 1], side="right")
            for i in range(int(np.max(stop - start, initial=0))):
                q = np.flatnonzero(start + i < stop)
                m = self._order[start[q] + i]
                d = np.hypot(at[m, 0] - xy_m[q, 0], at[m, 1] - xy_m[q, 1])
                closer = (d < best[q]) & (kinds[m] == kind[q])
                best[q[closer]], label[q[closer]] = d[closer], m[closer]
        label[best > reach_m] = -1
        return label, best

    def repeated(self, labels: Ints) -> tuple[Array, Array]:
        """(K, 2, 1) means and (K, 3, 1) covariances: the same for every particle."""
        return self.landmarks.xy_map_m[labels][:, :, None], self.packed[labels][:, :, None]


def packed(cov: Array) -> Array:
    """(M, 3) xx, xy, yy of covariances (M, 2, 2)."""
    return cov.reshape(-1, 4)[:, [0, 1, 3]]


def unpacked(packed: Array) -> Array:
    """(M, 2, 2) from (M, 3)."""
    return packed[:, [0, 1, 1, 2]].reshape(-1, 2, 2)
