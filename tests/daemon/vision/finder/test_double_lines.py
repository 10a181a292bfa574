"""Joints of two heights that meet in the picture look like one line that is bent, as a tilt would bend it."""

from __future__ import annotations

import numpy as np

from ceilvo.config import Features
from ceilvo.daemon.vision.finder.line_finder import LineFinder
from ceilvo.sim.motion import LapSpec
from ceilvo.sim.surroundings import scenes
from ceilvo.sim.world import World, WorldSpec

SEED = 7
LAP = LapSpec(speed_mps=0.5, rest_s=0.3, ramp_s=1.0)
HIGH_M = 2.2
TIMES_S = (2.5, 3.0, 3.5)
"""Half of the view is of the lower part then."""


def tilt_rad(world: World, t_s: float, several: bool) -> float:
    """What a frame alone shows of a robot that stands level."""
    lines = LineFinder(world.calibration, Features())(world.frame_at(t_s), None, several=several)
    assert lines is not None
    return float(np.max(np.abs(lines.free_tilt_rad)))


def test_lines_that_are_two_tell_no_tilt() -> None:
    world = World(WorldSpec(seed=SEED, lap=LAP, surroundings=scenes.step(LAP.room_m, HIGH_M)))
    off = np.degrees([[tilt_rad(world, t_s, several) for several in (False, True)] for t_s in TIMES_S])
    print(f"seed {SEED}: tilt deg, taken for one and left out: {off.tolist()}")
    assert np.max(off[:, 1]) < 0.07
    assert np.all(off[:, 1] < 0.5 * off[:, 0])
