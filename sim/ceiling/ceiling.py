"""A picture of a ceiling, exact to a fraction of a texel, and the truth about what is on it."""

from __future__ import annotations

from functools import cached_property
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from ceilvo import se2
from ceilvo.sim.ceiling import board
from ceilvo.sim.ceiling.arrangement import make_layout
from ceilvo.sim.ceiling.layout import Layout, TrueLines
from ceilvo.sim.ceiling.panels import Panel, Rect, Spot, SpotKind, grown
from ceilvo.sim.ceiling.pictured import albedo_of
from ceilvo.sim.ceiling.spec import CeilingSpec

Array = NDArray[np.float64]
Array32 = NDArray[np.float32]
Ints = NDArray[np.int64]

TILE, GROOVE, RIM, SLOT, PANEL, GAP = 0.76, 0.16, 0.90, 0.20, 0.84, 0.35
"""Albedo of what is painted white, of shadow joints and slots, of sheet metal; chosen, as all of this picture: it must
have what makes real ceilings hard, not be a certain one."""
LAMP_RADIANCE = 4.5
"""A white surface under the room's light is 1: a lamp's field saturates a camera exposed for the tiles."""
HALO, _HALO_M, _HALO_COARSE = 0.22, 0.30, 16
"""Extra light on the tiles next to a lamp, how far it reaches (sigma), and texels in one of the blur's."""
_TUBES, _TUBES_DEPTH = 2, 0.1
"""Of a lamp, and how much darker it is between them."""
_TILES_FROM, _TILES_TO = 0.4, 0.95
"""Albedo of the darkest and the brightest tile."""
_FALL = ((0.04, 0.5, 0.3), (0.03, 0.6))
"""Slow fall of light along x and y: relative size, rad/m and along x its phase."""
_STAIN_REACH, _STAIN_LOBES, _STAIN_LOBE = 1.6, (2, 3, 5), 0.09
"""Dried water: radii that are drawn, waves of its outline, and their relative size."""
_STAIN_EDGE, _STAIN_INSIDE, _STAIN_RIM = 0.05, 0.05, (0.97, 0.06, 0.10)
"""Dried water: softness of its edge in radii, how much darker it is inside, and its rim: where, how wide, how dark."""
_SPOT_RINGS: dict[SpotKind, tuple[tuple[float, float], ...]] = {
    "sprinkler": ((1.0, 0.88), (0.55, 0.35), (0.30, 0.80)),
    "detector": ((1.0, 0.92), (0.80, 0.30), (0.68, 0.90), (0.12, 0.25)),
    "speaker": ((1.0, 0.90), (0.88, 0.58)),
}
"""Discs from the outermost: radius over the spot's, albedo."""
_PROLONGED_M = 0.07
"""By which true lines are prolonged to meet: detection ends segments at panels' gaps and bridges them."""

_HEXAGON = tuple((float(np.cos(k * np.pi / 3.0)), float(np.sin(k * np.pi / 3.0))) for k in range(3))
"""Normals of a hexagon's sides."""


