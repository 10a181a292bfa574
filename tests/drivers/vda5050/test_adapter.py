"""VDA 5050: messages by hand, and the adapter against a real mosquitto and a real bus."""

from __future__ import annotations

import json
import threading
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import pytest
from fleet_manager import Fleet, mosquitto
from patience import PATIENCE_S, until
from ros2_parts import UNIX_NS, estimate
from zenoh_world import Robot, free_port

from ceilvo import config
from ceilvo.config import Config, Vda5050
from ceilvo.daemon.app.readers.shelved import FleetMaps
from ceilvo.drivers.bus import commands, messages
from ceilvo.drivers.bus.zenoh_bus import ZenohBus
from ceilvo.drivers.ports import Topic
from ceilvo.drivers.vda5050 import messages as vda
from ceilvo.errors import BusError
from ceilvo.types import State

ME = vda.Robot("3.0.0", "acme", "robot1")


def pose(state: State = State.TRACKING, **fields: object) -> messages.Pose:
    payload = json.loads(messages.encode_pose("robot1", estimate(state=state), UNIX_NS, 0))
    return messages.decode_pose(json.dumps(payload | fields).encode())


def test_a_position_of_version_3() -> None:
    where = vda.position(ME, pose(), "hall")
    assert where is not None
    assert where.pop("deviationRange") == pytest.approx(3 * 0.03)
    assert where == {"x": 1.25, "y": -0.5, "theta": 0.75, "mapId": "hall", "localized": True, "localizationScore": 0.97}
    old = vda.position(replace(ME, version="2.1.0"), pose(), "hall")
    assert old is not None and old["positionInitialized"] is True and old["mapId"] == "hall"
    assert (vda.floor_of(pose(map_id="floor 2")), vda.floor_of(pose(map_id=None))) == ("floor 2", "")


@pytest.mark.parametrize("state", list(State))
def test_errors_and_localized_by_state(state: State) -> None:
    found = vda.errors(pose(state), "")
    levels = [e["errorLevel"] for e in found]
    expected = {State.LOST: ["FATAL"], State.RELOCALISING: ["FATAL"], State.INIT: ["WARNING"]}
    assert levels == expected.get(state, [])
    assert all(e["errorType"] == "LOCALIZATION_ERROR" for e in found)
    where = vda.position(ME, pose(state), "map")
    assert where is not None
    assert where["localized"] is (state in (State.TRACKING, State.DEGRADED, State.DEAD_RECKONING))
    assert ("deviationRange" in where) is where["localized"]


def test_a_pose_on_another_floor_that_is_loaded() -> None:
    where = {"x": 1.0, "y": 2.0, "theta": 0.5}
    floors = {"hall": "ground", "first": "first"}
    for given, floor in (({}, "ground"), ({"mapId": "hall"}, "ground"), ({"mapId": "first"}, "first")):
        told = json.loads(vda.initial_pose(vda.Action("initPosition", "1", where | given), floors))
        assert told == {"x_m": 1.0, "y_m": 2.0, "theta_rad": 0.5, "map_id": floor}
    for wrong in ("ground", "", 3, None):
        with pytest.raises(BusError, match=r"mapId: found .*, expected one of hall, first"):
            vda.initial_pose(vda.Action("initPosition", "1", where | {"mapId": wrong}), floors)


def test_what_came_of_an_action_by_version() -> None:
    action = vda.Action("enableMap", "7", {})
    same = {"actionId": "7", "actionType": "enableMap", "actionStatus": "RUNNING"}
    assert vda.action_state(ME, action, "RUNNING", "waits") == {**same, "actionResult": "waits"}
    old = vda.action_state(replace(ME, version="2.1.0"), action, "RUNNING", "waits")
    assert old == {**same, "resultDescription": "waits"}


def test_the_maps_of_a_state() -> None:
    maps = [("hall", "7", True), ("yard", "", False)]
    told = json.loads(vda.state(ME, 0, UNIX_NS, pose(), "", maps, []))
    assert told["maps"] == [
        {"mapId": "hall", "mapVersion": "7", "mapStatus": "ENABLED"},
        {"mapId": "yard", "mapVersion": "", "mapStatus": "DISABLED"},
    ]
    assert told["mobileRobotPosition"]["mapId"] == "hall"


def test_a_header() -> None:
    assert vda.header(ME, 5, 1_750_000_000_123_456_789) == {
        "headerId": 5,
        "timestamp": "2025-06-15T15:06:40.123Z",
        "version": "3.0.0",
        "manufacturer": "acme",
        "serialNumber": "robot1",
    }


