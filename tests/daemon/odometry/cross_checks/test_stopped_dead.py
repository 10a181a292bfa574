"""Without wheels: a picture that stands where it was, though no robot brakes on no way."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ceilvo.config import Odometry
from ceilvo.daemon.odometry.cross_checks.standing import StoppedDead
from ceilvo.daemon.odometry.cross_checks.suspicion import Kind, Severity
from ceilvo.types import Motion, WheelMotion

NOISE_M = 1e-4
BRAKE_MPS2 = Odometry().max_accel_mps2
DRIVES = Motion(np.array([0.03, 0.0, 0.0]), np.eye(3), 9, 0.0)
STANDS = Motion(np.array([1e-4, 0.0, 0.0]), np.eye(3), 9, 0.0)


def seen(way_m: np.ndarray, rate_hz: float, seed: int = 0, lost: tuple[int, ...] = ()) -> list[bool]:
    """Whether it was suspected at each view of a robot that has come so far; lost views predict that it drives on."""
    rng, check, out = np.random.default_rng(seed), StoppedDead(Odometry()), []
    at = way_m + rng.normal(0.0, NOISE_M, len(way_m))
    believed = at[0]
    for k in range(1, len(at)):
        step = believed - at[k - 2] if k in lost and k > 1 else at[k] - believed
        motion = Motion(np.array([step, 0.0, 0.0]), np.eye(3), 9, 0.0, "nothing fits" if k in lost else None)
        believed += step
        out.append(check.step(motion, None, 1.0 / rate_hz) is not None)
    return out


def driven() -> StoppedDead:
    check = StoppedDead(Odometry())
    for _ in range(3):
        assert check.step(DRIVES, None, 1.0 / 30.0) is None
    return check


def stopping(speed_mps: float, brake_mps2: float, rate_hz: float, phase: float) -> np.ndarray:
    """(N,) way at views of a robot that drives for a second and then brakes."""
    t = np.arange(0.0, 2.5, 1.0 / rate_hz) - 1.0 - phase / rate_hz
    braking = np.clip(t, 0.0, speed_mps / brake_mps2)
    return np.minimum(t, 0.0) * speed_mps + speed_mps * braking - 0.5 * brake_mps2 * braking**2


@settings(max_examples=200, deadline=None)
@given(st.floats(0.05, 2.0), st.floats(0.3, BRAKE_MPS2), st.sampled_from([10.0, 15.0, 30.0, 60.0]), st.floats(0.0, 1.0))
def test_a_robot_that_brakes_as_hard_as_it_can_is_none(
    speed_mps: float, brake_mps2: float, rate_hz: float, phase: float
) -> None:
    assert not any(seen(stopping(speed_mps, brake_mps2, rate_hz, phase), rate_hz))


@pytest.mark.parametrize(("speed_mps", "rate_hz"), [(0.4, 30.0), (0.5, 20.0), (0.9, 30.0), (0.9, 10.0), (1.5, 15.0)])
@pytest.mark.parametrize("lost", [(), (21,), (21, 22)])
def test_a_picture_that_is_frozen_at_speed_is_one(speed_mps: float, rate_hz: float, lost: tuple[int, ...]) -> None:
    """Also where the first views that do not move were refused."""
    way = speed_mps / rate_hz * np.minimum(np.arange(40), 20)
    said = seen(way, rate_hz, 1, lost)
    assert not any(said[:20])
    assert all(said[20 + len(lost) :])


def test_it_is_over_when_the_picture_moves_and_graver_the_longer_it_lasts() -> None:
    check = driven()
    said = [check.step(STANDS, None, 1.0 / 30.0) for _ in range(15)]
    assert all(s is not None and s.kind is Kind.STANDS for s in said)
    assert said[0] is not None and said[0].severity is Severity.DEGRADED
    assert said[-1] is not None and said[-1].severity is Severity.IN_DOUBT
    assert abs(said[-1].jump_m - 0.9 * 15 / 30.0) < 0.02
    assert check.step(DRIVES, None, 1.0 / 30.0) is None and check.step(DRIVES, None, 1.0 / 30.0) is None


def test_what_the_picture_did_before_wheels_came_and_went_is_forgotten() -> None:
    """The robot braked while the wheels told it."""
    check = driven()
    assert check.step(STANDS, WheelMotion(np.zeros(3), np.eye(3)), 1.0 / 30.0) is None
    assert not any(check.step(STANDS, None, 1.0 / 30.0) for _ in range(5))
