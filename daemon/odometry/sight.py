"""Two views laid on each other at many displacements at once: where crossings meet, and what is missing."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from ceilvo.crossing_types import CROSSING_TYPES, turned_type
from ceilvo.se2 import rotation
from ceilvo.types import Array, Crossings, Ints

Bools = NDArray[np.bool_]

CELL_M = 0.01
"""Side of a cell of the pictures that crossings are looked up in; chosen: residuals are 1 mm, at worst 10 mm."""
_REACH_CELLS = 2
"""Crossings of one type that lie so many cells apart are one: 0.02 to 0.03 m, half of a joint's or a lamp's edges."""
BIN_M = 0.02
"""Differences are counted in bins of this side, three by three together; chosen: above the largest residual."""
_NEIGHBOURS = np.ones((5, 5), np.uint8)
"""Bins around one that must not have more votes."""
_FEWEST = 3
"""Crossings that make a candidate; fewer meet by chance."""
_CROWD_M = 0.1
"""Cell in which, with its neighbours, crossings share the worth of one: they are of one lamp's corner, or one vent;
chosen: less than the smallest tile."""
_MOST_VOTERS = 160
"""Crossings of a view that vote, those of rare types first; chosen for time, which grows with this number."""
_MOST_CANDIDATES = 192
"""Kept, those with most votes; chosen: more than whole tiles of 0.3 m in a view of 3 m."""


@dataclass(frozen=True, slots=True)
class Sight:
    """Crossings with what is needed to look them up.

    Attributes:
        xy, types: (N, 2) m, and (N,).
        worth: (N,) one divided among the crossings that lie close together, as those of a vent's slats do.
        low: (2,) cell of the picture's corner; bits: which types are within reach of each cell.
        normals, offsets: (V, 2), (V,) the convex hull: inside, normals . xy <= offsets.
    """

    xy: Array
    types: Ints
    worth: Array
    low: Ints
    bits: NDArray[np.uint16]
    normals: Array
    offsets: Array

    @staticmethod
    def of(crossings: Crossings) -> Sight:
        xy, types = crossings.xy_base_m, crossings.crossing_type
        pad = _REACH_CELLS + 1
        cell = np.floor(xy / CELL_M).astype(np.int64)
        low = cell.min(axis=0) - pad
        width, height = (cell.max(axis=0) - low + pad + 1).tolist()
        disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * _REACH_CELLS + 1, 2 * _REACH_CELLS + 1))
        bits = np.zeros((height, width), np.uint16)
        column, row = (cell - low).T
        for t in np.unique(types).tolist():
            picture = np.zeros((height, width), np.uint16)
            of = types == t
            picture[row[of], column[of]] = 1 << t
            bits |= np.asarray(cv2.dilate(picture, disc), np.uint16)
        return Sight(xy, types, 1.0 / _crowd(xy), low, bits, *_hull(xy))

    def turned(self, turn_rad: float, quarters: int) -> tuple[Array, Ints]:
        """Its crossings (N, 2) and types (N,) as seen from axes that are turned back."""
        return self.xy @ rotation(turn_rad).T, turned_type(self.types, quarters)

    def at(self, xy: Array) -> NDArray[np.uint16]:
        """(...,) the types of the crossings within reach of points (..., 2), as bits."""
        cell = np.floor(xy * (1.0 / CELL_M)).astype(np.int64) - self.low
        height, width = self.bits.shape
        column, row = cell[..., 0], cell[..., 1]
        inside = (column >= 0) & (row >= 0) & (column < width) & (row < height)
        bits = self.bits.reshape(-1)[np.where(inside, row * width + column, 0)]
        return np.asarray(np.where(inside, bits, np.uint16(0)))

    def shows(self, xy: Array) -> Bools:
        """(...,) whether a place (..., 2) lies among the crossings, so that one there would be seen."""
        return np.asarray(np.all(xy @ self.normals.T <= self.offsets, axis=-1))


def _crowd(xy: Array) -> Array:
    """(N,) crossings around each, itself included: in its cell and the eight about it."""
    cell = np.floor(xy / _CROWD_M).astype(np.int64)
    column, row = (cell - cell.min(axis=0)).T
    many = np.zeros((int(row.max()) + 1, int(column.max()) + 1))
    np.add.at(many, (row, column), 1.0)
    around = np.asarray(cv2.boxFilter(many, -1, (3, 3), None, (-1, -1), False, 0))
    return np.asarray(around[row, column], np.float64)


def _hull(xy: Array) -> tuple[Array, Array]:
    corners = cv2.convexHull(xy.astype(np.float32))[:, 0].astype(np.float64)
    edge = np.roll(corners, -1, axis=0) - corners
    normals = np.column_stack([edge[:, 1], -edge[:, 0]])
    inside = xy.mean(axis=0)
    normals *= np.where(np.sum(normals * (inside - corners), axis=1) > 0.0, -1.0, 1.0)[:, None]
    return normals, np.sum(normals * corners, axis=1)


def shifts_by_votes(before: Sight, now: Sight, turn_rad: float, quarters: int, far_m: float) -> Array:
    """(K, 2) shifts from crossings of now to those before that at least three of one type share, most votes first."""
    xy, types = now.turned(turn_rad, quarters)
    which = _rare_first(types)[:_MOST_VOTERS]
    i, j = np.nonzero(types[which, None] == before.types[None])
    off, worth = before.xy[j] - xy[which[i]], np.minimum(now.worth[which[i]], before.worth[j])
    near = np.max(np.abs(off), axis=1) < far_m
    off, worth = off[near], worth[near]
    half = int(far_m / BIN_M) + 2
    size = 2 * half + 1
    cell = np.floor(off * (1.0 / BIN_M)).astype(np.int64) + half
    flat = cell[:, 1] * size + cell[:, 0]
    single, number, x, y = (
        np.asarray(np.bincount(flat, w, size * size).reshape(size, size), np.float64)
        for w in (worth, np.ones(len(off)), worth * off[:, 0], worth * off[:, 1])
    )
    votes, number, sum_x, sum_y = (
        np.asarray(cv2.boxFilter(s, -1, (3, 3), None, (-1, -1), False, 0)) for s in (single, number, x, y)
    )
    # in the middle of its votes a peak is higher, and of equal neighbours the last is
    height = votes + 0.1 * single + np.linspace(0.0, 1e-3, size * size).reshape(size, size)
    row, column = np.nonzero((number > _FEWEST - 0.5) & (height >= cv2.dilate(height, _NEIGHBOURS)))
    order = np.argsort(-votes[row, column], kind="stable")[:_MOST_CANDIDATES]
    row, column = row[order], column[order]
    shifts = np.column_stack([sum_x[row, column], sum_y[row, column]]) / votes[row, column][:, None]
    return np.asarray(shifts, np.float64)


def _rare_first(types: Ints) -> Ints:
    count = np.bincount(types, minlength=CROSSING_TYPES)
    return np.asarray(np.argsort(count[types], kind="stable"))


@dataclass(frozen=True, slots=True)
class Matched:
    """What displacements (K, 3) explain.

    Attributes:
        counts: (K, 4, 9) by type, the worth of crossings of now where there was one of the same type, only one of
            another type, or none though it would have been seen; and of crossings before where now there is none though
            it would be seen.
    """

    at: Array
    counts: Array

    @staticmethod
    def of(before: Sight, now: Sight, shifts: Array, turn_rad: float, quarters: int) -> Matched:
        xy, types = now.turned(turn_rad, quarters)
        there = xy + shifts[:, None]
        bits = before.at(there)
        same = (bits >> types.astype(np.uint16)) & np.uint16(1) > 0
        back = (before.xy - shifts[:, None]) @ rotation(turn_rad)
        lost = now.shows(back) & (now.at(back) == 0)
        one = np.eye(CROSSING_TYPES)[types] * now.worth[:, None]
        other = np.eye(CROSSING_TYPES)[before.types] * before.worth[:, None]
        gone = before.shows(there) & (bits == 0)
        counts = np.stack([same @ one, ((bits > 0) & ~same) @ one, gone @ one, lost @ other], axis=1)
        at = np.column_stack([shifts, np.full(len(shifts), turn_rad)])
        return Matched(at, counts)
