"""Poses that somebody says are claims: a wrong one is never called good, a right one is taken.

By the commands as they arrive from the bus. Below bare tiles nothing that is seen speaks against a pose which is off by
whole tiles: there a claim that is taken for a fact is wrong at once. Below lamps the robot must be found again.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import numpy as np
import pytest

from ceilvo import se2
from ceilvo.bench.place.case import drive_in, load_known
from ceilvo.bench.place.ceiling.worlds import Lamps, WorldSpec, make_world
from ceilvo.bench.place.robot.drive import Drive
from ceilvo.bench.place.robot.tally import Tally
from ceilvo.daemon.app.requests import handlers
from ceilvo.daemon.map.kept.store import Store
from ceilvo.daemon.map.map_file import StoredMap
from ceilvo.drivers.bus.commands import InitialPose, Relocalise, Reset
from ceilvo.drivers.bus.requests import Handlers
from ceilvo.sim.rig import simulated_calibration
from ceilvo.types import Array

Claim = Callable[[Drive, Array], None]
SEED = 700
TILE_M = 0.6
FOUND_S = 60.0
"""Two laps of the room: everything that tells places apart was seen."""
TILE_OFF, ACROSS, DIAGONAL = TILE_M * np.array([[1.0, 0.0, 0.0], [0.0, -1.0, 0.0], [1.0, 1.0, 0.0]])
QUARTER, HALF = np.array([[0.0, 0.0, 0.5 * np.pi], [0.0, 0.0, np.pi]])
FAR = np.array([-5 * TILE_M, 3 * TILE_M, np.pi])


def robot_in(size: str, lamps: Lamps, at: Array | None = None, seed: int = SEED) -> Drive:
    """That has the map and stands where it believes to, at a pose (3,) in the room or at random."""
    world, rng = make_world(WorldSpec(size, TILE_M, lamps, seed)), np.random.default_rng(seed)
    d = drive_in(world, rng, True, 10.0, True, 0.5)
    if at is not None:
        d.room_pose = at
        d.driver.anew(at[:2])
    load_known(d, world, rng)
    return d


@pytest.fixture
def lamps() -> Drive:
    """TRACKING."""
    d = robot_in("5", "raster")
    assert d.settle(20.0)
    d.tally = Tally()
    return d


@pytest.fixture
def bare() -> Drive:
    """In the middle of 8 m of bare tiles."""
    return robot_in("20", "bare stretch", np.array([9.0, 10.0, 0.3]))


def commands(d: Drive) -> Handlers:
    return handlers(d.config, simulated_calibration(), d.estimator, Store(None), lambda: False)


def give(d: Drive, off: Array, sigma_m: float = 0.25) -> None:
    """cmd/initial_pose with the robot's pose but for (3,) in the room."""
    x_m, y_m, theta_rad = (float(v) for v in se2.compose(d.map_from_room, d.room_pose + off))
    commands(d).initial_pose(InitialPose(x_m, y_m, se2.wrap(theta_rad), sigma_m, 0.15))


def reset(d: Drive, off: Array) -> None:
    """cmd/reset with such a pose in the configuration."""
    d.configure(np.asarray(se2.compose(d.map_from_room, d.room_pose + off)))
    commands(d).reset(Reset(keep_map=True))


def start(d: Drive, off: Array) -> None:
    """Started with the map, without a stored pose, and with such a pose in the configuration."""
    landmarks, axis_rad = d.estimator.map()
    assert axis_rad is not None
    d.configure(np.asarray(se2.compose(d.map_from_room, d.room_pose + off)))
    d.begin_anew()
    d.estimator.load_map(StoredMap(landmarks, axis_rad), None)


def give_again_and_again(d: Drive, off: Array) -> None:
    for _ in range(3):
        give(d, off, 0.02)
        d.go(0.4)
        commands(d).relocalise(Relocalise())
        d.go(0.4)


CLAIMS: list[tuple[Claim, Array]] = [
    (partial(give, sigma_m=0.02), TILE_OFF),
    (partial(give, sigma_m=0.11), ACROSS),
    (partial(give, sigma_m=0.5), DIAGONAL),
    (give, QUARTER),
    (give, HALF),
    (reset, TILE_OFF),
    (reset, FAR),
    (start, TILE_OFF),
    (give_again_and_again, TILE_OFF),
]


@pytest.mark.parametrize(("claim", "off"), CLAIMS)
def test_a_wrong_claim_that_nothing_contradicts_is_not_called_good(bare: Drive, claim: Claim, off: Array) -> None:
    claim(bare, off)
    bare.go(1.2)
    assert bare.tally.wrong_s == {}, bare.tally.reasons


@pytest.mark.parametrize(("claim", "off"), [(give, TILE_OFF), (give, HALF), (reset, FAR), (start, FAR)])
def test_after_a_wrong_claim_the_robot_is_found_again(lamps: Drive, claim: Claim, off: Array) -> None:
    claim(lamps, off)
    assert lamps.settle(FOUND_S), lamps.tally.reasons
    assert lamps.tally.wrong_s == {}, lamps.tally.reasons


def test_a_claim_that_nothing_confirmed_is_no_better_after_a_restart() -> None:
    """It was believed as a stored pose is, 49 times of 50, and TRACKING 0.6 s later, 2.4 m off under the next lamp."""
    d = robot_in("20", "raster", np.array([9.0, 10.0, 0.3]), 702)
    give(d, np.array([4.0 * TILE_M, 0.0, 0.0]), 0.02)
    d.go(0.5)
    d.restart()
    d.go(2.0)
    assert d.tally.wrong_s == {}, d.tally.reasons


def test_a_right_pose_is_taken(lamps: Drive) -> None:
    """As a person gives it, 5 cm and 2 deg off."""
    lamps.tally.over()
    give(lamps, np.array([0.05, -0.05, np.radians(2.0)]), 0.11)
    lamps.go(8.0)
    assert lamps.tally.wrong_s == {}
    assert lamps.tally.recovered_m is not None and lamps.tally.recovered_m < 3.0, lamps.tally.reasons


def test_what_is_learnt_at_a_claimed_place_is_not_stored_and_goes_with_the_claim(bare: Drive) -> None:
    """It became part of the map with the next start or claim: a robot there matched what it had learnt itself."""
    known = len(bare.estimator.map()[0])
    give(bare, np.array([30.0, 0.0, 0.0]))
    bare.go(1.2)
    assert bare.pipeline.filter.size() > known, "ground that nobody has mapped"
    assert len(bare.estimator.map()[0]) == known
    give(bare, TILE_OFF)
    assert bare.pipeline.filter.size() == known
