"""ZenohBus against real Zenoh sessions over loopback TCP: explicit ports, no multicast, no sleeping."""

from __future__ import annotations

import functools
import json
import logging
import queue
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import zenoh

from ceilvo import config
from ceilvo.calibration import Calibration, NoiseCurves, mount_rotation, projection_matrix
from ceilvo.camera import CameraModel
from ceilvo.drivers.bus import commands, zenoh_bus
from ceilvo.drivers.bus.requests import Handlers
from ceilvo.drivers.bus.zenoh_bus import ZenohBus
from ceilvo.drivers.bus.zenoh_session import session_config, watcher_config
from ceilvo.drivers.ports import ON_DEMAND, Topic
from ceilvo.errors import BusError, FileFormatError
from ceilvo.types import Landmarks

PATIENCE_S = 20.0
"""Never waited for unless something is broken."""


def free_port() -> int:
    with socket.socket() as s:
        s.bind(("127.0.0.1", 0))
        return int(s.getsockname()[1])


def eventually(true: Callable[[], bool], what: str) -> None:
    """For conditions that only Zenoh knows: polled, not slept for."""
    deadline = time.monotonic() + PATIENCE_S
    pause = threading.Event()
    while not true():
        assert time.monotonic() < deadline, f"not within {PATIENCE_S} s: {what}"
        pause.wait(0.005)


def peer(*, listen: int | None = None, connect: int | None = None, mode: str = "peer") -> zenoh.Session:
    c = zenoh.Config()
    c.insert_json5("mode", json.dumps(mode))
    c.insert_json5("listen/endpoints", json.dumps([f"tcp/127.0.0.1:{listen}"] if listen else []))
    c.insert_json5("connect/endpoints", json.dumps([f"tcp/127.0.0.1:{connect}"] if connect else []))
    c.insert_json5("scouting/multicast/enabled", "false")
    c.insert_json5("open/return_conditions/connect_scouted", "false")
    return zenoh.open(c)


@dataclass
class Robot:
    """Handlers that remember; `refuse` makes every command fail with it."""

    calls: list[commands.Command] = field(default_factory=list)
    refuse: Exception | None = None

    def landmarks(self) -> Landmarks:
        return Landmarks(np.array([1]), np.array([[0.5, 1.5]]), np.eye(2)[None], np.array([4]), np.array([9]))

    def calibration(self) -> Calibration:
        camera = CameraModel("pinhole", 640, 480, 400.0, 400.0, 320.0, 240.0)
        m = projection_matrix(camera, mount_rotation(0.0), (0.25, 0.0), 2.0)
        return Calibration(camera, m, NoiseCurves((0.004,), (0.005,), 0.002, 0.2, 1.5))

    def command(self, request: commands.Command) -> Mapping[str, object]:
        if self.refuse is not None:
            raise self.refuse
        self.calls.append(request)
        return {"done": type(request).__name__}

    def handlers(self) -> Handlers:
        return Handlers(
            self.landmarks, self.calibration, config.Config, self.command, self.command, self.command, self.command
        )


class FakeClock:
    def __init__(self) -> None:
        self.ns = 0

    def __call__(self) -> int:
        return self.ns


@dataclass
class World:
    """A bus on a port, and what is needed to talk to it."""

    port: int
    robot: Robot
    clock: FakeClock
    bus: ZenohBus
    sessions: list[zenoh.Session] = field(default_factory=list)

    def other(self) -> zenoh.Session:
        self.sessions.append(peer(connect=self.port))
        return self.sessions[-1]

    def subscribe(self, session: zenoh.Session, key: str, topic: Topic | None = None) -> queue.Queue[zenoh.Sample]:
        """When `topic` is given, returns only after the bus knows of it."""
        inbox: queue.Queue[zenoh.Sample] = queue.Queue()
        session.declare_subscriber(key, inbox.put)
        if topic is not None:
            eventually(lambda: self.bus.wanted(topic), f"the bus knows of the subscriber of {topic.value}")
        return inbox


def bus_config(port: int, **changes: Any) -> config.Zenoh:
    return replace(config.Zenoh(), listen=(f"tcp/127.0.0.1:{port}",), multicast=False, **changes)


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


