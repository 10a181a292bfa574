"""Hanging lamps, vents and spots into a ceiling, from a seed."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from ceilvo.sim.ceiling.layout import Layout
from ceilvo.sim.ceiling.panels import SPOTS, Panel, PanelKind, Rect, Spot, grown
from ceilvo.sim.ceiling.spec import CeilingSpec

Array = NDArray[np.float64]
_VENTS = 0.6
"""Fraction of the air outlets that are slatted vents, the others are diffusers; chosen."""
_SPOTS = (0.5, 0.3, 0.2)
"""Chance of each of SPOTS; chosen: sprinklers are the most common."""
_STAIN_M = (0.06, 0.22)
"""Radius of a water stain; chosen."""
_NO_LAMP, _RECESSED_TO = 0.08, 0.75
"""Of a regular array's places: so many are left out, up to here a troffer, beyond a narrow lamp; chosen, so that the
array has exceptions."""
_SURFACE_LAMP = (0.95, 0.25)
"""Half length and half width of a surface-mounted lamp, in tiles; chosen."""

_DOWNLIGHT_M = 0.11
"""Radius of a round lamp with its rim; chosen, as common ones have."""


_STRIP_M, _STRIP_WIDE_M, _STRIP_APART_M = 1.5, 0.16, 0.04
"""Length and width of a strip lamp, and the gap to the next in its row; chosen, as battens for tubes of 58 W have."""


def make_layout(spec: CeilingSpec, rng: np.random.Generator) -> Layout:
    """Hang lamps in a regular array with exceptions, and the rest at random into free tiles."""
    half = 0.5 * spec.room_m + spec.margin_m
    turn = abs(np.cos(spec.grid_yaw_rad)) + abs(np.sin(spec.grid_yaw_rad))
    lo, hi = 0.5 * spec.room_m - half * turn, 0.5 * spec.room_m + half * turn
    grooves = (_grooves(spec, 0, lo, hi), _grooves(spec, 1, lo, hi))
    nx, ny = (len(g) - 1 for g in grooves)
    free = np.ones((nx, ny), dtype=bool)
    panels = (_strips if spec.strip_lamps else _lamps)(spec, grooves, free, rng)
    panels += _grilles(spec, grooves, free, rng) + _pictured(spec, grooves)
    for i, j in _pick(free, spec.vents, rng):
        kind: PanelKind = "vent" if rng.random() < _VENTS else "diffuser"
        panels.append(Panel(kind, _tiles(spec, grooves, i, j, 1, 1), int(rng.integers(2))))
    spots = []
    for i, j in _pick(free, spec.spots, rng):
        name, radius_m = SPOTS[int(rng.choice(len(SPOTS), p=_SPOTS))]
        spots.append(Spot(name, _centre(spec, grooves, i, j), radius_m))
    stains = [_stain(lo, hi, rng) for _ in range(spec.stains)]
    return Layout(spec, (lo, lo, hi, hi), grooves, tuple(panels), tuple(spots), tuple(stains))


def _stain(lo: float, hi: float, rng: np.random.Generator) -> tuple[float, float, float]:
    return float(rng.uniform(lo, hi)), float(rng.uniform(lo, hi)), float(rng.uniform(*_STAIN_M))


def _grooves(spec: CeilingSpec, axis: int, lo: float, hi: float) -> Array:
    """Positions of the grooves of one axis within the extent."""
    pitch = spec.tile_xy_m[axis]
    first = np.ceil((lo - spec.grid_offset_m[axis]) / pitch)
    n = int(np.floor((hi - spec.grid_offset_m[axis]) / pitch) - first) + 1
    return np.asarray(spec.grid_offset_m[axis] + pitch * (first + np.arange(n)))


def _tiles(spec: CeilingSpec, grooves: tuple[Array, Array], i: int, j: int, wide: int, high: int) -> Rect:
    """Rectangle between the grooves around a block of tiles."""
    g = 0.5 * spec.groove_m
    x0, y0 = float(grooves[0][i]), float(grooves[1][j])
    along_x, along_y = spec.tile_xy_m
    return (x0 + g, y0 + g, x0 + wide * along_x - g, y0 + high * along_y - g)


def _centre(spec: CeilingSpec, grooves: tuple[Array, Array], i: int, j: int) -> tuple[float, float]:
    along_x, along_y = spec.tile_xy_m
    return float(grooves[0][i]) + 0.5 * along_x, float(grooves[1][j]) + 0.5 * along_y


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
            if chance < _NO_LAMP or not free[i : i + 2, j].all():
                continue
            free[i : i + 2, j] = False
            if spec.round_lamps:
                x, y = float(grooves[0][i]) + spec.tile_m, _centre(spec, grooves, i, j)[1]
                out.append(
                    Panel(
                        "lamp", (x - _DOWNLIGHT_M, y - _DOWNLIGHT_M, x + _DOWNLIGHT_M, y + _DOWNLIGHT_M), 0, round=True
                    )
                )
                continue
            if chance < _RECESSED_TO:
                out.append(Panel("lamp", _tiles(spec, grooves, i, j, 2, 1), 0))
                continue
            x, y = float(grooves[0][i]) + spec.tile_m, _centre(spec, grooves, i, j)[1]
            w, h = (k * spec.tile_m for k in _SURFACE_LAMP)
            out.append(Panel("lamp", (x - w, y - h, x + w, y + h), 0, recessed=False))
    return out


def _strips(
    spec: CeilingSpec, grooves: tuple[Array, Array], free: NDArray[np.bool_], rng: np.random.Generator
) -> list[Panel]:
    """Rows of strip lamps along x, screwed on below the middles of tiles, with no place left out."""
    every = spec.lamp_every[1]
    if every < 1:
        return []
    begins = np.arange(grooves[0][0] + rng.uniform(0.0, _STRIP_M), grooves[0][-1] - _STRIP_M, _STRIP_M + _STRIP_APART_M)
    out = []
    for j in range(int(rng.integers(every)), free.shape[1], every):
        free[:, j] = False
        y0 = _centre(spec, grooves, 0, j)[1] - 0.5 * _STRIP_WIDE_M
        strips = ((float(x0), y0, float(x0) + _STRIP_M, y0 + _STRIP_WIDE_M) for x0 in begins)
        out += [Panel("lamp", rect, 0, recessed=False) for rect in strips]
    return out


def _grilles(
    spec: CeilingSpec, grooves: tuple[Array, Array], free: NDArray[np.bool_], rng: np.random.Generator
) -> list[Panel]:
    """Grilles in the places of two tiles along x."""
    if spec.grilles == 0:
        return []
    places = free[:-1] & free[1:]
    out: list[Panel] = []
    for i, j in np.argwhere(places)[rng.permutation(int(places.sum()))]:
        if len(out) < spec.grilles and free[i : i + 2, j].all():
            free[i : i + 2, j] = False
            out.append(Panel("grille", _tiles(spec, grooves, int(i), int(j), 2, 1), 0))
    return out


def _pictured(spec: CeilingSpec, grooves: tuple[Array, Array]) -> list[Panel]:
    """The dark panels of a ceiling that is a picture."""
    if spec.picture is None:
        return []
    inset_m, (along_x, along_y) = spec.picture.dark_inset * spec.tile_m, (g.tolist() for g in grooves)
    return [
        Panel("dark", grown((x0, y0, x1, y1), -inset_m), 0)
        for x0, x1 in pairwise(along_x)
        for y0, y1 in pairwise(along_y)
        if spec.picture.is_dark(round(x0 / spec.tile_m), round(y0 / spec.tile_m))
    ]


def _pick(free: NDArray[np.bool_], n: int, rng: np.random.Generator) -> list[tuple[int, int]]:
    """Up to n free tiles, taken."""
    where = np.argwhere(free)
    chosen = where[rng.permutation(len(where))[:n]]
    free[chosen[:, 0], chosen[:, 1]] = False
    return [(int(i), int(j)) for i, j in chosen]
