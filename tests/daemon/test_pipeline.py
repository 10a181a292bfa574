"""The whole method on rendered frames, against the simulator's truth; gaps, restarts, repeatability."""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest

from ceilvo import se2
from ceilvo.config import Config, Filter
from ceilvo.daemon.pipeline import Pipeline
from ceilvo.daemon.replay.trajectory import estimate_json
from ceilvo.sim.camera import SimCamera
from ceilvo.sim.world import World, WorldSpec
from ceilvo.types import Estimate, Frame, State

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


def frames(world: World, seconds: float) -> Iterator[Frame]:
    camera = SimCamera(world, RATE_HZ, realtime=False, duration_s=seconds)
    camera.open()
    while (frame := camera.read()) is not None:
        yield frame


def error(world: World, estimate: Estimate) -> np.ndarray:
    return se2.between(world.truth_at(world.seconds(estimate.stamp_ns)), estimate.pose)


def test_a_drive_around_a_corner_stays_within_millimetres(world: World) -> None:
    pipeline = pipeline_of(world)
    estimates = [pipeline.step(f) for f in frames(world, 12.0)]
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


def test_the_same_frames_give_the_same_bytes(world: World) -> None:
    first, second = (
        [estimate_json(p.step(f)) for f in frames(world, 3.0)] for p in (pipeline_of(world), pipeline_of(world))
    )
    assert first == second


def test_blackout_is_dead_reckoned_and_corrected_when_the_light_returns(world: World) -> None:
    pipeline, shot = pipeline_of(world), list(frames(world, 5.0))
    dark = np.zeros_like(shot[0].gray)
    blind = range(45, 54)
    estimates = [pipeline.step(replace(f, gray=dark) if k in blind else f) for k, f in enumerate(shot)]
    during = [estimates[k] for k in blind]
    assert all(not e.motion.ok for e in during)
    assert during[-1].state in (State.DEAD_RECKONING, State.LOST)
    sigma = [float(e.cov[0, 0]) for e in during]
    assert np.all(np.diff(sigma) > 0)
    after = estimates[blind.stop]
    assert after.motion.ok
    assert np.hypot(*error(world, after)[:2]) < 0.005
    assert estimates[-1].state is State.TRACKING


def test_without_frames_it_coasts_and_says_why(world: World) -> None:
    pipeline = pipeline_of(world)
    estimates = [pipeline.step(f) for f in frames(world, 2.0)]
    late = estimates[-1].stamp_ns + 400_000_000
    coasted = pipeline.step_crossings(late, None, missing="camera unplugged")
    assert coasted.state is State.DEAD_RECKONING
    assert coasted.motion.failure == "camera unplugged"
    assert coasted.seq == estimates[-1].seq + 1
    assert coasted.cov[0, 0] > estimates[-1].cov[0, 0]


def restarted(world: World, shift: tuple[float, float]) -> tuple[list[Estimate], list[Frame]]:
    """Map 8 s of driving, then start again on that map at 3 s with a stored pose that is off by `shift`."""
    shot = list(frames(world, 8.0))
    mapper = pipeline_of(world)
    poses = [mapper.step(frame) for frame in shot]
    axis = mapper.relocaliser.state.map_axis_rad
    assert axis is not None
    begin = int(3.0 * RATE_HZ)
    again = pipeline_of(world)
    stored = poses[begin].pose + np.array([*shift, 0.0])
    again.load_map(mapper.filter.landmarks(), axis, stored, np.diag([0.05, 0.05, 0.05]) ** 2)
    return [again.step(frame) for frame in shot[begin:]], shot[begin:]


def test_a_stored_pose_is_not_tracking_until_landmarks_confirm_it(world: World) -> None:
    estimates, _ = restarted(world, (0.02, -0.01))
    assert estimates[0].state is not State.TRACKING
    assert estimates[-1].state is State.TRACKING
    assert np.hypot(*error(world, estimates[-1])[:2]) < 0.03


@pytest.mark.parametrize("shift", [(0.6, 0.0), (0.0, -0.6), (-1.2, 0.6)])
def test_a_stored_pose_that_is_whole_tiles_off_is_never_tracking(world: World, shift: tuple[float, float]) -> None:
    """It may find the tile it is under, and says TRACKING only there."""
    estimates, _ = restarted(world, shift)
    assert estimates[0].state is State.RELOCALISING
    for e in estimates:
        assert e.state is State.RELOCALISING or np.hypot(*error(world, e)[:2]) < 0.05


def test_a_stored_pose_on_the_wrong_place_is_never_tracking(world: World) -> None:
    shot = list(frames(world, 4.0))
    mapper = pipeline_of(world)
    for frame in shot:
        last = mapper.step(frame)
    axis = mapper.relocaliser.state.map_axis_rad
    assert axis is not None
    wrong = last.pose + np.array([0.31, 0.28, 0.0])
    again = pipeline_of(world)
    again.load_map(mapper.filter.landmarks(), axis, wrong, np.diag([0.02, 0.02, 0.02]) ** 2)
    states = {again.step(replace(shot[-1], stamp_ns=shot[-1].stamp_ns + k * 66_000_000)).state for k in range(30)}
    assert State.TRACKING not in states


def test_a_robot_that_is_put_elsewhere_in_the_light_is_in_doubt_at_once_and_teaches_the_map_nothing(
    world: World,
) -> None:
    pipeline, shot = pipeline_of(world), list(frames(world, 8.0))
    for frame in shot:
        last = pipeline.step(frame)
    known, stamp_ns = len(pipeline.filter.landmarks()), shot[-1].stamp_ns
    states = []
    for k, frame in enumerate(shot[60:90]):  # 1.4 m back and before the bend
        estimate = pipeline.step(replace(frame, stamp_ns=stamp_ns + (k + 1) * 66_666_667))
        wrong = np.hypot(*(estimate.pose - world.truth_at(world.seconds(frame.stamp_ns)))[:2]) > 0.3
        states.append((estimate.state, wrong))
    assert last.state is State.TRACKING
    assert (State.TRACKING, True) not in states
    assert len(pipeline.filter.landmarks()) <= known + 3


def test_a_pose_that_is_given_before_anything_is_mapped_turns_the_map_with_it(world: World) -> None:
    pipeline, shot = pipeline_of(world), list(frames(world, 3.0))
    pipeline.step(shot[0])
    assert not len(pipeline.filter.landmarks())
    turned = world.initial_pose + np.array([0.0, 0.0, 0.4])
    pipeline.set_pose(turned, np.diag([0.02, 0.02, 0.02]) ** 2, "told")
    last = [pipeline.step(frame) for frame in shot[1:]][-1]
    assert last.state is State.TRACKING
    assert last.landmarks > 20
    assert abs(error(world, last)[2] - 0.4) < 0.02


def test_reset_forgets_the_map_and_says_so(world: World) -> None:
    pipeline = pipeline_of(world)
    for frame in frames(world, 2.0):
        pipeline.step(frame)
    pipeline.reset()
    assert len(pipeline.filter.landmarks()) == 0
    assert pipeline.relocaliser.state.map_axis_rad is None
