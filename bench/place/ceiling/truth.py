"""What a camera can find on a ceiling: the true crossings with their types, of true lines, for look-up by place."""

from __future__ import annotations

from dataclasses import dataclass, replace
from enum import IntEnum

import numpy as np
from numpy.typing import NDArray

from ceilvo.crossing_types import crossing_type_of
from ceilvo.se2 import inverse, transform
from ceilvo.sim.ceiling.layout import Layout, TrueLines
from ceilvo.sim.ceiling.panels import Rect
from ceilvo.types import Array, Ints, LineKind

PX_M = 2.2 / 409.7
"""Of the simulated camera on its ceiling (sim/rig.py): height over focal length."""
_REACH_M, _CORNER_M, _NEED_M = 12.0 * PX_M, 2.0 * PX_M, 7.0 * PX_M
"""An arm of a crossing: where it ends and begins, how much of it must be there; the finder's own: 12 px, 2 px and .6
of 12 px (daemon/vision/crossings.py). Of the rendered crossings with 7 px of an arm 73 % were found, 1 % with 6."""
_SAME_LINE_M = 0.004
"""Lines of one kind closer than this are one line; chosen: below what the finder tells apart."""
CELL_M = 1.0
"""Of the look-up; chosen: a view takes some 5 by 5 of them."""


class Origin(IntEnum):
    """What a line belongs to."""

    GRID = 0
    LAMP = 1
    VENT = 2
    WALL = 3


Row = tuple[int, float, float, float, int, int]
"""A segment: axis, position across, from, to, LineKind, Origin; in the ceiling's own frame."""


@dataclass(frozen=True)
class Features:
    """True crossings, in order of their cell.

    Attributes:
        xy_map_m: (N, 2).
        crossing_type: (N,) as the map stores it, with axis 0 along axis_rad.
        line: (N, 2) index of the axis-0 and the axis-1 line.
        origin: (L,) Origin of each line.
        kind: (L,) LineKind.
        axis_rad: direction of the ceiling's lines in map.
        starts: (rows * columns + 1,) where each cell's crossings begin.
    """

    xy_map_m: Array
    crossing_type: Ints
    line: Ints
    origin: Ints
    kind: Ints
    axis_rad: float
    low: Array
    columns: int
    rows: int
    starts: Ints

    def near(self, xy_m: Array, reach_m: float) -> Ints:
        """Indices of the crossings in all cells within reach of a point (2,)."""
        (i0, j0), (i1, j1) = (
            np.floor((xy_m + d - self.low) / CELL_M).astype(int).tolist() for d in (-reach_m, reach_m)
        )
        i0, i1 = max(i0, 0), min(i1, self.columns - 1)
        if i1 < i0:
            return np.zeros(0, np.int64)
        spans = [
            np.arange(self.starts[j * self.columns + i0], self.starts[j * self.columns + i1 + 1])
            for j in range(max(j0, 0), min(j1, self.rows - 1) + 1)
        ]
        return np.concatenate(spans) if spans else np.zeros(0, np.int64)

    def __len__(self) -> int:
        return len(self.crossing_type)

    @property
    def feature_origin(self) -> Ints:
        """(N,) the Origin that tells most: of the line that is not of the grid."""
        return np.asarray(self.origin[self.line].max(axis=1))


def features_of(layout: Layout, map_from_ceiling: Array, walls: Rect | None = None) -> Features:
    """The crossings of a layout, (3,) map_from_ceiling; with walls nothing is beyond them, and their edges are seen."""
    rows = _rows(layout)
    if walls is not None:
        rows = np.concatenate([_clipped(rows, walls), np.array(_outline(walls, LineKind.RISING, Origin.WALL))])
    return indexed(*_crossings(rows), map_from_ceiling)


def indexed(xy_m: Array, line: Ints, origin: Ints, kind: Ints, map_from_ceiling: Array) -> Features:
    """Features from (N, 2) places in the ceiling's own frame and their lines."""
    xy = transform(map_from_ceiling, xy_m)
    low = xy.min(axis=0) - CELL_M
    cell = np.floor((xy - low) / CELL_M).astype(np.int64)
    columns, rows = (int(n) + 1 for n in cell.max(axis=0))
    flat = cell[:, 1] * columns + cell[:, 0]
    order = np.argsort(flat, kind="stable")
    starts = np.searchsorted(flat[order], np.arange(rows * columns + 1))
    types = crossing_type_of(kind[line[:, 0]], kind[line[:, 1]])
    return Features(
        xy[order], types[order], line[order], origin, kind, float(map_from_ceiling[2]), low, columns, rows, starts
    )


def without(features: Features, gone: Ints) -> Features:
    """The same without the crossings `gone`."""
    keep = np.ones(len(features), bool)
    keep[gone] = False
    before = np.concatenate([[0], np.cumsum(keep)])
    return replace(
        features,
        xy_map_m=features.xy_map_m[keep],
        crossing_type=features.crossing_type[keep],
        line=features.line[keep],
        starts=before[features.starts],
    )


