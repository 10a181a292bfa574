"""Time of a step of the daemon's filter against what a view shows and what the map holds.

A step is association, predict, update and estimate of a robot that moves to and fro below a grid of crossings. Each
view also shows a few features that no landmark explains, so that a map in the making goes on being made.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np

from ceilvo.bench.results.bars import Bar
from ceilvo.calibration import NoiseCurves
from ceilvo.config import Filter
from ceilvo.daemon.relocalisation.filters import make_filter
from ceilvo.daemon.slam.association import associate
from ceilvo.daemon.slam.upkeep import inside
from ceilvo.se2 import inverse, transform
from ceilvo.types import Array, Crossings, Displacement, Landmarks, Motion

IN_VIEW = (60, 250, 1000)  # crossings, axis; a ceiling of tiles, of small tiles, of open cells (issue: 1,000)
MAPS = (100, 10_000, 100_000)  # landmarks, axis; chosen: a corner of a room, a hall, a building
USUAL = 60  # crossings in view of the table over maps; the golden lap shows 58 in half of its views
OVER_VIEW = 5_000  # landmarks of the table over views; chosen: five views of 1,000
HALF_M = np.array([1.3, 1.0])  # of the view; a camera of 76 deg 2.2 m below the ceiling sees about that
VISIBLE_M = HALF_M * np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])
FALSE = 2  # features a view without a landmark; chosen
SIGMA_M = 0.003  # of an observation; that of the simulated camera below it
STEP_M = 0.06  # between views; chosen: just more than filter.update_travel_m
TURN = 5  # steps to either side of the middle; chosen: the smallest map has no room for more
GROWTH = 1.2  # bar: time with the largest map over that with the smallest
BOUND = 3.0  # bar: time of 1,000 crossings over that of 60; chosen, association alone is linear in them
_MOTION_COV = np.diag([1e-6, 1e-6, 1e-7])  # m^2, m^2, rad^2; chosen: odometry over 6 cm
_CURVES = NoiseCurves((SIGMA_M,), (SIGMA_M,), 0.002, 0.0, 2.5)


def grid(landmarks: int, in_view: int) -> Landmarks:
    """A square grid around the origin so fine that a view shows so many of its points."""
    pitch = float(np.sqrt(4.0 * HALF_M[0] * HALF_M[1] / in_view))
    side = 2 * int(np.ceil(0.5 * np.sqrt(landmarks)))  # even, so that all grids look alike from the middle
    g = pitch * (np.arange(side) - 0.5 * (side - 1))
    xy = np.stack(np.meshgrid(g, g), axis=-1).reshape(-1, 2)[:landmarks]
    n, seen = len(xy), np.full(len(xy), 20)
    return Landmarks(np.arange(n), xy, np.tile(1e-6 * np.eye(2), (n, 1, 1)), np.arange(n) % 9, seen)


def stepper(landmarks: int, in_view: int, known: bool) -> Callable[[], None]:
    """One call is one step."""
    m, settings, rng = grid(landmarks, in_view), Filter(), np.random.default_rng(7)
    f = make_filter(replace(settings, method="joint"), np.random.default_rng(7))
    f.reset(np.zeros(3), 1e-6 * np.eye(3), m, known)
    here = m.of(np.all(np.abs(m.xy_map_m) < HALF_M + 2.0 * STEP_M * TURN, axis=1))
    pose, steps = np.zeros(3), 0

    def step() -> None:
        nonlocal pose, steps
        along = STEP_M if (steps // TURN) % 4 in (0, 3) else -STEP_M
        aside = np.array([0.0, along, 0.0])  # a view is wider than high, and the smallest map is square
        pose, steps = pose + aside, steps + 1
        f.predict(Motion(Displacement(aside), _MOTION_COV, 20, 0.0))
        seen = _crossings(here, pose, rng)
        view = associate(seen, _CURVES, np.zeros(2), f.estimate()[0], f.landmarks_near, settings, 0.0, VISIBLE_M)
        f.update(view)
        f.estimate()

    return step


def _crossings(m: Landmarks, pose: Array, rng: np.random.Generator) -> Crossings:
    at = transform(inverse(pose), m.xy_map_m)
    seen = inside(VISIBLE_M, at)
    xy = np.concatenate([at[seen], rng.uniform(-HALF_M, HALF_M, (FALSE, 2))])
    xy += SIGMA_M * rng.standard_normal(xy.shape)
    kind = np.append(m.crossing_type[seen], rng.integers(0, 9, FALSE))
    none = np.zeros((len(xy), 2, 2))
    return Crossings(xy, xy, none, kind, 0.0, 1e-3, np.zeros(2), np.zeros(2), np.zeros((2, 2)))


def measured(medians: Callable[..., dict[str, float]], repeats: int, largest: int) -> dict[str, Any]:
    """us per step; those of a row take turns."""
    maps = [n for n in MAPS if n <= max(largest, MAPS[0])]
    out: dict[str, Any] = {}
    for name, known in (("mapping", False), ("known map", True)):
        views = {str(k): stepper(OVER_VIEW, k, known) for k in IN_VIEW}
        sizes = {str(n): stepper(n, USUAL, known) for n in maps}
        out[name] = {"in_view": medians(views, repeats, {}), "map": medians(sizes, 3 * repeats, {})}
    return out


def bars(found: dict[str, Any]) -> list[Bar]:
    out = []
    for name, us in found.items():
        few, *_, many = us["map"].items()
        ratio = many[1] / few[1]
        out.append(Bar(f"joint, {name}: {many[0]} landmarks / {few[0]}", ratio, f"{ratio:.2f}", high=GROWTH))
        few, *_, many = us["in_view"].items()
        ratio = many[1] / few[1]
        out.append(Bar(f"joint, {name}: {many[0]} crossings in view / {few[0]}", ratio, f"{ratio:.2f}", high=BOUND))
    return out
