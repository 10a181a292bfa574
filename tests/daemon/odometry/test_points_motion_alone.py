"""Motion that points alone prove, and what is not known of it while the robot rocks."""

from __future__ import annotations

import numpy as np
import pytest
from drawn_crossings import crossings_at

from ceilvo import se2
from ceilvo.config import Odometry
from ceilvo.crossing_types import CORNER, JOINTS, LAMP
from ceilvo.daemon.odometry.points.constellation import Points, laid
from ceilvo.daemon.odometry.points.lean import LeanState, learn, step_cov, view_cov
from ceilvo.daemon.odometry.visual_odometry import VisualOdometry
from ceilvo.types import NO_DIRECTION_RAD, Array, Crossings

STEP_S = 1.0 / 30.0
SIGMA_M = 0.003
HEIGHT_M = 2.5
HALL = np.stack(np.meshgrid(np.arange(-6.0, 7.0, 3.0), np.arange(-6.0, 7.0, 3.0)), -1).reshape(-1, 2)
CLOSE = 0.05 * HALL
"""The same raster of 15 cm: any motion lays one on another."""
JERK = np.array([0.14, 0.03, 0.03])
"""Within one frame: 4.3 m/s from a stand."""


def crossings_of(xy: Array, kind: int, directed: bool) -> Crossings:
    return crossings_at(xy, kind, SIGMA_M, psi_sigma_rad=1e-4 if directed else NO_DIRECTION_RAD)


def after_a_stand(at: Array, kind: int, moved: Array, rng: np.random.Generator) -> VisualOdometry:
    """Ten frames of a stand; the eleventh is left to the test."""
    odometry = VisualOdometry(Odometry())
    for _ in range(10):
        odometry.step(crossings_of(at + rng.normal(0.0, 0.1 * SIGMA_M, at.shape), kind, kind == JOINTS), STEP_S)
    return odometry


def test_lamps_that_stand_alone_are_believed_however_fast_the_robot_is() -> None:
    rng = np.random.default_rng(1)
    odometry = after_a_stand(HALL, LAMP, JERK, rng)
    seen = se2.transform(se2.inverse(JERK), HALL) + rng.normal(0.0, 0.3 * SIGMA_M, HALL.shape)
    motion = odometry.step(crossings_of(seen, LAMP, False), STEP_S)
    assert motion.ok, motion.failure
    assert np.max(np.abs(se2.between(JERK, motion.prev_from_curr))) < 2.0 * SIGMA_M
    assert motion.doubt < 1e-4


def test_lamps_that_lie_close_together_are_not() -> None:
    """One raster step further they are the same lamps: how a robot drives has to say which."""
    rng = np.random.default_rng(2)
    odometry = after_a_stand(CLOSE, LAMP, JERK, rng)
    seen = se2.transform(se2.inverse(JERK), CLOSE) + rng.normal(0.0, 0.1 * SIGMA_M, CLOSE.shape)
    motion = odometry.step(crossings_of(seen, LAMP, False), STEP_S)
    right = np.max(np.abs(se2.between(JERK, motion.prev_from_curr))) < 2.0 * SIGMA_M
    assert not motion.ok or right or motion.doubt > 0.1


def test_joints_of_tiles_are_not() -> None:
    """Lines repeat, and change places with their neighbours: limits of speed hold."""
    rng = np.random.default_rng(3)
    tiles = np.stack(np.meshgrid(np.arange(-1.8, 1.9, 0.6), np.arange(-1.8, 1.9, 0.6)), -1).reshape(-1, 2)
    odometry = after_a_stand(tiles, JOINTS, JERK, rng)
    moved = np.array([0.14, 0.0, 0.0])
    seen = se2.transform(se2.inverse(moved), tiles) + rng.normal(0.0, 0.1 * SIGMA_M, tiles.shape)
    motion = odometry.step(crossings_of(seen, JOINTS, True), STEP_S)
    assert not motion.ok
    assert "jumped" in (motion.failure or "")


@pytest.mark.parametrize("lamps", [2, 3, 6])
def test_a_view_is_laid_alone_from_three_points_on(lamps: int) -> None:
    at = np.array([[0.5, 0.5], [3.4, 0.4], [-2.6, 3.1], [0.4, -2.9], [3.2, 3.6], [-2.7, -2.4]])[:lamps]
    sigma = np.full(lamps, SIGMA_M)
    ref = Points(at, np.full(lamps, LAMP), sigma)
    curr = Points(se2.transform(se2.inverse(JERK), at), np.full(lamps, LAMP), sigma)
    way = laid(ref, curr, np.zeros(3), STEP_S, Odometry())
    assert way is not None and way.met == lamps
    assert way.alone == (lamps >= 3)
    assert np.max(np.abs(way.ref_from_curr - JERK)) < 1e-9


def test_a_sprinkler_and_its_corner_are_one_thing() -> None:
    """A lamp and a sprinkler with a corner of its own, as seen in two views of which one took another lamp's end for
    it: two distances that are off alike are no third point."""
    at, kind = np.array([[0.40, -0.61], [0.38, -0.61], [-0.25, -0.61]]), np.array([LAMP, CORNER, LAMP])
    sigma = np.full(3, SIGMA_M)
    ref, curr = Points(at, kind, sigma), Points(np.add(at, [[0.0, 0.0], [0.0, 0.0], [0.05, 0.0]]), kind, sigma)
    way = laid(ref, curr, np.zeros(3), STEP_S, Odometry())
    assert way is not None and way.met == 2 and not way.alone


def leaning(at: Array, lean_rad: Array) -> Array:
    """What a camera that leans sees of points (N, 2) on a ceiling, in base as if it were level."""
    x, y = (at / HEIGHT_M).T
    a, b = lean_rad.tolist()
    rays = np.stack([x + a, y + b, 1.0 - a * x - b * y])
    return np.asarray((rays[:2] / rays[2]).T * HEIGHT_M)


def test_a_robot_that_rocks_is_as_far_off_as_it_says_and_one_that_does_not_is_sure() -> None:
    rng = np.random.default_rng(4)
    at = rng.uniform(-2.5, 2.5, (6, 2))
    for degrees, states in ((0.0, "sure"), (1.5, "not")):
        state, rate_s, before, off = LeanState(), 1.0 / 15.0, None, []
        for k in range(150):
            lean = np.radians(degrees) * np.array([np.sin(2.0 * np.pi * 0.4 * k * rate_s), 0.3 * np.cos(0.5 * k)])
            now = leaning(at, lean) + rng.normal(0.0, 1e-4, at.shape)
            if before is not None:
                moved = np.append(np.mean(before - now, axis=0), 0.0)
                points = [Points(xy, np.full(6, LAMP), np.full(6, SIGMA_M)) for xy in (before, now)]
                learn(state, points[0], points[1], moved, rate_s, HEIGHT_M)
                off.append(moved[:2])
            before = now
        step_m, view_m = np.sqrt(np.diag(step_cov(state))), np.sqrt(np.diag(view_cov(state)))
        true_m = np.sqrt(np.mean(np.square(off), axis=0))
        print(f"seed 4, {degrees} deg: steps off by {1e3 * true_m} mm, said {1e3 * step_m}, views {1e3 * view_m} mm")
        if states == "sure":
            assert np.max(step_m) < 1e-3 and np.max(view_m) < 3e-3
        else:
            assert np.all(step_m > 0.4 * true_m) and np.all(step_m < 3.0 * true_m)
            assert view_m[0] > HEIGHT_M * np.radians(degrees) / np.sqrt(2.0)
