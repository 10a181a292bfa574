"""Stamps that run at another rate than the clock are noticed and replaced; late, bunched and missing frames are not."""

from __future__ import annotations

import re
from collections.abc import Iterator

import numpy as np
import pytest

from ceilvo.daemon.integrity.stamp_rate import StampRate

S = 10**9
START = 5000 * S


def frames(
    seconds: float, rate_hz: float, seed: int, worst_wait_s: float = 0.02, busy: float = 0.0
) -> Iterator[tuple[int, int]]:
    """Stamp and arrival, ns, of a camera 30 ms behind; for the share `busy` of seconds everything waits .1 s more."""
    rng = np.random.default_rng(seed)
    for k in range(round(seconds * rate_hz)):
        t = START + round(k * S / rate_hz)
        slow = rng.random() < 0.05 or (busy > 0.0 and (t // S * 7919 % 100) < 100 * busy)
        yield t, t + round(S * (0.03 + rng.exponential(0.003) + slow * rng.uniform(0.0, worst_wait_s)))


@pytest.mark.parametrize("rate_hz", [5.0, 10.0, 30.0, 60.0])
@pytest.mark.parametrize("busy", [0.0, 0.3])
def test_an_hour_of_a_camera_with_jitter_has_its_own_stamps(rate_hz: float, busy: float) -> None:
    check = StampRate()
    assert all(check.usable(t, arrival) == t for t, arrival in frames(3600.0, rate_hz, 110, 0.15, busy))
    assert check.state.faults == 0


def test_a_computer_that_becomes_slow_for_good_is_no_fault() -> None:
    check = StampRate()
    for t, arrival in frames(60.0, 30.0, 111):
        late = arrival + (t > START + 30 * S) * S // 4
        assert check.usable(t, late) == t


def test_a_camera_that_was_away_for_a_while_is_no_fault() -> None:
    check = StampRate()
    for t, arrival in frames(60.0, 30.0, 112):
        if not START + 20 * S < t < START + 27 * S:
            assert check.usable(t, arrival) == t


@pytest.mark.parametrize("rate", [0.8, 0.9, 1.2])
@pytest.mark.parametrize("rate_hz", [10.0, 30.0])
def test_stamps_at_another_rate_are_replaced_within_seconds(rate: float, rate_hz: float) -> None:
    check, worst_s = StampRate(), 0.0
    for t, arrival in frames(30.0, rate_hz, 113):
        told = START + round((t - START) * rate)
        used = check.usable(told, arrival)
        if t > START + 4 * S:
            worst_s = max(worst_s, abs(used - t) / S)
    assert check.state.faults == 1
    said = re.search(r"run at (\d\.\d\d) times", check.state.reason)
    assert said is not None and float(said[1]) == pytest.approx(rate, abs=0.03)
    assert worst_s < 0.3


def test_slow_drift_is_found_as_well() -> None:
    check = StampRate()
    found_s = next(
        (t - START) / S
        for t, arrival in frames(60.0, 30.0, 114)
        if check.usable(START + round((t - START) * 0.97), arrival) and check.state.faults
    )
    assert found_s < 12.0


def test_stamps_that_are_right_again_are_believed_again() -> None:
    check = StampRate()
    for t, arrival in frames(30.0, 30.0, 115):
        behind = round(0.2 * (t - START - 5 * S)) if START + 5 * S < t < START + 10 * S else 0
        used = check.usable(t - behind, arrival)
    assert check.state.faults == 1
    assert check.state.reason == ""
    assert used == t


def test_a_recording_has_a_clock_of_its_own() -> None:
    check = StampRate()
    for k in range(300):
        assert check.usable(S + k * S // 30, START + k * S // 90) == S + k * S // 30
