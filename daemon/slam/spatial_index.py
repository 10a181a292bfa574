"""Landmarks by where they are, so that looking at a map costs what is in view."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ceilvo.types import Array, Ints, Landmarks

CELL_M = 1.0
"""Side of a cell; chosen: a view of 2 m touches about ten."""
CHANGING_CELL_M = 3.0
"""Side of a cell of a map that changes; chosen: a view touches about four, and a cell takes some 190 bytes beside 4
of each landmark."""
_SIDE = 1 << 20
"""Cells are numbered row by row; no building is a million cells wide."""


def _cells(xy: Array, cell_m: float) -> Ints:
    return np.floor(np.clip(xy / cell_m, -_SIDE / 2, _SIDE / 2 - 1)).astype(np.int64) + _SIDE // 2


def _numbers(cells: Ints) -> Ints:
    return np.asarray(cells[..., 0] * _SIDE + cells[..., 1], np.int64)


Labels = NDArray[np.int32]


@dataclass(slots=True)
class IndexedMap:
    """Landmarks in square cells; near() and nearest() look at the cells around a point only.

    Attributes:
        landmarks: the map; it does not change.
        cell_m: side of a cell.
        packed: (L, 3) covariances xx, xy, yy.
        next_id: the least that no landmark has reached.
    """

    landmarks: Landmarks
    cell_m: float = CELL_M
    packed: Array = field(init=False)
    next_id: int = field(init=False)
    _order: Ints = field(init=False)
    _sorted: Ints = field(init=False)

    def __post_init__(self) -> None:
        self.packed = packed(self.landmarks.cov_m2)
        self.next_id = int(np.max(self.landmarks.ids, initial=-1)) + 1
        cell = _numbers(_cells(self.landmarks.xy_map_m, self.cell_m))
        self._order = np.argsort(cell, kind="stable").astype(np.int64)
        self._sorted = cell[self._order]

    def __len__(self) -> int:
        return len(self.landmarks)

    def near(self, xy_m: Array, reach_m: float) -> Ints:
        """Labels, in order, of all landmarks in cells within reach of the box around the points (M, 2)."""
        if not len(xy_m):
            return np.empty(0, np.int64)
        low = _cells(np.min(xy_m, axis=0) - reach_m, self.cell_m)
        high = _cells(np.max(xy_m, axis=0) + reach_m, self.cell_m)
        columns = np.arange(low[0], high[0] + 1)
        if len(columns) > len(self) + 1:
            return np.arange(len(self))
        start = np.searchsorted(self._sorted, columns * _SIDE + low[1], side="left")
        stop = np.searchsorted(self._sorted, columns * _SIDE + high[1], side="right")
        return np.sort(np.concatenate([self._order[a:b] for a, b in zip(start, stop, strict=True)]))

    def landmarks_near(self, xy_m: Array, reach_m: float) -> tuple[Ints, Landmarks]:
        """near(), with the landmarks."""
        labels = self.near(xy_m, reach_m)
        return labels, self.landmarks.of(labels)

    def nearest(self, xy_m: Array, kind: Ints, reach_m: float) -> tuple[Ints, Array]:
        """For each point (Q, 2) the label of the nearest landmark of its kind (Q,), or -1, and its distance [m]."""
        best, label = np.full(len(xy_m), np.inf), np.full(len(xy_m), -1, np.int64)
        at, kinds = self.landmarks.xy_map_m, self.landmarks.crossing_type
        low, high = _cells(xy_m - reach_m, self.cell_m), _cells(xy_m + reach_m, self.cell_m)
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


class ChangingIndex:
    """Labels of points by square cell, kept while points come and go at the cost of those that do.

    It is made from all points when it is first asked; a copy begins anew.
    """

    __slots__ = ("_labels",)

    def __init__(self) -> None:
        self._labels: dict[int, Labels] | None = None

    def __deepcopy__(self, memo: Any) -> ChangingIndex:
        return ChangingIndex()

    @property
    def made(self) -> bool:
        return self._labels is not None

    def make(self, labels: Ints, xy_m: Array) -> None:
        """Of points (N, 2) and their labels (N,), and of no others."""
        number = _numbers(_cells(xy_m, CHANGING_CELL_M))
        order = np.argsort(number, kind="stable")
        cells, start = np.unique(number[order], return_index=True)
        self._labels = dict(zip(cells.tolist(), np.split(labels[order].astype(np.int32), start[1:]), strict=False))

    def add(self, labels: Ints, xy_m: Array) -> None:
        """Points (N, 2) that are new."""
        if self._labels is None:
            return
        for cell, label in zip(_numbers(_cells(xy_m, CHANGING_CELL_M)).tolist(), labels.astype(np.int32), strict=True):
            here = self._labels.get(cell)
            self._labels[cell] = np.array([label]) if here is None else np.append(here, label)

    def remove(self, labels: Ints, xy_m: Array) -> None:
        """Points (N, 2) where they were when they came."""
        if self._labels is None:
            return
        for cell, label in zip(_numbers(_cells(xy_m, CHANGING_CELL_M)).tolist(), labels, strict=True):
            left = self._labels[cell][self._labels[cell] != label]
            if len(left):
                self._labels[cell] = left
            else:
                del self._labels[cell]

    def near(self, low_m: Array, high_m: Array) -> Ints:
        """Labels, in any order, in the cells that a box touches."""
        if not self._labels:
            return np.empty(0, np.int64)
        (x0, y0), (x1, y1) = (_cells(corner, CHANGING_CELL_M).tolist() for corner in (low_m, high_m))
        if (x1 - x0 + 1) * (y1 - y0 + 1) > len(self._labels):
            found = list(self._labels.values())
        else:
            cells = (x * _SIDE + y for x in range(x0, x1 + 1) for y in range(y0, y1 + 1))
            found = [self._labels[c] for c in cells if c in self._labels]
        return np.concatenate(found).astype(np.int64) if found else np.empty(0, np.int64)


def in_box(at_m: Array, low_m: Array, high_m: Array) -> NDArray[np.bool_]:
    """(N,) which points (N, 2) are in a box."""
    return np.asarray(np.all((at_m >= low_m) & (at_m <= high_m), axis=1))


def landmarks_near(landmarks: Landmarks, xy_m: Array, reach_m: float) -> tuple[Ints, Landmarks]:
    """Of a map without an index: labels and landmarks within reach of the box around the points (M, 2)."""
    if not len(xy_m):
        return np.empty(0, np.int64), landmarks.of(np.empty(0, np.int64))
    low, high = np.min(xy_m, axis=0) - reach_m, np.max(xy_m, axis=0) + reach_m
    labels = np.flatnonzero(in_box(landmarks.xy_map_m, low, high))
    return labels, landmarks.of(labels)


def packed(cov: Array) -> Array:
    """(M, 3) xx, xy, yy of covariances (M, 2, 2)."""
    return cov.reshape(-1, 4)[:, [0, 1, 3]]


def unpacked(packed: Array) -> Array:
    """(M, 2, 2) from (M, 3)."""
    return packed[:, [0, 1, 1, 2]].reshape(-1, 2, 2)
