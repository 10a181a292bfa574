"""Queries and commands to ZenohBus from another session: what is answered, what is refused."""

from __future__ import annotations

from typing import Any

import pytest
from patience import until
from zenoh_world import World, get

from ceilvo.drivers.bus import commands
from ceilvo.errors import FileFormatError


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

    until(all_refuse, f"{asked} commands refuse {key}")
    assert all("wildcard" in a["error"] for a in refused)
    assert world.robot.calls == []


@pytest.mark.parametrize(("payload", "ahead"), [(None, None), (b"{}", None), (b'{"predict_ms": 50}', 50.0)])
def test_the_pose_is_asked_for_as_it_is_or_of_a_moment_from_now(
    world: World, payload: bytes | None, ahead: float | None
) -> None:
    ((ok, answer),) = get(world.other(), "ceilvo/robot1/pose", payload)
    assert ok
    assert answer == {"predict_ms": ahead}


@pytest.mark.parametrize(
    "payload", [b'{"predict_ms": -1}', b'{"predict_ms": 501}', b'{"predict_ms": true}', b'{"at": 1}']
)
def test_a_moment_that_is_too_far_off_is_refused(world: World, payload: bytes) -> None:
    ((ok, answer),) = get(world.other(), "ceilvo/robot1/pose", payload)
    assert not ok
    assert "query pose" in answer["error"]
