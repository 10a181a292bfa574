"""What every bus must do, run on the mock and on Zenoh."""

from __future__ import annotations

import json
import queue
import socket
import threading
from collections.abc import Callable, Iterator
from dataclasses import replace

import numpy as np
import pytest
import zenoh
from patience import PATIENCE_S, until

from ceilvo import config
from ceilvo.calibration import Calibration
from ceilvo.drivers.bus.mock_bus import MockBus
from ceilvo.drivers.bus.requests import Handlers, Result
from ceilvo.drivers.bus.zenoh_bus import ZenohBus
from ceilvo.drivers.ports import Publisher, Topic
from ceilvo.errors import BusError
from ceilvo.types import Landmarks


def no_landmarks() -> Landmarks:
    none = np.empty(0, np.int64)
    return Landmarks(none, np.empty((0, 2)), np.empty((0, 2, 2)), none, none)


def no_calibration() -> Calibration:
    raise BusError("no calibration")


def handlers(commands: list[object]) -> Handlers:
    def command(request: object) -> Result:
        commands.append(request)
        return {"number": len(commands)}

    return Handlers(no_landmarks, no_calibration, config.Config, command, command, command, command)


class PublisherContract:
    """Subclasses make a bus, and the far end of it."""

    commands: list[object]

    def make(self, robot: str, handlers: Handlers) -> Publisher:
        raise NotImplementedError

    def subscribe(self, bus: Publisher, topic: Topic) -> Callable[[int], list[bytes]]:
        """Returns what waits for so many samples and gives them."""
        raise NotImplementedError

    def ask(self, bus: Publisher, name: str, payload: bytes) -> tuple[bool, bytes]:
        raise NotImplementedError

    @pytest.fixture
    def bus(self) -> Iterator[Publisher]:
        self.commands = []
        bus = self.make("robot1", handlers(self.commands))
        bus.open()
        yield bus
        bus.close()

    def test_samples_arrive_in_order_and_are_counted(self, bus: Publisher) -> None:
        receive = self.subscribe(bus, Topic.POSE)
        for i in range(20):
            bus.put(Topic.POSE, str(i).encode())
        assert receive(20) == [str(i).encode() for i in range(20)]
        counts = bus.counters()
        assert (counts["samples"], counts["samples_pose"], counts["samples_odom"]) == (20, 20, 0)
        assert (counts["unsent"], counts["put_errors"]) == (0, 0)

    def test_put_before_open_and_after_close_is_counted_and_harmless(self) -> None:
        bus = self.make("robot1", handlers([]))
        bus.put(Topic.POSE, b"early")
        bus.open()
        bus.close()
        bus.close()
        bus.put(Topic.POSE, b"late")
        assert not bus.wanted(Topic.POSE)
        assert (bus.counters()["unsent"], bus.counters()["samples"]) == (2, 0)

    def test_offers_are_made_only_for_somebody(self, bus: Publisher) -> None:
        made: list[int] = []

        def make() -> bytes:
            made.append(1)
            return b"{}"

        assert not bus.wanted(Topic.PARTICLES)
        bus.offer(Topic.PARTICLES, make)
        receive = self.subscribe(bus, Topic.PARTICLES)
        assert bus.wanted(Topic.PARTICLES)
        assert made == []
        bus.offer(Topic.PARTICLES, make)
        assert receive(1) == [b"{}"]
        assert made == [1]

    def test_an_offer_of_what_is_not_on_demand_is_a_mistake(self, bus: Publisher) -> None:
        with pytest.raises(ValueError, match="pose is not made on demand"):
            bus.offer(Topic.POSE, lambda: b"")

    def test_requests_and_their_count(self, bus: Publisher) -> None:
        ok, answer = self.ask(bus, "map", b"")
        assert (ok, json.loads(answer)["schema"]) == (True, "ceilvo.map.1")
        ok, answer = self.ask(bus, "calibration", b"")
        assert (ok, json.loads(answer)["error"]) == (False, "no calibration")
        ok, answer = self.ask(bus, "cmd/reset", b"")
        assert (ok, json.loads(answer)["result"]) == (True, {"number": 1})
        ok, answer = self.ask(bus, "cmd/reset", b"[]")
        assert not ok
        assert len(self.commands) == 1
        counts = bus.counters()
        assert (counts["queries"], counts["commands"], counts["request_errors"]) == (1, 1, 2)

    def test_counters_have_the_same_names_everywhere(self, bus: Publisher) -> None:
        assert bus.counters().keys() == MockBus("r", handlers([])).counters().keys()

    def test_a_name_that_cannot_be_a_key_is_refused(self) -> None:
        with pytest.raises(BusError, match=r"robot\.name: found 'a/b'"):
            self.make("a/b", handlers([]))

    def test_threads_may_put_at_once(self, bus: Publisher) -> None:
        threads = [threading.Thread(target=lambda: [bus.put(Topic.EVENT, b"{}") for _ in range(50)]) for _ in range(4)]
        for t in threads:
            t.start()
        for t in threads:
            t.join()
        assert bus.counters()["samples_event"] == 200


