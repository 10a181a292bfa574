"""WheelTrack against motions whose truth is known in closed form."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ceilvo import se2
from ceilvo.drivers.base.protocol import wrap_int32
from ceilvo.drivers.base.wheel_track import WheelNoise, WheelTrack
from ceilvo.drivers.telegrams import BaseStatus

START_NS = 50_000_000_000
PERIOD_MS = 50

Path = Callable[[float], tuple[float, float, float]]


def status(pose: tuple[float, float, float], clock_ms: int) -> BaseStatus:
    x, y, theta = pose
    counts = (wrap_int32(round(x / 1e-4)), wrap_int32(round(y / 1e-4)), wrap_int32(round(theta / 1e-5)))
    return BaseStatus(True, False, False, False, *counts, clock_ms % 2**32)


def circle(t_s: float) -> tuple[float, float, float]:
    """0.5 m/s on a circle of 1 m radius."""
    return math.sin(0.5 * t_s), 1.0 - math.cos(0.5 * t_s), 0.5 * t_s


def straight(t_s: float) -> tuple[float, float, float]:
    return 0.5 * t_s, 0.0, 0.0


def starting(t_s: float) -> tuple[float, float, float]:
    """1 m/s^2 from rest: a shift in time shows, which it does not at constant speed."""
    return 0.5 * t_s**2, 0.0, 0.0


def fill(track: WheelTrack, path: Path, t0_s: float = 0.0, t1_s: float = 2.0, clock0_ms: int = 1000) -> None:
    """A status every 50 ms; the base's clock is clock0 at t = 0, the host's is START_NS."""
    for ms in range(round(1e3 * t0_s), round(1e3 * t1_s) + 1, PERIOD_MS):
        track.add(status(path(1e-3 * ms), clock0_ms + ms), START_NS + 1_000_000 * ms)


def at(t_s: float) -> int:
    return START_NS + round(1e9 * t_s)


def truth(path: Path, t0_s: float, t1_s: float) -> np.ndarray:
    return se2.between(np.array(path(t0_s)), np.array(path(t1_s)))


def assert_motion(track: WheelTrack, path: Path, t0_s: float, t1_s: float, tolerance: float = 5e-4) -> None:
    motion = track.between(at(t0_s), at(t1_s))
    assert motion is not None
    error = motion.prev_from_curr - truth(path, t0_s, t1_s)
    error[2] = se2.wrap(error[2])
    assert np.abs(error).max() < tolerance


@given(t0=st.floats(0.0, 2.0), span=st.floats(0.0, 2.0))
def test_displacement_on_a_circle(t0: float, span: float) -> None:
    track = WheelTrack()
    fill(track, circle)
    assert_motion(track, circle, t0, min(t0 + span, 2.0))


def test_the_motion_is_in_the_earlier_base_frame() -> None:
    def turned(t_s: float) -> tuple[float, float, float]:
        return 3.0, 0.5 * t_s, math.pi / 2

    track = WheelTrack()
    fill(track, turned)
    motion = track.between(at(0.5), at(1.5))
    assert motion is not None
    assert motion.prev_from_curr == pytest.approx([0.5, 0.0, 0.0], abs=5e-6)


@pytest.mark.parametrize("x_m", [2**31 * 1e-4 - 0.3, -(2**31) * 1e-4 + 0.01])
def test_counts_that_wrap_around(x_m: float) -> None:
    def far(t_s: float) -> tuple[float, float, float]:
        return x_m + 0.5 * t_s, x_m - 0.5 * t_s, 2**31 * 1e-5 - 0.2 + 0.5 * t_s

    track = WheelTrack()
    fill(track, far)
    assert track.restarts == 0
    assert_motion(track, far, 0.1, 1.9)


def test_a_heading_sent_modulo_two_pi() -> None:
    def wrapped(t_s: float) -> tuple[float, float, float]:
        x, y, theta = circle(t_s + 5.5)
        return x, y, se2.wrap(theta)

    track = WheelTrack()
    fill(track, wrapped)
    assert wrapped(0.0)[2] > 0 > wrapped(2.0)[2]
    assert_motion(track, wrapped, 0.3, 1.7)
    inside_the_step_s = (math.pi / 0.5 - 5.5) - 0.01
    assert_motion(track, wrapped, inside_the_step_s, 1.7)


def test_a_base_clock_that_wraps_is_no_restart() -> None:
    track = WheelTrack()
    fill(track, circle, clock0_ms=2**32 - 700)
    assert track.restarts == 0
    assert_motion(track, circle, 0.1, 1.9)


def test_not_covered() -> None:
    track = WheelTrack(coast_s=0.1)
    assert track.between(at(0.0), at(0.1)) is None
    track.add(status(straight(0.0), 1000), at(0.0))
    assert track.between(at(0.0), at(0.0)) is None, "one sample says nothing about motion"
    fill(track, straight, t0_s=0.05)
    assert track.between(at(-0.01), at(1.0)) is None
    assert track.between(at(1.0), at(2.11)) is None
    assert track.between(at(1.0), at(0.9)) is None
    assert track.between(at(0.0), at(2.0)) is not None


def test_coasting_goes_on_at_the_last_speed_and_says_how_sure_it_is() -> None:
    track = WheelTrack(WheelNoise(coast_accel_mps2=2.0), coast_s=0.1)
    fill(track, straight)
    inside, beyond = track.between(at(1.9), at(1.99)), track.between(at(1.99), at(2.08))
    assert inside is not None
    assert beyond is not None
    assert beyond.prev_from_curr == pytest.approx([0.045, 0.0, 0.0], abs=1e-6)
    assert beyond.cov[0, 0] - inside.cov[0, 0] == pytest.approx((0.5 * 2.0 * 0.08**2) ** 2, rel=1e-3)


def test_the_base_restarts() -> None:
    track = WheelTrack()
    fill(track, circle, t1_s=1.0, clock0_ms=60_000)
    fill(track, circle, t0_s=1.2, t1_s=2.0, clock0_ms=-1190)
    assert track.restarts == 1
    assert track.between(at(0.5), at(1.5)) is None
    assert_motion(track, circle, 1.3, 1.9)


def test_a_restart_during_a_long_silence_is_seen_although_its_clock_is_ahead() -> None:
    track = WheelTrack()
    fill(track, straight, t1_s=1.0, clock0_ms=1000)
    fill(track, straight, t0_s=61.0, t1_s=62.0, clock0_ms=-61_000 + 30_000)
    assert track.restarts == 1
    assert track.between(at(1.0), at(61.5)) is None


def test_odometry_that_jumps_is_a_restart() -> None:
    track = WheelTrack(max_speed_mps=5.0)
    fill(track, straight, t1_s=1.0)
    fill(track, lambda t: (straight(t)[0] + 10.0, 0.0, 0.0), t0_s=1.05)
    assert track.restarts == 1
    assert track.between(at(0.9), at(1.2)) is None


def test_a_silence_is_bridged_but_nothing_inside_it_is_known() -> None:
    track = WheelTrack(max_gap_s=0.5)
    fill(track, circle, t1_s=1.0)
    fill(track, circle, t0_s=2.0, t1_s=3.0)
    assert track.restarts == 0
    assert_motion(track, circle, 0.8, 2.2)
    assert track.between(at(0.8), at(1.5)) is None
    assert track.between(at(1.5), at(2.2)) is None


def test_late_answers_do_not_shift_the_odometry() -> None:
    rng = np.random.default_rng(3)
    track = WheelTrack()
    for i in range(40):
        delay_s = 0.0 if i % 5 == 0 else float(rng.uniform(0.0, 0.09))
        track.add(status(starting(0.05 * i), 1000 + 50 * i), at(0.05 * i + delay_s))
    assert track.restarts == 0
    assert_motion(track, starting, 0.1, 1.9, tolerance=2e-3)


def test_a_repeated_status_is_ignored() -> None:
    track = WheelTrack()
    fill(track, straight, t1_s=1.0)
    track.add(status(straight(1.0), 2000), at(1.04))
    assert_motion(track, straight, 0.3, 1.0)


def test_history_is_bounded() -> None:
    track = WheelTrack(samples=10)
    fill(track, straight)
    assert track.between(at(1.5), at(2.0)) is None
    assert track.between(at(1.56), at(2.0)) is not None


def test_variance_adds_up_along_the_path_and_is_positive() -> None:
    noise = WheelNoise(stamp_sigma_s=0.0)
    track = WheelTrack(noise)
    fill(track, circle)
    whole = track.between(at(0.0), at(2.0))
    parts = [track.between(at(0.0), at(0.7)), track.between(at(0.7), at(2.0))]
    assert whole is not None
    assert parts[0] is not None
    assert parts[1] is not None
    quantum = np.diag([1e-8 / 6, 1e-8 / 6, 1e-10 / 6])
    assert whole.cov == pytest.approx(parts[0].cov + parts[1].cov - quantum, rel=1e-3, abs=1e-12)
    path_m = turned_rad = 1.0
    expected = [
        noise.slip_m2_per_m * path_m,
        noise.slip_m2_per_m * path_m,
        noise.turn_rad2_per_m * path_m + noise.turn_rad2_per_rad * turned_rad,
    ]
    assert np.diag(whole.cov) == pytest.approx(expected, rel=1e-3)


def test_standing_still_is_not_certain() -> None:
    track = WheelTrack()
    fill(track, lambda _: (0.0, 0.0, 0.0))
    motion = track.between(at(1.0), at(1.0))
    assert motion is not None
    assert (np.diag(motion.cov) > 0.0).all()
    assert not motion.prev_from_curr.any()


def test_uneven_sampling_follows_the_base_clock() -> None:
    track = WheelTrack()
    for ms in (0, 10, 200, 210, 480, 900):
        track.add(status(straight(1e-3 * ms), ms), at(1e-3 * ms))
    assert_motion(track, straight, 0.15, 0.85)


def test_wrong_signs_would_show() -> None:
    track = WheelTrack()
    fill(track, lambda t: (-0.3 * t, 0.0, -0.2 * t))
    motion = track.between(at(0.0), at(1.0))
    assert motion is not None
    assert motion.prev_from_curr == pytest.approx([-0.3, 0.0, -0.2], abs=1e-4)


def with_gyro(t_s: float, clock_ms: int) -> BaseStatus:
    """Turns at 0.5 rad/s, and its wheels see less of it."""
    x, y, theta = circle(t_s)
    wheels = status((x, y, 0.9 * theta), clock_ms)
    return replace(
        wheels, version=2, gyro_count=wrap_int32(round(0.5 * t_s / 1e-6)), gained_x_count=7, gained_y_count=7
    )


def test_the_gyros_turn_comes_with_the_same_clock_and_wraps() -> None:
    track = WheelTrack()
    for ms in range(0, 2001, PERIOD_MS):
        track.add(with_gyro(4290.0 + 1e-3 * ms, 1000 + ms), START_NS + 1_000_000 * ms)
    turn = track.turn_between(at(0.31), at(1.73), 1e-7)
    assert turn is not None
    assert abs(turn.turned_rad - 0.5 * 1.42) < 1e-5
    assert turn.var_rad2 == pytest.approx(1.42e-7)
    assert turn.gained_mps is not None and turn.gained_mps.tolist() == [0.0, 0.0]
    assert track.turn_between(at(-1.0), at(1.0), 1e-7) is None


def test_a_base_without_a_gyro_tells_no_turn() -> None:
    track = WheelTrack()
    fill(track, circle)
    assert track.turn_between(at(0.5), at(1.0), 1e-7) is None


@pytest.mark.parametrize("seamless", [True, False])
def test_intervals_add_up_to_the_way_where_they_are_to(seamless: bool) -> None:
    """Speeding up, asked 40 ms after the newest sample each time, as a camera asks."""
    track, way = WheelTrack(seamless=seamless), 0.0
    asked = 0.54
    fill(track, starting, 0.0, 0.5)
    for k in range(15):
        now_s = 0.5 + 0.1 * (k + 1)
        fill(track, starting, now_s - 0.05, now_s)
        motion = track.between(at(asked), at(now_s + 0.04))
        assert motion is not None
        way, asked = way + float(motion.prev_from_curr[0]), now_s + 0.04
        before = track.aside(at(asked - 0.3), at(asked))
        assert before is not None, "somebody else may ask meanwhile"
    true = starting(asked)[0] - starting(0.54)[0]
    print(way - true)
    assert (abs(way - true) < 0.004) == seamless
