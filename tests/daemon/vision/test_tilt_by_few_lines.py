"""Two lamps in view: few lines, and edges of two lamps that may be taken for one long line."""

import numpy as np
import pytest

from ceilvo.bench.vision.textures import TWO_LAMPS
from ceilvo.config import Features
from ceilvo.daemon.vision.finder.line_finder import LineFinder
from ceilvo.sim.motion import LapSpec
from ceilvo.sim.renderer import RenderSpec
from ceilvo.sim.world import World, WorldSpec

LAP = LapSpec(room_m=6.94)
TILTED_RAD = np.radians(0.3)


@pytest.mark.parametrize(("seed", "begin_s", "end_s"), [(28, 5.0, 6.5), (29, 20.5, 23.5)])
def test_a_robot_that_is_level_under_two_lamps_is_not_said_to_lean(seed: int, begin_s: float, end_s: float) -> None:
    """A degree is 4 cm on the ceiling: the view seems to jump by that, though nothing in the picture has moved."""
    world = World(WorldSpec(seed=seed, lap=LAP, ceiling=TWO_LAMPS, render=RenderSpec(footprint=True)))
    finder, tilts = LineFinder(world.calibration, Features()), []
    for t_s in np.arange(begin_s, end_s, 0.1):
        lines = finder(world.frame_at(float(t_s)), None)
        assert lines is not None
        tilts.append(np.abs(lines.tilt_rad).max())
    leaning = np.count_nonzero(np.array(tilts) > TILTED_RAD)
    print(f"seed {seed}: {leaning} of {len(tilts)} views lean, {np.degrees(max(tilts)):.2f} deg at most")
    assert leaning == 0
