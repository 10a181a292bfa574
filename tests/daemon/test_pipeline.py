"""The whole method on rendered frames, against the simulator's truth; gaps, restarts, repeatability."""

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import islice

import numpy as np
import pytest

from ceilvo import se2
from ceilvo.config import Config, Filter
from ceilvo.daemon.pipeline import Pipeline
from ceilvo.daemon.replay.trajectory import estimate_json
from ceilvo.sim.camera import SimCamera
from ceilvo.sim.world import World, WorldSpec
from ceilvo.types import Crossings, Estimate, Frame, Pose, State

SEED = 3
RATE_HZ = 15.0


@pytest.fixture(scope="module")
def world() -> World:
    return World(WorldSpec(seed=SEED))


def config_of(world: World) -> Config:
    x, y, theta = (float(v) for v in world.initial_pose)
    start = Filter(initial_pose_x_m=x, initial_pose_y_m=y, initial_pose_theta_deg=float(np.degrees(theta)))
    return Config(filter=start)


def pipeline_of(world: World) -> Pipeline:
    return Pipeline(world.calibration, config_of(world), np.random.default_rng(SEED))


def frames(world: World, seconds: float, start: int = 0) -> Iterator[Frame]:
    camera = SimCamera(world, RATE_HZ, realtime=False, duration_s=seconds)
    camera.open()
    return islice(iter(camera.read, None), start, None)


def error(world: World, estimate: Estimate) -> np.ndarray:
    return se2.between(world.truth_at(world.seconds(estimate.stamp_ns)), estimate.pose)


@dataclass
class Drive:
    """Rendered and looked at once for all tests: what was estimated of each frame, and seen in it."""

    estimates: list[Estimate]
    seen: list[tuple[int, Crossings]]

    def through(self, pipeline: Pipeline, begin: int, end: int) -> list[Estimate]:
        """Estimates of a pipeline that sees what was seen in these frames."""
        return [pipeline.step_crossings(*seen) for seen in self.seen[begin:end]]


@pytest.fixture(scope="module")
def drive(world: World) -> Drive:
    pipeline, drive = pipeline_of(world), Drive([], [])
    for frame in frames(world, 12.0):
        drive.estimates.append(pipeline.step(frame))
        assert pipeline.vision.view is not None and pipeline.vision.view.crossings is not None
        drive.seen.append((frame.stamp_ns, pipeline.vision.view.crossings))
    return drive


def test_a_drive_around_a_corner_stays_within_millimetres(world: World, drive: Drive) -> None:
    estimates = drive.estimates
    errors = np.array([error(world, e) for e in estimates])
    rms = np.sqrt(np.mean(np.sum(errors[:, :2] ** 2, axis=1)))
    turn = np.degrees(np.sqrt(np.mean(errors[:, 2] ** 2)))
    driven = np.sum(np.hypot(*np.diff([e.odom[:2] for e in estimates], axis=0).T))
    print(f"seed {SEED}: {driven:.2f} m, rms {rms * 1e3:.2f} mm, {turn:.4f} deg")
    assert driven > 3.5
    assert rms < 0.005
    assert turn < 0.05
    assert estimates[-1].state is State.TRACKING
    assert all(e.state is State.TRACKING for e in estimates[10:])
    assert [e.seq for e in estimates] == list(range(1, len(estimates) + 1))
    assert estimates[-1].landmarks > 40


def test_crossings_give_what_their_frames_gave(world: World, drive: Drive) -> None:
    """So that the tests below may see the drive without rendering it."""
    again = drive.through(pipeline_of(world), 0, 45)
    assert [estimate_json(e) for e in again] == [estimate_json(e) for e in drive.estimates[:45]]


def test_the_same_frames_give_the_same_bytes(world: World, drive: Drive) -> None:
    pipeline = pipeline_of(world)
    again = [estimate_json(pipeline.step(f)) for f in frames(world, 3.0)]
    assert again == [estimate_json(e) for e in drive.estimates[: len(again)]]


def test_blackout_is_dead_reckoned_and_corrected_when_the_light_returns(world: World, drive: Drive) -> None:
    pipeline, begin, blind = pipeline_of(world), 40, range(45, 54)
    drive.through(pipeline, 0, begin)
    estimates = {}
    for k, f in enumerate(frames(world, 5.0, begin), begin):
        estimates[k] = pipeline.step(replace(f, gray=np.zeros_like(f.gray)) if k in blind else f)
    during = [estimates[k] for k in blind]
    assert all(not e.motion.ok for e in during)
    assert during[-1].state in (State.DEAD_RECKONING, State.LOST)
    sigma = [float(e.cov[0, 0]) for e in during]
    assert np.all(np.diff(sigma) > 0)
    after = estimates[blind.stop]
    assert after.motion.ok
    assert np.hypot(*error(world, after)[:2]) < 0.005
    assert estimates[max(estimates)].state is State.TRACKING


def test_without_frames_it_coasts_and_says_why(world: World, drive: Drive) -> None:
    pipeline = pipeline_of(world)
    estimates = drive.through(pipeline, 0, 30)
    late = estimates[-1].stamp_ns + 400_000_000
    coasted = pipeline.step_crossings(late, None, missing="camera unplugged")
    assert coasted.state is State.DEAD_RECKONING
    assert coasted.motion.failure == "camera unplugged"
    assert coasted.seq == estimates[-1].seq + 1
    assert coasted.cov[0, 0] > estimates[-1].cov[0, 0]


