"""Landmarks that should be in view and are not seen."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ceilvo.daemon.relocalisation.place_index.blocks import BLOCK_BITS, BLOCK_SHIFT, FINE_BITS, Fine, LandmarkBlocks
from ceilvo.daemon.relocalisation.place_index.id_table import Slots
from ceilvo.daemon.relocalisation.place_index.turned_views import TurnedViews
from ceilvo.types import Ints

SIDE = 1 << BLOCK_BITS
"""Cells of a block's side."""
AT_ONCE = 1 << 14
"""Blocks of which landmarks are looked at together, so that their arrays stay in the cache; chosen."""


def missed(blocks: LandmarkBlocks, views: TurnedViews, x: Fine, y: Fine, turn: Ints) -> Ints:
    """(M,) landmarks in view that are not seen, with the robot at these points in these turns of the view."""
    out = np.zeros(len(x), np.int64)
    _, w, h = views.unseen.shape
    if not len(x) or not w * h:
        return out
    corner = np.column_stack([x, y]) + views.corner[turn]
    picture, touched = (turn * (w * h)).astype(np.int32), _Touched(views)
    for part in np.array_split(np.arange(len(x)), len(x) * touched.offset.size // AT_ONCE + 1):
        pose, number = touched.blocks(blocks, corner[part], turn[part])
        for which, slot in blocks.walk(number):
            mine = part.take(pose.take(which))
            unseen = _unseen(blocks, views, slot, corner.take(mine, axis=0), picture.take(mine))
            out += np.bincount(mine[unseen], minlength=len(x))
    return out


class _Touched:
    """Which blocks a view touches.

    Attributes:
        any: (4, W', H') whether anything would be seen in a block whose first cell is [w' - 15, h' - 15] of the view.
        shift: (B,) from the block with a view's lower corner to all that it can touch, in `any`.
        offset: (B, 2) the same in FINE.
    """

    def __init__(self, views: TurnedViews) -> None:
        _, w, h = views.unseen.shape
        count = [(n >> BLOCK_BITS) + 2 for n in (w, h)]
        pad = [(SIDE, (c + 1) * SIDE - 1 - n) for c, n in zip(count, (w, h), strict=True)]
        total = np.pad(views.unseen > 0, ((0, 0), *pad)).cumsum(axis=1, dtype=np.int32).cumsum(axis=2)
        self.any = total[:, SIDE:, SIDE:] + total[:, :-SIDE, :-SIDE] > total[:, :-SIDE, SIDE:] + total[:, SIDE:, :-SIDE]
        i, j = (g.ravel().astype(np.int32) for g in np.meshgrid(*map(np.arange, count), indexing="ij"))
        self.shift = (i << BLOCK_BITS) * np.int32(self.any.shape[2]) + (j << BLOCK_BITS)
        self.offset = np.column_stack([i, j]) << BLOCK_SHIFT

    def blocks(self, blocks: LandmarkBlocks, corner: Fine, turn: Ints) -> tuple[Ints, NDArray[np.int32]]:
        """Which of the poses, and the number of a block with landmarks that its view touches."""
        _, w, h = self.any.shape
        phase = np.int32(SIDE - 1) - ((corner >> FINE_BITS) & np.int32(SIDE - 1))
        at = (turn * (w * h)).astype(np.int32) + phase[:, 0] * np.int32(h) + phase[:, 1]
        pose, which = np.nonzero(self.any.ravel().take(at[:, None] + self.shift))
        point = corner.take(pose, axis=0) + self.offset.take(which, axis=0)
        number = blocks.directory.at(point[:, 0], point[:, 1])
        some = np.flatnonzero(number)
        return pose[some], number[some]


def _unseen(blocks: LandmarkBlocks, views: TurnedViews, slot: Slots, corner: Fine, picture: Fine) -> NDArray[np.bool_]:
    """(N,) whether landmarks are in views with these lower corners, and not seen."""
    _, w, h = views.unseen.shape
    cell = (blocks.xy.take(slot, axis=0) - corner) >> FINE_BITS
    cell.view(np.uint32)[:] = np.minimum(cell.view(np.uint32), np.uint32(max(w, h)))  # below the corner: beyond
    inside = (cell[:, 0] < w) & (cell[:, 1] < h)
    at = picture + cell[:, 0] * np.int32(h) + cell[:, 1]
    at[~inside] = 0
    bits = views.unseen.ravel().take(at)
    return np.asarray(inside & ((bits >> blocks.crossing_type.take(slot).astype(np.uint16)) & 1).astype(bool))
