"""What the daemon and the base controller tell each other, in SI units; drivers.base makes registers of it."""

from __future__ import annotations

from dataclasses import dataclass

from ceilvo.types import State

PROTOCOL_VERSION = 1
"""Of docs/base-protocol.md, what every base speaks; a field that changes its meaning makes a new one."""
WITH_MOTION = 2
"""Version with gyro, accelerations and poses that are moved on to the moment of sending; base.protocol."""


@dataclass(frozen=True, slots=True)
class PoseTelegram:
    """What the base is told. Pose is map_from_base, sigmas are along the map's axes, twist is in base.

    Attributes:
        state, quality: how far the pose can be trusted; quality in 0..1.
        sequence: of the camera frame, modulo 2^32.
        age_s: from the frame's stamp to the sending of this telegram.
        heartbeat: changes with every telegram, modulo 2^16.
        version: protocol version.
        predicted_s: part of the age over which the pose was moved on; version 2.
    """

    state: State
    quality: float
    sequence: int
    age_s: float
    x_m: float
    y_m: float
    theta_rad: float
    sigma_x_m: float
    sigma_y_m: float
    sigma_theta_rad: float
    vx_mps: float
    vy_mps: float
    omega_radps: float
    heartbeat: int
    version: int = PROTOCOL_VERSION
    predicted_s: float = 0.0


@dataclass(frozen=True, slots=True)
class BaseStatus:
    """What the base reports.

    Attributes:
        motors_on, e_stop, fault: as they are now.
        heartbeat_lost: the base has stopped itself because the heartbeat stood still.
        wheel_x_count, wheel_y_count: cumulative wheel odometry, int32 in 0.1 mm, wraps around.
        wheel_theta_count: cumulative heading, int32 in 10 urad, wraps around (modulo 2 pi is accepted too).
        clock_ms: time since the base started, uint32, wraps around.
        version: protocol version.
        gyro_count: integral of the yaw rate, int32 in 1 urad, wraps around; None without a gyro. Version 2, as below.
        gained_x_count, gained_y_count: integrals of the accelerations along base x and y, int32 in 0.1 mm/s, wrap
            around; None without accelerometers.
    """

    motors_on: bool
    e_stop: bool
    fault: bool
    heartbeat_lost: bool
    wheel_x_count: int
    wheel_y_count: int
    wheel_theta_count: int
    clock_ms: int
    version: int = PROTOCOL_VERSION
    gyro_count: int | None = None
    gained_x_count: int | None = None
    gained_y_count: int | None = None
