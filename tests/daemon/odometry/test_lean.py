"""How far a robot leans by points alone, and when they do not tell it."""

import numpy as np
import pytest

from ceilvo import se2
from ceilvo.crossing_types import LAMP
from ceilvo.daemon.odometry.points.constellation import Points
from ceilvo.daemon.odometry.points.lean import LeanState, learn, view_cov
from ceilvo.types import Array

HEIGHT_M, STEP_S, SIGMA_M = 2.2, 1.0 / 30.0, 0.0005
MOTION = np.array([0.017, 0.0, 0.0])


def _seen(at: Array, pose: Array, tilt_rad: Array, rng: np.random.Generator) -> Points:
    xy = se2.transform(se2.inverse(pose), at)
    x, y = (xy / HEIGHT_M).T
    depth = 1.0 - tilt_rad[0] * x - tilt_rad[1] * y
    leaning = HEIGHT_M * np.column_stack([(x + tilt_rad[0]) / depth, (y + tilt_rad[1]) / depth])
    return Points(leaning + rng.normal(0.0, SIGMA_M, xy.shape), np.full(len(at), LAMP), np.full(len(at), SIGMA_M))


def _sway_m(at: Array, rocks_deg: float, seed: int, flicker_m: float = 0.0) -> float:
    """What is said of the view of a robot under points (N, 2) m after 3 s."""
    rng, state, pose, before = np.random.default_rng(seed), LeanState(), np.zeros(3), None
    for k in range(90):
        tilt = np.radians(rocks_deg) * np.array([np.sin(0.1 * k), np.cos(0.07 * k)])
        view = _seen(at, pose, tilt, rng)
        view.xy[0] += rng.choice([-1.0, 1.0], 2) * flicker_m
        if before is not None:
            sway = HEIGHT_M * (tilt - before[1])
            learn(state, before[0], view, np.array([*(MOTION[:2] - sway), 0.0]), STEP_S, HEIGHT_M)
        before, pose = (view, tilt), se2.compose(pose, MOTION)
    return float(np.sqrt(np.max(view_cov(state))))


SPREAD = np.array(
    [[1.0, 0.2], [-0.6, 0.9], [0.1, -0.8], [-0.9, -0.4], [1.6, 0.9], [0.7, -1.1], [2.0, -0.3], [1.3, 0.1]]
)
CLOSE = np.array([[0.52, -0.28], [0.52, -0.41], [0.55, -0.15], [0.65, -0.29]])


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_a_robot_that_rocks_is_said_to_and_one_that_does_not_is_not(seed: int) -> None:
    rocking, level = _sway_m(SPREAD, 2.0, seed), _sway_m(SPREAD, 0.0, seed)
    print(f"seed {seed}: {1e3 * rocking:.0f} mm rocking by 2 deg, {1e3 * level:.1f} mm level")
    assert rocking > 0.04
    assert level < 0.015


@pytest.mark.parametrize("seed", [1, 2, 3, 4])
def test_four_points_close_together_of_which_one_flickers_say_nothing(seed: int) -> None:
    """They said that the robot leant by degrees, and went on saying so while three were in view."""
    said = _sway_m(CLOSE, 0.0, seed, flicker_m=0.004)
    print(f"seed {seed}: {1e3 * said:.1f} mm")
    assert said < 0.015
