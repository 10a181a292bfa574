"""The daemon's bus behind a real router of the same computer: found, found again, and alone under its name."""

from __future__ import annotations

import itertools
import json
import logging
import time
from collections.abc import Iterator
from dataclasses import replace

import pytest
import zenoh
from patience import until
from zenoh_world import Robot, free_port

from ceilvo import config
from ceilvo.bench.wires.router import Router, as_ros
from ceilvo.drivers.bus.namesake import refuse_namesake
from ceilvo.drivers.bus.zenoh_bus import ZenohBus
from ceilvo.drivers.ports import Topic
from ceilvo.errors import EXIT_CONFIG, ConfigError

AGAIN_S = 5.0
"""Of issue 16: samples again within so long after a router is back."""


class Ear:
    """Another program's session, and the poses that reach it."""

    def __init__(self, settings: zenoh.Config, key: str = "ceilvo/*/pose") -> None:
        self.session = zenoh.open(settings)
        self.heard: list[tuple[str, bytes]] = []
        self.session.declare_subscriber(key, lambda s: self.heard.append((str(s.key_expr), s.payload.to_bytes())))

    def robots(self) -> set[str]:
        return {key.split("/")[1] for key, _ in self.heard}


@pytest.fixture
def router() -> Iterator[Router]:
    with Router(free_port()) as made:
        yield made


def defaults(router: Router, **changes: object) -> config.Zenoh:
    """As delivered, but for the router's endpoint."""
    return replace(config.Zenoh(), connect=(router.end,), **changes)


def opened(cfg: config.Zenoh, robot: str = "robot1") -> ZenohBus:
    bus = ZenohBus(cfg, robot, Robot().handlers())
    bus.open()
    return bus


def spoken_until(buses: list[ZenohBus], heard: object, what: str) -> None:
    """Every bus publishes a number after another until `heard()`."""
    numbers = iter(range(1_000_000))

    def once() -> object:
        for bus in buses:
            bus.put(Topic.POSE, str(next(numbers)).encode())
        return heard()  # type: ignore[operator]

    until(once, what)


@pytest.mark.parametrize("mode", ["peer", "client"])
@pytest.mark.parametrize("first", ["the reader", "the daemon"])
def test_peers_and_clients_behind_the_router_hear_the_defaults(router: Router, mode: str, first: str) -> None:
    changes = {} if mode == "peer" else {"mode": "client", "listen/endpoints": []}
    ears = [Ear(as_ros(router.end, **changes))] if first == "the reader" else []
    bus = opened(defaults(router))
    try:
        ears = ears or [Ear(as_ros(router.end, **changes))]
        spoken_until([bus], lambda: ears[0].heard, "a pose behind the router")
    finally:
        bus.close()
        ears[0].session.close()


def test_whoever_has_the_greater_id_connects_so_the_daemons_is_small(router: Router) -> None:
    """rmw_zenoh's nodes wait for the one with the greater id; the daemon connects to nobody it is told of."""
    bus = opened(defaults(router))
    ears = [Ear(as_ros(router.end, id=f"1{i:031x}")) for i in (1, 0xFF, 0x100, 0x10000)]
    try:
        spoken_until([bus], lambda: all(e.heard for e in ears), "a pose at every peer")
    finally:
        bus.close()
        for ear in ears:
            ear.session.close()


def test_two_robots_behind_one_router(router: Router) -> None:
    buses = [opened(defaults(router), name) for name in ("robot1", "robot2")]
    ear = Ear(as_ros(router.end))
    try:
        spoken_until(buses, lambda: ear.robots() == {"robot1", "robot2"}, "both robots")
    finally:
        for bus in buses:
            bus.close()
        ear.session.close()


