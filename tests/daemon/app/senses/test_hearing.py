"""Gyros where a robot has them: in the base's registers, or on Zenoh."""

from __future__ import annotations

import json
import time
from dataclasses import replace

import numpy as np
import pytest
from link_parts import estimate
from patience import until
from subscriber import free_port
from zenoh_world import Robot, bus_config, peer

from ceilvo.config import Config
from ceilvo.daemon.app.senses.hearing import Hearing
from ceilvo.drivers.base.mock_base import BaseModel, MockBase
from ceilvo.drivers.bus.zenoh_bus import ZenohBus
from ceilvo.senses.heard import NOTHING


def no_crash(error: BaseException) -> None:
    raise error


def configured(gyro: str, **base: object) -> Config:
    c = Config()
    return replace(c, senses=replace(c.senses, gyro=gyro), base=replace(c.base, port="mock", rate_hz=200.0, **base))


def test_without_other_senses_there_is_nothing_to_hear() -> None:
    hearing = Hearing(configured("none", enabled=False), MockBase, time.monotonic_ns, no_crash)
    assert hearing.base is None
    assert hearing.between(0, 10**9) is NOTHING
    assert hearing.wheels(0, 10**9) is None
    assert hearing.keys == ()


def test_the_bases_gyro_is_heard_between_two_moments() -> None:
    model = BaseModel(version=2, gyro=lambda t_s: 0.5 * t_s)
    hearing = Hearing(configured("base", protocol=2), lambda: MockBase(model), time.monotonic_ns, no_crash)
    assert hearing.base is not None
    hearing.base.start()
    try:
        assert model.wait_received(40)
        now_ns = time.monotonic_ns()
        turn = hearing.between(now_ns - 100_000_000, now_ns - 40_000_000).turn
        assert turn is not None
        assert turn.turned_rad == pytest.approx(0.5 * 0.06, rel=0.1)
        last = estimate(1, now_ns - 50_000_000)
        there, ahead_ms = hearing.ahead(last, 20.0)
        assert ahead_ms >= 70.0
        assert np.hypot(*(there.pose - last.pose)[:2]) < 1e-3, "its wheels stand, whatever the twist was"
    finally:
        hearing.base.stop()


def test_a_gyro_on_zenoh_is_welcome_on_the_robots_keys() -> None:
    port = free_port()
    hearing = Hearing(configured("topic", enabled=False), MockBase, time.monotonic_ns, no_crash)
    bus = ZenohBus(bus_config(port), "robot1", Robot().handlers(), speakers=[hearing.declare], welcome=hearing.keys)
    bus.open()
    session = peer(connect=port)
    try:

        def speaks() -> bool:
            session.put("ceilvo/robot1/imu", json.dumps({"yaw_rate_radps": 0.25}).encode())
            return hearing.counters()["imu_samples"] >= 20

        until(speaks, "samples are taken")
        now_ns = time.monotonic_ns()
        turn = hearing.between(now_ns - 30_000_000, now_ns).turn
        assert turn is not None
        assert turn.turned_rad == pytest.approx(0.25 * 0.03, rel=0.01)
        assert bus.counters()["foreign_samples"] == 0
    finally:
        session.close()
        bus.close()