def get(session: zenoh.Session, key: str, payload: bytes | None = None) -> list[tuple[bool, dict[str, Any]]]:
    """Replies as (ok, message), after the queryable is known."""
    found: list[zenoh.Reply] = []

    def ask() -> bool:
        found[:] = list(session.get(key, payload=payload, timeout=PATIENCE_S))
        return bool(found)

    eventually(ask, f"an answer from {key}")
    return [(r.ok is not None, json.loads((r.ok or r.err).payload.to_bytes())) for r in found]


def json_sample(i: int) -> bytes:
    return json.dumps({"seq": i, "padding": "x" * 600}).encode()


# samples


@pytest.mark.parametrize("topic", Topic)
def test_a_subscriber_gets_every_sample_in_order(world: World, topic: Topic) -> None:
    inbox = world.subscribe(world.other(), f"ceilvo/robot1/{topic.value}", topic)
    for start in range(0, 100, 20):  # in bursts that a congested link may not drop
        for i in range(start, start + 20):
            world.bus.put(topic, json_sample(i))
        got = [inbox.get(timeout=PATIENCE_S) for _ in range(20)]
        assert [json.loads(s.payload.to_bytes())["seq"] for s in got] == list(range(start, start + 20))
    assert str(got[0].key_expr) == f"ceilvo/robot1/{topic.value}"
    assert str(got[0].encoding) == ("image/jpeg" if topic is Topic.IMAGE else "application/json")
    assert got[0].congestion_control == zenoh.CongestionControl.DROP
    counts = world.bus.counters()
    assert (counts["samples"], counts[f"samples_{topic.value}"], counts["put_errors"]) == (100, 100, 0)


def test_a_late_subscriber_gets_all_that_follows_and_the_others_miss_nothing(world: World) -> None:
    inboxes: list[queue.Queue[zenoh.Sample]] = []
    sent = 0
    for _ in range(3):
        inboxes.append(world.subscribe(world.other(), "ceilvo/*/pose"))

        def arrives(inbox: queue.Queue[zenoh.Sample] = inboxes[-1]) -> bool:
            nonlocal sent
            sent += 1
            world.bus.put(Topic.POSE, str(sent).encode())
            return not inbox.empty()

        eventually(arrives, "the new subscriber gets something")
    for inbox in inboxes:
        got = [int(inbox.get(timeout=PATIENCE_S).payload.to_bytes())]
        while got[-1] < sent:
            got.append(int(inbox.get(timeout=PATIENCE_S).payload.to_bytes()))
        assert got == list(range(got[0], sent + 1))


def test_a_subscriber_that_restarts_is_served_again(world: World) -> None:
    for _ in range(2):
        session = peer(connect=world.port)
        inbox = world.subscribe(session, "ceilvo/robot1/pose", Topic.POSE)
        world.bus.put(Topic.POSE, b"here")
        assert inbox.get(timeout=PATIENCE_S).payload.to_bytes() == b"here"
        session.close()
        eventually(lambda: not world.bus.wanted(Topic.POSE), "the bus knows that the subscriber left")


SUBSCRIBER = """
import sys, zenoh
c = zenoh.Config()
c.insert_json5("connect/endpoints", f'["tcp/127.0.0.1:{sys.argv[1]}"]')
c.insert_json5("listen/endpoints", "[]")
c.insert_json5("scouting/multicast/enabled", "false")
with zenoh.open(c) as session, session.declare_subscriber("ceilvo/robot1/odom") as sub:
    text = ""
    while text != "last":
        text = sub.recv().payload.to_string()
        print(text[:10], flush=True)
"""


