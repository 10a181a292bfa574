"""A bus on a port of its own, with a robot that remembers what it was asked."""

from __future__ import annotations

from collections.abc import Iterator

import pytest
from zenoh_world import FakeClock, Robot, World, bus_config, free_port

from ceilvo.drivers.bus.zenoh_bus import ZenohBus


@pytest.fixture
def world() -> Iterator[World]:
    port, robot, clock = free_port(), Robot(), FakeClock()
    bus = ZenohBus(bus_config(port), "robot1", robot.handlers(), clock=clock)
    bus.open()
    w = World(port, robot, clock, bus)
    yield w
    bus.close()
    for s in w.sessions:
        s.close()
