"""Lines that end at gaps: edges of two lamps may be taken for one long line, and hexagons have no long ones."""

from dataclasses import replace

import numpy as np
import pytest

from ceilvo.bench.vision.conditions import conditions
from ceilvo.bench.vision.textures import HEXAGONS, TWO_LAMPS, WOOD
from ceilvo.config import Features
from ceilvo.daemon.vision.finder.line_finder import LineFinder
from ceilvo.sim.motion import LapSpec, TiltSpec
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


def test_slats_that_tell_one_half_of_the_tilt_to_a_hundredth_of_a_degree_do_not_make_up_the_other() -> None:
    """A floor is not that level. Half of the views leant by a degree along the slats, and steps were 8 cm off."""
    spec = WorldSpec(seed=153, lap=LAP, ceiling=replace(WOOD, round_lamps=True), render=RenderSpec(footprint=True))
    world = World(spec)
    finder, tilts = LineFinder(world.calibration, Features()), []
    for t_s in np.arange(21.3, 22.2, 1.0 / 15.0):
        lines = finder(world.frame_at(float(t_s)), None)
        assert lines is not None
        tilts.append(np.abs(lines.tilt_rad).max())
    leaning = np.count_nonzero(np.array(tilts) > 0.5 * TILTED_RAD)
    print(f"seed 153: {leaning} of {len(tilts)} views lean, {np.degrees(max(tilts)):.2f} deg at most")
    assert leaning == 0


@pytest.mark.parametrize("slope_deg", [(0.0, 0.0), (5.0, 0.0), (0.0, 5.0)])
def test_the_first_look_at_slats_tells_a_slope_from_vents_side_by_side(slope_deg: tuple[float, float]) -> None:
    """Rings of two vents are lines of a ceiling of 4 deg as well, but fewer of their edges lie on them."""
    slope = (float(np.tan(np.radians(slope_deg[0]))), float(np.tan(np.radians(slope_deg[1]))))
    looks = []
    for seed, times_s, round_lamps in ((161, [0.0], True), (163, np.arange(1.0, 31.0, 2.0), False)):
        ceiling = replace(WOOD, round_lamps=round_lamps, slope=slope)
        world = World(WorldSpec(seed=seed, lap=LAP, ceiling=ceiling, render=RenderSpec(footprint=True)))
        world.start(0)
        for t_s in times_s:
            lines = LineFinder(world.calibration, Features())(world.frame_at(float(t_s)), None)
            assert lines is not None
            looks.append(np.degrees(np.hypot(*lines.tilt_rad)))
    print(f"seeds 161 and 163, slope {slope_deg}: {np.round(looks, 2)}")
    if any(slope_deg):
        assert min(looks) > 2.5
    else:
        assert max(looks) < 0.3


@pytest.mark.parametrize("seed", [141, 144])
def test_a_robot_that_rocks_under_hexagons_from_the_start_is_not_taken_for_level(seed: int) -> None:
    """Until something is known of it. It was for the first seconds, and TRACKING 66 mm off."""
    world = World(
        WorldSpec(
            seed=seed,
            lap=LapSpec(speed_mps=0.5, rest_s=0.3, ramp_s=1.0),
            tilt=TiltSpec(float(np.radians(2.0))),
            ceiling=HEXAGONS,
        )
    )
    world.start(0)
    finder, off_deg = LineFinder(world.calibration, Features()), []
    for t_s in np.arange(75) / 15.0:
        lines = finder(world.frame_at(float(t_s)), None)
        assert lines is not None
        off_deg.append(np.degrees(np.abs(lines.tilt_rad - world.tilt_at(float(t_s))).max()))
    wrong = np.count_nonzero(np.array(off_deg) > 0.5)
    print(
        f"seed {seed}: tilt off by {np.median(off_deg):.3f} deg in the median, by more than 0.5 in {wrong} of 75 views"
    )
    assert np.median(off_deg) < 0.15
    assert wrong <= 5


def test_a_level_robot_under_slats_is_level_from_the_first_frame_on() -> None:
    """One direction tells the tilt to 0.09 deg, and some first frames seemed to lean by 0.24: a pose 13 mm off."""
    seed, off_deg = 212, []
    world = next(c for c in conditions() if c.name == "wood-slats").with_seed(seed).world()
    world.start(0)
    finder = LineFinder(world.calibration, Features())
    for k in range(30):
        lines = finder(world.frame_at(k / 15.0), None)
        assert lines is not None
        off_deg.append(float(np.degrees(np.max(np.abs(lines.tilt_rad)))))
    print(f"seed {seed}: {max(off_deg):.2f} deg at most")
    assert max(off_deg) < 0.15
