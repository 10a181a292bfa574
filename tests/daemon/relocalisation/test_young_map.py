"""A gap soon after the start: the map is all around the robot and cannot tell which way it went."""

import numpy as np
import pytest

from ceilvo.bench.place.case import drive_in
from ceilvo.bench.place.ceiling import worlds
from ceilvo.bench.place.robot.drive import Drive
from ceilvo.config import Config
from ceilvo.daemon.odometry.dead_reckoning import Track
from ceilvo.daemon.pipeline import Pipeline
from ceilvo.daemon.relocalisation import doubts
from ceilvo.se2 import compose, inverse, wrap
from ceilvo.sim.world import World, WorldSpec
from ceilvo.types import Array, Displacement, Frame, Motion, State

USABLE = (State.TRACKING, State.DEGRADED)
SEEDS = range(68101, 68109)


def hall(seed: int, wheels: bool = False) -> Drive:
    world = worlds.make_world(worlds.WorldSpec("20", 0.6, "sparse", seed))
    return drive_in(world, np.random.default_rng(seed), wheels, 10.0, True, 0.4)


def dark(drive: Drive, seconds: float) -> None:
    drive.conditions.dark = True
    drive.go(seconds)
    drive.conditions.dark = False


def after_a_gap(seed: int, light_s: float, dark_s: float) -> tuple[int, int]:
    """Frames of the 10 s after a gap in which the pose was called usable, and those of them in which it was wrong."""
    drive = hall(seed)
    drive.at_truth()
    drive.go(0.1)
    estimate = drive.tick()
    assert estimate is not None
    map_from_truth = compose(np.asarray(estimate.pose), inverse(drive.pose))
    drive.go(light_s)
    dark(drive, dark_s)
    usable = wrong = 0
    for _ in range(100):
        estimate = drive.tick()
        assert estimate is not None
        off = np.asarray(estimate.pose) - compose(map_from_truth, drive.pose)
        usable += estimate.state in USABLE
        wrong += estimate.state in USABLE and (np.hypot(*off[:2]) > 0.3 or abs(wrap(float(off[2]))) > 0.1)
    return usable, wrong


@pytest.mark.parametrize("light_s", [0.5, 1.5, 2.5])
def test_a_gap_whose_way_is_not_known_leaves_the_map_behind(light_s: float) -> None:
    """Without wheels. Odometry once took a view of other ground for the last one, and the map bore it out."""
    frames = [after_a_gap(seed, light_s, dark_s) for seed in SEEDS for dark_s in (1.5, 3.0, 6.0)]
    usable, wrong = (sum(column) for column in zip(*frames, strict=True))
    print(f"seeds {SEEDS}: {usable} frames of {100 * len(frames)} usable, {wrong} of them wrong")
    assert wrong == 0


def test_most_short_gaps_do_not() -> None:
    frames = [after_a_gap(seed, 1.5, 1.2) for seed in SEEDS]
    print(f"seeds {SEEDS}, frames of 100 that were usable, and wrong: {frames}")
    assert sum(wrong for _, wrong in frames) == 0
    assert sum(usable >= 90 for usable, _ in frames) > len(SEEDS) // 2


@pytest.mark.parametrize("gap_s", [2.0, 6.0])
def test_a_robot_that_stands_while_its_camera_stalls_is_where_it_was(gap_s: float) -> None:
    world = World(WorldSpec(seed=3))
    pipeline, stamp_ns = Pipeline(world.calibration, Config(), np.random.default_rng(1)), 10**9
    estimate = None
    for k in range(35):
        stamp_ns += round(1e9 / 15.0) + (round(gap_s * 1e9) if k == 20 else 0)
        estimate = pipeline.step(Frame(k, stamp_ns, world.frame_at(0.01 * k)))
        assert k < 5 or k >= 20 or estimate.state is State.TRACKING
    assert estimate is not None
    print(f"seed 3, {gap_s} s: {estimate.state.name} ({estimate.reason})")
    assert estimate.state is State.TRACKING
    assert np.hypot(*np.asarray(estimate.pose)[:2]) < 0.01