@pytest.fixture
def child(world: World) -> Iterator[subprocess.Popen[str]]:
    """A process that subscribes to odom and prints what it gets."""
    command = [sys.executable, "-c", SUBSCRIBER, str(world.port)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        try:
            eventually(lambda: world.bus.wanted(Topic.ODOM), "the other process subscribes")
            yield process
        finally:
            process.kill()


def test_a_subscriber_in_another_process(world: World, child: subprocess.Popen[str]) -> None:
    for i in range(50):
        world.bus.put(Topic.ODOM, str(i).encode())
    world.bus.put(Topic.ODOM, b"last")
    out, _ = child.communicate(timeout=PATIENCE_S)
    assert out.split() == [*map(str, range(50)), "last"]


def test_a_subscriber_that_hangs_holds_up_nobody(world: World, child: subprocess.Popen[str]) -> None:
    inbox = world.subscribe(world.other(), "ceilvo/robot1/odom")

    def arrives() -> bool:
        world.bus.put(Topic.ODOM, b"0")
        return not inbox.empty()

    eventually(arrives, "the healthy one gets something")
    child.send_signal(signal.SIGSTOP)
    big = b"x" * 30_000
    rounds = 400  # 24 MB, more than the sockets hold for the one that hangs
    whole = 0
    for i in range(1, rounds + 1):
        marker = str(i).encode()
        for payload in (big, big, marker):
            world.bus.put(Topic.ODOM, payload)
        got = [b""]
        while got[-1] != marker:
            try:
                got.append(inbox.get(timeout=1.0).payload.to_bytes())
            except queue.Empty:  # on a busy machine anybody may miss a sample, but nobody stays without
                world.bus.put(Topic.ODOM, marker)
        whole += got.count(big)
    assert whole > 1.8 * rounds
    child.send_signal(signal.SIGCONT)
    out: list[str] = []
    reader = threading.Thread(target=lambda: out.extend(child.communicate()[0].split()), daemon=True)
    reader.start()

    def served_again() -> bool:
        world.bus.put(Topic.ODOM, b"last")
        return child.poll() is not None

    eventually(served_again, "the one that hung is served again")
    reader.join(PATIENCE_S)
    assert out[-1] == "last"
    assert out.count("x" * 10) < 2 * rounds  # it did hang, and lost samples


def test_a_large_image_arrives_whole(world: World) -> None:
    inbox = world.subscribe(world.other(), "ceilvo/robot1/image", Topic.IMAGE)
    image = np.random.default_rng(1).bytes(500_000)

    def arrives() -> bool:  # an image may be dropped, but never in part
        world.bus.put(Topic.IMAGE, image)
        return not inbox.empty()

    eventually(arrives, "an image")
    assert inbox.get(timeout=PATIENCE_S).payload.to_bytes() == image


# on demand


@pytest.mark.parametrize("topic", ON_DEMAND)
def test_on_demand_messages_cost_nothing_without_a_subscriber(world: World, topic: Topic) -> None:
    made: list[int] = []
    done = threading.Event()

    def make() -> bytes:
        made.append(1)
        done.set()
        return b"{}"

    world.bus.offer(topic, make)
    session = world.other()
    inbox = world.subscribe(session, f"ceilvo/robot1/{topic.value}", topic)
    assert made == []
    world.bus.offer(topic, make)
    assert inbox.get(timeout=PATIENCE_S).payload.to_bytes() == b"{}"
    assert made == [1]
    session.close()
    eventually(lambda: not world.bus.wanted(topic), "the subscriber left")
    done.clear()
    world.clock.ns += 10**12
    world.bus.offer(topic, make)
    assert made == [1]


def test_on_demand_messages_keep_their_period(world: World) -> None:
    inbox = world.subscribe(world.other(), "ceilvo/robot1/particles", Topic.PARTICLES)
    period_ns = int(config.Zenoh().particles_period_s * 1e9)
    offers = [(0, b"a", True), (period_ns - 1, b"b", False), (1, b"c", True), (3 * period_ns, b"d", True)]
    for step_ns, payload, due in offers:
        world.clock.ns += step_ns
        world.bus.offer(Topic.PARTICLES, functools.partial(bytes, payload))
        if due:
            assert inbox.get(timeout=PATIENCE_S).payload.to_bytes() == payload
    eventually(lambda: world.bus.counters()["samples_particles"] == 3, "three are counted")
    assert inbox.empty()


def test_a_message_that_cannot_be_made_is_counted_and_the_next_one_is_sent(
    world: World, caplog: pytest.LogCaptureFixture
) -> None:
    inbox = world.subscribe(world.other(), "ceilvo/robot1/image", Topic.IMAGE)

    def fail() -> bytes:
        raise RuntimeError("no picture")

    world.bus.offer(Topic.IMAGE, fail)
    eventually(lambda: world.bus.counters()["offer_errors"] == 1, "the failure is counted")
    world.clock.ns += 10**10
    world.bus.offer(Topic.IMAGE, lambda: b"\xff\xd8")
    assert inbox.get(timeout=PATIENCE_S).payload.to_bytes() == b"\xff\xd8"
    assert "image could not be made" in caplog.text


def test_pose_is_not_an_on_demand_message(world: World) -> None:
    with pytest.raises(ValueError, match="pose is not made on demand"):
        world.bus.offer(Topic.POSE, lambda: b"")


# requests


def test_queries_for_data(world: World) -> None:
    session = world.other()
    ((ok, answer),) = get(session, "ceilvo/robot1/map")
    assert ok
    assert (answer["schema"], answer["x_m"], answer["sightings"]) == ("ceilvo.map.1", [0.5], [9])
    ((ok, answer),) = get(session, "ceilvo/robot1/calibration")
    assert ok
    assert (answer["schema"], answer["ceiling_height_m"]) == ("ceilvo.calibration.1", 2.0)
    ((ok, answer),) = get(session, "ceilvo/*/config")
    assert ok
    assert answer["config"]["zenoh"]["prefix"] == "ceilvo"
    assert world.bus.counters()["queries"] >= 3


@pytest.mark.parametrize(
    ("name", "payload", "request_"),
    [
        ("initial_pose", b'{"x_m":1,"y_m":2,"theta_rad":0.5}', commands.InitialPose(1.0, 2.0, 0.5)),
        ("relocalise", None, commands.Relocalise()),
        ("save_map", b"{}", commands.SaveMap()),
        ("reset", b'{"keep_map":false}', commands.Reset(keep_map=False)),
    ],
)
def test_commands_do_something_and_say_what(
    world: World, name: str, payload: bytes | None, request_: commands.Command
) -> None:
    ((ok, answer),) = get(world.other(), f"ceilvo/robot1/cmd/{name}", payload)
    assert ok
    assert answer == {
        "schema": "ceilvo.reply.1",
        "robot": "robot1",
        "command": name,
        "ok": True,
        "result": {"done": type(request_).__name__},
    }
    assert world.robot.calls == [request_]
    assert world.bus.counters()["commands"] == 1


@pytest.mark.parametrize(
    ("payload", "says"),
    [(b'{"x_m": 1}', "y_m is missing"), (b"\xff", "not JSON"), (b" " * 4097, "at most 4096"), (b"9" * 60_000, "4096")],
)
def test_bad_commands_get_an_error_and_do_nothing(world: World, payload: bytes, says: str) -> None:
    ((ok, answer),) = get(world.other(), "ceilvo/robot1/cmd/initial_pose", payload)
    assert not ok
    assert (answer["ok"], answer["command"]) == (False, "initial_pose")
    assert says in answer["error"]
    assert world.robot.calls == []
    assert world.bus.counters()["request_errors"] == 1


@pytest.mark.parametrize(
    ("fault", "says"),
    [(FileFormatError("map: disk full"), "map: disk full"), (KeyError("secret"), "internal error KeyError")],
)
def test_a_handler_that_fails_answers_with_an_error(world: World, fault: Exception, says: str) -> None:
    world.robot.refuse = fault
    session = world.other()
    ((ok, answer),) = get(session, "ceilvo/robot1/cmd/save_map")
    assert not ok
    assert says in answer["error"]
    assert "secret" not in answer["error"]
    world.robot.refuse = None
    assert get(session, "ceilvo/robot1/cmd/save_map")[0][0]


@pytest.mark.parametrize(("key", "asked"), [("**", 4), ("ceilvo/*/cmd/reset", 1), ("ceilvo/robot1/cmd/*", 4)])
def test_reading_everything_moves_nothing(world: World, key: str, asked: int) -> None:
    session = world.other()
    refused: list[dict[str, Any]] = []

    def all_refuse() -> bool:
        refused[:] = [answer for ok, answer in get(session, key) if not ok]
        return len(refused) == asked

    eventually(all_refuse, f"{asked} commands refuse {key}")
    assert all("wildcard" in a["error"] for a in refused)
    assert world.robot.calls == []


# coming and going


def test_liveliness_appears_and_disappears() -> None:
    port = free_port()
    session = peer(listen=port)
    inbox: queue.Queue[zenoh.Sample] = queue.Queue()
    session.liveliness().declare_subscriber("ceilvo/*", inbox.put, history=True)
    cfg = replace(config.Zenoh(), connect=(f"tcp/127.0.0.1:{port}",), multicast=False)
    bus = ZenohBus(cfg, "robot7", Robot().handlers())
    bus.open()
    came = inbox.get(timeout=PATIENCE_S)
    bus.close()
    went = inbox.get(timeout=PATIENCE_S)
    session.close()
    assert (str(came.key_expr), came.kind) == ("ceilvo/robot7", zenoh.SampleKind.PUT)
    assert (str(went.key_expr), went.kind) == ("ceilvo/robot7", zenoh.SampleKind.DELETE)


@pytest.mark.parametrize("mode", ["peer", "client"])
def test_a_router_that_is_absent_comes_goes_and_comes_back(mode: str) -> None:
    port = free_port()
    cfg = replace(config.Zenoh(), mode=mode, connect=(f"tcp/127.0.0.1:{port}",), multicast=False)
    bus = ZenohBus(cfg, "robot1", Robot().handlers())
    bus.open()
    bus.put(Topic.POSE, b"nobody hears it")
    assert bus.counters()["routers"] == 0
    for i in range(2):
        router = peer(listen=port, mode="router")
        inbox: queue.Queue[zenoh.Sample] = queue.Queue()
        router.declare_subscriber("ceilvo/robot1/pose", inbox.put)
        eventually(lambda: bus.wanted(Topic.POSE), "the bus reaches the router")
        assert bus.counters()["routers"] == 1
        bus.put(Topic.POSE, str(i).encode())
        assert inbox.get(timeout=PATIENCE_S).payload.to_bytes() == str(i).encode()
        assert get(router, "ceilvo/robot1/map")[0][0]
        router.close()
        eventually(lambda: bus.counters()["routers"] == 0, "the bus notices that the router left")
    counts = bus.counters()
    bus.close()
    assert counts["unsent"] == (1 if mode == "client" else 0)
    assert counts["put_errors"] == 0


def test_losing_a_peer_is_logged(caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(zenoh_bus, "_LINK_CHECK_S", 0.01)
    caplog.set_level(logging.INFO)
    port = free_port()
    bus = ZenohBus(bus_config(port), "robot1", Robot().handlers())
    bus.open()
    session = peer(connect=port)
    eventually(lambda: "0 routers, 1 peers connected (were 0, 0)" in caplog.text, "the peer is noticed")
    session.close()
    eventually(lambda: "0 routers, 0 peers connected (were 0, 1)" in caplog.text, "its loss is noticed")
    bus.close()


def test_close_is_idempotent_and_then_nothing_is_sent(world: World) -> None:
    world.bus.close()
    world.bus.close()
    world.bus.put(Topic.POSE, b"late")
    world.bus.offer(Topic.IMAGE, lambda: b"late")
    assert not world.bus.wanted(Topic.POSE)
    assert world.bus.counters()["unsent"] == 1
    with pytest.raises(BusError, match="opened before"):
        world.bus.open()


def test_close_before_open_and_open_twice() -> None:
    bus = ZenohBus(bus_config(free_port()), "robot1", Robot().handlers())
    bus.close()
    other = ZenohBus(bus_config(free_port()), "robot1", Robot().handlers())
    other.open()
    with pytest.raises(BusError, match="opened before"):
        other.open()
    other.close()


def test_close_ends_a_client_that_never_found_its_router() -> None:
    cfg = replace(config.Zenoh(), mode="client", connect=(f"tcp/127.0.0.1:{free_port()}",), multicast=False)
    bus = ZenohBus(cfg, "robot1", Robot().handlers())
    bus.open()
    bus.close()
    eventually(lambda: not any(t.name.startswith("zenoh-o") for t in threading.enumerate()), "its threads end")


# configuration


def test_a_taken_port_is_one_clear_error() -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        bus = ZenohBus(bus_config(taken.getsockname()[1]), "robot1", Robot().handlers())
        with pytest.raises(BusError, match=r"^zenoh\.listen: Zenoh cannot open: .*in use") as caught:
            bus.open()
        bus.close()
    assert "\n" not in str(caught.value)
    assert ".rs:" not in str(caught.value)


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"listen": ("foo",)}, "zenoh.listen: found 'foo', expected protocol/address"),
        ({"listen": ("tcp/",)}, "zenoh.listen: found 'tcp/', expected protocol/address"),
        ({"connect": ("tcp/127.0.0.1",)}, "zenoh.connect: found 'tcp/127.0.0.1', expected host:port"),
        ({"connect": ("tcp/127.0.0.1:0",)}, "with a port from 1 to 65535"),
        ({"listen": ("tcp/127.0.0.1:65536",)}, "with a port from 0 to 65535"),
        ({"connect": ("carrier-pigeon/roof:1",)}, "expected one of the protocols tcp, udp"),
        ({"mode": "client", "multicast": False}, "zenoh.connect: found nothing, expected a router"),
        ({"prefix": "a/*"}, "zenoh.prefix: found 'a/*'"),
        ({"config_file": "/nonexistent/z.json5"}, "zenoh.config_file: found '/nonexistent/z.json5'"),
    ],
)
def test_what_cannot_work_is_refused_before_anything_is_opened(changes: dict[str, Any], says: str) -> None:
    with pytest.raises(BusError) as caught:
        ZenohBus(replace(config.Zenoh(), **changes), "robot1", Robot().handlers())
    assert says in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    "end",
    ["tcp/127.0.0.1:7447", "tcp/[::1]:7447", "tls/robot.local:7447", "udp/10.0.0.1:1#iface=eth0", "serial//dev/ttyS1"],
)
def test_endpoints_that_zenoh_knows(end: str) -> None:
    c = session_config(replace(config.Zenoh(), connect=(end,)))
    assert json.loads(c.get_json("connect/endpoints")) == [end]


