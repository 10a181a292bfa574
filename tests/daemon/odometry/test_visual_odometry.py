"""Visual odometry on constructed crossings: signs, gaps, failures, axes that change their names."""

from dataclasses import replace

import numpy as np
import pytest

from ceilvo import se2
from ceilvo.config import Odometry
from ceilvo.crossing_types import quarter_turns, turned_type
from ceilvo.daemon.odometry.visual_odometry import VisualOdometry
from ceilvo.types import Crossings, Displacement, WheelMotion

DT_S = 1 / 30
RNG = np.random.default_rng(7)
WORLD = np.array([(0.6 * i + 0.1, 0.6 * j + 0.2) for i in range(-2, 12) for j in range(-2, 12)])
WORLD_KIND = RNG.integers(0, 9, len(WORLD))


def seen_from(pose: np.ndarray, noise_m: float = 0.0, seed: int = 0) -> Crossings:
    """What a robot at map_from_base sees within 1.3 m, with the axes named as the line fit names them."""
    base = se2.transform(se2.inverse(pose), WORLD)
    near = np.hypot(base[:, 0], base[:, 1]) < 1.3
    psi = float((-pose[2] + np.pi / 4) % (np.pi / 2) - np.pi / 4)
    turns = quarter_turns(psi + float(pose[2]), 0.0)
    kind = turned_type(WORLD_KIND[near], -turns)
    xy = base[near] + np.random.default_rng(seed).normal(0, noise_m, (int(near.sum()), 2))
    n = len(xy)
    return Crossings(
        186.0 * xy + [320, 240],
        xy,
        np.tile(np.eye(2) * 1e-6, (n, 1, 1)),
        kind,
        psi,
        1e-4,
        np.zeros(2),
        np.ones(2),
        np.zeros((2, 2)),
    )


def drive(poses: list[np.ndarray], blind: range = range(0), noise_m: float = 0.0) -> tuple[np.ndarray, list[bool]]:
    vo, pose, ok = VisualOdometry(Odometry()), poses[0], []
    for k, p in enumerate(poses):
        motion = vo.step(None if k in blind else seen_from(p, noise_m, k), DT_S)
        pose = se2.compose(pose, motion.prev_from_curr)
        ok.append(motion.ok)
    return pose, ok


def circle(n: int, v_mps: float = 0.5, w_radps: float = 0.6) -> list[np.ndarray]:
    out = [np.array([2.0, 2.0, 0.3])]
    for _ in range(n):
        out.append(se2.compose(out[-1], np.array([v_mps * DT_S, 0.0, w_radps * DT_S])))
    return out


def test_a_robot_that_moves_forward_sees_the_world_go_back() -> None:
    vo = VisualOdometry(Odometry())
    vo.step(seen_from(np.array([2.0, 2.0, 0.0])), DT_S)
    motion = vo.step(seen_from(np.array([2.02, 2.0, 0.0])), DT_S)
    assert motion.ok
    assert np.abs(motion.prev_from_curr - [0.02, 0.0, 0.0]).max() < 1e-9


def test_a_left_turn_is_positive() -> None:
    vo = VisualOdometry(Odometry())
    vo.step(seen_from(np.array([2.0, 2.0, 0.0])), DT_S)
    motion = vo.step(seen_from(np.array([2.0, 2.0, 0.03])), DT_S)
    assert motion.prev_from_curr[2] == pytest.approx(0.03, abs=1e-9)


def test_full_circle_through_all_four_axis_names() -> None:
    poses = circle(320)
    end, ok = drive(poses)
    assert all(ok[1:])
    assert np.abs(se2.between(poses[-1], end)).max() < 1e-6


def test_noise_averages_and_covariance_is_of_its_size() -> None:
    poses = circle(100)
    end, ok = drive(poses, noise_m=3e-4)
    assert all(ok[1:])
    assert np.hypot(*(end - poses[-1])[:2]) < 0.01


def test_gap_is_bridged_from_the_last_good_frame() -> None:
    poses = circle(60)
    end, ok = drive(poses, blind=range(20, 26))
    assert not any(ok[20:26]) and all(ok[26:])
    assert np.abs(se2.between(poses[-1], end)).max() < 1e-6


