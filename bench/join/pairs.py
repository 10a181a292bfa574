"""One pair of maps, drawn from a seed, and what comes of joining them."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ceilvo.bench.place.ceiling.truth import features_of
from ceilvo.bench.place.ceiling.worlds import Lamps, WorldSpec, make_world
from ceilvo.crossing_types import JOINTS
from ceilvo.daemon.building.frames import frame_of
from ceilvo.daemon.map.database.content import MapContent
from ceilvo.se2 import between, inverse, transform, wrap
from ceilvo.types import Array, Ints, Landmarks

KINDS: Mapping[str, str] = {
    "sparse": "lamps at random, 15 % overlap",
    "raster": "a raster of lamps with gaps, 15 % overlap",
    "apart-sparse": "lamps at random, two halls",
    "apart-raster": "rasters with gaps, two halls",
    "perfect": "a perfect raster of lamps, 15 % overlap",
    "bare": "bare tiles, 15 % overlap",
}
_TILES_M = (0.6, 0.625)
_DEPTH_M = 30.0
"""Of the hall, 60 m long, that both maps have."""
_MISSED, _FALSE = 0.05, 0.02
"""Share of the landmarks that a map lacks, and of those of another type than is true."""
_MOVED = 0.05
"""Share of the lamps and vents that are gone from the second map: time has passed."""
_SIGMA_M = 3e-3
_SCALE = 3e-3
"""Standard deviation of a map's scale: a height off by .3 %."""
_SIGHTINGS = 20
_RIGHT_M, _RIGHT_RAD = 0.2, 0.02
"""A join within so much, at the middle of the overlap, is right; chosen: a third of a tile."""


@dataclass(frozen=True)
class Case:
    """A kind of KINDS, a seed, and the share of each map that the other has, too."""

    kind: str
    seed: int
    overlap: float


@dataclass(frozen=True)
class Outcome:
    """ "right", "wrong" or "refused" and why, what the overlap showed, and how long it took."""

    verdict: str
    why: str
    false_alarm: float
    things: tuple[int, int]
    seconds: float


def outcome(case: Case) -> Outcome:
    """Draw the pair and join it."""
    a, b, a_from_b, middle = pair(case)
    began = time.monotonic()
    found = frame_of(a, b)
    seconds = time.monotonic() - began
    if found.refused:
        return Outcome("refused", found.refused, found.false_alarm, found.things, seconds)
    verdict = "wrong"
    if a_from_b is not None:
        off = between(a_from_b, found.a_from_b)
        apart = np.hypot(*(transform(found.a_from_b, middle[None]) - transform(a_from_b, middle[None]))[0])
        verdict = "right" if apart < _RIGHT_M and abs(wrap(float(off[2]))) < _RIGHT_RAD else "wrong"
    return Outcome(verdict, "", found.false_alarm, found.things, seconds)


def pair(case: Case) -> tuple[MapContent, MapContent, Array | None, Array]:
    """Two maps, a_from_b (3,) of their frames (None: two halls), and the middle of the overlap in b."""
    rng = np.random.default_rng([case.seed, 0x101])
    tile_m = float(rng.choice(_TILES_M))
    first = _ceiling(case.kind, tile_m, case.seed, rng)
    apart = case.kind.startswith("apart")
    second = _ceiling(case.kind, tile_m, case.seed + 10**6, rng) if apart else first
    length = 60.0 / (2.0 - case.overlap)
    a_from, b_from = (np.array([*rng.uniform(-50.0, 50.0, 2), rng.uniform(-np.pi, np.pi)]) for _ in range(2))
    a = _map(first, (0.0, length), a_from, rng, 0.0)
    b = _map(second, (60.0 - length, 60.0), b_from, rng, _MOVED)
    middle = np.array([30.0, 0.5 * _DEPTH_M])
    return a, b, None if apart else between(a_from, b_from), transform(inverse(b_from), middle[None])[0]


def _ceiling(kind: str, tile_m: float, seed: int, rng: np.random.Generator) -> tuple[Array, Ints]:
    """(N, 2) places in the hall and types of its landmarks."""
    lamps: Lamps = "raster" if kind in ("raster", "apart-raster", "perfect", "bare") else "sparse"
    world = make_world(WorldSpec("60", tile_m, lamps, seed % 2**31))
    layout = world.layout
    if kind == "perfect":
        layout = replace(layout, panels=_perfect(layout.panels, tile_m, rng))
    elif kind == "bare":
        layout = replace(layout, panels=())
    features = features_of(layout, np.zeros(3), world.room)
    inside = features.xy_map_m[:, 1] < _DEPTH_M
    return features.xy_map_m[inside], features.crossing_type[inside]


def _perfect(panels: tuple, tile_m: float, rng: np.random.Generator) -> tuple:  # type: ignore[type-arg]
    """The lamp that is there laid every four tiles by three, nothing else."""
    lamp = next(p for p in panels if p.kind == "lamp")
    x0, y0, x1, y1 = lamp.rect
    out = []
    for i in range(-40, 40):
        for j in range(-40, 40):
            dx, dy = 4 * i * tile_m, 3 * j * tile_m
            if x0 + dx > 0.5 and y0 + dy > 0.5 and x1 + dx < 59.0 and y1 + dy < 59.0:
                out.append(replace(lamp, rect=(x0 + dx, y0 + dy, x1 + dx, y1 + dy)))
    return tuple(out)


def _map(
    ceiling: tuple[Array, Ints],
    between_m: tuple[float, float],
    hall_from: Array,
    rng: np.random.Generator,
    moved: float,
) -> MapContent:
    """What a robot has learnt between two places along the hall, in its own frame hall_from_map (3,)."""
    xy, kind = ceiling
    gone = _gone(xy, kind, moved, rng)
    keep = (xy[:, 0] >= between_m[0]) & (xy[:, 0] < between_m[1]) & (rng.random(len(xy)) > _MISSED) & ~gone
    xy, kind = xy[keep], kind[keep].copy()
    false = rng.random(len(xy)) < _FALSE
    kind[false] = rng.integers(0, 9, np.count_nonzero(false))
    own = transform(inverse(hall_from), xy)
    own = (own - own.mean(axis=0)) * (1.0 + _SCALE * rng.standard_normal()) + own.mean(axis=0)
    n = len(own)
    landmarks = Landmarks(
        ids=np.arange(n),
        xy_map_m=own + _SIGMA_M * rng.standard_normal((n, 2)),
        cov_m2=np.tile(_SIGMA_M**2 * np.eye(2), (n, 1, 1)),
        crossing_type=kind,
        sightings=np.full(n, _SIGHTINGS),
    )
    return MapContent.of(landmarks, wrap(-float(hall_from[2])))


def _gone(xy: Array, kind: Ints, share: float, rng: np.random.Generator) -> NDArray[np.bool_]:
    """(N,) crossings of lamps and vents in squares of 2 m, of which some have lost all of theirs."""
    square = np.floor(xy / 2.0).astype(np.int64)
    number = square[:, 0] * 1000 + square[:, 1]
    lost = {int(s) for s in np.unique(number) if rng.random() < share}
    return np.asarray(np.isin(number, list(lost)) & (kind != JOINTS))