def restarted(
    world: World, drive: Drive, mapped: int, off: list[float], sigma: float, begin: int, ago_s: float = math.inf
) -> Pipeline:
    """A pipeline that knows the map of the first frames and a stored pose that is off from where it was at one."""
    mapper = pipeline_of(world)
    poses = drive.through(mapper, 0, mapped)
    axis = mapper.relocaliser.state.map_axis_rad
    assert axis is not None
    again = pipeline_of(world)
    pose, cov = Pose(poses[begin].pose + np.array(off)), np.eye(3) * sigma**2
    again.load_map(mapper.filter.landmarks(), axis, pose, cov, ago_s)
    return again


def test_a_stored_pose_is_not_tracking_until_landmarks_confirm_it(world: World, drive: Drive) -> None:
    estimates = drive.through(restarted(world, drive, 120, [0.02, -0.01, 0.0], 0.05, 45), 45, 120)
    assert estimates[0].state is not State.TRACKING
    assert estimates[-1].state is State.TRACKING
    assert np.hypot(*error(world, estimates[-1])[:2]) < 0.03


@pytest.mark.parametrize("ago_s", [5.0, math.inf])
@pytest.mark.parametrize("shift", [(0.6, 0.0), (0.0, -0.6), (-1.2, 0.6)])
def test_a_stored_pose_that_is_whole_tiles_off_is_never_tracking(
    world: World, drive: Drive, shift: tuple[float, float], ago_s: float
) -> None:
    """It may find the tile it is under, and says TRACKING only there."""
    estimates = drive.through(restarted(world, drive, 120, [*shift, 0.0], 0.05, 45, ago_s), 45, 120)
    assert estimates[0].state is State.RELOCALISING
    for e in estimates:
        assert e.state is State.RELOCALISING or np.hypot(*error(world, e)[:2]) < 0.05


def standing(frame: Frame, count: int, rng: np.random.Generator) -> Iterator[Frame]:
    """A robot that stands sees the same with the noise of its sensor."""
    for k in range(count):
        noise = rng.integers(-2, 3, frame.gray.shape)
        gray = np.clip(frame.gray + noise, 0, 255).astype(np.uint8)
        yield Frame(k, frame.stamp_ns + round(k * 1e9 / RATE_HZ), gray)


@pytest.mark.parametrize("at", [0, 50, 100, 150])
def test_a_robot_that_was_killed_where_it_stands_is_tracked_again_though_its_map_is_of_one_view(
    world: World, at: int
) -> None:
    """Whatever the view shows: on plain tiles nothing seen tells it from a robot that was carried, but time does."""
    frame, rng = next(frames(world, 12.0, at)), np.random.default_rng(at)
    first = pipeline_of(world)
    last = [first.step(f) for f in standing(frame, 60, rng)][-1]
    axis = first.relocaliser.state.map_axis_rad
    assert last.state is State.TRACKING and axis is not None
    for life in range(3):
        again = pipeline_of(world)
        cov = last.cov + 0.05**2 * np.eye(3)
        again.load_map(first.filter.landmarks(), axis, last.pose, cov, 5.0, first.elsewhere)
        states = [e.state for e in map(again.step, standing(frame, 60, rng))]
        print(f"view {at}, life {life}: {len(first.filter.landmarks())} landmarks, {again.elsewhere:.1e} elsewhere")
        assert set(states[15:]) == {State.TRACKING}
        first = again


def test_a_stored_pose_on_the_wrong_place_is_never_tracking(world: World, drive: Drive) -> None:
    again = restarted(world, drive, 60, [0.31, 0.28, 0.0], 0.02, 59)
    stamp_ns, seen = drive.seen[59]
    states = {again.step_crossings(stamp_ns + k * 66_000_000, seen).state for k in range(30)}
    assert State.TRACKING not in states


def test_a_robot_that_is_put_elsewhere_in_the_light_is_in_doubt_at_once_and_teaches_the_map_nothing(
    world: World, drive: Drive
) -> None:
    pipeline = pipeline_of(world)
    last = drive.through(pipeline, 0, 120)[-1]
    known = len(pipeline.filter.landmarks())
    states = []
    for k, (stamp_ns, seen) in enumerate(drive.seen[60:90]):  # 1.4 m back and before the bend
        estimate = pipeline.step_crossings(last.stamp_ns + (k + 1) * 66_666_667, seen)
        wrong = np.hypot(*(estimate.pose - world.truth_at(world.seconds(stamp_ns)))[:2]) > 0.3
        states.append((estimate.state, wrong))
    assert last.state is State.TRACKING
    assert (State.TRACKING, True) not in states
    assert len(pipeline.filter.landmarks()) <= known + 3


def test_a_pose_that_is_given_before_anything_is_mapped_turns_the_map_with_it(world: World, drive: Drive) -> None:
    pipeline = pipeline_of(world)
    drive.through(pipeline, 0, 1)
    assert not len(pipeline.filter.landmarks())
    turned = Pose(world.initial_pose + np.array([0.0, 0.0, 0.4]))
    pipeline.set_pose(turned, np.diag([0.02, 0.02, 0.02]) ** 2, "told")
    last = drive.through(pipeline, 1, 45)[-1]
    assert last.state is State.TRACKING
    assert last.landmarks > 20
    assert abs(error(world, last)[2] - 0.4) < 0.02


def test_reset_forgets_the_map_and_says_so(world: World, drive: Drive) -> None:
    pipeline = pipeline_of(world)
    drive.through(pipeline, 0, 30)
    assert len(pipeline.filter.landmarks())
    pipeline.reset()
    assert len(pipeline.filter.landmarks()) == 0
    assert pipeline.relocaliser.state.map_axis_rad is None
