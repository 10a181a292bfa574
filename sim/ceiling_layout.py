"""What hangs where: tiles, lamps, vents and round spots of a simulated ceiling, and the true lines they make.

Coordinates are the ceiling's own: metres, parallel to its grid.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import IntEnum
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from ceilvo.errors import ConfigError
from ceilvo.types import LineKind

Array = NDArray[np.float64]
Ints = NDArray[np.int64]
Rect = tuple[float, float, float, float]
PanelKind = Literal["lamp", "vent", "diffuser"]
SpotKind = Literal["sprinkler", "detector", "speaker"]
WIDE_M = 0.015
SPOTS: tuple[tuple[SpotKind, float], ...] = (("sprinkler", 0.038), ("detector", 0.055), ("speaker", 0.105))


class CrossingKind(IntEnum):
    """What meets at a true crossing."""

    CROSS = 0  # two grooves, all four arms visible
    TEE = 1  # two grooves, an arm hidden by a panel
    LAMP = 2  # corner of a lamp's luminous field
    VENT = 3  # corner of a vent's opening


@dataclass(frozen=True)
class CeilingSpec:
    """A tiled office ceiling.

    Attributes:
        room_m: side of the room below it.
        margin_m: how far it goes on beyond the walls (open plan), so that the camera never sees its end.
        tile_m: side of a tile.
        grid_offset_m: where a groove of each axis lies, from the map's origin.
        grid_yaw_rad: the grid against the map, turned about the room's centre.
        groove_m, lip_m: width of the dark joint, and of the bright bevel on either side of it.
        groove_albedo, lip_albedo: how bright they are (a tile is 0.76). A wide bright joint is a T-bar, one of nearly
            the tile's brightness a faint groove.
        joints: False is a bare plaster ceiling; what hangs on it stays where it was.
        texel_m: resolution of the picture.
        tile_spread: standard deviation of the tiles' brightness.
        texture: strength of the tiles' speckle and mottling; 0 is plain.
        lamp_every: one lamp in so many tiles along each axis; (0, 0) is none.
        vents, spots, stains: how many of each in the room and its margin.
    """

    room_m: float = 5.0
    margin_m: float = 2.0
    tile_m: float = 0.6
    grid_offset_m: tuple[float, float] = (0.137, 0.418)
    grid_yaw_rad: float = 0.0
    groove_m: float = 0.008
    lip_m: float = 0.005
    groove_albedo: float = 0.16
    lip_albedo: float = 0.84
    joints: bool = True
    texel_m: float = 0.003
    tile_spread: float = 0.025
    texture: float = 1.0
    lamp_every: tuple[int, int] = (4, 3)
    vents: int = 12
    spots: int = 24
    stains: int = 7

    def __post_init__(self) -> None:
        for name in ("room_m", "tile_m", "groove_m", "texel_m"):
            if not getattr(self, name) > 0:
                raise ConfigError(f"ceiling: {name} is {getattr(self, name)}, expected more than 0")
        if self.groove_m + 2 * self.lip_m > 0.5 * self.tile_m:
            raise ConfigError(
                f"ceiling: groove_m {self.groove_m} with lip_m {self.lip_m} does not fit tiles of tile_m {self.tile_m}"
            )


@dataclass(frozen=True)
class Panel:
    """Something rectangular in the ceiling.

    Attributes:
        rect: outer rectangle x0, y0, x1, y1 in metres.
        axis: a vent's slats run along x (0) or y (1).
        recessed: in the grid's place, not screwed on with a gap around it.
    """

    kind: PanelKind
    rect: Rect
    axis: int
    recessed: bool = True

    RIM_M = 0.030
    GAP_M = 0.007
    SLAT_M = 0.050

    @property
    def inner(self) -> Rect:
        """Luminous field or opening, inside the rim."""
        x0, y0, x1, y1 = self.rect
        return (x0 + self.RIM_M, y0 + self.RIM_M, x1 - self.RIM_M, y1 - self.RIM_M)

    def steps(self) -> list[Rect]:
        """Dark rectangles in a vent's opening: slots between slats, or nothing for a lamp and a diffuser."""
        if self.kind != "vent":
            return []
        x0, y0, x1, y1 = self.inner
        lo, hi = (x0, x1) if self.axis == 1 else (y0, y1)
        n = max(1, round((hi - lo) / self.SLAT_M))
        pitch = (hi - lo) / n
        slots = [(lo + (i + 0.15) * pitch, lo + (i + 0.60) * pitch) for i in range(n)]
        if self.axis == 1:
            return [(a, y0, b, y1) for a, b in slots]
        return [(x0, a, x1, b) for a, b in slots]

    def rings(self) -> list[Rect]:
        """Nested rectangles of a diffuser, outermost first, alternately dark and bright."""
        if self.kind != "diffuser":
            return []
        x0, y0, x1, y1 = self.inner
        half = 0.5 * min(x1 - x0, y1 - y0)
        insets = [d for i in range(20) for d in (0.075 * i, 0.075 * i + 0.028) if d < half - 0.03]
        return [(x0 + d, y0 + d, x1 - d, y1 - d) for d in insets]

    def joints(self) -> list[Rect]:
        """Rectangles along the middles of what is narrow and dark: gap, slots, rings."""
        out = [] if self.recessed else [_grown(self.rect, 0.5 * self.GAP_M)]
        rings = self.rings()
        for outer, inner in zip(rings[0::2], rings[1::2], strict=False):
            out.append(_grown(outer, 0.5 * (outer[0] - inner[0])))
        for x0, y0, x1, y1 in self.steps():
            x, y = 0.5 * (x0 + x1), 0.5 * (y0 + y1)
            out.append((x, y0, x, y1) if self.axis == 1 else (x0, y, x1, y))
        return out

    def hides(self, x: float, y: float) -> bool:
        """Whether a groove at this point lies behind the panel."""
        x0, y0, x1, y1 = self.rect
        return x0 < x < x1 and y0 < y < y1


