"""A view at the four headings that the direction of the ceiling's lines leaves."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ceilvo.crossing_types import CROSSING_TYPES, turned_type
from ceilvo.daemon.relocalisation.kernel.arguments import Fine
from ceilvo.daemon.relocalisation.place_index.blocks import BLOCK_BITS, CELL_M, FINE_BITS, fine
from ceilvo.daemon.relocalisation.place_index.type_grid import Bits, reached
from ceilvo.se2 import rotation, wrap
from ceilvo.types import Array, Ints, Observations

TURNS = 4
"""Headings that the direction of the lines leaves."""
SIDE = 1 << BLOCK_BITS
"""Cells of a block's side."""
ALL_TYPES = np.uint16((1 << CROSSING_TYPES) - 1)


@dataclass(frozen=True, slots=True)
class TurnedViews:
    """Features along the map's axes, as offsets from the robot.

    Attributes:
        heading_rad: (4,) of the robot in the map.
        xy: (4, K, 2) offsets.
        kind: (4, K) types in the map's quadrant, as int32.
        unseen: (4, W, H) bits of the types that are not seen in a cell though they would be, with a block's width of
            zeros around; whole blocks in size; (4, 0, 0) where it is not known what is in view.
        corner: (4, 2) offset of the lower corner of unseen[:, 0, 0].
    """

    heading_rad: Array
    xy: Fine
    kind: Fine
    unseen: Bits
    corner: Fine

    @staticmethod
    def of(view: Observations, reach_m: float) -> TurnedViews:
        heading = [wrap(view.heading_rad - 0.5 * np.pi * turn) for turn in range(TURNS)]
        xy = np.array([view.xy_base_m @ rotation(h).T for h in heading])
        kind = np.array([turned_type(view.crossing_type, turn) for turn in range(TURNS)])
        corners = np.array([view.visible_m @ rotation(h).T for h in heading])
        low, shape = _frame(corners)
        seen = [_unseen(xy[t], kind[t], corners[t], low[t], shape, reach_m) for t in range(TURNS)]
        return TurnedViews(
            np.array(heading), fine(xy), kind.astype(np.int32), np.array(seen), (low << FINE_BITS).astype(np.int32)
        )

    def __len__(self) -> int:
        return int(self.kind.shape[1])


def _frame(corners: Array) -> tuple[Ints, tuple[int, int]]:
    """First cells (4, 2) and the size in cells of rectangles around corners (4, V, 2) and a rim."""
    if not corners.shape[1]:
        return np.zeros((TURNS, 2), np.int64), (0, 0)
    low = np.floor(corners.min(axis=1) / CELL_M).astype(np.int64)
    size = np.max(np.floor(corners.max(axis=1) / CELL_M).astype(np.int64) - low, axis=0) + 1
    blocks = -(-size // SIDE) + 2
    return low - SIDE, (int(blocks[0]) * SIDE, int(blocks[1]) * SIDE)


def _unseen(xy: Array, kind: Ints, corners: Array, low: Ints, shape: tuple[int, int], reach_m: float) -> Bits:
    """(W, H) types not seen; where a cell is within reach of the rim of what is visible, none."""
    if not np.prod(shape):
        return np.zeros(shape, np.uint16)
    x, y = ((low[i] + np.arange(shape[i]) + 0.5) * CELL_M for i in (0, 1))
    side = np.roll(corners, -1, axis=0) - corners
    length = np.hypot(*side.T)
    inside = np.ones(shape, bool)
    for (cx, cy), (dx, dy) in zip(corners[length > 0.0], side[length > 0.0] / length[length > 0.0, None], strict=True):
        inside &= dx * (y - cy) - dy * (x[:, None] - cx) >= reach_m
    return np.asarray(inside * (ALL_TYPES & ~_seen(xy, kind, low, shape, reach_m)), np.uint16)


def _seen(xy: Array, kind: Ints, low: Ints, shape: tuple[int, int], reach_m: float) -> Bits:
    """(W, H) types of features within reach of the cells, drawn as a TypeGrid draws landmarks."""
    x, y, own, _ = reached(fine(xy), kind, reach_m, reach_m)
    column, row = (x >> FINE_BITS) - low[0], (y >> FINE_BITS) - low[1]
    inside = (column >= 0) & (column < shape[0]) & (row >= 0) & (row < shape[1])
    out = np.zeros(shape, np.uint16)
    np.bitwise_or.at(out, (column[inside], row[inside]), own[inside])
    return out