@pytest.mark.parametrize("kind", ["restarted", "replaced"])
@pytest.mark.parametrize("reader", ["peer", "client"])
def test_a_router_that_comes_back_brings_the_samples_back(kind: str, reader: str) -> None:
    """Replaced: by another one, which has been away for longer than it was there."""
    port = free_port()
    router = Router(port)
    changes = {} if reader == "peer" else {"mode": "client", "listen/endpoints": []}
    bus, ear = opened(defaults(router)), Ear(as_ros(router.end, **changes))
    try:
        spoken_until([bus], lambda: ear.heard, "a pose before")
        router.kill()
        until(lambda: bus.counters()["routers"] == 0, "the daemon sees the router go")
        if kind == "replaced":  # peers go on among themselves; a late one needs the new router to be introduced
            ear.session.close()
        router = Router(port)
        since = time.monotonic()
        if kind == "replaced":
            ear = Ear(as_ros(router.end, **changes))
        known = len(ear.heard)
        spoken_until([bus], lambda: len(ear.heard) > known, "a pose after")
        assert time.monotonic() - since < AGAIN_S
        numbers = [int(payload) for _, payload in ear.heard]
        assert all(a < b or b == 0 for a, b in itertools.pairwise(numbers)), "none twice, none old"
    finally:
        router.kill()
        bus.close()
        ear.session.close()


def test_a_second_daemon_of_one_name_is_refused_and_says_so(router: Router) -> None:
    bus = opened(defaults(router))
    try:
        refuse_namesake(defaults(router), "robot2", patience_s=0.0)
        until(lambda: bus.counters()["routers"] == 1, "the first is known to the router")
        with pytest.raises(ConfigError, match=r"^robot\.name: found robot1 in use behind tcp/.*allow_same_name") as e:
            refuse_namesake(defaults(router), "robot1", patience_s=0.5)
        assert e.value.exit_code == EXIT_CONFIG == 78
        refuse_namesake(defaults(router, allow_same_name=True), "robot1", patience_s=0.0)
    finally:
        bus.close()


def test_a_daemon_that_ended_does_not_keep_its_own_restart_out(router: Router) -> None:
    opened(defaults(router)).close()
    refuse_namesake(defaults(router), "robot1")


def test_a_router_that_is_away_or_silent_holds_up_nobody() -> None:
    cfg = replace(config.Zenoh(), connect=(f"tcp/127.0.0.1:{free_port()}",))
    refuse_namesake(cfg, "robot1", patience_s=0.0)


def test_a_namesake_that_a_late_router_brings_is_reported(caplog: pytest.LogCaptureFixture) -> None:
    port = free_port()
    cfg = replace(config.Zenoh(), connect=(f"tcp/127.0.0.1:{port}",))
    buses = [opened(cfg), opened(cfg)]
    try:
        with caplog.at_level(logging.ERROR), Router(port):
            until(lambda: sum(b.counters()["namesakes"] for b in buses), "one of the two sees the other")
        assert "another daemon behind" in caplog.text
    finally:
        for bus in buses:
            bus.close()


def test_publications_of_others_on_our_keys_are_reported_once_and_do_nothing(caplog: pytest.LogCaptureFixture) -> None:
    port = free_port()
    cfg = replace(config.Zenoh(), listen=(f"tcp/127.0.0.1:{port}",), multicast=False)
    robot = Robot()
    bus = ZenohBus(cfg, "robot1", robot.handlers())
    bus.open()
    stranger = Ear(as_ros(f"tcp/127.0.0.1:{port}"))
    try:
        with caplog.at_level(logging.WARNING):
            for sample in (b"{}", b"\xff", json.dumps({"x_m": 1}).encode()):
                stranger.session.put("ceilvo/robot1/pose", sample)
            stranger.session.put("ceilvo/robot1/cmd/reset", b"")
            until(lambda: bus.counters()["foreign_samples"] == 4, "all of them are counted")
            bus.put(Topic.POSE, b"own")
            until(lambda: stranger.heard, "one's own")
        assert bus.counters()["foreign_samples"] == 4, "one's own are not foreign"
        said = [r.getMessage() for r in caplog.records if "another session" in r.getMessage()]
        assert len(said) == 1 and said[0].startswith("ceilvo/robot1/pose: found a publication of another session")
        assert robot.calls == []
        assert not bus.wanted(Topic.IMAGE), "listening for strangers is no subscription"
    finally:
        bus.close()
        stranger.session.close()
