"""Pose telegrams and base status as Modbus registers: pure encoding, no I/O. docs/base-protocol.md is the reference.

Both blocks are big-endian, 32-bit values high word first. Every field saturates; NaN and infinity never reach the wire.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Sequence
from dataclasses import replace

from ceilvo import se2
from ceilvo.config.serial_budget import pose_registers, status_registers
from ceilvo.drivers.telegrams import PROTOCOL_VERSION, WITH_MOTION, BaseStatus, PoseTelegram
from ceilvo.errors import BaseLinkError
from ceilvo.types import Estimate, State

POSE_ADDRESS = 1000
"""First holding register of the pose block, zero-based as in the frame."""
STATUS_ADDRESS = 1100
"""First register of the status block, both as input register (FC04) and as holding register (FC23, FC03)."""

LENGTH_UNIT_M = 1e-4
"""Of positions and their sigmas; docs/base-protocol.md, as the three below."""
ANGLE_UNIT_RAD = 1e-5
"""Of the heading and its sigma."""
SPEED_UNIT_MPS = 1e-3
"""Of vx and vy."""
TURN_UNIT_RADPS = 1e-3
"""Of omega."""
GYRO_UNIT_RAD = 1e-6
"""Of the integral of the yaw rate; docs/base-protocol.md, as the one below."""
GAINED_UNIT_MPS = 1e-4
"""Of the integrals of the accelerations."""

UINT16_MAX = 0xFFFF  # registers have 16 bits, docs/base-protocol.md
INT16_MAX = 0x7FFF  # the same, with sign
INT32_MAX = 0x7FFFFFFF
"""Largest values of the registers' types."""

STATUS_MOTORS_ON = 1 << 0  # docs/base-protocol.md, as the three below
STATUS_E_STOP = 1 << 1  # as above
STATUS_FAULT = 1 << 2  # as above
STATUS_HEARTBEAT_LOST = 1 << 3
STATUS_GYRO = 1 << 4  # version 2, as below
STATUS_ACCELERATIONS = 1 << 5
"""Bits of the status word."""

_POSE = struct.Struct(">HHHIHiiiHHHhhhH")
_POSE_2 = struct.Struct(">HHHIHiiiHHHhhhHH")
_STATUS = struct.Struct(">HHiiiI")
_STATUS_2 = struct.Struct(">HHiiiIiii")


def no_estimate(heartbeat: int) -> PoseTelegram:
    """The telegram before the first estimate: state INIT, nothing known, age saturated."""
    inf = math.inf
    return PoseTelegram(State.INIT, 0.0, 0, inf, 0.0, 0.0, 0.0, inf, inf, inf, 0.0, 0.0, 0.0, heartbeat)


def telegram_of(estimate: Estimate, now_ns: int, heartbeat: int) -> PoseTelegram:
    """The estimate as it is at now_ns (same clock as its stamp); nothing is predicted, only the age grows."""
    x, y, theta = (float(v) for v in estimate.pose)
    sx, sy, st = (_sigma(float(estimate.cov[i, i])) for i in range(3))
    vx, vy, omega = (float(v) for v in estimate.twist)
    age_s = max(0.0, 1e-9 * (now_ns - estimate.stamp_ns))
    return PoseTelegram(
        estimate.state, estimate.quality, estimate.seq, age_s, x, y, theta, sx, sy, st, vx, vy, omega, heartbeat
    )