def test_covariance_grows_with_the_gap() -> None:
    vo, poses = VisualOdometry(Odometry()), circle(40)
    for p in poses[:5]:
        vo.step(seen_from(p), DT_S)
    sigma = [float(np.sqrt(vo.step(None, DT_S).cov[0, 0])) for _ in range(15)]
    assert np.all(np.diff(sigma) > 0)
    total = float(np.sqrt(np.sum(np.square(sigma))))
    since_twist_s = 0.5 + 3 * DT_S  # it is the median of three views
    assert total == pytest.approx(0.5 * Odometry().coast_accel_mps2 * 0.5 * since_twist_s, rel=0.08)


def test_wheels_carry_the_motion_when_vision_is_out() -> None:
    vo = VisualOdometry(Odometry())
    vo.step(seen_from(np.array([2.0, 2.0, 0.0])), DT_S)
    wheels = WheelMotion(np.array([0.01, 0.0, 0.002]), np.eye(3) * 1e-4)
    motion = vo.step(None, DT_S, wheels)
    assert not motion.ok
    assert motion.failure == "no lines found"
    assert np.array_equal(motion.prev_from_curr, wheels.prev_from_curr)


def test_an_unrelated_view_is_a_failure_and_then_a_new_start() -> None:
    vo, poses = VisualOdometry(Odometry()), circle(30)
    for p in poses[:3]:
        vo.step(seen_from(p), DT_S)
    elsewhere = np.array([4.3, 4.25, 1.1])
    results = [vo.step(seen_from(elsewhere), DT_S) for _ in range(12)]
    assert not results[0].ok and results[0].failure
    assert results[-1].ok
    assert np.abs(results[-1].prev_from_curr).max() < 1e-9


def test_implausible_speed_is_a_failure() -> None:
    vo = VisualOdometry(Odometry(max_speed_mps=0.3))
    vo.step(seen_from(np.array([2.0, 2.0, 0.0])), DT_S)
    motion = vo.step(seen_from(np.array([2.03, 2.0, 0.0])), DT_S)
    assert motion.failure is not None and "moved 0.030 m" in motion.failure


def test_a_consistent_jump_that_no_robot_makes_is_a_failure() -> None:
    """All crossings 30 mm off, as when every line was taken for its neighbour: nothing contradicts it but physics."""
    vo, poses = VisualOdometry(Odometry()), circle(10)
    for p in poses:
        assert vo.step(seen_from(p), DT_S).prev_from_curr is not None
    jumped = se2.compose(poses[-1], np.array([0.5 * DT_S + 0.03, 0.0, 0.6 * DT_S]))
    motion = vo.step(seen_from(jumped), DT_S)
    assert motion.failure is not None and "off its course" in motion.failure
    assert abs(motion.prev_from_curr[0] - 0.5 * DT_S) < 0.002


def test_a_view_that_was_mistaken_costs_one_motion_and_leaves_the_twist_alone() -> None:
    """The next view is on course: what lies between the two was no motion, and nobody moved the robot."""
    vo = VisualOdometry(Odometry())
    poses = circle(12)
    steps = [se2.compose(pose, np.array([0.03, 0.0, 0.0])) if k == 6 else pose for k, pose in enumerate(poses)]
    motions = [vo.step(seen_from(pose), DT_S) for pose in steps]
    assert [k for k, motion in enumerate(motions) if not motion.ok] == [0, 6]
    assert np.abs(vo.state.twist - [0.5, 0.0, 0.6]).max() < 0.05
    assert max(motion.doubt for motion in motions[7:]) < 1e-3


def test_a_turn_that_no_robot_makes_is_a_failure() -> None:
    """An old picture on a bend: it fits a part of what was seen last, turned by half a radian."""
    vo, poses = VisualOdometry(Odometry(max_turn_radps=20.0)), circle(10)
    for p in poses:
        vo.step(seen_from(p), DT_S)
    motion = vo.step(seen_from(se2.compose(poses[-1], np.array([0.5 * DT_S, 0.0, -0.1]))), DT_S)
    assert motion.failure is not None and "rad off its course" in motion.failure
    assert abs(motion.prev_from_curr[2] - 0.6 * DT_S) < 0.002
    brisk = VisualOdometry(Odometry())
    turned = [np.array([2.0, 2.0, 0.5 * 8.0 * (k * DT_S) ** 2]) for k in range(10)]  # 8 rad/s^2
    assert all([brisk.step(seen_from(p), DT_S).ok for p in turned][1:])


