from __future__ import annotations

import math
import struct
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ceilvo.drivers.base import protocol as bp
from ceilvo.drivers.telegrams import BaseStatus, PoseTelegram
from ceilvo.errors import BaseLinkError
from ceilvo.types import Estimate, FilterHealth, Motion, State

BASIC = PoseTelegram(
    State.TRACKING, 0.9, 7, 0.02, 1.0, -2.0, 0.5, 0.01, 0.02, 0.003, 0.3, 0.0, -0.1, heartbeat=1
)  # fmt: skip
IDLE = BaseStatus(False, False, False, False, 0, 0, 0, 0)

any_float = st.floats(allow_nan=True, allow_infinity=True)


def reals(limit: float) -> st.SearchStrategy[float]:
    return st.floats(-limit, limit)


telegrams = st.builds(
    PoseTelegram,
    state=st.sampled_from(State),
    quality=st.floats(0.0, 1.0),
    sequence=st.integers(0, 2**32 - 1),
    age_s=st.floats(0.0, 65.535),
    x_m=reals(2e5),
    y_m=reals(2e5),
    theta_rad=st.floats(-math.pi, math.pi, exclude_max=True),
    sigma_x_m=st.floats(0.0, 6.5535),
    sigma_y_m=st.floats(0.0, 6.5535),
    sigma_theta_rad=st.floats(0.0, 0.65535),
    vx_mps=reals(32.767),
    vy_mps=reals(32.767),
    omega_radps=reals(32.767),
    heartbeat=st.integers(0, 0xFFFF),
)

_FLOATS = ("quality", "age_s", "x_m", "y_m", "theta_rad", "vx_mps", "vy_mps", "omega_radps")
_FLOATS += ("sigma_x_m", "sigma_y_m", "sigma_theta_rad")

wild_telegrams = st.builds(
    PoseTelegram,
    state=st.sampled_from(State),
    heartbeat=st.integers(0, 2**20),
    sequence=st.integers(0, 2**40),
    **dict.fromkeys(_FLOATS, any_float),
)


@given(telegrams)
def test_round_trip_is_exact_to_half_a_unit(t: PoseTelegram) -> None:
    back = bp.decode_pose(bp.encode_pose(t))
    assert (back.state, back.sequence, back.heartbeat, back.version) == (t.state, t.sequence, t.heartbeat, 1)
    half = 0.5 * (1 + 1e-6)
    assert abs(back.quality - t.quality) <= half * 1e-3
    assert abs(back.age_s - t.age_s) <= half * 1e-3
    for name, unit in (("x_m", 1e-4), ("y_m", 1e-4), ("vx_mps", 1e-3), ("vy_mps", 1e-3), ("omega_radps", 1e-3)):
        assert abs(getattr(back, name) - getattr(t, name)) <= half * unit, name
    assert abs(math.remainder(back.theta_rad - t.theta_rad, 2 * math.pi)) <= half * 1e-5
    for name, unit in (("sigma_x_m", 1e-4), ("sigma_y_m", 1e-4), ("sigma_theta_rad", 1e-5)):
        over = getattr(back, name) - getattr(t, name)
        assert abs(over - 0.5 * unit) <= 0.5 * unit + 1e-8, f"{name} is not rounded up by less than a unit"


@given(wild_telegrams)
def test_whatever_comes_in_fits_the_wire_and_is_never_called_good_when_it_is_not(t: PoseTelegram) -> None:
    registers = bp.encode_pose(t)
    assert len(registers) == 19
    assert all(0 <= r <= 0xFFFF for r in registers)
    back = bp.decode_pose(registers)
    numbers = (t.x_m, t.y_m, t.theta_rad, t.vx_mps, t.vy_mps, t.omega_radps)
    if not all(map(math.isfinite, numbers)):
        assert back.state is (State.STOPPED if t.state is State.STOPPED else State.LOST)
        assert back.quality == 0.0
        assert registers[12:15] == [65535] * 3
    if back.state is not t.state:
        assert back.state is State.LOST


@pytest.mark.parametrize(
    ("change", "index", "value"),
    [
        ({"age_s": 70.0}, 5, 65535),
        ({"age_s": math.inf}, 5, 65535),
        ({"sigma_x_m": 7.0}, 12, 65535),
        ({"sigma_y_m": math.inf}, 13, 65535),
        ({"sigma_theta_rad": 3.0}, 14, 65535),
        ({"vx_mps": 40.0}, 15, 32767),
        ({"vy_mps": -40.0}, 16, 0x10000 - 32767),
        ({"omega_radps": 1e9}, 17, 32767),
        ({"quality": 1.5}, 2, 1000),
        ({"quality": -0.5}, 2, 0),
        ({"sequence": 2**32 + 5}, 4, 5),
        ({"heartbeat": 0x10003}, 18, 3),
    ],
)
def test_saturation_keeps_the_state(change: dict[str, float], index: int, value: int) -> None:
    registers = bp.encode_pose(replace(BASIC, **change))  # type: ignore[arg-type]
    assert registers[index] == value
    assert registers[1] == State.TRACKING


@pytest.mark.parametrize("change", [{"x_m": 214748.4}, {"y_m": -1e30}, {"sigma_x_m": math.nan}, {"quality": math.nan}])
def test_a_telegram_that_cannot_be_true_says_lost(change: dict[str, float]) -> None:
    registers = bp.encode_pose(replace(BASIC, **change))  # type: ignore[arg-type]
    assert registers[1:3] == [State.LOST, 0]
    assert registers[12:15] == [65535] * 3


