"""Landmarks that should be in view and are not seen."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ceilvo.daemon.relocalisation.kernel.arguments import Fine
from ceilvo.daemon.relocalisation.place_index.blocks import BLOCK_BITS, BLOCK_SHIFT, FINE_BITS, LandmarkBlocks
from ceilvo.daemon.relocalisation.place_index.turned_views import SIDE, TurnedViews
from ceilvo.types import Ints

AT_ONCE = 1 << 14
"""Blocks of which landmarks are looked at together, so that their arrays stay in the cache; chosen."""


def missed(blocks: LandmarkBlocks, views: TurnedViews, x: Fine, y: Fine, turn: Ints) -> Ints:
    """(M,) landmarks in view that are not seen, with the robot at these points in these turns of the view."""
    out = np.zeros(len(x), np.int64)
    if not len(x) or not views.unseen.size:
        return out
    touched = _Touched(views)
    _, w, h = views.unseen.shape
    corner = np.column_stack([x, y]) + views.corner.take(turn, axis=0)
    for part in np.array_split(np.arange(len(x)), len(x) * len(touched.shift) // AT_ONCE + 1):
        pose, number = touched.blocks(blocks, corner.take(part, axis=0), turn.take(part))
        pose = part.take(pose)
        for which, slot in blocks.walk(number):
            mine = pose.take(which)
            cell = (blocks.xy.take(slot, axis=0) - corner.take(mine, axis=0)) >> FINE_BITS
            at = (turn.take(mine) * (w * h)) + (cell[:, 0] * np.int32(h) + cell[:, 1])
            unseen = views.unseen.ravel().take(at) & blocks.own_bit(slot)
            out += np.bincount(mine.take(np.flatnonzero(unseen)), minlength=len(x))
    return out


class _Touched:
    """Which blocks a view touches.

    Attributes:
        any: (4, W', H') whether anything would be seen in a block whose first cell is this one of the view's.
        shift: (B,) from the first block that begins in the view to all others, in `any`.
        offset: (B, 2) the same in FINE.
    """

    def __init__(self, views: TurnedViews) -> None:
        total = np.pad(views.unseen > 0, ((0, 0), (1, 0), (1, 0))).cumsum(axis=1, dtype=np.int32).cumsum(axis=2)
        self.any = total[:, SIDE:, SIDE:] + total[:, :-SIDE, :-SIDE] > total[:, :-SIDE, SIDE:] + total[:, SIDE:, :-SIDE]
        _, w, h = views.unseen.shape
        steps = (np.arange(n // SIDE - 1, dtype=np.int32) for n in (w, h))
        i, j = (g.ravel() for g in np.meshgrid(*steps, indexing="ij"))
        self.shift = (i * np.int32(self.any.shape[2]) + j) << BLOCK_BITS
        self.offset = np.column_stack([i, j]) << BLOCK_SHIFT

    def blocks(self, blocks: LandmarkBlocks, corner: Fine, turn: Ints) -> tuple[Ints, NDArray[np.int32]]:
        """Which of the poses, and the number of a block with landmarks that its view touches."""
        _, w, h = self.any.shape
        first = -(corner >> FINE_BITS) & np.int32(SIDE - 1)  # cell of the view with which a block begins
        at = turn * (w * h) + first[:, 0] * h + first[:, 1]
        pose, which = np.nonzero(self.any.ravel().take(at[:, None] + self.shift))
        begin = corner + (first << FINE_BITS)
        point = begin.take(pose, axis=0) + self.offset.take(which, axis=0)
        number = blocks.directory.at(point[:, 0], point[:, 1])
        some = np.flatnonzero(number)
        return pose.take(some), number.take(some)