@pytest.mark.parametrize("wheels", [False, True])
def test_a_map_begins_where_a_robot_that_was_told_nothing_first_sees_the_ceiling(wheels: bool) -> None:
    """Booted at night, it stayed in INIT for good: where it might have rolled meanwhile is no question of a new map."""
    drive = hall(1, wheels)
    dark(drive, 20.0)
    states = [drive.tick() for _ in range(10)]
    last = states[-1]
    assert last is not None
    print(f"seed 1: {last.state.name} ({last.reason})")
    assert last.state is State.TRACKING
    assert np.sqrt(last.cov[0, 0] + last.cov[1, 1]) < 0.02


def test_one_that_was_told_where_it_is_waits_until_it_is_told_again() -> None:
    drive = hall(1)
    drive.at_truth()
    dark(drive, 20.0)
    states = [drive.tick() for _ in range(10)]
    last = states[-1]
    assert last is not None
    print(f"seed 1: {last.state.name} ({last.reason})")
    assert last.state is State.INIT
    assert "cmd/initial_pose" in last.reason


def test_a_small_map_of_an_earlier_run_is_asked_after_a_gap() -> None:
    world = worlds.make_world(worlds.WorldSpec("5", 0.6, "sparse", 3))
    rng = np.random.default_rng(3)
    drive = drive_in(world, rng, False, 10.0, True, 0.4)
    all_of_it = worlds.landmarks_of(world.features, np.zeros(len(world.features.xy_map_m)), rng)
    middle = np.mean(all_of_it.xy_map_m, axis=0)
    near = all_of_it.of(np.max(np.abs(all_of_it.xy_map_m - middle), axis=1) < 1.3)
    relocaliser = drive.estimator._pipeline.relocaliser
    gap = doubts.of_gap(np.diag([1.0, 1.0, 4.0]), 6.0, 0.0, 0.1)
    relocaliser.raise_doubt(gap)
    assert relocaliser.sure
    drive.load(near, world.features.axis_rad, np.array([*middle, 0.0]))
    relocaliser = drive.estimator._pipeline.relocaliser
    relocaliser.state.pending, relocaliser.state.reason = None, ""
    assert relocaliser.sure
    relocaliser.raise_doubt(gap)
    assert not relocaliser.sure


def test_places_are_judged_from_where_prediction_had_the_robot_not_from_the_way_that_odometry_chose() -> None:
    """It chose half a turn; what it foresaw was straight on."""
    ahead, turned = np.array([1.0, 0.0, 0.0]), np.array([1.0, 0.0, np.pi])
    cov = np.diag([0.3**2, 0.3**2, 1.0])
    doubt = doubts.of_track(_track(ahead, turned, cov, 0.02), _motion(turned, 0.02), 0.0, ahead, turned)
    off, here = np.array([[0.0, 0.0, -np.pi]]), np.zeros(3)
    foreseen = float(doubt.log_odds(off - doubt.centre, here - doubt.centre, np.zeros(2))[0])
    expected = 0.5 * np.pi**2 / (1.0 + 0.05**2)
    print(f"log-odds {foreseen:.2f}, of a Gaussian {expected:.2f}")
    assert expected - 1.0 < foreseen < expected  # hands may have turned it as well


def test_what_odometry_is_sure_of_has_no_other_centre() -> None:
    ahead, turned = np.array([1.0, 0.0, 0.0]), np.array([1.0, 0.0, 0.1])
    doubt = doubts.of_track(_track(ahead, turned, np.eye(3), 0.0), _motion(turned, 0.0), 0.0, ahead, turned)
    assert not np.any(doubt.centre)
    assert np.array_equal(doubt.cov, _motion(turned, 0.0).cov)


def _motion(step: Array, doubt: float) -> Motion:
    return Motion(Displacement(step), 1e-6 * np.eye(3), 20, 0.002, doubt=doubt)


def _track(blind: Array, step: Array, cov: Array, doubt: float) -> Track:
    return Track(_motion(step, doubt), None, 1.0, Displacement(blind), cov, 1.0, 0.0, 3.0, False)
