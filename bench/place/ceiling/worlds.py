"""Rooms and halls: what hangs where on their ceilings, and the map of them that a daemon has learnt."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from ceilvo.bench.place.ceiling.truth import Features, features_of
from ceilvo.sim.ceiling.layout import Layout
from ceilvo.sim.ceiling.panels import Panel, PanelKind, Rect
from ceilvo.sim.ceiling.spec import CeilingSpec
from ceilvo.types import Array, Landmarks

Lamps = Literal["raster", "sparse", "bare stretch", "perfect"]
LAMPS: tuple[Lamps, ...] = ("raster", "sparse", "bare stretch")
"""That rooms are drawn with; a perfect raster has neither gaps nor vents, so that the eye cannot tell places apart."""
SIZES_M = {"5": (5.0, 5.0), "20": (20.0, 20.0), "60": (60.0, 60.0), "150": (150.0, 100.0)}
"""Of the rooms and halls, issue's."""
TILES_M = (0.3, 0.6, 0.625, 1.25)
_LAMP_EVERY = (4, 3)
"""Tiles from lamp to lamp of a raster, as CeilingSpec."""
_GAPS = (0.1, 0.2)
"""Share of the raster's lamps that are missing, from and to."""
_SPARSE = 1.0 / 40.0
"""Lamps a tile where they hang at random; chosen: one in 14 m^2 of 0.6 m tiles."""
_VENTS: dict[Lamps, float] = {"raster": 1.0 / 150.0, "sparse": 1.0 / 60.0, "bare stretch": 1.0 / 150.0, "perfect": 0.0}
"""Vents a tile; chosen: one in some 20 to 50 m^2 of 0.6 m tiles."""
_DIFFUSERS = 0.4
"""Of them, as in sim/ceiling/arrangement.py; slatted vents have hardly a crossing."""
_STRETCH_M, _STRETCH_EVERY_M = 10.0, 30.0
"""A bare stretch has neither lamps nor vents for so long, and so far from the next one (a small room: its middle)."""
_SEVERAL_TILES_M = 1.0
"""A lamp covers two tiles smaller than this, else one; chosen."""
MAP_SIGMA_M = 0.003
"""Of a loaded map's landmarks."""
_SIGHTINGS = 20
"""Of each; chosen: far beyond filter.birth_sightings."""
_IN_MAP = 0.7
"""Crossings that are missed more often than this are not in a loaded map; chosen."""


@dataclass(frozen=True)
class WorldSpec:
    """A room: its name in SIZES_M, tiles, lamps, and the seed of all that is at random: of where the grid lies, and of
    what hangs in it (None: the same)."""

    size: str
    tile_m: float
    lamps: Lamps
    seed: int
    hung: int | None = None


@dataclass(frozen=True)
class World:
    """A room with walls: its spec, what hangs, true crossings, room (x0, y0, x1, y1) and (3,) map_from_ceiling."""

    spec: WorldSpec
    layout: Layout
    features: Features
    room: Rect
    map_from_ceiling: Array


@lru_cache(maxsize=4)
def make_world(spec: WorldSpec) -> World:
    """The same of the same spec."""
    rng = np.random.default_rng([spec.seed, 0xB0])
    map_from_ceiling = np.array([0.0, 0.0, rng.choice([0.0, rng.uniform(-0.75, 0.75)])])
    layout, room = _layout(spec, rng)
    return World(spec, layout, features_of(layout, map_from_ceiling, room), room, map_from_ceiling)


def in_map(missed: Array) -> NDArray[np.bool_]:
    """(N,) which crossings a loaded map has, by the share of the frames (N,) in which each is not seen."""
    return np.asarray(missed < _IN_MAP)


def landmarks_of(features: Features, missed: Array, rng: np.random.Generator) -> Landmarks:
    """The map as a daemon would have learnt it; missed (N,): share of the frames in which each crossing is not seen."""
    known = in_map(missed)
    n = int(np.count_nonzero(known))
    return Landmarks(
        ids=np.arange(n),
        xy_map_m=features.xy_map_m[known] + MAP_SIGMA_M * rng.standard_normal((n, 2)),
        cov_m2=np.tile(MAP_SIGMA_M**2 * np.eye(2), (n, 1, 1)),
        crossing_type=features.crossing_type[known],
        sightings=np.full(n, _SIGHTINGS),
    )


def _layout(spec: WorldSpec, rng: np.random.Generator) -> tuple[Layout, Rect]:
    width_m, height_m = SIZES_M[spec.size]
    tile_m = spec.tile_m
    first = rng.uniform(0.0, tile_m, 2)
    grooves = tuple(np.arange(first[i], size_m, tile_m) for i, size_m in enumerate((width_m, height_m)))
    ceiling = replace(CeilingSpec(), room_m=width_m, tile_m=tile_m)
    room = (0.0, 0.0, width_m, height_m)
    hung = np.random.default_rng([spec.seed if spec.hung is None else spec.hung, 0xB1])
    panels = hang(spec, grooves[0], grooves[1], hung)
    return Layout(ceiling, room, (grooves[0], grooves[1]), panels, (), ()), room


def hang(spec: WorldSpec, x: Array, y: Array, rng: np.random.Generator) -> tuple[Panel, ...]:
    """Lamps and vents into the tiles between grooves at x and y."""
    free = np.ones((len(x) - 1, len(y) - 1), bool)
    wide = 2 if spec.tile_m < _SEVERAL_TILES_M else 1
    if spec.lamps == "bare stretch":
        middle_m = x[:-1] + 0.5 * spec.tile_m
        period_m = min(_STRETCH_EVERY_M, float(x[-1]))
        free[(middle_m - 0.3 * period_m) % period_m < min(_STRETCH_M, 0.4 * period_m)] = False
    panels = []
    for i, j in _lamp_places(spec, free.shape, rng):
        if i + wide <= free.shape[0] and free[i : i + wide, j].all():
            free[i : i + wide, j] = False
            panels.append(Panel("lamp", _rect(spec.tile_m, x[i], y[j], wide), 0))
    where = np.argwhere(free)
    vents = max(1, round(free.size * _VENTS[spec.lamps])) if _VENTS[spec.lamps] else 0
    for i, j in where[rng.permutation(len(where))[:vents]]:
        kind: PanelKind = "diffuser" if rng.random() < _DIFFUSERS else "vent"
        panels.append(Panel(kind, _rect(spec.tile_m, x[i], y[j], 1), int(rng.integers(2))))
    return tuple(panels)


def _lamp_places(spec: WorldSpec, tiles: tuple[int, ...], rng: np.random.Generator) -> list[tuple[int, int]]:
    if spec.lamps == "sparse":
        count = max(2, round(tiles[0] * tiles[1] * _SPARSE))
        return list(
            zip(rng.integers(tiles[0], size=count).tolist(), rng.integers(tiles[1], size=count).tolist(), strict=True)
        )
    missing = rng.uniform(*_GAPS) if spec.lamps == "raster" else 0.0
    first = [int(rng.integers(min(e, n))) for e, n in zip(_LAMP_EVERY, tiles, strict=True)]
    places = [
        (i, j) for i in range(first[0], tiles[0], _LAMP_EVERY[0]) for j in range(first[1], tiles[1], _LAMP_EVERY[1])
    ]
    return [p for p in places if rng.random() >= missing]


def _rect(tile_m: float, x: float, y: float, wide: int) -> Rect:
    """Between the grooves around so many tiles along x."""
    g = 0.5 * CeilingSpec.groove_m
    return (float(x) + g, float(y) + g, float(x) + wide * tile_m - g, float(y) + tile_m - g)
