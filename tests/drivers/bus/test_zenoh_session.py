"""The Zenoh configuration that a session gets: what cannot work, endpoints, defaults, a file of one's own."""

from __future__ import annotations

import json
import socket
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from zenoh_world import Robot, bus_config, free_port, get, peer

from ceilvo import config
from ceilvo.drivers.bus.zenoh_bus import ZenohBus
from ceilvo.drivers.bus.zenoh_session import session_config, watcher_config
from ceilvo.errors import BusError, ConfigError


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
    assert json.loads(c.get_json("scouting/multicast/interface")) == "127.0.0.1"
    assert json.loads(c.get_json("connect/exit_on_failure")) is False
    assert json.loads(c.get_json("scouting/gossip/enabled")) is False


@pytest.mark.parametrize(
    "changes",
    [
        {"multicast": False},
        {"connect": ("tcp/10.0.0.1:7447",)},
        {"connect": ("tcp/127.0.0.1:7447",)},
        {"listen": ("tcp/[::]:7447",)},
    ],
)
def test_gossip_where_the_configuration_leaves_the_computer_or_names_its_peers(changes: dict[str, Any]) -> None:
    c = session_config(replace(config.Zenoh(), **changes))
    assert json.loads(c.get_json("scouting/gossip/enabled")) is True


def test_whom_a_router_of_this_computer_introduces_the_daemon_does_not_go_to() -> None:
    """It is met by multicast too, and a stranger's friends may be on the network."""
    c = session_config(replace(config.Zenoh(), connect=("tcp/127.0.0.1:7447",)))
    assert json.loads(c.get_json("scouting/gossip/autoconnect")) == {"router": [], "peer": [], "client": []}


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


@pytest.mark.parametrize(
    ("text", "says"), [(None, r"found '/.*no such file"), ("{ mood: 'peer' }", "unknown field `mood`")]
)
def test_a_broken_zenoh_file_names_the_key_and_the_fault(tmp_path: Path, text: str | None, says: str) -> None:
    """It is configuration: who starts the daemon again and again does not mend it."""
    path = tmp_path / "zenoh.json5"
    if text is not None:
        path.write_text(text)
    with pytest.raises(ConfigError, match=rf"^zenoh\.config_file: .*{says}") as caught:
        ZenohBus(replace(config.Zenoh(), config_file=str(path)), "robot1", Robot().handlers())
    assert "\n" not in str(caught.value)


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
