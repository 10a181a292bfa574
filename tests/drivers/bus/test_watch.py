"""`ceilvod watch` as a function: what a robot publishes becomes lines."""

from __future__ import annotations

import io
import json
import math
import queue
import socket
import threading
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from types import MappingProxyType

import numpy as np
import pytest
from patience import PATIENCE_S, until

from ceilvo import config
from ceilvo.calibration import Calibration
from ceilvo.drivers.bus import messages
from ceilvo.drivers.bus import watch as watch_module
from ceilvo.drivers.bus.requests import Handlers, Result
from ceilvo.drivers.bus.watch import WatchOptions, pose_line, watch
from ceilvo.drivers.bus.zenoh_bus import ZenohBus
from ceilvo.drivers.ports import Topic
from ceilvo.errors import BusError
from ceilvo.types import Estimate, FilterHealth, Landmarks, Motion, State

STAMP = messages.Stamp(1, 2)


class Lines(io.TextIOBase):
    """A stream whose lines a test can wait for; `broken` makes it a pipe without a reader."""

    def __init__(self) -> None:
        self.lines: queue.Queue[str] = queue.Queue()
        self.broken = False

    def write(self, text: str) -> int:
        if self.broken:
            raise BrokenPipeError
        self.lines.put(text.removesuffix("\n"))
        return len(text)

    def next(self) -> str:
        return self.lines.get(timeout=PATIENCE_S)


def nothing_asked(*_request: object) -> Result:
    raise AssertionError("a watcher asks for nothing")


def no_landmarks() -> Landmarks:
    raise AssertionError("a watcher asks for nothing")


def no_calibration() -> Calibration:
    raise AssertionError("a watcher asks for nothing")


HANDLERS = Handlers(
    no_landmarks, no_calibration, config.Config, nothing_asked, nothing_asked, nothing_asked, nothing_asked
)


def pose(seq: int, state: State = State.TRACKING, *, robot: str = "robot1", reason: str = "") -> bytes:
    e = Estimate(
        seq, 0, np.array([1.25, -0.5, math.pi / 2]), np.diag([9e-4, 16e-4, math.radians(0.5) ** 2]), np.zeros(3),
        np.zeros(3), state, 0.9, reason, Motion(np.zeros(3), np.zeros((3, 3)), 9, 0.001),
        FilterHealth(100, 50.0, 9, 0.1, 1.0, 8), 20, 30, MappingProxyType({}),
    )  # fmt: skip
    return messages.encode_pose(robot, e, 0, sent_ns=12_500_000)


@dataclass
class Scene:
    config: config.Zenoh
    bus: ZenohBus
    out: Lines
    stop: threading.Event

    def start(self, robot: str, options: WatchOptions, clock: Callable[[], float] = lambda: 0.0) -> Callable[[], int]:
        """Run watch in a thread; returns what waits for its result."""
        result: list[int | BaseException] = []

        def run() -> None:
            try:
                result.append(watch(self.config, robot, self.out, self.stop, options, clock=clock))
            except BaseException as e:
                result.append(e)

        thread = threading.Thread(target=run)
        thread.start()

        def join() -> int:
            thread.join(PATIENCE_S)
            assert not thread.is_alive()
            assert isinstance(result[0], int), result[0]
            return result[0]

        topics = (Topic.POSE, Topic.HEALTH, Topic.EVENT)
        until(lambda: all(self.bus.wanted(t) for t in topics), "the watcher subscribes")
        return join


@pytest.fixture
def scene() -> Iterator[Scene]:
    with socket.socket() as s:
        s.bind(("127.0.0.1", 0))
        port = s.getsockname()[1]
    cfg = replace(config.Zenoh(), listen=(f"tcp/127.0.0.1:{port}",), multicast=False)
    bus = ZenohBus(cfg, "robot1", HANDLERS)
    bus.open()
    made = Scene(cfg, bus, Lines(), threading.Event())
    yield made
    made.stop.set()
    bus.close()


def test_a_pose_line_by_hand() -> None:
    line = pose_line(messages.decode_pose(pose(7, reason="few lamps")))
    assert line == (
        "robot1       7 TRACKING       x   +1.250 y   -0.500 m   +90.00 deg  "
        "sigma   50.0 mm  0.50 deg  q 0.90   12.5 ms  few lamps"
    )


def test_appears_poses_count(scene: Scene) -> None:
    join = scene.start("robot1", WatchOptions(count=3, rate_hz=1e9), clock=iter(np.arange(1e3)).__next__)
    assert scene.out.next() == "robot1 appeared"
    for seq in range(1, 6):
        scene.bus.put(Topic.POSE, pose(seq))
    assert join() == 3
    assert [scene.out.next().split()[1] for _ in range(3)] == ["1", "2", "3"]
    assert scene.out.lines.empty()


def test_the_rate_is_limited_but_a_change_of_state_is_always_told(scene: Scene) -> None:
    now = [0.0]
    join = scene.start("robot1", WatchOptions(count=4, rate_hz=10.0), clock=lambda: now[0])
    assert scene.out.next() == "robot1 appeared"
    for seq in range(1, 5):
        scene.bus.put(Topic.POSE, pose(seq))
    scene.bus.put(Topic.POSE, pose(5, State.LOST))
    assert [scene.out.next().split()[1:3] for _ in range(2)] == [["1", "TRACKING"], ["5", "LOST"]]
    now[0] = 0.11
    scene.bus.put(Topic.POSE, pose(6, State.LOST))
    assert scene.out.next().split()[1] == "6"
    scene.bus.put(Topic.POSE, pose(7, State.TRACKING))
    assert scene.out.next().split()[1] == "7"
    assert join() == 4


