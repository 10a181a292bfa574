"""Two views laid on each other at many displacements at once: where crossings meet, and what is missing."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from ceilvo.crossing_types import CROSSING_TYPES, commonest, turned_type
from ceilvo.daemon.odometry.lines.through import lines_through
from ceilvo.se2 import rotation
from ceilvo.types import Array, Crossings, Ints

CELL_M = 0.02
"""Side of a cell of the pictures that crossings are looked up in; chosen: residuals are 1 mm, at worst 10 mm."""
SMALLEST_TILE_M = 0.28
"""The smallest tiles made are 0.3 m; what differs by less is the two edges of a joint, or the slats of a vent."""
_REACH_CELLS = 2
"""Crossings of one type that lie so many cells apart are one: 0.04 to 0.05 m. With half of it a fisheye's views a fifth
of a second apart shared 55 % of their crossings, so 69 %; more changes little; chosen."""
BIN_M = 0.02
"""Differences are counted in bins of this side, three by three together; chosen: above the largest residual."""
_NEIGHBOURS = np.ones((5, 5), np.uint8)
"""Bins around one that must not have more votes."""
SHOWN = 1 << 15
"""Bit of a cell that would show a crossing if there were one."""
_FEWEST, _FEWEST_OF_FEW, FEW = 3, 2, 8
"""Crossings that make a candidate, for fewer meet by chance; where a view has no more than so many, two do: under tiles
of 1.25 m two views half a metre apart may share no more."""
CROWD_M = 0.1
"""Cell in which, with its neighbours, crossings share the worth of one: they are of one lamp's corner, or one vent;
chosen: less than the smallest tile."""
_LINE_WORTH = 3.0
"""Crossings of one line that are missing are worth so many at most; chosen: with one, places are told apart less well.
"""
_MOST_SPEAKERS = 128
"""Crossings of a view that vote and are looked for in the other one; chosen for time, which grows with their number."""


@dataclass(frozen=True, slots=True)
class Sight:
    """Crossings with what is needed to look them up.

    Attributes:
        xy, types: (N, 2) m, and (N,) of those that speak for the view, rare types first.
        worth: (N,) one divided among the crossings that lie close together, as those of a vent's slats do.
        lines: (N, 2) numbers of the two lines that meet there, one's own for each point.
        low: (2,) cell of the picture's corner.
        bits: (H, W) which types are within reach of each cell; and bit 15, that it lies among the crossings.
        several: they are at several heights.
    """

    xy: Array
    types: Ints
    worth: Array
    lines: Ints
    low: Ints
    bits: NDArray[np.uint16]
    several: bool

    @staticmethod
    def of(crossings: Crossings) -> Sight:
        xy, types = crossings.xy_base_m, crossings.crossing_type
        pad = _REACH_CELLS + 1
        cell = np.floor(xy * (1.0 / CELL_M)).astype(np.int32)
        low = cell.min(axis=0) - pad
        width, height = (cell.max(axis=0) - low + pad + 1).tolist()
        disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * _REACH_CELLS + 1, 2 * _REACH_CELLS + 1))
        bits = np.zeros((height, width), np.uint16)
        cv2.fillConvexPoly(bits, cv2.convexHull(cell - low), SHOWN)
        column, row = (cell - low).T
        for t in np.unique(types).tolist():
            picture = np.zeros((height, width), np.uint16)
            of = types == t
            picture[row[of], column[of]] = 1 << t
            bits |= np.asarray(cv2.dilate(picture, disc), np.uint16)
        which = _rare_first(types)[:_MOST_SPEAKERS]
        lines = lines_through(xy, types, crossings.psi_rad)
        return Sight(
            xy[which], types[which], 1.0 / crowd(xy, CROWD_M)[which], lines[which], low, bits, crossings.several
        )

    def turned(self, turn_rad: float, quarters: int) -> tuple[Array, Ints]:
        """Its crossings (N, 2) and types (N,) as seen from axes that are turned back."""
        return self.xy @ rotation(turn_rad).T, turned_type(self.types, quarters)

    def at(self, xy: Array) -> NDArray[np.uint16]:
        """(...,) the types of the crossings within reach of points (..., 2), as bits, and SHOWN."""
        cell = np.floor(xy * (1.0 / CELL_M)).astype(np.int32) - self.low
        height, width = self.bits.shape
        column, row = cell[..., 0], cell[..., 1]
        inside = (column >= 0) & (row >= 0) & (column < width) & (row < height)
        return np.asarray(self.bits.reshape(-1)[np.where(inside, row * width + column, 0)] * inside)


def is_in(bits: NDArray[np.uint16], types: Ints) -> NDArray[np.bool_]:
    """(...,) whether types (...,) are among those that bits (...,) say."""
    return np.asarray((bits >> types.astype(np.uint16)) & np.uint16(1) > 0)


def _rare_first(types: Ints) -> Ints:
    count = np.bincount(types, minlength=CROSSING_TYPES)
    return np.asarray(np.argsort(count[types], kind="stable"))


def by_line(events: NDArray[np.bool_], lines: Ints) -> Array:
    """(K, N) of events (K, N) at crossings of lines (N, 2): one divided among those that one line may have caused.

    Of 843 pairs of views in rooms of 5, 20 and 60 m a wrong displacement seemed e^12 times likelier than the true one
    in 3, else in 10: lines were called by another type.
    """
    out = events.astype(np.float64)
    most = np.ones_like(out)
    for axis in (0, 1):
        number, index = np.unique(lines[:, axis], return_inverse=True)
        on_line = np.eye(len(number))[index.reshape(-1)]
        np.maximum(most, (out @ on_line)[:, index.reshape(-1)], out=most)
    return np.asarray(out / most)


def _of_lines(missing: Array, of: Sight) -> Array:
    """(K, N) what missing crossings (K, N) are worth where lines come and go: joints everywhere, and all below several
    heights.

    Under a truss (vision seed 105, tuned on) a wrong displacement seemed e^5 times likelier than the true one, or more,
    in 0.4, 3 and 5 % of pairs of views 0.1, 0.3 and 0.7 s apart, else in 3, 9 and 15 %. Lamps below one ceiling do not
    come and go: a robot that is moved by whole tiles is told by their lines that are gone.
    """
    come_and_go = of.several | (of.types == commonest(of.types))
    return np.where(come_and_go, np.minimum(_LINE_WORTH * by_line(missing > 0.0, of.lines), missing), missing)


def crowd(xy: Array, cell_m: float) -> Array:
    """(N,) how many points (N, 2) lie around each, itself included: in its cell and the eight about it."""
    if not len(xy):
        return np.zeros(0)
    cell = np.floor(xy / cell_m).astype(np.int64)
    column, row = (cell - cell.min(axis=0)).T
    many = np.zeros((int(row.max()) + 1, int(column.max()) + 1))
    np.add.at(many, (row, column), 1.0)
    around = np.asarray(cv2.boxFilter(many, -1, (3, 3), None, (-1, -1), False, 0))
    return np.asarray(around[row, column], np.float64)


def shifts_by_votes(before: Sight, now: Sight, turn_rad: float, quarters: int, far_m: float) -> tuple[Array, Array]:
    """(K, 2) shifts from crossings of now to those before that at least three of one type share, or two of few; (K,)
    their votes."""
    xy, types = now.turned(turn_rad, quarters)
    i, j = np.nonzero(types[:, None] == before.types[None])
    off, worth = before.xy[j] - xy[i], np.minimum(now.worth[i], before.worth[j])
    near = np.max(np.abs(off), axis=1) < far_m
    off, worth = off[near], worth[near]
    half = int(far_m / BIN_M) + 2
    size = 2 * half + 1
    cell = np.floor(off * (1.0 / BIN_M)).astype(np.int64) + half
    flat = cell[:, 1] * size + cell[:, 0]
    weights = (worth, np.ones(len(off)), worth * off[:, 0], worth * off[:, 1])
    sums = [np.bincount(flat, w, size * size).astype(np.float64).reshape(size, size) for w in weights]
    single = sums[0]
    votes, number, sum_x, sum_y = (cv2.boxFilter(s, -1, (3, 3), normalize=False, borderType=0) for s in sums)
    # in the middle of its votes a peak is higher, and of equal neighbours the last is
    height = votes + 0.1 * single + np.linspace(0.0, 1e-3, size * size).reshape(size, size)
    fewest = _FEWEST_OF_FEW if min(len(before.xy), len(now.xy)) <= FEW else _FEWEST
    row, column = np.nonzero((number > fewest - 0.5) & (height >= cv2.dilate(height, _NEIGHBOURS)))
    shifts = np.column_stack([sum_x[row, column], sum_y[row, column]]) / votes[row, column][:, None]
    return np.asarray(shifts, np.float64), np.asarray(votes[row, column], np.float64)


@dataclass(frozen=True, slots=True)
class Matched:
    """What displacements (K, 3) explain.

    Attributes:
        counts: (K, 4, 13) by type, the worth of crossings of now where there was one of the same type, only one of
            another type, or none though it would have been seen; and of crossings before where now there is none though
            it would be seen. A line that is called something else takes all its crossings with it: they count as one.
            One that is not seen does, too: a line of joints, and any under several heights, counts as three at most.
    """

    at: Array
    counts: Array

    @staticmethod
    def of(before: Sight, now: Sight, at: Array, quarters: int) -> Matched:
        """at: (K, 3) of one rotation."""
        shifts, turn_rad = at[:, :2], float(at[0, 2])
        xy, types = now.turned(turn_rad, quarters)
        there = before.at(xy + shifts[:, None])
        back = now.at((before.xy - shifts[:, None]) @ rotation(turn_rad))
        same = is_in(there, types)
        other = by_line((there & np.uint16(SHOWN - 1) > 0) & ~same, now.lines)
        gone, lost = (there == SHOWN).astype(np.float64), (back == SHOWN).astype(np.float64)
        gone, lost = _of_lines(gone, now), _of_lines(lost, before)
        one = np.eye(CROSSING_TYPES)[types] * now.worth[:, None]
        then = np.eye(CROSSING_TYPES)[before.types] * before.worth[:, None]
        counts = np.stack([same @ one, other @ one, gone @ one, lost @ then], axis=1)
        return Matched(at, counts)
