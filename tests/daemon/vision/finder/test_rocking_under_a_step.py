"""A robot that rocks by up to 2 deg below the edge of a step: no false tilt, against the simulator's."""

import numpy as np
import pytest

from ceilvo.config import Features
from ceilvo.daemon.vision.finder.line_finder import LineFinder
from ceilvo.sim.motion import LapSpec, TiltSpec
from ceilvo.sim.surroundings import scenes
from ceilvo.sim.world import World, WorldSpec

FPS, FIRST, LAST = 15.0, 20, 72
LAP = LapSpec(speed_mps=0.5, rest_s=0.3, ramp_s=1.0)


@pytest.mark.parametrize("seed", [113, 114, 115])
def test_lines_are_not_fitted_with_a_false_tilt(seed: int) -> None:
    """Seed 113 was tuned on: the tilt changes by 0.6 deg from frame to frame, and lines of two heights hide that."""
    tilt = TiltSpec(float(np.radians(2.0)))
    world = World(WorldSpec(seed=seed, lap=LAP, tilt=tilt, surroundings=scenes.step(LAP.room_m, 2.2)))
    world.start(0)
    finder, off_deg, sigma_deg = LineFinder(world.calibration, Features()), [], []
    for k in range(FIRST, LAST):
        lines = finder(world.frame_at(k / FPS), None, several=True)
        assert lines is not None
        off_deg.append(np.degrees(np.abs(lines.tilt_rad - world.tilt_at(k / FPS))))
        sigma_deg.append(np.degrees(lines.tilt_sigma_rad))
    settled = np.array(off_deg)[20:]
    print(f"seed {seed}: tilt off by {np.max(settled):.3f} deg at most, {np.median(settled):.3f} in the median")
    assert np.max(settled) < 0.2
    assert np.all(settled < 5.0 * np.array(sigma_deg)[20:] + 0.02), "no more than it says"
