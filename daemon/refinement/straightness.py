"""Joints of a ceiling are straight: landmarks one after the other on a line differ along it only."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ceilvo.types import Array, Ints

_APART_M = 0.015
"""Landmarks of one line differ by less across it, from one to the next; chosen: grids are laid to some mm."""
_REACH_M = 2.6
"""And by less along it; chosen: two tiles of 1.2 m, where one is hidden by a lamp."""
_SIGMA_M = 2e-3
"""Standard deviation across, from one landmark to the next of a line; chosen: a T-bar's joint. So a line of 66 tiles
may wander by 16 mm."""


@dataclass(frozen=True)
class Rows:
    """Pairs of landmarks on one line: pair (T, 2), the axis of its normal (T,), and sigma_m (T,) across."""

    pair: Ints
    axis: Ints
    sigma_m: Array


def rows_of(xy_m: Array, axis_rad: float, crossings: NDArray[np.bool_]) -> Rows:
    """The next landmark along each line of either axis.

    Args:
        xy_m: (L, 2).
        axis_rad: direction of the normal of axis 0 in map.
        crossings: (L,) bool, of those that lie on lines.
    """
    pairs, axes = [], []
    which = np.flatnonzero(crossings)
    for axis in (0, 1):
        angle = axis_rad + 0.5 * np.pi * axis
        across = xy_m[which] @ np.array([np.cos(angle), np.sin(angle)])
        along = xy_m[which] @ np.array([-np.sin(angle), np.cos(angle)])
        order = np.argsort(across)
        lane = np.empty(len(which), np.int64)
        lane[order] = np.cumsum(np.diff(across[order], prepend=-np.inf) > _APART_M)
        walk = np.lexsort((along, lane))
        a, b = walk[:-1], walk[1:]
        near = (
            (lane[a] == lane[b])
            & (along[b] - along[a] < _REACH_M)
            & (along[b] - along[a] > _APART_M)
            & (np.abs(across[b] - across[a]) < _APART_M)
        )
        pairs.append(np.column_stack([which[a[near]], which[b[near]]]))
        axes.append(np.full(np.count_nonzero(near), axis))
    pair = np.concatenate(pairs).astype(np.int64)
    return Rows(pair, np.concatenate(axes).astype(np.int64), np.full(len(pair), _SIGMA_M))