def joined(a: Features, b: Features, map_from_ceiling: Array, low: Array, high: Array) -> Features:
    """a with b's crossings within low (2,) to high (2,) of the ceiling's own frame; their lines stay apart."""
    ceiling_from_map = inverse(map_from_ceiling)
    parts = [transform(ceiling_from_map, f.xy_map_m) for f in (a, b)]
    inside = [np.all((xy > low) & (xy < high), axis=1) for xy in parts]
    keep = (~inside[0], inside[1])
    return indexed(
        np.concatenate([parts[0][keep[0]], parts[1][keep[1]]]),
        np.concatenate([a.line[keep[0]], b.line[keep[1]] + len(a.origin)]),
        np.concatenate([a.origin, b.origin]),
        np.concatenate([a.kind, b.kind]),
        map_from_ceiling,
    )


def _rows(layout: Layout) -> Array:
    """(S, 6) Row of every line that the finder tells apart: narrow dark things are one groove along their middle."""
    lines = layout.lines()
    at, ends = _across(lines)
    on_grid = np.where(lines.axis == 0, np.isin(at, layout.grooves[0]), np.isin(at, layout.grooves[1]))
    on_grid &= lines.kind == LineKind.GROOVE
    grid = np.column_stack([lines.axis, at, ends, lines.kind, np.full(len(at), Origin.GRID)])[on_grid]
    out: list[Row] = []
    for p in layout.panels:
        origin = Origin.LAMP if p.kind == "lamp" else Origin.VENT
        if p.kind == "lamp":
            out += _outline(p.inner, LineKind.RISING, origin)
        for rect in p.joints():
            out += _outline(rect, LineKind.GROOVE, origin)
    return np.concatenate([grid, np.array(out, np.float64).reshape(-1, 6)])


def _across(lines: TrueLines) -> tuple[Array, Array]:
    """(S,) position across and (S, 2) from and to of every segment."""
    first = lines.axis[:, None] == 0
    x, y = lines.segments[..., 0], lines.segments[..., 1]
    return np.where(first, x, y)[:, 0], np.where(first, y, x)


def _outline(rect: Rect, kind: LineKind, origin: Origin) -> list[Row]:
    """The four sides; one side of a rectangle without width."""
    x0, y0, x1, y1 = rect
    k, o = int(kind), int(origin)
    upright: list[Row] = [(0, x0, y0, y1, k, o), (0, x1, y0, y1, -k, o)][: 1 + (x1 > x0)]
    level: list[Row] = [(1, y0, x0, x1, k, o), (1, y1, x0, x1, -k, o)][: 1 + (y1 > y0)]
    return upright * (y1 > y0) + level * (x1 > x0)


def _clipped(rows: Array, walls: Rect) -> Array:
    """What is within the walls of every segment."""
    axis = rows[:, 0].astype(int)
    low, high = np.array(walls[:2]), np.array(walls[2:])
    inside = (rows[:, 1] > low[axis]) & (rows[:, 1] < high[axis])
    out = rows.copy()
    out[:, 2] = np.maximum(rows[:, 2], low[1 - axis])
    out[:, 3] = np.minimum(rows[:, 3], high[1 - axis])
    return np.asarray(out[inside & (out[:, 3] > out[:, 2])])


def _crossings(rows: Array) -> tuple[Array, Ints, Ints, Ints]:
    """(N, 2) places, (N, 2) lines, and Origin and LineKind of the lines, from (S, 6) segments."""
    line, origin, kind = _merged(rows)
    axis = rows[:, 0].astype(int)
    upright, level = np.flatnonzero(axis == 0), np.flatnonzero(axis == 1)
    level = level[np.argsort(rows[level, 1], kind="stable")]
    heights = rows[level, 1]
    found_a, found_b = [], []
    for k in upright:
        first, last = np.searchsorted(heights, (rows[k, 2] - _CORNER_M, rows[k, 3] + _CORNER_M))
        near = level[first:last]
        good = _has_arm(rows[k, 1], rows[near, 2], rows[near, 3]) & _has_arm(rows[near, 1], rows[k, 2], rows[k, 3])
        found_a.append(np.full(int(good.sum()), k))
        found_b.append(near[good])
    a, b = np.concatenate(found_a), np.concatenate(found_b)
    pairs, first_of = np.unique(np.column_stack([line[a], line[b]]), axis=0, return_index=True)
    return np.column_stack([rows[a, 1], rows[b, 1]])[first_of], pairs, origin, kind


def _has_arm(at: Array, low: Array, high: Array) -> NDArray[np.bool_]:
    """Is enough of a segment there to one side of a position on it?"""
    before = np.minimum(high, at + _CORNER_M) - np.maximum(low, at - _REACH_M)
    after = np.minimum(high, at + _REACH_M) - np.maximum(low, at - _CORNER_M)
    return np.asarray(np.maximum(before, after) >= _NEED_M)


def _merged(rows: Array) -> tuple[Ints, Ints, Ints]:
    """(S,) line of each segment, and Origin and LineKind of the lines: what lies in one line is one."""
    order = np.lexsort((rows[:, 1], rows[:, 4], rows[:, 0]))
    r = rows[order]
    apart = (np.diff(r[:, 0]) != 0) | (np.diff(r[:, 4]) != 0) | (np.diff(r[:, 1]) > _SAME_LINE_M)
    number = np.concatenate([[0], np.cumsum(apart)])
    line = np.empty(len(rows), np.int64)
    line[order] = number
    origin = np.zeros(int(number[-1]) + 1, np.int64)
    np.maximum.at(origin, number, r[:, 5].astype(np.int64))
    kind = r[np.searchsorted(number, np.arange(len(origin))), 4].astype(np.int64)
    return line, origin, kind