def encode_pose(telegram: PoseTelegram) -> list[int]:
    """The register values of the telegram's version.

    Sigmas and age saturate at 65535 (infinite sigma included), speeds at +-32767. A pose or twist that is not finite,
    a sigma that is NaN, or a position outside int32 is sent as state LOST (unless STOPPED) with quality 0 and all
    sigmas saturated; what is not finite becomes 0.
    """
    t = telegram if _sound(telegram) else _unusable(telegram)
    values = (
        t.version,
        int(t.state),
        _saturated(t.quality, 1e-3, 0, 1000),
        t.sequence & 0xFFFFFFFF,
        _saturated(t.age_s, 1e-3, 0, UINT16_MAX),
        _saturated(t.x_m, LENGTH_UNIT_M, -INT32_MAX, INT32_MAX),
        _saturated(t.y_m, LENGTH_UNIT_M, -INT32_MAX, INT32_MAX),
        _saturated(se2.wrap(t.theta_rad), ANGLE_UNIT_RAD, -INT32_MAX, INT32_MAX),
        _rounded_up(t.sigma_x_m, LENGTH_UNIT_M),
        _rounded_up(t.sigma_y_m, LENGTH_UNIT_M),
        _rounded_up(t.sigma_theta_rad, ANGLE_UNIT_RAD),
        _saturated(t.vx_mps, SPEED_UNIT_MPS, -INT16_MAX, INT16_MAX),
        _saturated(t.vy_mps, SPEED_UNIT_MPS, -INT16_MAX, INT16_MAX),
        _saturated(t.omega_radps, TURN_UNIT_RADPS, -INT16_MAX, INT16_MAX),
        t.heartbeat & 0xFFFF,
    )
    if t.version != WITH_MOTION:
        return _registers(_POSE.pack(*values))
    return _registers(_POSE_2.pack(*values, _saturated(t.predicted_s, 1e-3, 0, UINT16_MAX)))


def decode_pose(registers: Sequence[int], version: int = PROTOCOL_VERSION) -> PoseTelegram:
    """The base's side of encode_pose, of a base that speaks that version.

    Raises:
        BaseLinkError: wrong length, another protocol version or an unknown state.
    """
    _check_version(registers, version, "pose block")
    layout = _POSE_2 if version == WITH_MOTION else _POSE
    fields = layout.unpack(_bytes(registers, pose_registers(version), "pose block"))
    found, state, quality, sequence, age, x, y, theta, sx, sy, st, vx, vy, omega, heartbeat, *more = fields
    if state not in State.__members__.values():
        raise BaseLinkError(f"pose block: state {state} is not one of 0..{max(State)}")
    return PoseTelegram(
        state=State(state),
        quality=1e-3 * quality,
        sequence=sequence,
        age_s=1e-3 * age,
        x_m=LENGTH_UNIT_M * x,
        y_m=LENGTH_UNIT_M * y,
        theta_rad=ANGLE_UNIT_RAD * theta,
        sigma_x_m=LENGTH_UNIT_M * sx,
        sigma_y_m=LENGTH_UNIT_M * sy,
        sigma_theta_rad=ANGLE_UNIT_RAD * st,
        vx_mps=SPEED_UNIT_MPS * vx,
        vy_mps=SPEED_UNIT_MPS * vy,
        omega_radps=TURN_UNIT_RADPS * omega,
        heartbeat=heartbeat,
        version=found,
        predicted_s=1e-3 * sum(more),
    )


def encode_status(status: BaseStatus) -> list[int]:
    """The register values of the status's version; counts and clock wrap around, what is not there is 0."""
    flags = (
        (STATUS_MOTORS_ON, status.motors_on),
        (STATUS_E_STOP, status.e_stop),
        (STATUS_FAULT, status.fault),
        (STATUS_HEARTBEAT_LOST, status.heartbeat_lost),
        (STATUS_GYRO, status.gyro_count is not None),
        (STATUS_ACCELERATIONS, None not in (status.gained_x_count, status.gained_y_count)),
    )
    values = (
        status.version,
        sum(bit for bit, on in flags if on),
        wrap_int32(status.wheel_x_count),
        wrap_int32(status.wheel_y_count),
        wrap_int32(status.wheel_theta_count),
        status.clock_ms & 0xFFFFFFFF,
    )
    if status.version != WITH_MOTION:
        return _registers(_STATUS.pack(*values))
    counts = (status.gyro_count, status.gained_x_count, status.gained_y_count)
    return _registers(_STATUS_2.pack(*values, *(wrap_int32(c or 0) for c in counts)))


