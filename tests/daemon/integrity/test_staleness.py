"""The monitor of stale calibrations: bounds, hold, outliers, recovery, and false alarms with ideal innovations."""

from __future__ import annotations

import math

import numpy as np
import pytest

from ceilvo.daemon.integrity.staleness import HIGH, UNMEASURED_NIS, StalenessMonitor, worst_stretch

STEP_NS = 200_000_000


def feed(monitor: StalenessMonitor, values: list[float], start: int = 0) -> list[bool]:
    return [monitor.add((start + i) * STEP_NS, v, 20).stale for i, v in enumerate(values)]


def test_it_is_silent_while_the_model_holds() -> None:
    rng = np.random.default_rng(1)
    hour = list(rng.chisquare(20, 18_000) / 20)
    assert not any(feed(StalenessMonitor(1.0), hour))


def test_a_stale_calibration_is_raised_after_the_hold_and_gives_its_reason() -> None:
    monitor = StalenessMonitor(1.0, window_s=20, hold_s=10)
    told = feed(monitor, [1.5 * HIGH] * 300)
    first = told.index(True)
    assert first * STEP_NS >= 10e9 and first * STEP_NS <= 25e9
    assert "run 'calib check'" in monitor.last.reason and f"NIS is {1.5 * HIGH:.1f} for" in monitor.last.reason


def test_a_burst_is_not_staleness() -> None:
    """Ten seconds of wrong associations, however wild."""
    assert not any(feed(StalenessMonitor(1.0), [0.5] * 400 + [1e6] * 50 + [0.5] * 400))


@pytest.mark.parametrize("bad", [math.nan, math.inf])
def test_innovations_that_are_no_numbers_count_as_wild(bad: float) -> None:
    assert any(feed(StalenessMonitor(1.0), [bad] * 600))


def test_it_recovers_below_the_bound_with_hysteresis() -> None:
    monitor = StalenessMonitor(1.0, window_s=20, hold_s=5)
    assert feed(monitor, [2 * HIGH] * 300)[-1]
    assert feed(monitor, [0.9 * HIGH] * 300, 300)[-1], "within the hysteresis it stays"
    assert not feed(monitor, [0.5 * HIGH] * 300, 600)[-1]
    assert monitor.last.reason == ""


def test_frames_without_innovations_say_nothing() -> None:
    monitor = StalenessMonitor(1.0)
    for i in range(1000):
        monitor.add(i * STEP_NS, 100.0, 0)
    assert not monitor.last.stale and math.isnan(monitor.last.mean_nis)


def test_a_reset_forgets() -> None:
    monitor = StalenessMonitor(1.0, window_s=20, hold_s=5)
    assert feed(monitor, [2 * HIGH] * 300)[-1]
    monitor.reset()
    assert not monitor.last.stale


@pytest.mark.parametrize(("expected", "noticed"), [(0.3, True), (1.0, False), (None, False)])
def test_the_bound_is_a_multiple_of_what_commissioning_measured(expected: float | None, noticed: bool) -> None:
    assert any(feed(StalenessMonitor(expected), [1.9 * 0.3 * HIGH] * 600)) is noticed


def test_without_a_survey_only_much_is_noticed() -> None:
    assert not any(feed(StalenessMonitor(), [0.9 * HIGH * UNMEASURED_NIS] * 600))
    assert any(feed(StalenessMonitor(), [1.1 * HIGH * UNMEASURED_NIS] * 600))


def test_the_worst_stretch_of_a_drive_is_found() -> None:
    series = [(0.2 * i, 3.0 if 200 <= i < 300 else 0.5) for i in range(600)]
    worst = worst_stretch(series)
    assert worst is not None and abs(worst - 3.0) < 1e-9
    assert worst_stretch(series[:50]) is None
    short = worst_stretch([(0.1 * i, 2.0) for i in range(100)])
    assert short is not None and abs(short - 2.0) < 1e-9
