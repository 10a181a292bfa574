"""How a level view stretches the blur of a picture, against the lens's own formula, and a groove that it parts."""

from __future__ import annotations

from dataclasses import replace
from typing import Literal

import numpy as np
import pytest

from ceilvo.bench.vision.metrics import CrossingScore
from ceilvo.camera import CameraModel, LevelView
from ceilvo.config import Features
from ceilvo.daemon.vision.crossings import cross
from ceilvo.daemon.vision.finder.line_finder import LineFinder
from ceilvo.daemon.vision.lens import for_lens, stretch
from ceilvo.sim.rig import simulated_calibration, simulated_camera
from ceilvo.sim.world import World, WorldSpec

SIDE_PX, FOCAL_PX = 800, 300.0


def looking_up(kind: Literal["pinhole", "fisheye"]) -> LevelView:
    """Without distortion."""
    middle = 0.5 * (SIDE_PX - 1)
    camera = CameraModel(
        kind=kind,
        width_px=SIDE_PX,
        height_px=SIDE_PX,
        fx_px=FOCAL_PX,
        fy_px=FOCAL_PX,
        cx_px=middle,
        cy_px=middle,
        distortion=(0.0,) * 4,
    )
    return LevelView(camera, np.eye(3), FOCAL_PX)


@pytest.mark.parametrize("degrees", [20.0, 45.0, 60.0])
def test_an_equidistant_lens_is_stretched_by_the_square_of_the_secant(degrees: float) -> None:
    """r = f theta, and the level view has f tan theta."""
    expected = 1.0 / np.cos(np.radians(degrees)) ** 2
    assert stretch(looking_up("fisheye"), degrees) == pytest.approx(expected, rel=0.1)


def test_a_pinhole_that_looks_up_is_not_stretched() -> None:
    view = looking_up("pinhole")
    assert stretch(view, 70.0) == pytest.approx(1.0, abs=1e-6)
    assert for_lens(Features(), view) == Features()


def test_settings_for_a_lens_stay_when_they_are_made_again() -> None:
    view = looking_up("fisheye")
    once = for_lens(Features(), view)
    assert once.groove_deg > Features().groove_deg and once.crossing_reach_deg > Features().crossing_reach_deg
    assert for_lens(once, view) == once


def test_a_fisheye_sees_grooves_where_they_are() -> None:
    """Its sides were 5 px apart and no groove any more: 13 % of the crossings, and lines 25 mm off."""
    seed = 12
    print(f"seed {seed}")
    calibration = simulated_calibration(simulated_camera("fisheye"))
    world = World(WorldSpec(seed=seed), calibration)
    finder = LineFinder(calibration, replace(Features(), faint_lines=False))
    score = CrossingScore(world, calibration)
    for k in range(5):
        lines = finder(world.frame_at(0.1 * k), None)
        crossings = None if lines is None else cross(lines, calibration, finder.config)
        score.add(crossings, world.truth_at(0.1 * k), np.zeros(2))
    found = score.figures()
    assert found["recall_grid_pct"] > 85.0 and found["precision_pct"] > 90.0, found
