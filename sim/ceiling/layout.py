"""Everything on one simulated ceiling, and the true lines and crossings that it makes.

Coordinates are the ceiling's own: metres, parallel to its grid.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import IntEnum

import numpy as np
from numpy.typing import NDArray

from ceilvo.sim.ceiling.panels import Panel, Rect, Spot
from ceilvo.sim.ceiling.spec import CeilingSpec
from ceilvo.types import LineKind

Array = NDArray[np.float64]
Ints = NDArray[np.int64]
WIDE_M = 0.015
"""A wider joint shows two edges of its own; chosen: twice the usual joint."""
_ARM_M = 0.05
"""How far from a crossing its arms are looked for; chosen: outside the joint, inside the tile."""


class CrossingType(IntEnum):
    """What meets at a true crossing."""

    CROSS = 0  # two grooves, all four arms visible
    TEE = 1  # two grooves, an arm hidden by a panel
    LAMP = 2  # corner of a lamp's luminous field
    VENT = 3  # corner of a vent's opening


@dataclass(frozen=True)
class TrueLines:
    """Straight lines that can be seen. A dark slot is listed three times: two edges, and a groove along its middle.

    Attributes:
        segments: (L, 2, 2) end points in map.
        axis: (L,) 0 for x = const in the ceiling's own frame, 1 for y = const.
        kind: (L,) LineKind along the axis' positive normal in the ceiling's frame.
    """

    segments: Array
    axis: Ints
    kind: Ints


@dataclass(frozen=True)
class Layout:
    """Everything on one ceiling: extent (x0, y0, x1, y1), groove positions per axis, what hangs, stains (x, y, r)."""

    spec: CeilingSpec
    extent: Rect
    grooves: tuple[Array, Array]
    panels: tuple[Panel, ...]
    spots: tuple[Spot, ...]
    stains: tuple[tuple[float, float, float], ...]
    lamps: tuple[Panel, ...] = field(init=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "lamps", tuple(p for p in self.panels if p.kind == "lamp"))

    def crossings(self) -> tuple[Array, Ints]:
        """(N, 2) true crossings and (N,) CrossingType."""
        xy: list[tuple[float, float]] = []
        types: list[int] = []
        for x in self._joints(0):
            for y in self._joints(1):
                if not self._hidden(x, y):
                    arms = ((x + _ARM_M, y), (x - _ARM_M, y), (x, y + _ARM_M), (x, y - _ARM_M))
                    xy.append((x, y))
                    types.append(CrossingType.TEE if any(self._hidden(*a) for a in arms) else CrossingType.CROSS)
        for p in self.panels:
            if p.round:
                continue
            x0, y0, x1, y1 = p.inner
            xy += [(x0, y0), (x1, y0), (x1, y1), (x0, y1)]
            types += [CrossingType.LAMP if p.kind == "lamp" else CrossingType.VENT] * 4
        return np.array(xy).reshape(-1, 2), np.array(types, dtype=np.int64)

    def lines(self) -> TrueLines:
        """All true lines, with segments in the ceiling's own frame."""
        found: list[tuple[int, float, float, float, int]] = []
        for axis in (0, 1):
            for at in self._joints(axis):
                for lo, hi in self._visible(axis, at):
                    found += [(axis, at + d, lo, hi, kind) for d, kind in self._profile()]
        for p in self.panels:
            if p.round:
                continue
            if p.kind == "lamp":
                found += _outline(p.inner, LineKind.RISING)
            if p.recessed and not self.spec.joints:  # otherwise the joint around it is the line
                found += _outline(p.rect, LineKind.RISING)
            for at in p.joints():
                found += _outline(at, LineKind.GROOVE)
            for slot in p.steps():
                found += _outline(slot, LineKind.FALLING)
            for x0, y0, x1, y1 in p.blades():
                sides = _outline((x0, y0, x1, y1), LineKind.RISING)
                middle = (1, 0.5 * (y0 + y1), x0, x1) if x1 - x0 > y1 - y0 else (0, 0.5 * (x0 + x1), y0, y1)
                found += [*(s for s in sides if s[0] == middle[0]), (*middle, int(LineKind.GROOVE))]
            if p.kind in ("grille", "dark"):
                found += _outline(p.inner, LineKind.FALLING)
            for i, ring in enumerate(p.rings()):
                found += _outline(ring, LineKind.FALLING if i % 2 == 0 else LineKind.RISING)
        a = np.array(found, dtype=np.float64).reshape(-1, 5)
        axes = a[:, 0].astype(np.int64)
        ends = a[:, 2:4]
        across = np.repeat(a[:, 1:2], 2, axis=1)
        x = np.where(axes[:, None] == 0, across, ends)
        y = np.where(axes[:, None] == 0, ends, across)
        return TrueLines(np.stack([x, y], axis=-1), axes, a[:, 4].astype(np.int64))

    def intersections(self, reach_m: float) -> Array:
        """(N, 2) where lines of both axes meet, or would within reach_m of an end."""
        t = self.lines()
        x_lines, y_lines = t.segments[t.axis == 0], t.segments[t.axis == 1]
        x, y = x_lines[:, 0, 0], y_lines[:, 0, 1]
        on_x = (y >= x_lines[:, :1, 1] - reach_m) & (y <= x_lines[:, 1:, 1] + reach_m)
        on_y = (x[:, None] >= y_lines[:, 0, 0] - reach_m) & (x[:, None] <= y_lines[:, 1, 0] + reach_m)
        i, j = np.nonzero(on_x & on_y)
        return np.column_stack([x[i], y[j]])

    def _joints(self, axis: int) -> Array:
        return self.joints()[axis] if self.spec.joints else np.zeros(0)

    def joints(self) -> tuple[Array, Array]:
        """Where straight joints are, per axis: those of tiles or slats; hexagons have none as long as a line."""
        if self.spec.pattern == "tiles":
            return self.grooves
        if self.spec.pattern == "hexagons":
            return np.zeros(0), np.zeros(0)
        lo, hi, pitch = self.extent[0], self.extent[2], self.spec.slat_m
        first = np.ceil((lo - self.spec.grid_offset_m[0]) / pitch)
        n = int((hi - self.spec.grid_offset_m[0]) / pitch - first) + 1
        return self.spec.grid_offset_m[0] + pitch * (first + np.arange(n)), np.zeros(0)

    def _profile(self) -> list[tuple[float, int]]:
        """Lines that a joint shows, with their distance from its middle: a wide one has two edges of its own."""
        s = self.spec
        half, bright = 0.5 * s.groove_m, s.groove_albedo > s.lip_albedo
        if s.groove_darker is not None:
            bright = s.groove_darker < 0.0
        edge = int(LineKind.RISING if bright else LineKind.FALLING)
        edges = [(-half, edge), (half, -edge)] if s.groove_m > WIDE_M else []
        return [(0.0, int(LineKind.GROOVE)), *edges]

    def _hidden(self, x: float, y: float) -> bool:
        return any(p.hides(x, y) for p in self.panels)

    def _visible(self, axis: int, at: float) -> list[tuple[float, float]]:
        """Stretches of a groove that no panel covers."""
        lo, hi = self.extent[1 - axis], self.extent[3 - axis]
        over = sorted((p.rect[1 - axis], p.rect[3 - axis]) for p in self.panels if p.rect[axis] < at < p.rect[axis + 2])
        out = []
        for a, b in over:
            if a > lo:
                out.append((lo, a))
            lo = max(lo, b)
        return [*out, (lo, hi)] if hi > lo else out


def _outline(rect: Rect, first: LineKind) -> list[tuple[int, float, float, float, int]]:
    """Edges of a rectangle whose inside is brighter (first RISING) or darker (first FALLING), or that is drawn with a
    dark line (GROOVE); one line for a rectangle without width."""
    x0, y0, x1, y1 = rect
    k = int(first)
    along_y = [(0, x0, y0, y1, k), (0, x1, y0, y1, -k)][: 1 + (x1 > x0)]
    along_x = [(1, y0, x0, x1, k), (1, y1, x0, x1, -k)][: 1 + (y1 > y0)]
    return along_y * (y1 > y0) + along_x * (x1 > x0)