@dataclass(frozen=True)
class Spot:
    """Something round: a sprinkler's plate, a smoke detector, a loudspeaker's grille."""

    kind: SpotKind
    xy: tuple[float, float]
    radius_m: float


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
        """(N, 2) true crossings and (N,) CrossingKind."""
        xy: list[tuple[float, float]] = []
        kind: list[int] = []
        for x in self._joints(0):
            for y in self._joints(1):
                if not self._hidden(x, y):
                    arms = ((x + 0.05, y), (x - 0.05, y), (x, y + 0.05), (x, y - 0.05))
                    xy.append((x, y))
                    kind.append(CrossingKind.TEE if any(self._hidden(*a) for a in arms) else CrossingKind.CROSS)
        for p in self.panels:
            x0, y0, x1, y1 = p.inner
            xy += [(x0, y0), (x1, y0), (x1, y1), (x0, y1)]
            kind += [CrossingKind.LAMP if p.kind == "lamp" else CrossingKind.VENT] * 4
        return np.array(xy).reshape(-1, 2), np.array(kind, dtype=np.int64)

    def lines(self) -> TrueLines:
        """All true lines, with segments in the ceiling's own frame."""
        found: list[tuple[int, float, float, float, int]] = []
        for axis in (0, 1):
            for at in self._joints(axis):
                for lo, hi in self._visible(axis, at):
                    found += [(axis, at + d, lo, hi, kind) for d, kind in self._profile()]
        for p in self.panels:
            if p.kind == "lamp":
                found += _outline(p.inner, LineKind.RISING)
            if p.recessed and not self.spec.joints:  # otherwise the joint around it is the line
                found += _outline(p.rect, LineKind.RISING)
            for at in p.joints():
                found += _outline(at, LineKind.GROOVE)
            for slot in p.steps():
                found += _outline(slot, LineKind.FALLING)
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
        return self.grooves[axis] if self.spec.joints else np.zeros(0)

    def _profile(self) -> list[tuple[float, int]]:
        """Lines that a joint shows, with their distance from its middle: a wide one has two edges of its own."""
        half, bright = 0.5 * self.spec.groove_m, self.spec.groove_albedo > self.spec.lip_albedo
        edge = int(LineKind.RISING if bright else LineKind.FALLING)
        edges = [(-half, edge), (half, -edge)] if self.spec.groove_m > WIDE_M else []
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


def _grown(rect: Rect, by: float) -> Rect:
    return (rect[0] - by, rect[1] - by, rect[2] + by, rect[3] + by)


def _outline(rect: Rect, first: LineKind) -> list[tuple[int, float, float, float, int]]:
    """Edges of a rectangle whose inside is brighter (first RISING) or darker (first FALLING), or that is drawn with a
    dark line (GROOVE); one line for a rectangle without width."""
    x0, y0, x1, y1 = rect
    k = int(first)
    along_y = [(0, x0, y0, y1, k), (0, x1, y0, y1, -k)][: 1 + (x1 > x0)]
    along_x = [(1, y0, x0, x1, k), (1, y1, x0, x1, -k)][: 1 + (y1 > y0)]
    return along_y * (y1 > y0) + along_x * (x1 > x0)


