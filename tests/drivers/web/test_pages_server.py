"""The pages' server as browsers and programs meet it, beside a robot on real Zenoh."""

from __future__ import annotations

import contextlib
import json
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from patience import PATIENCE_S, until
from ros2_parts import UNIX_NS, estimate, scene
from web_parts import Client, config_for, served
from zenoh_world import FakeClock, Robot, World, bus_config, free_port

from ceilvo.config import Config
from ceilvo.drivers.bus import commands, messages
from ceilvo.drivers.bus.zenoh_bus import ZenohBus
from ceilvo.drivers.ports import ON_DEMAND, Stamp, Topic
from ceilvo.errors import BusError, CeilvoError

STAMP = Stamp(0, UNIX_NS)
JPEG = b"\xff\xd8jpeg"
POSE = b'{"x_m": 1.0, "y_m": 2.0, "theta_rad": 0.5, "map_id": "hall"}'
TOKEN = "a token of the owner"


@contextlib.contextmanager
def robot_on_zenoh(**changes: Any) -> Iterator[World]:
    port, robot, clock = free_port(), Robot(), FakeClock()
    bus = ZenohBus(bus_config(port, **changes), "robot1", robot.handlers(), clock=clock)
    bus.open()
    try:
        yield World(port, robot, clock, bus)
    finally:
        bus.close()


@pytest.fixture
def world() -> Iterator[World]:
    with robot_on_zenoh() as made:
        yield made


@pytest.fixture
def token_file(tmp_path: Path) -> str:
    file = tmp_path / "token"
    file.write_text(TOKEN)
    file.chmod(0o640)
    return str(file)


def speak(world: World) -> None:
    e, seen = estimate(), scene()
    world.bus.put(Topic.POSE, messages.encode_pose("robot1", e, UNIX_NS, e.stamp_ns, "hall", 3))
    world.bus.put(Topic.LANDMARKS, messages.encode_landmarks("robot1", STAMP, seen.landmarks))
    world.bus.put(Topic.PARTICLES, messages.encode_particles("robot1", 1, STAMP, seen.particles[:1], np.ones(1)))
    world.bus.put(Topic.IMAGE, JPEG)
    world.bus.put(Topic.EVENT, messages.encode_event("robot1", STAMP, "state", "warning", "<b>lost</b>"))


def heard(ws: Any, world: World, wanted: set[str]) -> dict[str, Any]:
    """One message of each of these topics; "image" for pictures."""
    got: dict[str, Any] = {}

    def all_of_them() -> bool:
        speak(world)
        said = ws.recv(PATIENCE_S)
        if isinstance(said, bytes):
            got["image"] = said
        else:
            message = json.loads(said)
            got[message["topic"]] = message["data"]
        return wanted <= set(got)

    until(all_of_them, f"{wanted}")
    return got


def test_a_page_gets_all_that_the_robot_says(world: World) -> None:
    with served(config_for(world.port)) as address:
        until(lambda: world.bus.wanted(Topic.POSE), "it listens")
        with Client(address).live() as ws:
            ws.send(json.dumps({"want": ["landmarks", "particles", "image"]}))
            topics = {"hello", "link", "path", "pose", "states", "events", "landmarks", "particles", "image"}
            got = heard(ws, world, topics)
    e, map_ = estimate(), scene().landmarks
    assert got["hello"] == {"robot": "robot1", "read_only": False, "signed_in": False}
    assert [got["pose"][name] for name in ("x_m", "y_m", "theta_rad")] == pytest.approx(list(e.pose))
    assert (got["pose"]["map_id"], got["pose"]["map_version"]) == ("hall", 3)
    assert [s["state"] for s in got["states"]] == [e.state.name]
    assert got["events"][-1]["text"] == "<b>lost</b>"
    assert got["landmarks"]["count"] == len(map_)
    assert np.array(got["landmarks"]["rows"])[:, :2] == pytest.approx(map_.xy_map_m, abs=5e-4)
    assert got["image"] == JPEG


def test_the_daemon_makes_nothing_for_a_page_that_does_not_look(world: World) -> None:
    with served(config_for(world.port)) as address:
        until(lambda: world.bus.wanted(Topic.POSE), "it listens")
        assert not any(world.bus.wanted(t) for t in ON_DEMAND)
        with Client(address).live() as ws:
            heard(ws, world, {"hello", "pose"})
            assert not any(world.bus.wanted(t) for t in ON_DEMAND)
            ws.send(json.dumps({"want": ["image"]}))
            until(lambda: world.bus.wanted(Topic.IMAGE), "the picture is wanted")
            assert not world.bus.wanted(Topic.PARTICLES)
            ws.send(json.dumps({"want": []}))
            until(lambda: not world.bus.wanted(Topic.IMAGE), "the picture is not wanted")
            ws.send(json.dumps({"want": ["image", "particles", "landmarks"]}))
            until(lambda: all(world.bus.wanted(t) for t in ON_DEMAND), "all is wanted")
            world.bus.put(Topic.LANDMARKS, messages.encode_landmarks("robot1", STAMP, scene().landmarks))
            until(lambda: not world.bus.wanted(Topic.LANDMARKS), "the map is looked at now and then")
        until(lambda: not any(world.bus.wanted(t) for t in ON_DEMAND), "nothing is wanted when the page is closed")