class TestMockBus(PublisherContract):
    def make(self, robot: str, handlers: Handlers) -> Publisher:
        return MockBus(robot, handlers)

    def subscribe(self, bus: Publisher, topic: Topic) -> Callable[[int], list[bytes]]:
        assert isinstance(bus, MockBus)
        bus.subscribed.add(topic)
        return lambda count: bus.sent(topic)[:count]

    def ask(self, bus: Publisher, name: str, payload: bytes) -> tuple[bool, bytes]:
        assert isinstance(bus, MockBus)
        answer = bus.ask(name, payload)
        return answer.ok, answer.payload

    def test_a_bus_that_fails_is_counted(self, bus: Publisher) -> None:
        assert isinstance(bus, MockBus)
        bus.fail = True
        bus.put(Topic.POSE, b"{}")
        assert (bus.counters()["put_errors"], bus.counters()["samples"]) == (1, 0)
        assert bus.sent(Topic.POSE) == []


class TestZenohBus(PublisherContract):
    @pytest.fixture(autouse=True)
    def session(self) -> Iterator[None]:
        with socket.socket() as s:
            s.bind(("127.0.0.1", 0))
            self.end = f"tcp/127.0.0.1:{s.getsockname()[1]}"
        self.far: zenoh.Session | None = None
        yield
        if self.far is not None:
            self.far.close()

    def far_end(self) -> zenoh.Session:
        if self.far is None:
            c = zenoh.Config()
            c.insert_json5("connect/endpoints", json.dumps([self.end]))
            c.insert_json5("listen/endpoints", "[]")
            c.insert_json5("scouting/multicast/enabled", "false")
            self.far = zenoh.open(c)
        return self.far

    def make(self, robot: str, handlers: Handlers) -> Publisher:
        return ZenohBus(replace(config.Zenoh(), listen=(self.end,), multicast=False), robot, handlers)

    def subscribe(self, bus: Publisher, topic: Topic) -> Callable[[int], list[bytes]]:
        inbox: queue.Queue[bytes] = queue.Queue()
        self.far_end().declare_subscriber(f"ceilvo/robot1/{topic.value}", lambda s: inbox.put(s.payload.to_bytes()))
        until(lambda: bus.wanted(topic), "the subscriber is known")
        return lambda count: [inbox.get(timeout=PATIENCE_S) for _ in range(count)]

    def ask(self, bus: Publisher, name: str, payload: bytes) -> tuple[bool, bytes]:
        replies: list[zenoh.Reply] = []

        def answered() -> bool:
            replies.extend(self.far_end().get(f"ceilvo/robot1/{name}", payload=payload, timeout=PATIENCE_S))
            return bool(replies)

        until(answered, f"an answer from {name}")
        return replies[0].ok is not None, (replies[0].ok or replies[0].err).payload.to_bytes()
