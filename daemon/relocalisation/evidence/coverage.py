"""Which ground the map knows: only there is a feature without a landmark, or a landmark not seen, evidence."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field

import cv2
import numpy as np
from numpy.typing import NDArray

from ceilvo.crossing_types import LINE_CROSSINGS
from ceilvo.daemon.relocalisation import kernel
from ceilvo.daemon.relocalisation.evidence.type_raster import REACH_M
from ceilvo.daemon.relocalisation.kernel.arguments import COVERAGE_OFFSET as OFFSET
from ceilvo.daemon.relocalisation.kernel.arguments import COVERAGE_SIDE as SIDE
from ceilvo.daemon.relocalisation.kernel.arguments import Ground
from ceilvo.types import Array, Ints, Landmarks

CELL_M = 0.25
"""Side of a cell; chosen: smaller than any tile, so that a row of tiles that was not seen yet is not known."""
VIEWS = 8
"""Views that must have shown a cell before it counts as known: of the joints between tiles, 1 in 1000 is not in the map
then (two rooms, first laps, seeds 501 and 502)."""
_MOST = 255
"""Views of a cell are counted up to here."""
_GAP_TILES = 0.75
"""Of a map that came without coverage, ground is known between landmarks that are so many tiles apart at most: a tile's
diagonal is 1.41, half of it 0.71."""
GAP_M = 0.45
"""The same where there are no tiles; chosen."""
_WINDOW = 1024
"""Cells along a window in which the ground between landmarks is looked for, 256 m: two landmarks that are kilometres
apart must not cost the ground between them."""
_RIM = 4
"""Times the reach that landmarks around a window count in it: closing looks twice as far, and once more at the rim."""
_AROUND = np.array([(x, y) for x in (-1, 0, 1) for y in (-1, 0, 1)])


@dataclass(slots=True)
class Coverage:
    """How often each cell of the ceiling was shown while the place was sure.

    Attributes:
        block: (B,) numbers of the blocks there are, rising.
        shown: (B, 32, 32) views of each cell.
        of_lines, of_points: the same of the views that had crossings of lines, and of those that had points: points are
            taken where lines do not suffice, and may be all that a view has. None: kinds are not told apart.
    """

    block: Ints = field(default_factory=lambda: np.empty(0, np.int64))
    shown: NDArray[np.uint8] = field(default_factory=lambda: np.empty((0, SIDE, SIDE), np.uint8))
    of_lines: Coverage | None = None
    of_points: Coverage | None = None

    @staticmethod
    def of_kinds() -> Coverage:
        """Nothing yet, of lines and of points apart."""
        return Coverage(of_lines=Coverage(), of_points=Coverage())

    @staticmethod
    def of(landmarks: Landmarks, tile_m: float) -> Coverage:
        """Of a map that came without: the ground between its landmarks, but none outside of them.

        Each landmark says how often it should have been seen; tile_m: side of a tile, 0 where there are none.
        """
        out, points = Coverage._between(landmarks, tile_m), landmarks.crossing_type >= LINE_CROSSINGS
        if np.any(points):
            out.of_lines = Coverage._between(landmarks.of(~points), tile_m)
        else:  # the same ground; the search for it takes its time on a large map
            out.of_lines = Coverage(out.block, out.shown.copy())
        out.of_points = Coverage._between(landmarks.of(points), 0.0)
        return out

    @staticmethod
    def _between(landmarks: Landmarks, tile_m: float) -> Coverage:
        """The same of one kind of features: lines and points are not told apart."""
        out = Coverage()
        if not len(landmarks):
            return out
        reach = int(np.ceil(max(_GAP_TILES * tile_m, GAP_M) / CELL_M))
        for low, members in _windows(_cells(landmarks.xy_map_m), _RIM * (reach + 1)):
            cell, views = _ground(landmarks.of(members), reach)
            own = np.all((cell >= low) & (cell < low + _WINDOW), axis=1)
            out._add(cell[own], views[own])
        return out

    def show(self, corners_m: Array, kind: Ints | None = None) -> None:
        """One more view of the convex polygon (V, 2) in map, that had features of types (K,); None: no kind is told."""
        cell = _within(corners_m)
        self._add(cell, 1)
        points = np.empty(0, bool) if kind is None else kind >= LINE_CROSSINGS
        for coverage, had in ((self.of_lines, np.any(~points)), (self.of_points, np.any(points))):
            if coverage is not None and had:
                coverage._add(cell, 1)

    def forget(self, corners_m: Array) -> None:
        """What views of the convex polygon (V, 2) in map showed there was taken to be elsewhere than it is."""
        cell = _within(corners_m)
        block = _numbered(cell)[0]
        for coverage in (self, self.of_lines, self.of_points):
            if coverage is not None:
                coverage._add(cell[np.isin(block, coverage.block)], -_MOST)

    def views(self, xy_m: Array, kind: Ints | None = None) -> Ints:
        """(...,) views that showed the ground at (..., 2), and where a feature is said, would have shown its type."""
        if kind is None:
            views: Ints = kernel.views(self.ground, xy_m.reshape(-1, 2))
            return views.reshape(xy_m.shape[:-1])
        points, of_lines = np.broadcast_to(kind >= LINE_CROSSINGS, xy_m.shape[:-1]), self.of_kind(points=False)
        if not np.any(points):
            return of_lines.views(xy_m)
        out = np.empty(xy_m.shape[:-1], np.int64)
        out[points], out[~points] = self.of_kind(points=True).views(xy_m[points]), of_lines.views(xy_m[~points])
        return out

    @property
    def ground(self) -> Ground:
        """Where kinds are not told apart."""
        return Ground(self.block, self.shown, CELL_M)

    def of_kind(self, points: bool) -> Coverage:
        """The ground that points, or crossings of lines, would have been seen on."""
        return (self.of_points if points else self.of_lines) or self

    def knows(self, xy_m: Array, kind: Ints | None = None) -> NDArray[np.bool_]:
        """(...,) whether the map should know what is at (..., 2), or a feature there of a type."""
        return self.views(xy_m, kind) >= VIEWS

    @property
    def area_m2(self) -> float:
        return float(np.count_nonzero(self.shown >= VIEWS)) * CELL_M**2

    @property
    def shown_m2(self) -> float:
        """Ground that any view has shown."""
        return float(np.count_nonzero(self.shown)) * CELL_M**2

    @property
    def cells_m(self) -> Array:
        """(N, 2) middles of the cells that any view has shown."""
        at, row, column = np.nonzero(self.shown)
        x, y = self.block[at] // (2 * OFFSET) - OFFSET, self.block[at] % (2 * OFFSET) - OFFSET
        return np.asarray(CELL_M * (np.column_stack([SIDE * x + row, SIDE * y + column]) + 0.5))

    def share_beyond(self, at_m: Array, reach_m: float) -> float:
        """Of the ground that is known, how much lies further than so from a point (2,)."""
        known = self.cells_m[self.shown[self.shown > 0] >= VIEWS]
        return float(np.mean(np.hypot(*(known - at_m).T) > reach_m)) if len(known) else 1.0

    def _add(self, cell: Ints, views: Ints | int) -> None:
        if not len(cell):
            return
        number, inside = _numbered(cell)
        fresh = np.setdiff1d(number, self.block)
        if len(fresh):
            at = np.searchsorted(self.block, fresh)
            self.block = np.insert(self.block, at, fresh)
            self.shown = np.insert(self.shown, at, np.uint8(0), axis=0)
        flat = self.shown.reshape(len(self.block), -1)
        at = np.searchsorted(self.block, number)
        flat[at, inside] = np.clip(flat[at, inside].astype(np.int64) + views, 0, _MOST)


def _windows(cell: Ints, rim: int) -> Iterator[tuple[Ints, Ints]]:
    """The lowest cell (2,) of each square of _WINDOW that has some of these cells (N, 2) within its rim, and which."""
    first = np.min(cell, axis=0) - rim
    off = cell - first
    columns, rows = np.concatenate([(off + d) // _WINDOW for d in rim * _AROUND]).T
    most = int(rows.max()) + 1
    for number in np.unique(columns * most + rows):
        low = _WINDOW * np.array(divmod(int(number), most))
        yield low + first, np.flatnonzero(np.all((off >= low - rim) & (off < low + _WINDOW + rim), axis=1))


def _ground(landmarks: Landmarks, reach: int) -> tuple[Ints, Ints]:
    """Cells (N, 2) between landmarks, and how often each was in view."""
    cell = _cells(landmarks.xy_map_m)
    low = np.min(cell, axis=0) - reach
    shape = (np.max(cell, axis=0) - low + reach + 1)[::-1]
    views, there = np.zeros(shape, np.uint8), np.zeros(shape, np.uint8)
    column, row = (cell - low).T
    np.maximum.at(views, (row, column), np.minimum(landmarks.expected, _MOST).astype(np.uint8))
    for diagonal in _AROUND[_AROUND.all(axis=1)]:  # a feature beside a landmark at the edge lies on known ground
        column, row = (_cells(landmarks.xy_map_m + REACH_M * diagonal) - low).T
        there[row, column] = 1
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * reach + 1, 2 * reach + 1))
    inside = np.nonzero(cv2.morphologyEx(there, cv2.MORPH_CLOSE, disc))
    return np.column_stack(inside[::-1]) + low, np.asarray(cv2.dilate(views, disc), np.int64)[inside]


def _within(corners_m: Array) -> Ints:
    """(N, 2) cells of the convex polygon (V, 2)."""
    if len(corners_m) < 3:
        return np.zeros((0, 2), np.int64)
    low, high = _cells(np.min(corners_m, axis=0)), _cells(np.max(corners_m, axis=0))
    picture = np.zeros((high - low + 1)[::-1], np.uint8)
    cv2.fillConvexPoly(picture, np.round(corners_m / CELL_M - 0.5 - low).astype(np.int32), 1)
    row, column = np.nonzero(picture)
    return np.column_stack([column, row]) + low


def _cells(xy_m: Array) -> Ints:
    return np.floor(xy_m / CELL_M).astype(np.int64)


def _numbered(cell: Ints) -> tuple[Ints, Ints]:
    """(N,) number of the block of each cell (N, 2), and of the cell in it."""
    block, inside = cell // SIDE + OFFSET, cell % SIDE
    return block[:, 0] * (2 * OFFSET) + block[:, 1], inside[:, 0] * SIDE + inside[:, 1]
