"""The delay between pictures and wheels is found from the drive alone; none is found where there is none."""

import numpy as np
import pytest
from told_drives import DRIVING, ahead, paths_of, seen, told

from ceilvo import se2
from ceilvo.config import Config
from ceilvo.daemon.odometry.cross_checks.delay import NO_DELAY_S, Delay, Rewound
from ceilvo.daemon.odometry.cross_checks.paths import Paths
from ceilvo.types import Array, Displacement, Motion, WheelMotion


@pytest.mark.parametrize("late_s", [0.1, 0.2, 0.33])
def test_a_delay_is_found(late_s: float) -> None:
    check, first_s = Delay(), None
    for now_s, paths in paths_of(told(DRIVING, 120.0, 100, late_s)):
        check.step(paths)
        if first_s is None and check.state.steady_s is not None:
            first_s = now_s
    assert first_s is not None and first_s < 60.0
    assert check.known_s == pytest.approx(late_s, abs=0.03)


def test_without_a_delay_none_is_found_in_20_minutes() -> None:
    check, worst_s = Delay(), 0.0
    for _, paths in paths_of(told(DRIVING, 1200.0, 101)):
        check.step(paths)
        worst_s = max(worst_s, abs(check.state.steady_s or 0.0))
    assert check.state.steady_s is not None
    assert worst_s < NO_DELAY_S
    assert check.known_s == 0.0


def test_a_steady_speed_tells_nothing() -> None:
    check, paths, rng = Delay(), Paths(), np.random.default_rng(3)
    for _ in range(900):
        paths.add(seen(np.array([0.02, 0.0, 0.0]), rng), ahead(0.02), 1.0 / 15.0)
        check.step(paths)
    assert check.state.steady_s is None
    assert check.known_s == 0.0


def test_a_steady_speed_tells_nothing_by_wheels_that_are_noisy() -> None:
    """Between two samples of the wheels their noise is halved, so every other half frame looks like the right lag."""
    check, paths, rng = Delay(), Paths(), np.random.default_rng(0)
    for _ in range(1500):
        told = ahead(0.08)
        noise = np.sqrt(np.diag(told.cov)) * rng.standard_normal(3)
        paths.add(
            seen(np.array([0.08, 0.0, 0.0]), rng),
            WheelMotion(Displacement(np.asarray(told.prev_from_curr + noise)), told.cov),
            1.0 / 15.0,
        )
        check.step(paths)
        assert check.state.estimate_s is None and check.known_s == 0.0


def test_a_delay_that_changes_is_followed() -> None:
    check, offset_s = Delay(), 0.0
    for late_s, seed in ((0.1, 102), (0.3, 103)):
        for _, paths in paths_of(told(DRIVING, 150.0, seed, late_s)):
            check.step(paths)
        offset_s = late_s
    assert check.known_s == pytest.approx(offset_s, abs=0.04)


STEP_S = 0.1
SPEED = np.array([0.5, 0.0, 0.4])
"""m/s, m/s, rad/s."""


def on(seconds: float) -> Array:
    """(3,) the way of so long."""
    return np.asarray(se2.driven(SPEED, np.array([seconds]))[0])


def frame(moved: Array, seen: bool = True) -> Motion:
    return Motion(Displacement(moved), np.diag([1e-8, 1e-8, 1e-8]), 20, 0.0, failure=None if seen else "an old picture")


def driven_on(check: Rewound, frames: int) -> None:
    for _ in range(frames):
        check.step(0, frame(on(STEP_S)), STEP_S)


def shown_again(check: Rewound, periods: list[int], then_s: float) -> None:
    """Old pictures, each of so many frames before, and then a new one, then_s of the way on."""
    predicted = np.zeros(3)
    for period in periods:
        step = on(STEP_S)
        predicted = np.asarray(se2.compose(predicted, step))
        check.step(period, frame(step, seen=False), STEP_S)
    corrected = se2.compose(se2.inverse(predicted), on(then_s))
    check.step(0, frame(np.asarray(corrected)), STEP_S)


@pytest.mark.parametrize("old", [2, 3, 9])
def test_pictures_that_came_once_more_are_late_from_then_on(old: int) -> None:
    check = Rewound(Config().odometry)
    driven_on(check, 10)
    shown_again(check, [old] * old, STEP_S)
    assert check.late_s == pytest.approx(old * STEP_S)
    driven_on(check, 50)
    assert check.late_s == pytest.approx(old * STEP_S)
    since = check.since
    assert since is not None
    off = since[0] - on(old * STEP_S)
    assert np.all(np.abs(off) < 3.0 * np.sqrt(np.diag(since[1])))


def test_a_ring_that_ends_after_one_round_shows_a_robot_that_has_moved_on() -> None:
    check = Rewound(Config().odometry)
    driven_on(check, 10)
    shown_again(check, [3] * 3, 4 * STEP_S)
    assert check.late_s == 0.0
    assert check.since is None


@pytest.mark.parametrize("periods", [[3, 3, 3, 3], [3, 2, 3], [3, 3], [1], [2]], ids=str)
def test_old_pictures_in_another_order_or_number_tell_no_delay(periods: list[int]) -> None:
    check = Rewound(Config().odometry)
    driven_on(check, 10)
    shown_again(check, periods, STEP_S)
    assert check.late_s == 0.0


def test_pictures_that_catch_up_are_late_no_more() -> None:
    check = Rewound(Config().odometry)
    driven_on(check, 10)
    shown_again(check, [3] * 3, STEP_S)
    driven_on(check, 20)
    check.step(0, frame(on(4 * STEP_S)), STEP_S)
    assert check.late_s == 0.0
    driven_on(check, 20)
    assert check.late_s == 0.0