def test_defaults_stay_on_this_computer() -> None:
    c = session_config(config.Zenoh())
    assert json.loads(c.get_json("listen/endpoints")) == ["tcp/127.0.0.1:0"]
    assert json.loads(c.get_json("scouting/multicast/interface")) == "lo"
    assert json.loads(c.get_json("connect/exit_on_failure")) is False
    assert json.loads(c.get_json("scouting/gossip/enabled")) is False


@pytest.mark.parametrize(
    "changes", [{"multicast": False}, {"connect": ("tcp/10.0.0.1:7447",)}, {"listen": ("tcp/[::]:7447",)}]
)
def test_gossip_where_the_configuration_leaves_the_computer_or_names_its_peers(changes: dict[str, Any]) -> None:
    c = session_config(replace(config.Zenoh(), **changes))
    assert json.loads(c.get_json("scouting/gossip/enabled")) is True


def test_a_zenoh_file_is_passed_through_whole(tmp_path: Path) -> None:
    port = free_port()
    path = tmp_path / "zenoh.json5"
    path.write_text(
        "{ mode: 'peer', /* JSON5 */ listen: { endpoints: ['tcp/127.0.0.1:PORT'] }, "
        "scouting: { multicast: { enabled: false } }, transport: { unicast: { max_sessions: 7 } } }".replace(
            "PORT", str(port)
        )
    )
    cfg = replace(config.Zenoh(), config_file=str(path), listen=("tcp/127.0.0.1:1",))
    assert json.loads(session_config(cfg).get_json("transport/unicast/max_sessions")) == 7
    bus = ZenohBus(cfg, "robot1", Robot().handlers())
    bus.open()
    session = peer(connect=port)
    assert get(session, "ceilvo/robot1/map")[0][0]
    session.close()
    bus.close()


