"""A pose moved on against where a robot on a circle really is."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from ceilvo import se2
from ceilvo.senses.prediction import MAX_AHEAD_S, predicted
from ceilvo.types import Displacement, Estimate, FilterHealth, Motion, Pose, State, Twist, WheelMotion

TWIST = np.array([0.5, 0.0, 0.4])
POSE = np.array([1.0, -2.0, 0.7])


def estimate() -> Estimate:
    motion = Motion(Displacement(np.zeros(3)), np.eye(3), 10, 0.0)
    health = FilterHealth(100, 100.0, None, 0.0, 1.0, 3)
    pose, cov = Pose(POSE), np.diag([1e-6, 1e-6, 1e-6])
    return Estimate(1, 10**9, pose, cov, pose, Twist(TWIST), State.TRACKING, 0.9, "", motion, health, 10, 10)


@given(st.floats(0.0, MAX_AHEAD_S))
def test_a_steady_twist_leads_to_where_the_robot_is(ahead_s: float) -> None:
    pose, cov, by_s = predicted(estimate(), 10**9 + round(1e9 * ahead_s))
    true = se2.compose(POSE, se2.driven(TWIST, np.array([ahead_s]))[0])
    assert np.allclose(pose, true, atol=1e-8)
    assert abs(by_s - ahead_s) < 1e-8
    assert cov[0, 0] >= 1e-6


def test_wheels_are_believed_before_the_twist_and_nothing_is_moved_back_or_too_far() -> None:
    wheels = WheelMotion(Displacement(np.array([0.01, 0.0, 0.0])), np.eye(3) * 1e-6)
    assert np.allclose(predicted(estimate(), 10**9 + 10**8, wheels)[0], se2.compose(POSE, wheels.prev_from_curr))
    assert predicted(estimate(), 10**9 - 5, wheels)[2] == 0.0
    late = predicted(estimate(), 3 * 10**9, wheels)
    assert late[2] == MAX_AHEAD_S
    assert late[1][0, 0] > 0.01
