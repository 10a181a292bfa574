"""Drives under ceilings on which lines cross too rarely, from pictures to states, against the simulator's truth."""

import numpy as np
import pytest
from point_ceilings import PLASTER_ROUND, RATE_HZ, followed

from ceilvo.config import Config
from ceilvo.sim.ceiling.spec import CeilingSpec
from ceilvo.sim.motion import LapSpec
from ceilvo.sim.world import World, WorldSpec
from ceilvo.types import Array, Estimate, State

SEED = 22
FRAMES = 75
START_S = 1.5
GOOD = (State.TRACKING, State.DEGRADED)
CEILINGS = {
    "plaster with round lamps": PLASTER_ROUND,
    "hexagons": CeilingSpec(pattern="hexagons", vents=0, spots=0, stains=0, round_lamps=True),
    "slats with round lamps": CeilingSpec(
        pattern="slats", vents=0, spots=0, stains=0, round_lamps=True, lamp_every=(3, 2)
    ),
}


def drive(ceiling: CeilingSpec, *overrides: str) -> tuple[list[Estimate], Array]:
    """Estimates of a drive round a bend, and (N,) how far each is from the truth, m."""
    world = World(WorldSpec(seed=SEED, ceiling=ceiling, lap=LapSpec(room_m=4.0, inset_m=1.0, corner_radius_m=0.5)))
    return followed(world, START_S, FRAMES, *overrides)


@pytest.mark.parametrize("name", CEILINGS)
def test_the_robot_localises(name: str) -> None:
    estimates, off_m = drive(CEILINGS[name])
    settled = [e.state for e in estimates[2 * Config().states.tracking_frames :]]
    good = float(np.mean([s in GOOD for s in settled]))
    way_m = sum(float(np.hypot(*e.motion.prev_from_curr[:2])) for e in estimates)
    print(f"seed {SEED}, {name}: good {100 * good:.0f} %, {1e3 * off_m[-1]:.1f} mm off after {way_m:.2f} m")
    assert way_m > 1.5
    assert good >= 0.9
    assert off_m[-1] <= 0.005 * way_m
    sigma_m = np.sqrt(np.linalg.eigvalsh(estimates[-1].cov[:2, :2])[-1])
    assert off_m[-1] < 4.0 * sigma_m, "and as well as it says"


def test_without_points_it_does_not() -> None:
    """The paper's features find nothing there."""
    estimates, _ = drive(CEILINGS["plaster with round lamps"], "features.points=false")
    assert all(e.state is State.INIT for e in estimates)


@pytest.mark.parametrize("pattern", ["slats", "bare"])
def test_where_nothing_tells_the_motion_it_is_never_called_good(pattern: str) -> None:
    """Along slats that all look alike, and under bare plaster: a prediction, and a covariance that grows."""
    spec = CeilingSpec(vents=0, spots=0, stains=0, lamp_every=(0, 0), joints=pattern == "slats", pattern="slats")
    estimates, off_m = drive(spec)
    sigma_m = np.sqrt([np.linalg.eigvalsh(e.cov[:2, :2])[-1] for e in estimates])
    good = np.array([e.state in GOOD for e in estimates])
    print(f"seed {SEED}, {pattern}: {off_m[-1]:.2f} m off, sigma {sigma_m[-1]:.2f} m, good in {np.sum(good)} frames")
    assert not np.any(good & (off_m > 0.3))
    assert not np.any(good[-20:])
    assert off_m[-1] < 3.0 * sigma_m[-1]


@pytest.mark.parametrize("seed", [96])
def test_a_ceiling_that_shows_now_lines_and_now_corners_is_one(seed: int) -> None:
    """Hexagons have joints along one direction only; where few of them are in view, corners take over, and the map
    must have them by then."""
    ceiling = CeilingSpec(pattern="hexagons", tile_m=0.5, round_lamps=True)
    world = World(WorldSpec(seed=seed, ceiling=ceiling, lap=LapSpec(room_m=6.94, inset_m=1.0)))
    estimates, off_m = followed(world, 0.0, round(11.0 * RATE_HZ))
    good = sum(e.state in GOOD for e in estimates)
    print(f"seed {seed}: good {good} of {len(off_m)}, {1e3 * max(off_m):.1f} mm at most")
    assert good >= 0.9 * len(off_m)
    assert max(off_m) < 0.01