def test_a_broken_zenoh_file_names_the_key_and_the_fault(tmp_path: Path) -> None:
    path = tmp_path / "zenoh.json5"
    path.write_text("{ mood: 'peer' }")
    with pytest.raises(BusError, match=r"^zenoh\.config_file: .*unknown field `mood`"):
        ZenohBus(replace(config.Zenoh(), config_file=str(path)), "robot1", Robot().handlers())


def test_a_watcher_beside_the_daemon_takes_no_port_of_its_own(tmp_path: Path) -> None:
    cfg = replace(config.Zenoh(), listen=("tcp/0.0.0.0:7500", "tcp/127.0.0.1:0"), connect=("tcp/10.0.0.9:7447",))
    path = tmp_path / "zenoh.json5"
    path.write_text("{ mode: 'peer', listen: { endpoints: { peer: ['tcp/[::]:7500', 'tcp/127.0.0.1:0'] } } }")
    for given, connect in [
        (cfg, ["tcp/10.0.0.9:7447", "tcp/127.0.0.1:7500"]),
        (replace(cfg, config_file=str(path)), ["tcp/127.0.0.1:7500"]),
    ]:
        c = watcher_config(given)
        assert json.loads(c.get_json("listen/endpoints")) == ["tcp/127.0.0.1:0"]
        assert json.loads(c.get_json("connect/endpoints")) == connect
