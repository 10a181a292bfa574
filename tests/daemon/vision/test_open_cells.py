"""Ceilings that are all cells: as many lines askew as straight, and lamps for places."""

from __future__ import annotations

import numpy as np
import pytest

from ceilvo.config import Config, Features
from ceilvo.crossing_types import CORNER, LAMP
from ceilvo.daemon.pipeline import Pipeline
from ceilvo.daemon.vision.finder.crossing_finder import CrossingFinder
from ceilvo.se2 import transform
from ceilvo.sim.ceiling.spec import CeilingSpec
from ceilvo.sim.motion import LapSpec
from ceilvo.sim.world import World, WorldSpec
from ceilvo.types import Frame, State

CELLS = CeilingSpec(tile_m=0.1, groove_m=0.012, lip_m=0.0, lamp_every=(18, 12), vents=0, stains=0)
FPS = 30.0
BEND_S = np.arange(12.0, 14.5, 0.25)
"""Of this lap: 1 to 88 deg."""


@pytest.fixture(scope="module")
def world() -> World:
    return World(WorldSpec(seed=83, lap=LapSpec(room_m=6.94, inset_m=1.0), ceiling=CELLS))


def test_cells_are_found_however_they_lie(world: World) -> None:
    """Most pixels stand on edges when they are seen askew: that is no noise."""
    finder = CrossingFinder(world.calibration, Features())
    true = world.ceiling.true_crossings()[0]
    for t_s in BEND_S.tolist():
        crossings = finder(Frame(0, 0, world.frame_at(t_s)), None)
        assert crossings is not None
        lines = crossings.crossing_type < LAMP
        assert np.count_nonzero(lines) > 800, t_s  # of 1,100
        at = transform(world.truth_at(t_s), crossings.xy_base_m[lines])
        off = np.hypot(*(at[:, None] - true).transpose(2, 0, 1)).min(axis=1)
        assert np.mean(off < 0.005) > 0.97, t_s


def test_a_bend_under_open_cells_is_driven_in_tracking(world: World) -> None:
    pipeline = Pipeline(world.calibration, Config(), np.random.default_rng(1))
    begin_s = 10.0
    origin = world.truth_at(begin_s)
    pipeline.set_pose(origin, np.diag([1e-6, 1e-6, 1e-6]), "given")
    tracked, off_m = [], []
    for k in range(int(5.0 * FPS)):
        t_s = begin_s + k / FPS
        estimate = pipeline.step(Frame(k, round(1e9 * (1.0 + k / FPS)), world.frame_at(t_s)))
        tracked.append(estimate.state is State.TRACKING)
        off_m.append(float(np.hypot(*(estimate.pose - world.truth_at(t_s))[:2])))
    assert np.mean(tracked) > 0.9
    assert max(off_m) < 0.005
    kind = pipeline.landmarks().crossing_type
    assert np.count_nonzero(kind == LAMP) == np.count_nonzero(kind != CORNER) < 12, "lamps, not cells"
    assert np.count_nonzero(kind == CORNER) < 24, "two ends of each"