def test_events_health_and_messages_that_are_not_ours(scene: Scene) -> None:
    join = scene.start("*", WatchOptions())
    assert scene.out.next() == "robot1 appeared"
    scene.bus.put(Topic.EVENT, messages.encode_event("robot1", STAMP, "state", "warning", "a\x1b[2J -> \nb"))
    assert scene.out.next() == "robot1 warning: state: a?[2J -> ?b"
    for _ in range(2):
        scene.bus.put(
            Topic.HEALTH, messages.encode_health("robot1", STAMP, 3.5, State.TRACKING, {"frames": 9, "ok": 1})
        )
    assert scene.out.next() == "robot1 health: up 3.5 s frames=9 ok=1"
    scene.bus.put(Topic.POSE, b"\xff")
    assert scene.out.next().startswith("robot1 pose message: payload is not JSON")
    scene.bus.put(Topic.POSE, messages.encode_reply("robot1", "x", {}))
    assert scene.out.next().startswith("robot1 pose message: schema is 'ceilvo.reply.1', expected 'ceilvo.pose.1'")
    scene.bus.close()
    assert scene.out.next() == "robot1 disappeared"
    scene.stop.set()
    assert join() == 0


def test_raw_lines_are_the_messages_all_of_them(scene: Scene) -> None:
    join = scene.start("robot1", WatchOptions(raw=True, count=20))
    assert json.loads(scene.out.next()) == {"robot": "robot1", "liveliness": "appeared"}
    health = messages.encode_health("robot1", STAMP, 3.5, State.TRACKING, {"frames": 9})
    scene.bus.put(Topic.HEALTH, health)
    assert scene.out.next() == health.decode()
    sent = [pose(seq) for seq in range(20)]
    for payload in sent:
        scene.bus.put(Topic.POSE, payload)
    assert [scene.out.next() for _ in sent] == [p.decode() for p in sent]
    assert join() == 20


def test_a_robot_that_comes_later_is_announced(scene: Scene) -> None:
    join = scene.start("*", WatchOptions())
    assert scene.out.next() == "robot1 appeared"
    other = ZenohBus(replace(scene.config, connect=scene.config.listen, listen=()), "robot2", HANDLERS)
    other.open()
    assert scene.out.next() == "robot2 appeared"
    other.close()
    assert scene.out.next() == "robot2 disappeared"
    scene.stop.set()
    assert join() == 0


def test_a_reader_that_leaves_ends_it_quietly(scene: Scene) -> None:
    join = scene.start("robot1", WatchOptions())
    assert scene.out.next() == "robot1 appeared"
    scene.out.broken = True
    scene.bus.put(Topic.POSE, pose(1))
    assert join() == 0


def test_a_watcher_may_come_before_the_robot() -> None:
    with socket.socket() as s:
        s.bind(("127.0.0.1", 0))
        port = s.getsockname()[1]
    cfg = replace(config.Zenoh(), listen=(f"tcp/127.0.0.1:{port}",), multicast=False)
    out, stop, ready = Lines(), threading.Event(), threading.Event()
    thread = threading.Thread(target=watch, args=(cfg, "*", out, stop), kwargs={"on_ready": ready.set})
    thread.start()
    assert ready.wait(PATIENCE_S)
    bus = ZenohBus(cfg, "robot1", HANDLERS)
    bus.open()
    assert out.next() == "robot1 appeared"
    stop.set()
    thread.join(PATIENCE_S)
    bus.close()
    assert not thread.is_alive()


def test_a_robot_that_cannot_be() -> None:
    with pytest.raises(BusError, match=r"robot\.name: found 'a/b'"):
        watch(config.Zenoh(), "a/b", io.StringIO(), threading.Event())


def test_lines_for_people_have_120_characters_at_most(scene: Scene) -> None:
    join = scene.start("robot1", WatchOptions(count=1), clock=iter(np.arange(1e3)).__next__)
    assert scene.out.next() == "robot1 appeared"
    scene.bus.put(Topic.POSE, pose(7, reason="a reason that goes on " * 12))
    assert join() == 1
    lines = scene.out.next().split("\n")
    assert len(lines) >= 3 and all(len(line) <= 120 for line in lines)
    assert all(line.startswith("    ") for line in lines[1:]) and " ".join(lines).count("goes on") == 12


def test_a_robot_that_is_not_there_is_said_so_once(
    scene: Scene, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(watch_module, "_SILENCE_S", 0.4)

    def said() -> list[str]:
        return [r.getMessage() for r in caplog.records if "nothing heard" in r.getMessage()]

    thread = threading.Thread(target=watch, args=(scene.config, "robot9", scene.out, scene.stop, WatchOptions()))
    thread.start()
    until(lambda: bool(said()), "it is said")
    scene.stop.set()
    thread.join(PATIENCE_S)
    assert said() == ["nothing heard from robot 'robot9' for 0.4 s; there are robot1; waiting"]


def test_a_robot_that_is_there_is_not_called_silent(
    scene: Scene, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It says nothing but that it is there, for many times as long."""
    monkeypatch.setattr(watch_module, "_SILENCE_S", 0.1)
    monkeypatch.setattr(watch_module, "_POLL_S", 0.1)
    join = scene.start("robot1", WatchOptions(count=1), clock=iter(np.arange(1e3)).__next__)
    assert scene.out.next() == "robot1 appeared"
    caplog.clear()
    threading.Event().wait(0.5)
    scene.bus.put(Topic.POSE, pose(1))
    assert join() == 1
    assert not [r for r in caplog.records if "nothing heard" in r.getMessage()]