def decode_status(registers: Sequence[int], version: int = PROTOCOL_VERSION) -> BaseStatus:
    """What a base of that version says; unknown status bits are ignored.

    Raises:
        BaseLinkError: wrong length or another protocol version.
    """
    _check_version(registers, version, "status block")
    layout = _STATUS_2 if version == WITH_MOTION else _STATUS
    fields = layout.unpack(_bytes(registers, status_registers(version), "status block"))
    found, bits, x, y, theta, clock_ms, *motion = fields
    gyro = motion[0] if motion and bits & STATUS_GYRO else None
    gained = motion[1:] if motion and bits & STATUS_ACCELERATIONS else (None, None)
    return BaseStatus(
        motors_on=bool(bits & STATUS_MOTORS_ON),
        e_stop=bool(bits & STATUS_E_STOP),
        fault=bool(bits & STATUS_FAULT),
        heartbeat_lost=bool(bits & STATUS_HEARTBEAT_LOST),
        wheel_x_count=x,
        wheel_y_count=y,
        wheel_theta_count=theta,
        clock_ms=clock_ms,
        version=found,
        gyro_count=gyro,
        gained_x_count=gained[0],
        gained_y_count=gained[1],
    )


def wrap_int32(count: int) -> int:
    """count modulo 2^32, in [-2^31, 2^31)."""
    return (count + 0x80000000) % 0x100000000 - 0x80000000


def _sound(t: PoseTelegram) -> bool:
    finite = all(map(math.isfinite, (t.x_m, t.y_m, t.theta_rad, t.vx_mps, t.vy_mps, t.omega_radps)))
    known = not any(map(math.isnan, (t.quality, t.age_s, t.sigma_x_m, t.sigma_y_m, t.sigma_theta_rad)))
    return finite and known and max(abs(t.x_m), abs(t.y_m)) <= INT32_MAX * LENGTH_UNIT_M


def _unusable(t: PoseTelegram) -> PoseTelegram:
    return replace(
        t,
        state=t.state if t.state is State.STOPPED else State.LOST,
        quality=0.0,
        age_s=math.inf if math.isnan(t.age_s) else t.age_s,
        x_m=_finite(t.x_m),
        y_m=_finite(t.y_m),
        theta_rad=_finite(t.theta_rad),
        sigma_x_m=math.inf,
        sigma_y_m=math.inf,
        sigma_theta_rad=math.inf,
        vx_mps=_finite(t.vx_mps),
        vy_mps=_finite(t.vy_mps),
        omega_radps=_finite(t.omega_radps),
    )


def _finite(value: float) -> float:
    return value if math.isfinite(value) else 0.0


def _sigma(variance: float) -> float:
    return math.sqrt(variance) if variance >= 0.0 else math.nan


def _saturated(value: float, unit: float, low: int, high: int) -> int:
    return round(min(max(value / unit, low), high))


def _rounded_up(sigma: float, unit: float) -> int:
    """Up, so that a sigma is never understated; the 1e-9 forgives the last bit of the division."""
    return math.ceil(min(max(sigma / unit - 1e-9, 0.0), UINT16_MAX))


def _registers(raw: bytes) -> list[int]:
    return list(struct.unpack(f">{len(raw) // 2}H", raw))


def _bytes(registers: Sequence[int], count: int, what: str) -> bytes:
    if len(registers) != count:
        raise BaseLinkError(f"{what}: {len(registers)} registers, expected {count}; compare with docs/base-protocol.md")
    return struct.pack(f">{count}H", *registers)


def _check_version(registers: Sequence[int], version: int, what: str) -> None:
    if registers and registers[0] != version:
        raise BaseLinkError(
            f"{what}: protocol version {registers[0]}, expected {version};"
            f" set base.protocol, update the base's firmware or ceilvo, or check the register addresses"
        )
