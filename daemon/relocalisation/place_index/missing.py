"""Landmarks that should be in view and are not seen."""

from __future__ import annotations

import numpy as np

from ceilvo.daemon.relocalisation.place_index.blocks import BLOCK_SHIFT, FINE_BITS, Fine
from ceilvo.daemon.relocalisation.place_index.id_table import Slots
from ceilvo.daemon.relocalisation.place_index.turned_view import VISIBLE, TurnedView
from ceilvo.daemon.relocalisation.place_index.type_grid import Bits, TypeGrid
from ceilvo.types import Ints


def missed(grid: TypeGrid, views: list[TurnedView], x: Fine, y: Fine, turn: Ints) -> Ints:
    """(M,) landmarks in view that are not seen, with the robot at these points in these turns of the view."""
    out = np.zeros(len(x), np.int64)
    if not len(x) or not views[0].expected.size:
        return out
    picture = _Picture(views)
    low = (picture.origin[turn] << FINE_BITS).astype(np.int32)
    span = (np.array(picture.bits.shape[1:]) << FINE_BITS >> BLOCK_SHIFT) + 2
    for i in range(span[0]):
        for j in range(span[1]):
            blocks = grid.blocks.directory.at(
                x + low[:, 0] + np.int32(i << BLOCK_SHIFT), y + low[:, 1] + np.int32(j << BLOCK_SHIFT)
            )
            at = np.flatnonzero(blocks)
            for which, slot in grid.blocks.walk(blocks[at]):
                pose = at[which]
                unseen = picture.unseen(grid, x[pose], y[pose], turn[pose], slot)
                out += np.bincount(pose[unseen], minlength=len(x))
    return out


class _Picture:
    """What is expected in the view's turns, one above the other.

    Attributes:
        origin: (T, 2) first cell of each, from the robot.
        bits: (T, W, H), as in TurnedView.expected.
    """

    def __init__(self, views: list[TurnedView]) -> None:
        size = np.max([v.expected.shape for v in views], axis=0)
        self.origin = np.array([v.origin for v in views], np.int32)
        self.bits: Bits = np.zeros((len(views), *size), np.uint16)
        for bits, view in zip(self.bits, views, strict=True):
            bits[: view.expected.shape[0], : view.expected.shape[1]] = view.expected

    def unseen(self, grid: TypeGrid, x: Fine, y: Fine, turn: Ints, slot: Slots) -> Ints:
        """Which of these landmarks are in view and not seen from these points in these turns."""
        at = grid.blocks.xy[slot]
        column = ((at[:, 0] - x) >> FINE_BITS) - self.origin[turn, 0]
        row = ((at[:, 1] - y) >> FINE_BITS) - self.origin[turn, 1]
        _, w, h = self.bits.shape
        inside = np.flatnonzero((column >= 0) & (column < w) & (row >= 0) & (row < h))
        bits = self.bits[turn[inside], column[inside], row[inside]]
        own = np.left_shift(1, grid.blocks.crossing_type[slot[inside]].astype(np.uint16)).astype(np.uint16)
        return np.asarray(inside[((bits & VISIBLE) > 0) & ((bits & own) == 0)], np.int64)