def test_a_position_out_of_range_saturates_with_its_sign() -> None:
    back = bp.decode_pose(bp.encode_pose(replace(BASIC, x_m=-1e9)))
    assert abs(back.x_m + 214748.3647) < 1e-6
    assert abs(back.y_m - BASIC.y_m) < 1e-9


def test_theta_is_wrapped_before_it_is_sent() -> None:
    back = bp.decode_pose(bp.encode_pose(replace(BASIC, theta_rad=0.5 + 6 * math.pi)))
    assert abs(back.theta_rad - 0.5) < 1e-5


@given(
    st.booleans(),
    st.booleans(),
    st.booleans(),
    st.booleans(),
    *[st.integers(-(2**40), 2**40)] * 3,
    st.integers(0, 2**40),
)
def test_status_round_trip_wraps(m: bool, e: bool, f: bool, h: bool, x: int, y: int, th: int, clock: int) -> None:
    registers = bp.encode_status(BaseStatus(m, e, f, h, x, y, th, clock))
    assert registers[1] == m + 2 * e + 4 * f + 8 * h
    back = bp.decode_status(registers)
    assert (back.motors_on, back.e_stop, back.fault, back.heartbeat_lost) == (m, e, f, h)
    for got, sent in ((back.wheel_x_count, x), (back.wheel_y_count, y), (back.wheel_theta_count, th)):
        assert -(2**31) <= got < 2**31
        assert (got - sent) % 2**32 == 0
    assert back.clock_ms == clock % 2**32


def test_high_word_first() -> None:
    registers = bp.encode_status(replace(IDLE, wheel_x_count=0x12345678))
    assert registers[2:4] == [0x1234, 0x5678]


def test_unknown_status_bits_are_ignored() -> None:
    registers = bp.encode_status(replace(IDLE, motors_on=True))
    registers[1] |= 0xFF00
    assert bp.decode_status(registers) == replace(IDLE, motors_on=True)


@pytest.mark.parametrize("version", [0, 2, 0xFFFF])
def test_another_version_is_refused_by_both_sides(version: int) -> None:
    message = f"protocol version {version}, expected 1"
    with pytest.raises(BaseLinkError, match=f"status block: {message}"):
        bp.decode_status(bp.encode_status(replace(IDLE, version=version)))
    with pytest.raises(BaseLinkError, match=f"pose block: {message}"):
        bp.decode_pose(bp.encode_pose(replace(BASIC, version=version)))


def test_unknown_state_and_wrong_length_are_refused() -> None:
    registers = bp.encode_pose(BASIC)
    registers[1] = 7
    with pytest.raises(BaseLinkError, match="state 7"):
        bp.decode_pose(registers)
    with pytest.raises(BaseLinkError, match="18 registers, expected 19"):
        bp.decode_pose(registers[:-1])
    with pytest.raises(BaseLinkError, match="0 registers, expected 10"):
        bp.decode_status([])


def test_the_telegram_before_any_estimate_claims_nothing() -> None:
    registers = bp.encode_pose(bp.no_estimate(heartbeat=9))
    assert registers == [1, State.INIT, 0, 0, 0, 65535, *[0] * 6, *[65535] * 3, 0, 0, 0, 9]


def _estimate(**change: object) -> Estimate:
    values: dict[str, object] = {
        "seq": 5,
        "stamp_ns": 1_000_000_000,
        "pose": np.array([1.0, 2.0, 0.25]),
        "cov": np.diag([0.01**2, 0.02**2, 0.003**2]),
        "odom": np.zeros(3),
        "twist": np.array([0.1, -0.2, 0.3]),
        "state": State.DEGRADED,
        "quality": 0.5,
        "reason": "",
        "motion": Motion(np.zeros(3), np.eye(3), 0, 0.0),
        "health": FilterHealth(0, 0.0, 0, math.nan, 0.0, 0),
        "crossings": 0,
        "landmarks": 0,
    }
    return Estimate(**{**values, **change})  # type: ignore[arg-type]


def test_an_estimate_becomes_a_telegram_with_its_age() -> None:
    t = bp.telegram_of(_estimate(), now_ns=1_042_000_000, heartbeat=3)
    assert (t.state, t.sequence, t.heartbeat, t.quality) == (State.DEGRADED, 5, 3, 0.5)
    got = (t.age_s, t.x_m, t.y_m, t.theta_rad, t.sigma_x_m, t.sigma_y_m, t.sigma_theta_rad)
    assert got == pytest.approx((0.042, 1.0, 2.0, 0.25, 0.01, 0.02, 0.003))
    assert (t.vx_mps, t.vy_mps, t.omega_radps) == (0.1, -0.2, 0.3)


def test_a_stamp_in_the_future_has_age_zero() -> None:
    assert bp.telegram_of(_estimate(), now_ns=0, heartbeat=0).age_s == 0.0


@pytest.mark.parametrize(
    "change",
    [
        {"pose": np.array([math.nan, 0.0, 0.0])},
        {"pose": np.array([0.0, math.inf, 0.0])},
        {"twist": np.array([0.0, 0.0, math.nan])},
        {"cov": np.diag([-1.0, 1.0, 1.0])},
        {"cov": np.full((3, 3), math.nan)},
    ],
)
def test_a_broken_estimate_is_sent_as_lost(change: dict[str, object]) -> None:
    registers = bp.encode_pose(bp.telegram_of(_estimate(**change), now_ns=1_000_000_000, heartbeat=0))
    assert registers[1:3] == [State.LOST, 0]


def test_the_block_is_packed_without_padding() -> None:
    raw = struct.pack(">19H", *bp.encode_pose(BASIC))
    assert struct.unpack(">i", raw[12:16])[0] == 10_000
    assert struct.unpack(">i", raw[20:24])[0] == 50_000
