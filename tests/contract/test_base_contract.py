"""What every base driver must do: the mock, and pymodbus on a real pty against the simulated base, both FC variants."""

from __future__ import annotations

import logging
import math
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Protocol

import pytest

from ceilvo import config
from ceilvo.drivers.base.late import late_modbus
from ceilvo.drivers.base.mock_base import BaseModel, MockBase
from ceilvo.drivers.base.protocol import decode_pose, encode_pose
from ceilvo.drivers.base.wheel_track import WheelTrack
from ceilvo.drivers.ports import Base
from ceilvo.drivers.telegrams import BaseStatus, PoseTelegram
from ceilvo.errors import BaseLinkError
from ceilvo.sim.base import SimBase
from ceilvo.types import State

TIMEOUT_S = 0.25
TELEGRAM = PoseTelegram(State.TRACKING, 0.9, 1, 0.02, 1.0, -2.0, 0.5, 0.01, 0.02, 0.003, 0.3, 0.0, -0.1, heartbeat=1)


class FakeClock:
    def __init__(self) -> None:
        self.now_ns = 7_000_000_000

    def __call__(self) -> int:
        return self.now_ns

    def advance(self, s: float) -> None:
        self.now_ns += round(1e9 * s)


def odometry(t_s: float) -> tuple[float, float, float]:
    return 0.5 * t_s, -0.25 * t_s, 0.125 * t_s


class Rig(Protocol):
    base: Base
    model: BaseModel
    clock: FakeClock

    def unplug(self) -> None: ...

    def plug(self) -> None: ...

    def end(self) -> None: ...


class MockRig:
    def __init__(self) -> None:
        self.clock = FakeClock()
        self.model = BaseModel(self.clock, odometry)
        self.mock = MockBase(self.model, timeout_s=0.01, port="mock0")
        self.base: Base = self.mock

    def unplug(self) -> None:
        self.mock.present = False

    def plug(self) -> None:
        self.mock.present = True

    def end(self) -> None:
        self.base.close()


class PtyRig:
    def __init__(self, link: Path, function: str) -> None:
        self.clock = FakeClock()
        self.sim = SimBase(baud=1_000_000, turnaround_s=0.0, odometry=odometry, clock=self.clock, port_link=link)
        self.sim.start()
        self.model = self.sim.model
        settings = config.Base(port=str(link), baud=1_000_000, function=function, timeout_s=TIMEOUT_S)
        self.base: Base = late_modbus(settings)

    def unplug(self) -> None:
        self.sim.stop()

    def plug(self) -> None:
        self.sim.start()

    def end(self) -> None:
        self.base.close()
        self.sim.stop()


@pytest.fixture(params=["mock", "fc23", "fc16_fc04"])
def rig(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Rig]:
    rig: Rig = MockRig() if request.param == "mock" else PtyRig(tmp_path / "tty-base", request.param)
    rig.base.open()
    yield rig
    rig.end()


def exchange(rig: Rig, heartbeat: int = 1) -> BaseStatus:
    return rig.base.exchange(replace(TELEGRAM, heartbeat=heartbeat, sequence=heartbeat))


def test_the_pose_arrives_and_the_status_comes_back(rig: Rig) -> None:
    status = exchange(rig)
    (received,) = rig.model.telegrams
    assert received.telegram == decode_pose(encode_pose(TELEGRAM))
    assert received.recv_ns == rig.clock.now_ns
    assert (status.motors_on, status.e_stop, status.fault, status.heartbeat_lost) == (True, False, False, False)
    assert (status.wheel_x_count, status.wheel_y_count, status.wheel_theta_count) == (35_000, -17_500, 87_500)
    assert status.clock_ms == 0


def test_many_telegrams_arrive_in_order_each_once(rig: Rig) -> None:
    for i in range(30):
        exchange(rig, i)
    assert [r.telegram.sequence for r in rig.model.telegrams] == list(range(30))


def test_flags_are_passed_on(rig: Rig) -> None:
    rig.model.e_stop = True
    status = exchange(rig)
    assert (status.motors_on, status.e_stop, status.fault) == (False, True, False)
    rig.model.e_stop, rig.model.fault = False, True
    status = exchange(rig, 2)
    assert (status.motors_on, status.e_stop, status.fault) == (False, False, True)