def test_what_is_not_ceilvos_is_left_out(world: World, caplog: pytest.LogCaptureFixture) -> None:
    bad = (b"", b"{}", b'{"schema":"ceilvo.pose.1"}', b"\xff", b'{"schema":"ceilvo.event.1","stamp_unix_ns":1e999}')
    huge = b'{"schema":"ceilvo.landmarks.1","x_m":[1e999],"y_m":[0],"kind":[1e999]}'
    with served(config_for(world.port)) as address, Client(address).live() as ws:
        ws.send(json.dumps({"want": ["landmarks"]}))
        until(lambda: world.bus.wanted(Topic.LANDMARKS), "it listens")
        for topic in (Topic.POSE, Topic.EVENT, Topic.HEALTH):
            for payload in bad:
                world.bus.put(topic, payload)
        world.bus.put(Topic.LANDMARKS, huge)
        for text in ("", "[]", "{", '{"want": 3}', '{"want": [{}]}', "\0"):
            ws.send(text)
        assert heard(ws, world, {"pose"})["pose"]["seq"] == estimate().seq
    assert any("is left out" in r.getMessage() for r in caplog.records)
    assert not any(r.exc_info for r in caplog.records)


def test_commands_reach_the_robot_with_its_own_token(token_file: str) -> None:
    with robot_on_zenoh(command_token_file=token_file) as world:
        config = config_for(world.port)
        config = replace(config, zenoh=replace(config.zenoh, command_token_file=token_file))
        with served(config) as address:
            client = Client(address)
            until(lambda: client.post("/cmd/save_map", b"{}").status == 200, "the robot answers")
            given = client.post("/cmd/initial_pose", POSE)
            assert (given.status, given.json["ok"]) == (200, True)
            assert client.post("/cmd/relocalise", b"").status == 200
            calls = list(dict.fromkeys(world.robot.calls))
            expected = commands.InitialPose(1.0, 2.0, 0.5, map_id="hall")
            assert calls == [commands.SaveMap(), expected, commands.Relocalise()]
            world.robot.refuse = BusError("no map of a hall")
            refused = client.post("/cmd/initial_pose", POSE)
            assert (refused.status, refused.json["error"]) == (409, "no map of a hall")


@pytest.mark.parametrize(
    ("path", "body", "status"),
    [
        ("/cmd/reset", b"{}", 404),
        ("/cmd/initial_pose", b"{}", 400),
        ("/cmd/initial_pose", b'{"x_m": 1, "y_m": NaN, "theta_rad": 0}', 400),
        ("/cmd/initial_pose", b'{"x_m": 1, "y_m": 1e9, "theta_rad": 0}', 400),
        ("/cmd/save_map", b'{"now": 1}', 400),
        ("/cmd/save_map", b"[" * 4000, 400),
        ("/cmd/save_map", b" " * 5000, 413),
        ("/cmd/%2e%2e", b"{}", 404),
        ("/login", b"{}", 401),
        ("/login", b'{"token": ["a"]}', 401),
        ("/login", b"7", 400),
        ("/pages/../server.py", b"", 404),
    ],
)
def test_wrong_requests_are_refused_and_nothing_is_done(world: World, path: str, body: bytes, status: int) -> None:
    with served(config_for(world.port)) as address:
        assert Client(address).post(path, body).status == status
    assert world.robot.calls == []


def test_other_sites_and_names_get_nothing(world: World) -> None:
    with served(config_for(world.port)) as address:
        client, own = Client(address), address.removeprefix("http://")
        foreign = [
            {"Origin": "https://evil.example"},
            {"Origin": "null"},
            {"Origin": f"http://{own}.evil.example"},
            {"Origin": "http://[bad"},
            {"Sec-Fetch-Site": "cross-site"},
            {"Sec-Fetch-Site": "same-site"},
        ]
        for headers in foreign:
            assert client.post("/cmd/save_map", b"{}", headers).status == 403, headers
            assert client.upgrade(headers) == 403, headers
        for kind in ("text/plain", "application/x-www-form-urlencoded", "multipart/form-data"):
            assert client.post("/cmd/save_map", b"{}", {"Content-Type": kind}).status == 415
        for host in ("evil.example", "evil.example:80", "127.0.0.1.evil.example", "", "[", "10.0.0.1"):
            assert client.get("/", {"Host": host}).status == 421, host
            assert client.upgrade({"Host": host}) == 421, host
        until(lambda: client.post("/cmd/save_map", b"{}", {"Origin": address}).status == 200, "its own page may")
    assert set(world.robot.calls) == {commands.SaveMap()}