def make_layout(spec: CeilingSpec, rng: np.random.Generator) -> Layout:
    """Hang lamps in a regular array with exceptions, and the rest at random into free tiles."""
    half = 0.5 * spec.room_m + spec.margin_m
    turn = abs(np.cos(spec.grid_yaw_rad)) + abs(np.sin(spec.grid_yaw_rad))
    lo, hi = 0.5 * spec.room_m - half * turn, 0.5 * spec.room_m + half * turn
    grooves = (_grooves(spec, 0, lo, hi), _grooves(spec, 1, lo, hi))
    nx, ny = (len(g) - 1 for g in grooves)
    free = np.ones((nx, ny), dtype=bool)
    panels = _lamps(spec, grooves, free, rng)
    for i, j in _pick(free, spec.vents, rng):
        kind: PanelKind = "vent" if rng.random() < 0.6 else "diffuser"
        panels.append(Panel(kind, _tiles(spec, grooves, i, j, 1, 1), int(rng.integers(2))))
    spots = []
    for i, j in _pick(free, spec.spots, rng):
        name, radius_m = SPOTS[int(rng.choice(len(SPOTS), p=(0.5, 0.3, 0.2)))]
        spots.append(Spot(name, _centre(spec, grooves, i, j), radius_m))
    stains = [_stain(lo, hi, rng) for _ in range(spec.stains)]
    return Layout(spec, (lo, lo, hi, hi), grooves, tuple(panels), tuple(spots), tuple(stains))


def _stain(lo: float, hi: float, rng: np.random.Generator) -> tuple[float, float, float]:
    return float(rng.uniform(lo, hi)), float(rng.uniform(lo, hi)), float(rng.uniform(0.06, 0.22))


def _grooves(spec: CeilingSpec, axis: int, lo: float, hi: float) -> Array:
    """Positions of the grooves of one axis within the extent."""
    first = np.ceil((lo - spec.grid_offset_m[axis]) / spec.tile_m)
    n = int(np.floor((hi - spec.grid_offset_m[axis]) / spec.tile_m) - first) + 1
    return np.asarray(spec.grid_offset_m[axis] + spec.tile_m * (first + np.arange(n)))


def _tiles(spec: CeilingSpec, grooves: tuple[Array, Array], i: int, j: int, wide: int, high: int) -> Rect:
    """Rectangle between the grooves around a block of tiles."""
    g = 0.5 * spec.groove_m
    x0, y0 = float(grooves[0][i]), float(grooves[1][j])
    return (x0 + g, y0 + g, x0 + wide * spec.tile_m - g, y0 + high * spec.tile_m - g)


def _centre(spec: CeilingSpec, grooves: tuple[Array, Array], i: int, j: int) -> tuple[float, float]:
    return float(grooves[0][i]) + 0.5 * spec.tile_m, float(grooves[1][j]) + 0.5 * spec.tile_m


def _lamps(
    spec: CeilingSpec, grooves: tuple[Array, Array], free: NDArray[np.bool_], rng: np.random.Generator
) -> list[Panel]:
    """Troffers of two tiles by one, some places left out, some with a narrow surface-mounted lamp instead."""
    every_x, every_y = spec.lamp_every
    if every_x < 1 or every_y < 1:
        return []
    nx, ny = free.shape
    out = []
    first_i, first_j = int(rng.integers(every_x)), int(rng.integers(every_y))
    for i in range(first_i, nx - 1, every_x):
        for j in range(first_j, ny, every_y):
            chance = rng.random()
            if chance < 0.08 or not free[i : i + 2, j].all():
                continue
            free[i : i + 2, j] = False
            if chance < 0.75:
                out.append(Panel("lamp", _tiles(spec, grooves, i, j, 2, 1), 0))
                continue
            x, y = float(grooves[0][i]) + spec.tile_m, float(grooves[1][j]) + 0.5 * spec.tile_m
            w, h = 0.95 * spec.tile_m, 0.25 * spec.tile_m
            out.append(Panel("lamp", (x - w, y - h, x + w, y + h), 0, recessed=False))
    return out


def _pick(free: NDArray[np.bool_], n: int, rng: np.random.Generator) -> list[tuple[int, int]]:
    """Up to n free tiles, taken."""
    where = np.argwhere(free)
    chosen = where[rng.permutation(len(where))[:n]]
    free[chosen[:, 0], chosen[:, 1]] = False
    return [(int(i), int(j)) for i, j in chosen]
