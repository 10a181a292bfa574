"""The delay between pictures and wheels is found from the drive alone; none is found where there is none."""

import numpy as np
import pytest
from told_drives import DRIVING, ahead, paths_of, seen, told

from ceilvo.daemon.odometry.cross_checks.delay import NO_DELAY_S, Delay
from ceilvo.daemon.odometry.cross_checks.paths import Paths
from ceilvo.types import Displacement, WheelMotion


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