def test_a_motion_that_a_fifth_of_the_crossings_share_is_a_failure() -> None:
    """The others saw another place: what is left fits by chance."""
    vo, poses = VisualOdometry(Odometry()), circle(5)
    for p in poses:
        vo.step(seen_from(p), DT_S)
    view = seen_from(se2.compose(poses[-1], np.array([0.5 * DT_S, 0.0, 0.6 * DT_S])))
    astray = np.random.default_rng(8).uniform(0.1, 0.4, (len(view), 2))
    off = np.where((np.arange(len(view)) % 5 > 0)[:, None], astray, 0.0)
    motion = vo.step(replace(view, xy_base_m=view.xy_base_m + off, uv_px=view.uv_px + 186.0 * off), DT_S)
    assert motion.failure is not None and "crossings moved alike" in motion.failure
    half = np.where((np.arange(len(view)) % 2 > 0)[:, None], astray, 0.0)
    motion = vo.step(replace(view, xy_base_m=view.xy_base_m + half, uv_px=view.uv_px + 186.0 * half), 0.0)
    assert motion.ok


def test_a_motion_that_most_crossings_share_but_no_robot_makes_is_a_failure() -> None:
    """Four in five moved by 0.4 m in a thirtieth of a second, the others as predicted."""
    vo, poses = VisualOdometry(Odometry()), circle(5)
    for p in poses:
        vo.step(seen_from(p), DT_S)
    view = seen_from(se2.compose(poses[-1], np.array([0.5 * DT_S, 0.0, 0.6 * DT_S])))
    off = np.where((np.arange(len(view)) % 5 > 0)[:, None], np.array([0.21, 0.33]), 0.0)
    motion = vo.step(replace(view, xy_base_m=view.xy_base_m + off, uv_px=view.uv_px + 186.0 * off), DT_S)
    assert motion.failure is not None and "jumped 0.39" in motion.failure


def test_a_robot_that_is_already_moving_is_taken_as_it_is() -> None:
    vo, poses = VisualOdometry(Odometry()), circle(5, v_mps=1.5, w_radps=0.0)
    assert all([vo.step(seen_from(p), DT_S).ok for p in poses][1:])


def only(crossings: Crossings, xy_map: np.ndarray, pose: np.ndarray) -> Crossings:
    """Those that lie at places (N, 2) of the map."""
    off = se2.transform(pose, crossings.xy_base_m)[:, None] - xy_map
    return crossings.of(np.flatnonzero(np.min(np.hypot(*off.T).T, axis=1) < 1e-6))


@pytest.mark.parametrize("off_m", [0.0, 0.25])
def test_two_crossings_do_where_wheels_say_where_they_are(off_m: float) -> None:
    """Large tiles: three are seen, then six of which two were among them. A robot that was moved is not there."""
    places = np.array([(0.1 + 1.2 * i, 0.2 + 1.2 * j) for i in range(-1, 7) for j in range(-1, 7)])
    before, after = np.array([2.0, 2.0, 0.0]), np.array([2.05, 2.0, 0.0])
    wheels = WheelMotion(Displacement(after - before), np.diag([4e-6, 4e-6, 4e-6]))
    vo = VisualOdometry(Odometry())
    first = only(seen_from(before), places, before)
    vo.step(first.of(np.arange(3)), 0.1, wheels)
    there = np.array([2.05 + off_m, 2.0, 0.0])
    later = only(seen_from(there), places, there)
    known = np.min(
        np.hypot(*(se2.transform(there, later.xy_base_m)[:, None] - se2.transform(before, first.xy_base_m[:3])).T).T,
        axis=1,
    )
    two = np.flatnonzero(known < 1e-6)[:2]
    later = later.of(np.append(two, np.flatnonzero(known > 1e-6)))
    motion = vo.step(later, 0.1, wheels)
    assert len(two) == 2
    if off_m == 0.0:
        assert motion.ok and motion.inliers == 2
        assert np.abs(motion.prev_from_curr - [0.05, 0.0, 0.0]).max() < 1e-6
    else:
        assert not motion.ok or motion.doubt > 0.01