class Ceiling:
    """Drawn from a seed.

    Attributes:
        layout: what hangs where.
        albedo: (Ny, Nx) float32; texel [j, i] covers x0 + [i, i + 1] * texel, y0 + [j, j + 1] * texel.
    """

    def __init__(self, spec: CeilingSpec | None = None, seed: int = 1) -> None:
        self.spec = spec or CeilingSpec()
        rng = np.random.default_rng([seed, 0xCE11])
        self.layout: Layout = make_layout(self.spec, rng)
        x0, y0, x1, y1 = self.layout.extent
        n = self.spec.texel_m
        self._size = (int(np.ceil((x1 - x0) / n)), int(np.ceil((y1 - y0) / n)))
        self.albedo: Array32 = self._draw(rng, np.random.default_rng([seed, 0xF1B2E]))

    def true_crossings(self) -> tuple[Array, Ints]:
        """(N, 2) crossings in map and (N,) CrossingType: grooves that meet, corners of lamps and vents."""
        xy, crossing_type = self.layout.crossings()
        return se2.transform(self._map_from_ceiling, xy), crossing_type

    def true_intersections(self, reach_m: float = _PROLONGED_M) -> Array:
        """(N, 2) in map: all places where two true lines meet or, prolonged by reach_m, would; for precision."""
        return se2.transform(self._map_from_ceiling, self.layout.intersections(reach_m))

    def true_lines(self) -> TrueLines:
        """Every groove, lamp edge and slat edge, with end points in map."""
        lines = self.layout.lines()
        xy = se2.transform(self._map_from_ceiling, lines.segments.reshape(-1, 2))
        return TrueLines(xy.reshape(-1, 2, 2), lines.axis, lines.kind)

    @cached_property
    def _map_from_ceiling(self) -> Array:
        """The grid is turned about the room's centre."""
        c = np.full(2, 0.5 * self.spec.room_m)
        turn = np.array([0.0, 0.0, self.spec.grid_yaw_rad])
        return np.array([*(c - se2.transform(turn, c[None])[0]), self.spec.grid_yaw_rad])

    @cached_property
    def texel_from_map(self) -> Array:
        """(3, 3) homogeneous: texture coordinates, integers at texel centres, from metres in map."""
        x, y, th = se2.inverse(self._map_from_ceiling)
        c, s = np.cos(th), np.sin(th)
        k = 1.0 / self.spec.texel_m
        x0, y0 = self.layout.extent[:2]
        return np.array([[c * k, -s * k, (x - x0) * k - 0.5], [s * k, c * k, (y - y0) * k - 0.5], [0.0, 0.0, 1.0]])

    def radiance(self, lit: tuple[int, ...] | None = None, daylight: float = 0.3) -> tuple[Array32, Array32]:
        """Two (Ny, Nx) float32 pictures to be added: by daylight, and by the lamps that are lit.

        Args:
            lit: indices into layout.lamps, None for all.
            daylight: fraction of the room's light that does not come from lamps; the rest comes with the fraction lit.
        """
        lamps = self.layout.lamps
        on = lamps if lit is None else tuple(lamps[i] for i in lit)
        lamps_on = len(on) / len(lamps) if lamps else 1.0
        glow = np.zeros_like(self.albedo)
        for lamp in on:
            self._emit(glow, lamp)
        light = (1.0 - daylight) * lamps_on + self._halo(glow)
        return self.albedo * np.float32(daylight), self.albedo * light + glow

    def _emit(self, glow: Array32, lamp: Panel) -> None:
        if lamp.round:
            win, cover = self._disc(lamp.inner)
            glow[win] += np.float32(LAMP_RADIANCE) * cover
            return
        win, cover = self._cover(lamp.inner)
        _, y0, _, y1 = lamp.inner
        _, y = self._centres()
        tubes = 1.0 - _TUBES_DEPTH + _TUBES_DEPTH * np.cos(2 * _TUBES * np.pi * (y[win[0]] - y0) / (y1 - y0))
        glow[win] += (LAMP_RADIANCE * cover * tubes[:, None]).astype(np.float32)

    def _halo(self, glow: Array32) -> Array32:
        """Light that lamps throw on the tiles around them."""
        small = cv2.resize(glow, None, fx=1 / _HALO_COARSE, fy=1 / _HALO_COARSE, interpolation=cv2.INTER_AREA)
        sigma = _HALO_M / (_HALO_COARSE * self.spec.texel_m)
        soft = cv2.GaussianBlur(small, (0, 0), sigma) * (HALO / LAMP_RADIANCE)
        return np.asarray(cv2.resize(soft, self._size, interpolation=cv2.INTER_LINEAR), np.float32)

    def _draw(self, rng: np.random.Generator, of_boards: np.random.Generator) -> Array32:
        s = self.spec
        if s.picture is not None:
            return albedo_of(s.picture, s.tile_m, self.layout.extent[:2], self._size, s.texel_m, TILE)
        a = self._tiles(rng)
        self._stain(a, rng)
        if s.fibre > 0:
            self._face(a, board.fibre(self._size, s.texel_m, s.fibre, of_boards))
        else:
            a *= board.mineral(self._size, s.texture, rng)
        if s.wood:
            slat = np.searchsorted(self.layout.joints()[0], self._centres()[0])
            self._face(a, board.wood(slat, self._size, s.texel_m, of_boards))
        if s.joints:
            (self._hexagons if s.pattern == "hexagons" else self._grooves)(a)
        for p in self.layout.panels:
            self._panel(a, p)
        for spot in self.layout.spots:
            self._spot(a, spot)
        return a

    def _centres(self) -> tuple[Array, Array]:
        """Texel centres along x and y."""
        n = self.spec.texel_m
        x0, y0 = self.layout.extent[:2]
        x = x0 + (np.arange(self._size[0], dtype=np.float64) + 0.5) * n
        y = y0 + (np.arange(self._size[1], dtype=np.float64) + 0.5) * n
        return np.asarray(x, np.float64), np.asarray(y, np.float64)

    def _tiles(self, rng: np.random.Generator) -> Array32:
        """Each tile's own brightness, and a slow fall of light across the room."""
        x, y = self._centres()
        i, j = np.searchsorted(self.layout.grooves[0], x), np.searchsorted(self.layout.grooves[1], y)
        shape = (len(self.layout.grooves[1]) + 1, len(self.layout.grooves[0]) + 1)
        spread = self.spec.tile_spread if self.spec.pattern == "tiles" else 0.0
        own = np.clip(rng.normal(TILE, TILE * spread, shape), _TILES_FROM, _TILES_TO)
        a = own.astype(np.float32)[j[:, None], i[None, :]]
        (along_x, wave_x, phase), (along_y, wave_y) = _FALL
        a *= (1.0 + along_x * np.sin(wave_x * x + phase)).astype(np.float32)
        a *= (1.0 + along_y * np.cos(wave_y * y)).astype(np.float32)[:, None]
        return np.asarray(a, np.float32)

    def _face(self, a: Array32, factor: Array32) -> None:
        """What the boards show, not the painted joints between them."""
        if self.spec.joints and self.spec.pattern != "hexagons":
            factor = 1.0 + (factor - 1.0) * self._besides_joints(0.5 * self.spec.groove_m)
        a *= factor

    def _stain(self, a: Array32, rng: np.random.Generator) -> None:
        """Dried water: a soft patch with a darker rim, not quite round."""
        for x, y, r in self.layout.stains:
            m = _STAIN_REACH * r
            win, (dx, dy) = self._window((x - m, y - m, x + m, y + m))
            th = np.arctan2(dy - y, dx - x)
            phases = rng.uniform(0, 6.28, len(_STAIN_LOBES))
            lobes = sum(_STAIN_LOBE * np.cos(k * th + p) for k, p in zip(_STAIN_LOBES, phases, strict=True))
            d = np.hypot(dx - x, dy - y) / (r * (1.0 + lobes))
            inside = 1.0 / (1.0 + np.exp((d - 1.0) / _STAIN_EDGE))
            at, width, dark = _STAIN_RIM
            rim = np.exp(-0.5 * ((d - at) / width) ** 2)
            a[win] *= (1.0 - _STAIN_INSIDE * inside - dark * rim).astype(np.float32)

    def _grooves(self, a: Array32) -> None:
        """Joints with a bevel on either side."""
        half, lip = 0.5 * self.spec.groove_m, self.spec.lip_m
        bare, tile = self._besides_joints(half), self._besides_joints(half + lip)  # all but joints, and their bevels
        if self.spec.groove_darker is not None:
            a *= 1.0 - np.float32(self.spec.groove_darker) * (1.0 - bare)
            return
        a *= tile
        a += np.float32(self.spec.lip_albedo) * (bare - tile) + np.float32(self.spec.groove_albedo) * (1.0 - bare)

    def _besides_joints(self, half_m: float) -> Array32:
        """(Ny, Nx) share of each texel that is farther than this from the middle of any straight joint."""
        free = [1.0 - self._profile(axis, at - half_m, at + half_m) for axis, at in enumerate(self.layout.joints())]
        soft = self.spec.groove_soft_m / self.spec.texel_m
        if soft > 0:
            free = [cv2.GaussianBlur(f[None], (0, 0), soft, borderType=cv2.BORDER_REFLECT)[0] for f in free]
        return np.outer(free[1], free[0]).astype(np.float32)

    def _panel(self, a: Array32, p: Panel) -> None:
        if p.round:
            for rect, value in ((p.rect, RIM), (p.inner, PANEL)):
                win, cover = self._disc(rect)
                a[win] += cover * (np.float32(value) - a[win])
            return
        if not p.recessed:
            x0, y0, x1, y1 = p.rect
            g = p.GAP_M
            self._fill(a, (x0 - g, y0 - g, x1 + g, y1 + g), GAP)
        self._fill(a, p.rect, RIM)
        self._fill(a, p.inner, PANEL)
        for slot in p.steps():
            self._fill(a, slot, SLOT)
        if p.kind == "grille":
            self._fill(a, p.inner, SLOT)
        for blade in p.blades():
            self._fill(a, blade, RIM)
        for i, ring in enumerate(p.rings()):
            self._fill(a, ring, SLOT if i % 2 == 0 else RIM)

    def _disc(self, rect: Rect) -> tuple[tuple[slice, slice], Array32]:
        """Window of texels of a rectangle, and how much of each the disc in its middle covers."""
        x0, y0, x1, y1 = rect
        win, (x, y) = self._window(grown(rect, 3 * self.spec.texel_m))
        d = np.hypot(x - 0.5 * (x0 + x1), y - 0.5 * (y0 + y1))
        radius = 0.5 * min(x1 - x0, y1 - y0)
        return win, np.clip((radius - d) / self.spec.texel_m + 0.5, 0.0, 1.0).astype(np.float32)

    def _hexagons(self, a: Array32) -> None:
        """Joints between hexagons: a point's distance from the nearest one's sides."""
        s, (x, y) = self.spec, self._centres()
        size = np.array([s.tile_m, s.tile_m * np.sqrt(3.0)])
        nearest = np.full(a.shape, np.inf, np.float32)
        inside = np.zeros(a.shape, np.float32)
        for shift in (0.0, 0.5):  # two interleaved rectangular lattices of centres
            dx, dy = (_from_nearest(p - s.grid_offset_m[i], size[i], shift) for i, p in enumerate((x, y)))
            off = np.hypot(dx[None, :], dy[:, None]).astype(np.float32)
            sides = [np.abs(c * dx[None, :] + d * dy[:, None]).astype(np.float32) for c, d in _HEXAGON]
            np.copyto(inside, 0.5 * s.tile_m - np.maximum.reduce(sides), where=off < nearest)
            np.minimum(nearest, off, out=nearest)
        half = 0.5 * s.groove_m
        joint, lip = (np.clip((w - inside) / s.texel_m + 0.5, 0.0, 1.0) for w in (half, half + s.lip_m))
        if s.groove_darker is not None:
            a *= 1.0 - np.float32(s.groove_darker) * joint
            return
        a += lip * (np.float32(s.lip_albedo) - a)
        a += joint * (np.float32(s.groove_albedo) - a)

    def _spot(self, a: Array32, s: Spot) -> None:
        x, y = s.xy
        m = s.radius_m + 3 * self.spec.texel_m
        win, (dx, dy) = self._window((x - m, y - m, x + m, y + m))
        d = np.hypot(dx - x, dy - y)
        for radius, value in _SPOT_RINGS[s.kind]:
            cover = np.clip((radius * s.radius_m - d) / self.spec.texel_m + 0.5, 0.0, 1.0).astype(np.float32)
            a[win] += cover * (np.float32(value) - a[win])

    def _fill(self, a: Array32, rect: Rect, value: float) -> None:
        win, cover = self._cover(rect)
        a[win] += cover * (np.float32(value) - a[win])

    def _cover(self, rect: Rect) -> tuple[tuple[slice, slice], Array32]:
        """Window of texels that a rectangle touches and how much of it each gets."""
        sx, cx = self._interval(0, rect[0], rect[2])
        sy, cy = self._interval(1, rect[1], rect[3])
        return (sy, sx), np.outer(cy, cx).astype(np.float32)

    def _interval(self, axis: int, lo: float, hi: float) -> tuple[slice, Array]:
        """Texels along an axis that an interval reaches, and how much of it each gets: weighted with the tent of the
        linear interpolation that the picture will be read with, so that mass and centre are kept exactly."""
        n, origin = self.spec.texel_m, self.layout.extent[axis]
        a, b = (lo - origin) / n - 0.5, (hi - origin) / n - 0.5
        first = max(int(np.floor(a)), 0)
        last = max(min(int(np.ceil(b)) + 1, self._size[axis]), first)
        i = np.arange(first, last)
        return slice(first, last), _tent_integral(b - i) - _tent_integral(a - i)

    def _profile(self, axis: int, lo: Array, hi: Array) -> Array:
        """How much each texel along an axis gets of disjoint intervals."""
        out = np.zeros(self._size[axis])
        for a, b in zip(lo, hi, strict=True):
            where, cover = self._interval(axis, float(a), float(b))
            out[where] += cover
        return out

    def _window(self, rect: Rect) -> tuple[tuple[slice, slice], tuple[Array, Array]]:
        """Window of texels and their centres as a broadcastable pair."""
        sx, _ = self._interval(0, rect[0], rect[2])
        sy, _ = self._interval(1, rect[1], rect[3])
        x, y = self._centres()
        return (sy, sx), (x[sx][None, :], y[sy][:, None])


def _from_nearest(at: Array, pitch: float, shift: float) -> Array:
    """Signed distances from the nearest of places a pitch apart, moved by a share of it."""
    return at - pitch * (np.round(at / pitch - shift) + shift)


def _tent_integral(t: NDArray[np.floating[Any]]) -> Array:
    """Integral of max(0, 1 - |t|) from minus infinity."""
    c = np.clip(t, -1.0, 1.0)
    return np.asarray(0.5 + c - 0.5 * c * np.abs(c))