def test_a_read_only_server_commands_nothing(world: World) -> None:
    with served(config_for(world.port, read_only=True)) as address:
        client = Client(address)
        for name, body in (("initial_pose", POSE), ("relocalise", b"{}"), ("save_map", b"{}")):
            assert client.post(f"/cmd/{name}", body).status == 403
        with client.live() as ws:
            assert heard(ws, world, {"hello"})["hello"]["read_only"] is True
    assert world.robot.calls == []


def test_with_a_token_nothing_is_readable_or_changeable_without_it(world: World, token_file: str) -> None:
    with served(config_for(world.port, token_file=token_file)) as address:
        client = Client(address)
        home = client.get("/")
        assert (home.status, home.headers["Location"]) == (303, "/login")
        open_to_all = ["/login", "/pages/login.js", "/pages/style.css", "/pages/icon.svg"]
        assert [client.get(path).status for path in open_to_all] == [200] * 4
        for path in ("/live", "/pages/live.js", "/pages/live.html", "/pages/x", "/x", "//", "/login/", "/LOGIN"):
            assert client.get(path).status == 401, path
        wrong = ["", "x", TOKEN[:-1], f"{TOKEN}x", "ä", "a" * 3000]
        for token in wrong:
            bearer = {"Authorization": f"Bearer {token}".encode().decode("latin-1"), "Cookie": f"ceilvo={len(token)}"}
            assert client.post("/cmd/save_map", b"{}", bearer).status == 401
            assert client.upgrade(bearer) == 401
            assert client.post("/login", json.dumps({"token": token}).encode()).status == 401
        assert world.robot.calls == []
        signed = client.post("/login", json.dumps({"token": TOKEN}).encode())
        cookie = signed.headers["Set-Cookie"]
        assert signed.status == 200 and "HttpOnly" in cookie and "SameSite=Strict" in cookie and TOKEN not in cookie
        session = {"Cookie": cookie.partition(";")[0]}
        assert client.get("/", session).status == 200
        until(lambda: client.post("/cmd/save_map", b"{}", session).status == 200, "the owner commands")
        assert client.post("/cmd/relocalise", b"", {"Authorization": f"Bearer {TOKEN}"}).status == 200
        with client.live(session) as ws:
            assert heard(ws, world, {"hello", "pose"})["hello"]["signed_in"] is True
        assert client.post("/logout", b"", session).status == 200
        assert client.post("/cmd/save_map", b"{}", session).status == 401
    assert set(world.robot.calls) == {commands.SaveMap(), commands.Relocalise()}


def test_every_answer_has_the_headers_that_keep_a_page_to_itself(world: World) -> None:
    with served(config_for(world.port)) as address:
        client = Client(address)
        answers = [client.get("/"), client.get("/pages/map.js"), client.get("/x"), client.post("/cmd/save_map", b"[")]
        answers.append(client.get("/", {"Host": "evil.example"}))
    for answer in answers:
        policy = answer.headers["Content-Security-Policy"]
        assert "default-src 'none'" in policy and "frame-ancestors 'none'" in policy and "unsafe" not in policy
        assert answer.headers["X-Content-Type-Options"] == "nosniff" and answer.headers["Cache-Control"] == "no-store"


def test_no_more_pages_than_it_can_serve_and_a_closed_one_makes_room(world: World) -> None:
    with served(config_for(world.port)) as address, contextlib.ExitStack() as pages:
        client = Client(address)
        for _ in range(15):
            pages.enter_context(client.live())
        with client.live():
            assert client.upgrade({}) == 503
        until(lambda: client.upgrade({}) == 101, "there is room again")


def refused(config: Config) -> str:
    with pytest.raises(CeilvoError) as e, served(config):
        pass
    return str(e.value)


def test_a_port_that_is_taken_and_files_that_cannot_be_used_are_one_line(tmp_path: Path, world: World) -> None:
    with served(config_for(world.port)) as address:
        port = int(address.rpartition(":")[2])
        assert refused(config_for(world.port, port=port)).startswith(
            f"web.port: 127.0.0.1:{port} cannot be listened on"
        )
    none = str(tmp_path / "none")
    assert refused(config_for(world.port, token_file=none)).startswith(f"web.token_file: found {none}: No such file")
    key = tmp_path / "key"
    key.write_text("no key")
    key.chmod(0o600)
    found = refused(config_for(world.port, certificate_file=str(key), key_file=str(key)))
    assert found.startswith(f"web.certificate_file: {key} with web.key_file: {key}: ")
    assert "expected a certificate in PEM" in found and "\n" not in found
    key.chmod(0o644)
    found = refused(config_for(world.port, certificate_file=str(key), key_file=str(key)))
    assert "web.key_file" in found and "may be read by everybody" in found
