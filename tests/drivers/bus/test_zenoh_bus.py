"""ZenohBus against real Zenoh sessions over loopback TCP: samples, messages on demand, coming and going."""

from __future__ import annotations

import functools
import json
import logging
import queue
import signal
import subprocess
import sys
import threading
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest
import zenoh
from patience import PATIENCE_S, until
from zenoh_world import Robot, World, bus_config, free_port, get, peer

from ceilvo import config
from ceilvo.bench.soak.floods import session
from ceilvo.drivers.bus import zenoh_bus
from ceilvo.drivers.bus.zenoh_bus import ZenohBus
from ceilvo.drivers.ports import ON_DEMAND, Topic
from ceilvo.errors import BusError, CeilvoError


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

        until(arrives, "the new subscriber gets something")
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
        until(lambda: not world.bus.wanted(Topic.POSE), "the bus knows that the subscriber left")


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
            until(lambda: world.bus.wanted(Topic.ODOM), "the other process subscribes")
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

    until(arrives, "the healthy one gets something")
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

    until(served_again, "the one that hung is served again")
    reader.join(PATIENCE_S)
    assert out[-1] == "last"
    assert out.count("x" * 10) < 2 * rounds  # it did hang, and lost samples


def test_a_large_image_arrives_whole(world: World) -> None:
    inbox = world.subscribe(world.other(), "ceilvo/robot1/image", Topic.IMAGE)
    image = np.random.default_rng(1).bytes(500_000)

    def arrives() -> bool:  # an image may be dropped, but never in part
        world.bus.put(Topic.IMAGE, image)
        return not inbox.empty()

    until(arrives, "an image")
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
    until(lambda: not world.bus.wanted(topic), "the subscriber left")
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
    until(lambda: world.bus.counters()["samples_particles"] == 3, "three are counted")
    assert inbox.empty()


@pytest.mark.parametrize("failure", (RuntimeError("no picture"), CeilvoError("no picture")), ids=("mistake", "said"))
def test_a_message_that_cannot_be_made_is_counted_and_the_next_one_is_sent(
    world: World, caplog: pytest.LogCaptureFixture, failure: Exception
) -> None:
    inbox = world.subscribe(world.other(), "ceilvo/robot1/image", Topic.IMAGE)

    def fail() -> bytes:
        raise failure

    world.bus.offer(Topic.IMAGE, fail)
    until(lambda: world.bus.counters()["offer_errors"] == 1, "the failure is counted")
    world.clock.ns += 10**10
    world.bus.offer(Topic.IMAGE, lambda: b"\xff\xd8")
    assert inbox.get(timeout=PATIENCE_S).payload.to_bytes() == b"\xff\xd8"
    assert "image could not be made" in caplog.text
    assert ("Traceback" in caplog.text) == isinstance(failure, RuntimeError)


def test_pose_is_not_an_on_demand_message(world: World) -> None:
    with pytest.raises(ValueError, match="pose is not made on demand"):
        world.bus.offer(Topic.POSE, lambda: b"")


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
        until(lambda: bus.wanted(Topic.POSE), "the bus reaches the router")
        assert bus.counters()["routers"] == 1
        bus.put(Topic.POSE, str(i).encode())
        assert inbox.get(timeout=PATIENCE_S).payload.to_bytes() == str(i).encode()
        assert get(router, "ceilvo/robot1/map")[0][0]
        router.close()
        until(lambda: bus.counters()["routers"] == 0, "the bus notices that the router left")
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
    until(lambda: "0 routers, 1 peers connected (were 0, 0)" in caplog.text, "the peer is noticed")
    session.close()
    until(lambda: "0 routers, 0 peers connected (were 0, 1)" in caplog.text, "its loss is noticed")
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
    until(lambda: not any(t.name.startswith("zenoh-o") for t in threading.enumerate()), "its threads end")


# many


def test_hundreds_of_sessions_that_do_nothing_lock_nobody_out(world: World) -> None:
    """It took 351, one for each counter in shared memory, and then nobody."""
    world.sessions += [session(f"tcp/127.0.0.1:{world.port}") for _ in range(400)]
    assert get(session(f"tcp/127.0.0.1:{world.port}"), "ceilvo/robot1/map")[0][0]
