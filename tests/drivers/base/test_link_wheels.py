"""Wheel odometry through the link: collected, dated to when the base sampled it, left alone when told so."""

from __future__ import annotations

import numpy as np
from link_parts import SETTINGS, FakeClock, Watched

from ceilvo import config
from ceilvo.drivers.base.link import BaseLink
from ceilvo.drivers.base.mock_base import BaseModel, MockBase
from ceilvo.drivers.telegrams import BaseStatus, PoseTelegram


def test_wheel_odometry_is_collected(base: Watched, link: BaseLink) -> None:
    link.start()
    assert base.model.wait_received(2)
    assert link.wheels.between(0, 0) is None, "the fake clock stands still: one moment is no track"

    model = BaseModel(odometry=lambda t: (0.5 * t, 0.0, 0.0))
    moving = BaseLink(SETTINGS, MockBase(model))
    moving.start()
    assert model.wait_received(40)
    assert moving.stop()
    stamps = [r.recv_ns for r in model.telegrams]
    motion = moving.wheels.between(stamps[5], stamps[30])
    assert motion is not None
    assert abs(motion.prev_from_curr[0] - 0.5e-9 * (stamps[30] - stamps[5])) < 0.002
    assert np.abs(motion.prev_from_curr[1:]).max() == 0.0


class _Delayed(MockBase):
    """The status is sampled, then takes the time that its bytes need on the line."""

    def __init__(self, clock: FakeClock, delay_s: float, model: BaseModel) -> None:
        super().__init__(model)
        self._delay_ns = round(1e9 * delay_s)
        self._time = clock

    def exchange(self, telegram: PoseTelegram) -> BaseStatus:
        status = super().exchange(telegram)
        self._time.now_ns += self._delay_ns
        return status


def test_wheel_odometry_is_dated_to_when_the_base_sampled_it() -> None:
    clock = FakeClock()
    start_s = 1e-9 * clock.now_ns
    model = BaseModel(clock, lambda t: (0.5 * (t - start_s) ** 2, 0.0, 0.0))
    slow = config.Base(port="mock", baud=1200, rate_hz=200.0)
    link = BaseLink(slow, _Delayed(clock, 25 * 11 / 1200, model), clock=clock)
    link.start()
    assert model.wait_received(12)
    assert link.stop()
    t0_ns, t1_ns = (model.telegrams[i].recv_ns for i in (2, 10))
    motion = link.wheels.between(t0_ns, t1_ns)
    assert motion is not None
    expected_m = 0.5 * ((1e-9 * t1_ns - start_s) ** 2 - (1e-9 * t0_ns - start_s) ** 2)
    assert abs(motion.prev_from_curr[0] - expected_m) < 2e-3


def test_wheels_can_be_left_alone() -> None:
    model = BaseModel()
    link = BaseLink(config.Base(port="mock", rate_hz=200.0, use_wheels=False), MockBase(model))
    link.start()
    assert model.wait_received(20)
    assert link.stop()
    stamps = [r.recv_ns for r in model.telegrams]
    assert link.wheels.between(stamps[5], stamps[10]) is None