def test_not_open(rig: Rig) -> None:
    rig.base.close()
    rig.base.close()
    assert not rig.base.is_open
    with pytest.raises(BaseLinkError, match="not open"):
        exchange(rig)
    rig.base.open()
    assert rig.base.is_open
    exchange(rig)


@pytest.mark.parametrize("fault", ["silent", "garbage", "bad_crc"])
def test_a_bad_answer_is_an_error_and_then_over(rig: Rig, fault: str) -> None:
    exchange(rig)
    setattr(rig.model.faults, fault, True)
    for i in range(2):
        with pytest.raises(BaseLinkError, match="base at ") as e:
            exchange(rig, 2 + i)
        assert "\n" not in str(e.value)
    assert rig.base.is_open
    setattr(rig.model.faults, fault, False)
    assert exchange(rig, 10).motors_on
    assert rig.model.telegrams[-1].telegram.sequence == 10


def test_an_answer_after_the_timeout_is_an_error_and_then_over(rig: Rig) -> None:
    rig.model.faults.slow_s = 1.2 * TIMEOUT_S
    with pytest.raises(BaseLinkError, match="base at "):
        exchange(rig)
    rig.model.faults.slow_s = 0.0
    for i in range(3):
        assert exchange(rig, 100 + i).motors_on
        assert rig.model.telegrams[-1].telegram.sequence == 100 + i, "a late answer was taken for this telegram's"


def test_another_protocol_version_names_both(rig: Rig) -> None:
    rig.model.faults.wrong_version = True
    with pytest.raises(BaseLinkError, match=r"base at .*version 2, expected 1"):
        exchange(rig)


def test_an_exception_response_is_named(rig: Rig) -> None:
    rig.model.faults.exception_code = 4
    with pytest.raises(BaseLinkError, match="exception 4"):
        exchange(rig)
    rig.model.faults.exception_code = 0
    exchange(rig, 2)


def test_unplugged_and_plugged_in_again(rig: Rig) -> None:
    exchange(rig)
    rig.unplug()
    with pytest.raises(BaseLinkError, match=r"base port .*lost"):
        exchange(rig, 2)
    assert not rig.base.is_open
    with pytest.raises(BaseLinkError, match=r"base port .*cannot be opened"):
        rig.base.open()
    rig.plug()
    rig.base.open()
    assert exchange(rig, 3).motors_on
    assert rig.model.telegrams[-1].telegram.sequence == 3


def test_a_standing_heartbeat_stops_the_motors_until_it_moves(rig: Rig) -> None:
    assert exchange(rig, 1).motors_on
    rig.clock.advance(0.3)
    assert exchange(rig, 1).motors_on
    rig.clock.advance(0.3)
    assert not rig.model.motors_on
    status = exchange(rig, 1)
    assert (status.motors_on, status.heartbeat_lost) == (False, True)
    status = exchange(rig, 2)
    assert (status.motors_on, status.heartbeat_lost) == (True, False)


def test_stopped_stops_the_motors_at_once(rig: Rig) -> None:
    assert exchange(rig, 1).motors_on
    status = rig.base.exchange(replace(TELEGRAM, state=State.STOPPED, heartbeat=2))
    assert (status.motors_on, status.heartbeat_lost) == (False, False)


def test_a_reboot_shows_in_clock_and_odometry(rig: Rig) -> None:
    track = WheelTrack()
    stamps = []
    for i in range(6):
        if i == 3:
            rig.model.reboot()
        rig.clock.advance(0.05)
        stamps.append(rig.clock.now_ns)
        track.add(exchange(rig, i), rig.clock.now_ns)
    assert track.restarts == 1
    assert track.between(stamps[1], stamps[4]) is None
    motion = track.between(stamps[3], stamps[5])
    assert motion is not None
    assert math.hypot(*motion.prev_from_curr[:2]) == pytest.approx(0.1 * math.hypot(0.5, 0.25), abs=2e-4)


def test_failures_are_raised_not_logged(rig: Rig, caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.DEBUG)
    rig.model.faults.garbage = True
    with pytest.raises(BaseLinkError):
        exchange(rig)
    assert caplog.records == []
