"""The two paths: windows are what the steps in them add up to."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from told_drives import ahead, seen, still

from ceilvo import se2
from ceilvo.daemon.odometry.cross_checks.paths import KEPT_S, Paths, displacement
from ceilvo.types import Displacement, WheelMotion

steps = st.lists(st.tuples(*[st.floats(-0.3, 0.3)] * 3), min_size=2, max_size=12)


@given(steps, st.integers(0, 100))
def test_a_window_is_the_sum_of_its_steps(moved: list[tuple[float, float, float]], start: int) -> None:
    paths, whole = Paths(), [np.zeros(3)]
    paths.add(seen(np.zeros(3), np.random.default_rng(1)), still(), 0.0)
    for step in moved:
        paths.add(
            seen(np.zeros(3), np.random.default_rng(1)), WheelMotion(Displacement(np.array(step)), np.eye(3)), 0.1
        )
        whole.append(se2.compose(whole[-1], np.array(step)))
    first = start % len(moved)
    told = displacement(paths.wheels[first], paths.wheels[-1])
    true = se2.between(whole[first], whole[-1])
    assert np.allclose(told[:2], true[:2])
    assert abs(se2.wrap(float(told[2] - true[2]))) < 1e-9
    variance = paths.wheel_variance(float(paths.time_s[first]), float(paths.time_s[-1]))
    assert np.allclose(variance, len(moved) - first)


def test_between_frames_the_wheels_go_on_evenly() -> None:
    paths, rng = Paths(), np.random.default_rng(1)
    for _ in range(4):
        paths.add(seen(np.zeros(3), rng), ahead(0.1), 0.1)
    middle = paths.wheel_motion(0.15, 0.35)
    assert middle is not None
    assert np.allclose(middle.prev_from_curr, [0.2, 0.0, 0.0])
    assert np.isclose(middle.cov[0, 0], 2.0 * ahead(0.1).cov[0, 0])


def test_what_is_not_covered_is_not_made_up() -> None:
    paths, rng = Paths(), np.random.default_rng(1)
    for _ in range(4):
        paths.add(seen(np.zeros(3), rng), ahead(0.1), 0.1)
    assert paths.wheel_motion(0.0, 0.3) is None
    assert paths.wheel_motion(0.2, 0.5) is None


def test_history_is_bounded_and_ends_with_the_wheels() -> None:
    paths, rng = Paths(), np.random.default_rng(1)
    for _ in range(400):
        paths.add(seen(np.zeros(3), rng), ahead(0.01), 0.02)
    assert paths.time_s[-1] - paths.time_s[0] <= KEPT_S
    paths.add(seen(np.zeros(3), rng), None, 0.02)
    assert len(paths) == 0
