"""Which crossings lie on one line."""

from __future__ import annotations

import numpy as np

from ceilvo.crossing_types import LINE_CROSSINGS
from ceilvo.se2 import rotation
from ceilvo.types import Array, Ints

LINE_M = 0.04
"""Crossings that differ by less across a line lie on it: as is said of landmarks in a row, lattice.ALIGNED_M."""


def numbered(ascending_m: Array, within_m: float = LINE_M) -> Ints:
    """(N,) numbers of the lines that places (N,) across them are on, from 1; on one neighbours are within_m apart."""
    return np.asarray(np.cumsum(np.diff(ascending_m, prepend=-np.inf) > within_m))


def lines_through(xy: Array, types: Ints, axis_rad: float, within_m: float = LINE_M) -> Ints:
    """(N, 2) numbers of the lines through crossings (N, 2), along both axes; points are on none but their own."""
    across = xy @ rotation(axis_rad)
    out = np.empty((len(xy), 2), np.int64)
    for axis in (0, 1):
        order = np.argsort(across[:, axis], kind="stable")
        out[order, axis] = numbered(across[order, axis], within_m)
    point = np.flatnonzero(types >= LINE_CROSSINGS)
    out[point] = len(xy) + 1 + np.arange(len(point))[:, None]
    return out
