"""Correspondences of point features between two frames: near the prediction, of the same kind, mutually nearest."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Ints = NDArray[np.int64]


def mutual_nearest(a: Array, kind_a: Ints, b: Array, kind_b: Ints, radius: float) -> tuple[Ints, Ints]:
    """Index pairs (i, j) of points (N, 2) and (M, 2) that are each other's nearest of their kind within a radius.

    Points and radius are in one unit; kinds are (N,) and (M,).
    """
    if len(a) == 0 or len(b) == 0:
        none = np.zeros(0, np.int64)
        return none, none
    d2 = np.subtract.outer(a[:, 0], b[:, 0]) ** 2 + np.subtract.outer(a[:, 1], b[:, 1]) ** 2
    d2[kind_a[:, None] != kind_b[None, :]] = np.inf
    j = np.argmin(d2, axis=1)
    i = np.arange(len(a))
    good = (np.argmin(d2, axis=0)[j] == i) & (d2[i, j] < radius * radius)
    return i[good], j[good]
