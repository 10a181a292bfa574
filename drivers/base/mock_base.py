"""A base controller in memory: what a base does with the telegrams, and a fake driver with faults to switch on."""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np

from ceilvo import se2
from ceilvo.drivers.base.protocol import (
    ANGLE_UNIT_RAD,
    GYRO_UNIT_RAD,
    LENGTH_UNIT_M,
    decode_pose,
    decode_status,
    encode_pose,
    encode_status,
)
from ceilvo.drivers.ports import Clock
from ceilvo.drivers.telegrams import PROTOCOL_VERSION, BaseStatus, PoseTelegram
from ceilvo.errors import BaseLinkError
from ceilvo.types import State

Odometry = Callable[[float], Sequence[float]]
"""Seconds of the base's host clock -> cumulative wheel odometry (x m, y m, theta rad)."""


def standing_still(_t_s: float) -> tuple[float, float, float]:
    """Odometry of a base that does not move."""
    return 0.0, 0.0, 0.0


@dataclass
class BaseFaults:
    """Switches, all off. A garbled answer means that the telegram did arrive; a silent base hears nothing."""

    silent: bool = False
    garbage: bool = False
    bad_crc: bool = False
    wrong_version: bool = False
    slow_s: float = 0.0
    exception_code: int = 0


@dataclass(frozen=True, slots=True)
class ReceivedTelegram:
    """A pose telegram with the time of its arrival (monotonic and wall clock, ns) at the base."""

    recv_ns: int
    recv_unix_ns: int
    telegram: PoseTelegram


@dataclass
class BaseModel:
    """The behaviour of an AIM-style base, whatever carries its registers.

    The motors run while the heartbeat keeps changing and the state is not STOPPED. They stop, with HEARTBEAT_LOST set,
    when the heartbeat has stood still for heartbeat_timeout_s.

    Attributes:
        version: that it speaks.
        gyro: integral of its yaw rate, rad, at seconds of the clock; None without one.
    """

    clock: Clock = time.monotonic_ns
    odometry: Odometry = standing_still
    heartbeat_timeout_s: float = 0.5
    keep: int = 4096
    on_telegram: Callable[[ReceivedTelegram], None] | None = None
    e_stop: bool = False
    fault: bool = False
    version: int = PROTOCOL_VERSION
    gyro: Callable[[float], float] | None = None
    faults: BaseFaults = field(default_factory=BaseFaults)

    def __post_init__(self) -> None:
        self.telegrams: deque[ReceivedTelegram] = deque(maxlen=self.keep)
        self._arrived = threading.Condition()
        self._count = 0
        self._boot_ns = self.clock()
        self._boot_odometry = np.zeros(3)
        self._heartbeat: int | None = None
        self._heartbeat_ns = 0
        self._state = State.INIT

    @property
    def received(self) -> int:
        """Telegrams since construction."""
        return self._count

    @property
    def heartbeat_lost(self) -> bool:
        """No heartbeat yet, or it has stood still for the timeout."""
        return self._heartbeat is None or 1e-9 * (self.clock() - self._heartbeat_ns) >= self.heartbeat_timeout_s

    @property
    def motors_on(self) -> bool:
        return not (self.heartbeat_lost or self.e_stop or self.fault or self._state is State.STOPPED)

    def write_pose(self, registers: Sequence[int]) -> None:
        """A pose block arrives. Raises BaseLinkError when it is not understood; it is then not used."""
        telegram = decode_pose(registers, self.version)
        now_ns = self.clock()
        if telegram.heartbeat != self._heartbeat:
            self._heartbeat, self._heartbeat_ns = telegram.heartbeat, now_ns
        self._state = telegram.state
        received = ReceivedTelegram(now_ns, time.time_ns(), telegram)
        if self.on_telegram is not None:
            self.on_telegram(received)
        with self._arrived:
            self.telegrams.append(received)
            self._count += 1
            self._arrived.notify_all()

    def read_status(self) -> list[int]:
        """The status block now."""
        now_ns = self.clock()
        # seen from where it stood when it booted: x, y and heading begin at zero together
        x, y, theta = se2.between(self._boot_odometry, np.array(self.odometry(1e-9 * now_ns), np.float64))
        return encode_status(
            BaseStatus(
                motors_on=self.motors_on,
                e_stop=self.e_stop,
                fault=self.fault,
                heartbeat_lost=self.heartbeat_lost,
                wheel_x_count=round(float(x) / LENGTH_UNIT_M),
                wheel_y_count=round(float(y) / LENGTH_UNIT_M),
                wheel_theta_count=round(float(theta) / ANGLE_UNIT_RAD),
                clock_ms=(now_ns - self._boot_ns) // 1_000_000,
                version=self.version + self.faults.wrong_version,
                gyro_count=None if self.gyro is None else round(self.gyro(1e-9 * now_ns) / GYRO_UNIT_RAD),
            )
        )

    def reboot(self) -> None:
        """Clock and odometry begin at zero, the heartbeat is forgotten."""
        self._boot_ns = self.clock()
        self._boot_odometry = np.array(self.odometry(1e-9 * self._boot_ns), np.float64)
        self._heartbeat, self._state = None, State.INIT

    def wait_received(self, count: int, timeout_s: float = 5.0) -> bool:
        """Block until `count` telegrams have arrived since construction; False on timeout."""
        with self._arrived:
            return self._arrived.wait_for(lambda: self._count >= count, timeout_s)


class MockBase:
    """drivers.ports.Base without a wire.

    Attributes:
        model: the base behind it, with its faults.
        present: False is an unplugged adapter.
        gate: cleared, it holds every exchange (at most 5 s), to test what happens meanwhile.
    """

    def __init__(self, model: BaseModel | None = None, timeout_s: float = 0.1, port: str = "mock") -> None:
        self.model = model or BaseModel()
        self.present = True
        self.gate = threading.Event()
        self.gate.set()
        self._timeout_s = timeout_s
        self._port = port
        self._open = False
        self._never = threading.Event()

    @property
    def is_open(self) -> bool:
        return self._open

    def open(self) -> None:
        if not self.present:
            raise BaseLinkError(f"base port {self._port}: cannot be opened: no such device; plug it in")
        self._open = True

    def exchange(self, telegram: PoseTelegram) -> BaseStatus:
        if not self._open:
            raise BaseLinkError(f"base port {self._port}: is not open; open it before exchanging telegrams")
        self.gate.wait(5.0)
        if not self.present:
            self._open = False
            raise BaseLinkError(f"base port {self._port}: lost; plug it in")
        faults = self.model.faults
        self._never.wait(min(faults.slow_s, self._timeout_s))
        if faults.silent:
            raise BaseLinkError(f"base at {self._port}: no answer within {self._timeout_s} s; check its power")
        if faults.exception_code:
            raise BaseLinkError(f"base at {self._port}: exception {faults.exception_code}; see its manual")
        self.model.write_pose(encode_pose(telegram))
        if faults.garbage or faults.bad_crc or faults.slow_s >= self._timeout_s:
            raise BaseLinkError(f"base at {self._port}: no Modbus answer within {self._timeout_s} s; check the line")
        try:
            return decode_status(self.model.read_status(), self.model.version)
        except BaseLinkError as e:
            raise BaseLinkError(f"base at {self._port}: {e}") from e

    def close(self) -> None:
        self._open = False