@pytest.mark.parametrize(
    "payload",
    [b"", b"\xff", b"[]", b"{}", b'{"actions": 3}', b'{"actions": [{}]}', b'{"actions": [{"actionType": "a"}]}',
     b'{"actions": [{"actionType": "a", "actionId": "1", "actionParameters": [3]}]}',
     json.dumps({"actions": [{"actionType": "a", "actionId": "1"}] * 21}).encode()],
)  # fmt: skip
def test_what_is_no_instant_action(payload: bytes) -> None:
    with pytest.raises(BusError, match="instantActions"):
        vda.instant_actions(payload)


@pytest.mark.parametrize("value", [None, "1", True, [1.0]])
def test_a_pose_without_a_number(value: object) -> None:
    with pytest.raises(BusError, match="x: found"):
        vda.initial_pose(vda.Action("initPosition", "1", {"x": value, "y": 1.0, "theta": 0.0}), {"map": ""})


@pytest.fixture
def broker(tmp_path: Path) -> Iterator[int]:
    with mosquitto(tmp_path) as port:
        yield port


@pytest.fixture
def scene(broker: int) -> Iterator[tuple[Robot, ZenohBus, Fleet, Callable[[], None]]]:
    from ceilvo.drivers.vda5050.adapter import Adapter

    robot, port, stop = Robot(), free_port(), threading.Event()
    cfg = replace(config.Zenoh(), listen=(f"tcp/127.0.0.1:{port}",), multicast=False)
    bus = ZenohBus(cfg, "robot1", robot.handlers())
    bus.open()
    fleet = Fleet(broker)
    settings = Config(zenoh=cfg, vda5050=Vda5050(port=broker, state_period_s=0.2, visualization_period_s=0.05))
    thread = threading.Thread(target=Adapter(settings, FleetMaps(settings)).run, args=(stop,))
    thread.start()

    def end() -> None:
        stop.set()
        thread.join(PATIENCE_S)

    yield robot, bus, fleet, end
    end()
    bus.close()
    fleet.close()


def say(bus: ZenohBus, state: State = State.TRACKING) -> None:
    bus.put(Topic.POSE, messages.encode_pose("robot1", estimate(state=state), UNIX_NS, 0))


def test_through_a_real_broker(scene: tuple[Robot, ZenohBus, Fleet, Callable[[], None]]) -> None:
    robot, bus, fleet, end = scene

    def told(state: State, true: Callable[[], object]) -> None:
        until(lambda: say(bus, state) or true(), f"{state.name} is told")

    until(lambda: fleet.last("connection").get("connectionState") == "ONLINE", "it is online")
    told(State.TRACKING, lambda: fleet.last("state").get("mobileRobotPosition", {}).get("localized"))
    where = fleet.last("state")["mobileRobotPosition"]
    assert (where["x"], where["y"], where["theta"], where["mapId"]) == (1.25, -0.5, 0.75, "map")
    assert fleet.last("state")["errors"] == []
    assert fleet.last("state")["maps"] == [{"mapId": "map", "mapVersion": "", "mapStatus": "ENABLED"}]
    told(State.TRACKING, lambda: len(fleet.told.get("visualization", [])) >= 3)
    told(State.LOST, lambda: fleet.last("state")["errors"])
    [error] = fleet.last("state")["errors"]
    assert (error["errorType"], error["errorLevel"]) == ("LOCALIZATION_ERROR", "FATAL")
    told(State.TRACKING, lambda: not fleet.last("state")["errors"])

    where3 = {"x": 3.0, "y": -2.0, "theta": 1.0}
    assert fleet.result("initializePosition", **where3, mapId="map")[0] == "FINISHED"
    assert robot.calls == [commands.InitialPose(3.0, -2.0, 1.0)]
    status, text = fleet.result("initPosition", **where3, mapId="another")
    assert status == "FAILED" and "mapId: found 'another'" in text
    assert fleet.result("enableMap", mapId="map") == ("FINISHED", "map is in use")
    fleet.client.publish("uagv/v3/ceilvo/robot1/instantActions", b"nonsense")
    for kind in ("downloadMap", "enableMap", "deleteMap"):
        status, text = fleet.result(kind, mapId="other", mapVersion="1", mapDownloadLink="x")
        assert status == "FAILED" and text.startswith("service.state_dir: found nothing, expected the folder")
    assert fleet.result("deleteMap", mapId="map")[0] == "FAILED"
    assert len(robot.calls) == 1, "nothing else moved the robot"
    numbers = [s["headerId"] for s in fleet.told["state"]]
    assert numbers == list(range(numbers[0], numbers[0] + len(numbers)))

    bus.close()
    until(lambda: fleet.last("state")["errors"], "a daemon that ended is no longer localized")
    assert fleet.last("state")["mobileRobotPosition"]["localized"] is False
    end()
    until(lambda: fleet.last("connection")["connectionState"] == "OFFLINE", "its end is told")
