"""A robot that rocks while it starts: nothing is known of it yet, and its first frames must give its tilt."""

from collections.abc import Iterator

import numpy as np
import pytest

from ceilvo.config import Features
from ceilvo.daemon.vision.finder.line_finder import LineFinder, LineFinderState
from ceilvo.daemon.vision.tilt_prior import TiltTracker
from ceilvo.sim.ceiling.spec import CeilingSpec
from ceilvo.sim.renderer import RenderSpec
from ceilvo.sim.world import World, WorldSpec

SEED = 3
FAINT = CeilingSpec(groove_albedo=0.66, lip_albedo=0.78)
T_BAR = CeilingSpec(groove_m=0.024, lip_m=0.0, groove_albedo=0.95)
DIM = RenderSpec(lit=())
AMPLITUDE_RAD = np.radians(1.5)


def views(spec: WorldSpec, count: int) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Pictures from anywhere in the room, tilted anyhow, and the tilt."""
    world, rng = World(spec), np.random.default_rng(SEED)
    for _ in range(count):
        pose = np.array([*rng.uniform(1.0, spec.lap.room_m - 1.0, 2), rng.uniform(-np.pi, np.pi)])
        tilt = rng.uniform(-AMPLITUDE_RAD, AMPLITUDE_RAD, 2)
        yield world.renderer.render(pose, rng, tilt), tilt


@pytest.mark.parametrize("spec", [WorldSpec(ceiling=FAINT), WorldSpec(ceiling=T_BAR, render=DIM)])
def test_the_first_frame_of_a_tilted_robot_gives_its_tilt(spec: WorldSpec) -> None:
    """A level fit that takes in nearly as many points is no reason to call the robot level."""
    finder, off, sigmas = LineFinder(World(spec).calibration, Features()), [], []
    for gray, tilt in views(spec, 30):
        finder.state = LineFinderState()
        lines = finder(gray, None)
        assert lines is not None
        error = np.abs(lines.tilt_rad - tilt)
        off.append(np.degrees(error.max()))
        sigmas.append(np.max(error / lines.tilt_sigma_rad))
    print(f"seed {SEED}: tilt off by {max(off):.3f} deg, {max(sigmas):.1f} claimed sigma at most")
    assert max(off) < 0.3
    assert max(sigmas) < 5.0


def test_frames_of_a_start_that_rocks_teach_how_it_rocks() -> None:
    spec = WorldSpec(ceiling=FAINT)
    finder = LineFinder(World(spec).calibration, Features())
    for gray, _ in views(spec, 24):
        assert finder(gray, None) is not None
    prior = TiltTracker(finder.state.tilt).prior()
    assert prior is not None, "two dozen frames are enough for a prior"
    spread = AMPLITUDE_RAD / np.sqrt(3.0)
    print(f"seed {SEED}: prior {np.degrees(prior.mean_rad)} +- {np.degrees(prior.sigma_rad)} deg")
    assert (prior.sigma_rad > 0.7 * spread).all()
