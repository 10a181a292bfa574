"""A robot that starts again where the ceiling hangs lower, drawn by hand: heights by the map, against the truth."""

from __future__ import annotations

import numpy as np
import pytest
from height_drawings import CALIBRATION, HIGH_M, SEED, grid, seen

from ceilvo import se2
from ceilvo.crossing_types import JOINTS
from ceilvo.daemon.odometry.heights.by_map import AskMap, MapHere
from ceilvo.daemon.odometry.heights.levels import Levels
from ceilvo.daemon.odometry.heights.stage import Heights
from ceilvo.daemon.slam.spatial_index import landmarks_near
from ceilvo.types import Array, Displacement, Landmarks, Motion

LOW_M = HIGH_M - 0.4
STILL = Motion(Displacement(np.zeros(3)), 1e-6 * np.eye(3), 9, 0.0)
STEP = [*grid(LOW_M, -1.5, 4), *((axis, at + 2.1, high) for axis, at, high in grid(HIGH_M, -1.2, 4))]


def mapped(lines: list[tuple[int, float, float]]) -> Landmarks:
    """Of crossings of lines of one height, where they are."""
    xy = np.array(
        [[x, y] for a, x, high in lines for b, y, other in lines if (a, b) == (0, 1) and high == other], np.float64
    )
    n = len(xy)
    return Landmarks(np.arange(n), xy, np.tile(1e-6 * np.eye(2), (n, 1, 1)), np.full(n, JOINTS), np.full(n, 9))


def here(pose: Array, landmarks: Landmarks) -> AskMap:
    known = MapHere(pose, 0.0, lambda xy_m, reach_m: landmarks_near(landmarks, xy_m, reach_m))
    return lambda expected: known


def restarted(drops_m: tuple[float, ...], pose: Array, believed: Array) -> tuple[Heights, float, int]:
    """A stage that knows of heights, after three views from a pose where it is believed to be at another; the largest
    error of a crossing it handed on last, m, and how many there were."""
    heights, rng = Heights(CALIBRATION), np.random.default_rng(SEED)
    heights.know(drops_m)
    landmarks = mapped(STEP)
    for _ in range(3):
        crossings, true = seen(STEP, pose, rng)
        placed = heights.look(crossings, np.zeros(3), here(believed, landmarks))
        heights.learn(STILL)
    assert placed is not None
    off = np.hypot(*(placed.xy_base_m[:, None] - true[None]).transpose(2, 0, 1))
    return heights, float(np.max(np.min(off, axis=1))), len(placed)


@pytest.mark.parametrize("turn_rad", [0.0, 0.3, 0.5 * np.pi, -2.4])
def test_the_map_tells_which_lines_are_lower(turn_rad: float) -> None:
    pose = np.array([0.1, -0.05, turn_rad])
    heights, off_m, count = restarted((0.4,), pose, pose)
    assert heights.several and not heights.state.asks
    assert off_m < 0.002
    assert count > 20


def test_a_pose_that_is_centimetres_off_does_as_well() -> None:
    pose = np.array([0.1, -0.05, 0.2])
    heights, off_m, _ = restarted((0.4,), pose, pose + np.array([0.015, -0.01, 0.003]))
    assert heights.several
    assert off_m < 0.002


@pytest.mark.parametrize("off", [[0.31, 0.17, 0.0], [0.2, -0.26, 0.1], [-0.4, 0.12, 0.0]])
def test_a_map_that_shows_nothing_there_tells_nothing(off: list[float]) -> None:
    """Then all is as in a run that never met another height."""
    pose = np.array([0.1, -0.05, 0.2])
    heights, _, _ = restarted((0.4,), pose, pose + off)
    assert not heights.several
    assert heights.drops_m == pytest.approx((0.4,)), "not forgotten: it is stored again"


def test_under_the_calibrated_height_nothing_is_changed() -> None:
    """As the map has nothing lower in view, the view is handed on as it is."""
    heights, rng, lines = Heights(CALIBRATION), np.random.default_rng(SEED), grid(HIGH_M, -1.2, 5)
    heights.know((0.4,))
    crossings, _ = seen(lines, np.zeros(3), rng)
    assert heights.look(crossings, None, here(np.zeros(3), mapped(lines))) is crossings
    assert not heights.several and not heights.state.asks, "nor is the map asked again"


def test_lines_that_come_into_view_later_are_told_as_well() -> None:
    """A robot that starts under the calibrated height, and drives below a step that an earlier run found."""
    heights, rng, high = Heights(CALIBRATION), np.random.default_rng(SEED), grid(HIGH_M, -1.2, 5)
    heights.know((0.4,))
    heights.look(seen(high, np.zeros(3), rng)[0], None, here(np.zeros(3), mapped(high)))
    heights.learn(STILL)
    assert not heights.several
    crossings, true = seen(STEP, np.zeros(3), rng)
    placed = heights.look(crossings, np.zeros(3), here(np.zeros(3), mapped(STEP)))
    assert heights.several and placed is not None
    off = np.hypot(*(placed.xy_base_m[:, None] - true[None]).transpose(2, 0, 1))
    assert len(placed) > 20 and float(np.max(np.min(off, axis=1))) < 0.002


@pytest.mark.parametrize("drops_m", [(), (0.4,), (0.3, 0.15), (-0.5, 0.4)])
def test_heights_come_back_from_what_was_stored(drops_m: tuple[float, ...]) -> None:
    levels = Levels.of_drops(drops_m, HIGH_M)
    assert len(levels) == 1 + len(drops_m)
    assert levels.drops_m(HIGH_M) == pytest.approx(drops_m)
    np.testing.assert_allclose(levels.ratio[1:], [HIGH_M / (HIGH_M - d) for d in drops_m])


@pytest.mark.parametrize("drops_m", [(HIGH_M,), (50.0,), (0.01,), (-30.0,)])
def test_heights_that_no_ceiling_here_has_are_left_out(drops_m: tuple[float, ...]) -> None:
    """Of another robot's camera, or a file that was edited."""
    assert len(Levels.of_drops(drops_m, HIGH_M)) == 1


def test_a_robot_drives_on_from_there_in_the_right_scale() -> None:
    """The way of its camera is that of the truth, though all that it saw at first hangs lower."""
    heights, rng, lines = Heights(CALIBRATION), np.random.default_rng(SEED), grid(LOW_M, -1.5, 6)
    heights.know((0.4,))
    landmarks, poses = mapped(lines), [np.array([0.02 * k, 0.0, 0.004 * k]) for k in range(40)]
    for k, pose in enumerate(poses):
        crossings, true = seen(lines, pose, rng)
        moved = np.zeros(3) if k == 0 else se2.between(poses[k - 1], pose)
        placed = heights.look(crossings, moved, here(pose, landmarks))
        assert placed is not None and len(placed) == len(true)
        assert np.max(np.abs(placed.xy_base_m - true)) < 0.004
        heights.learn(Motion(Displacement(moved), 1e-6 * np.eye(3), len(placed), 0.0, restarted=k == 0))
