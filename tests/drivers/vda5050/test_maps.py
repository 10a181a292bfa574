"""A fleet manager's maps through a real broker: brought, chosen, taken at the next start, removed."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import pytest
from fleet_manager import Fleet, mosquitto
from map_contents import landmarks
from patience import PATIENCE_S, until
from ros2_parts import UNIX_NS, estimate
from zenoh_world import Robot, free_port

from ceilvo import config
from ceilvo.config import Config, Filter, Service, Vda5050
from ceilvo.daemon.app.readers.shelved import FleetMaps
from ceilvo.daemon.editing.exchange import to_json
from ceilvo.daemon.map.database.content import MapContent
from ceilvo.daemon.map.database.copies import open_map
from ceilvo.daemon.shelf.taking import take_chosen
from ceilvo.drivers.bus import commands, messages
from ceilvo.drivers.bus.zenoh_bus import ZenohBus
from ceilvo.drivers.ports import Topic
from ceilvo.drivers.vda5050.adapter import Adapter
from ceilvo.errors import ConfigError

HOME, HALL = ("home", ""), ("hall", "7")
MOST = 60


@dataclass
class Site:
    """A robot with a map of 40 landmarks, and others where its owner allows."""

    fleet: Fleet
    bus: ZenohBus
    robot: Robot
    state_dir: Path
    link: str

    def start_again(self) -> None:
        """What a start of the daemon does, before it reads its map."""
        taken = take_chosen(self.state_dir, "", HOME[0])
        assert taken is not None and taken.ok, taken

    def count(self) -> int:
        with open_map(self.state_dir / "map.db") as db:
            return len(db.content().landmarks)


def put(path: Path, count: int, seed: int) -> None:
    path.write_text(to_json(MapContent.of(landmarks(count, seed), 0.25)))


@pytest.fixture
def site(tmp_path: Path) -> Iterator[Site]:
    state_dir, served = tmp_path / "state", tmp_path / "served"
    state_dir.mkdir()
    served.mkdir()
    put(served / "hall.json", 50, 2)
    put(served / "empty.json", 0, 2)
    put(served / "huge.json", MOST + 1, 2)
    (served / "bad.json").write_text("{}")
    with open_map(state_dir / "map.db", create=True) as db:
        db.edit(MapContent.of(landmarks(40, 1), 0.25), "learnt")
    robot, port, stop = Robot(), free_port(), threading.Event()
    cfg = replace(config.Zenoh(), listen=(f"tcp/127.0.0.1:{port}",), multicast=False)
    with mosquitto(tmp_path) as broker:
        bus, fleet = ZenohBus(cfg, "robot1", robot.handlers()), Fleet(broker)
        bus.open()
        settings = Config(
            zenoh=cfg,
            service=Service(state_dir=str(state_dir)),
            filter=Filter(max_landmarks=MOST),
            vda5050=Vda5050(
                port=broker,
                state_period_s=0.2,
                visualization_period_s=0.05,
                map_id=HOME[0],
                map_sources=(f"file://{served}",),
            ),
        )
        thread = threading.Thread(target=Adapter(settings, FleetMaps(settings)).run, args=(stop,))
        thread.start()
        until(lambda: fleet.last("connection").get("connectionState") == "ONLINE", "it is online")
        yield Site(fleet, bus, robot, state_dir, f"file://{served}")
        stop.set()
        thread.join(PATIENCE_S)
        bus.close()
        fleet.close()


def test_a_map_is_brought_chosen_taken_and_the_one_before_comes_back(site: Site) -> None:
    fleet = site.fleet
    until(lambda: fleet.maps() == {HOME: "ENABLED"}, "its own map")
    came = fleet.result("downloadMap", mapId="hall", mapVersion="7", mapDownloadLink=f"{site.link}/hall.json")
    assert came == ("FINISHED", "50 landmarks")
    until(lambda: fleet.maps() == {HOME: "ENABLED", HALL: "DISABLED"}, "the map is there")

    waits = fleet.order("enableMap", mapId="hall", mapVersion="7")
    until(lambda: "next start" in fleet.told_of(waits).get("actionResult", ""), "it waits for a start")
    assert fleet.told_of(waits)["actionStatus"] == "RUNNING" and site.count() == 40
    assert (
        fleet.told_of(waits)["actionResult"] == "the next start of the daemon takes hall 7; until then home is in use"
    )
    status, text = fleet.result("deleteMap", mapId="hall", mapVersion="7")
    assert status == "FAILED" and "the next start takes it" in text
    site.start_again()
    until(lambda: fleet.told_of(waits)["actionStatus"] == "FINISHED", "it was taken")
    assert fleet.told_of(waits)["actionResult"] == "hall 7 is in use" and site.count() == 50
    until(lambda: fleet.maps() == {HALL: "ENABLED", HOME: "DISABLED"}, "the map is in use")

    def told_where() -> object:
        site.bus.put(Topic.POSE, messages.encode_pose("robot1", estimate(), UNIX_NS, 0))
        return fleet.last("visualization").get("mobileRobotPosition", {}).get("mapId") == "hall"

    until(told_where, "poses are on the new map")
    where = {"x": 3.0, "y": -2.0, "theta": 1.0}
    status, text = fleet.result("initPosition", **where, mapId="home")
    assert status == "FAILED" and "mapId: found 'home', expected 'hall'" in text and site.robot.calls == []
    assert fleet.result("initPosition", **where, mapId="hall")[0] == "FINISHED"
    assert site.robot.calls == [commands.InitialPose(3.0, -2.0, 1.0)]

    status, text = fleet.result("deleteMap", mapId="hall", mapVersion="7")
    assert status == "FAILED" and text == "hall 7: is in use, expected another one; enable another first"
    back = fleet.order("enableMap", mapId="home")
    until(lambda: fleet.told_of(back).get("actionStatus") == "RUNNING", "it waits for a start")
    until(lambda: "next start" in fleet.told_of(back)["actionResult"], "it is chosen")
    site.start_again()
    until(lambda: fleet.told_of(back)["actionStatus"] == "FINISHED", "it was taken")
    assert site.count() == 40
    assert fleet.result("deleteMap", mapId="hall", mapVersion="7") == ("FINISHED", "hall 7 is removed")
    until(lambda: fleet.maps() == {HOME: "ENABLED"}, "it is gone")
    assert fleet.result("deleteMap", mapId="hall", mapVersion="7")[0] == "FAILED"


def test_what_cannot_be_done_says_why_and_changes_nothing(site: Site) -> None:
    link = f"{site.link}/hall.json"
    for parameters, says in (
        ({}, "mapId: found nothing, expected a text"),
        ({"mapId": 3, "mapVersion": "7", "mapDownloadLink": link}, "mapId: found 3, expected a text"),
        ({"mapId": "hall", "mapDownloadLink": link}, "mapVersion: found nothing, expected a text"),
        ({"mapId": "hall", "mapVersion": "7"}, "mapDownloadLink: found nothing, expected a text"),
        ({"mapId": "hall", "mapVersion": "7", "mapDownloadLink": "file:///etc/passwd"}, "expected a link below"),
        ({"mapId": "hall", "mapVersion": "7", "mapDownloadLink": link, "mapHash": "00"}, "mapHash: found"),
        (
            {"mapId": "hall", "mapVersion": "7", "mapDownloadLink": f"{site.link}/none.json"},
            "none.json: did not come: No such",
        ),
        (
            {"mapId": "hall", "mapVersion": "7", "mapDownloadLink": f"{site.link}/bad.json"},
            "bad.json: not a ",
        ),
        ({"mapId": "hall", "mapVersion": "7", "mapDownloadLink": f"{site.link}/empty.json"}, "found 0 landmarks"),
        (
            {"mapId": "hall", "mapVersion": "7", "mapDownloadLink": f"{site.link}/huge.json"},
            f"found {MOST + 1} landmarks",
        ),
    ):
        status, text = site.fleet.result("downloadMap", **parameters)
        assert status == "FAILED" and says in text, (parameters, text)
    for kind in ("enableMap", "deleteMap"):
        status, text = site.fleet.result(kind, mapId="hall", mapVersion="7")
        assert status == "FAILED" and "is not here, expected one of: none" in text
    assert (
        site.fleet.result("deleteMap", mapId="home")[1] == "home: is in use, expected another one; enable another first"
    )
    assert site.fleet.maps() == {HOME: "ENABLED"} and site.count() == 40
    assert take_chosen(site.state_dir, "", HOME[0]) is None


def test_the_last_choice_counts_and_a_refused_one_fails(site: Site) -> None:
    fleet = site.fleet
    for version in ("7", "8"):
        given = {"mapId": "hall", "mapVersion": version}
        assert fleet.result("downloadMap", **given, mapDownloadLink=f"{site.link}/hall.json")[0] == "FINISHED"
    again = fleet.result("downloadMap", mapId="hall", mapVersion="8", mapDownloadLink=f"{site.link}/hall.json")
    assert again == ("FAILED", "hall 8: is here already, expected another mapVersion")
    first = fleet.order("enableMap", mapId="hall", mapVersion="7")
    until(lambda: "next start" in fleet.told_of(first).get("actionResult", ""), "it is chosen")
    second = fleet.order("enableMap", mapId="hall", mapVersion="8")
    until(lambda: fleet.told_of(first)["actionStatus"] == "FAILED", "it is not any more")
    assert "another map was chosen meanwhile: hall 8" in fleet.told_of(first)["actionResult"]
    until(lambda: "next start" in fleet.told_of(second).get("actionResult", ""), "the other one is")
    for path in (site.state_dir / "maps").glob("*8.map.json"):
        path.write_text("{}")
    taken = take_chosen(site.state_dir, "", HOME[0])
    assert taken is not None and not taken.ok
    until(lambda: fleet.told_of(second)["actionStatus"] == "FAILED", "the daemon refused it")
    assert "map hall 8 not taken" in fleet.told_of(second)["actionResult"]
    assert site.count() == 40 and fleet.maps()[HOME] == "ENABLED"


def test_secrets_that_cannot_be_used_are_said_at_the_start(tmp_path: Path) -> None:
    """Not at the first command."""
    file = tmp_path / "secret"
    file.write_text("0123456789abcdef\n")
    file.chmod(0o644)
    for settings, says in (
        (Config(vda5050=Vda5050(user="me", password_file=str(file))), "vda5050.password_file: .* read by everybody"),
        (Config(vda5050=Vda5050(user="me", password_file=str(tmp_path))), "vda5050.password_file: .*not a file"),
        (Config(zenoh=config.Zenoh(command_token_file=str(file))), "zenoh.command_token_file: .*read by everybody"),
    ):
        with pytest.raises(ConfigError, match=says):
            Adapter(settings, FleetMaps(settings))
    file.chmod(0o600)
    good = Config(vda5050=Vda5050(user="me", password_file=str(file)))
    Adapter(good, FleetMaps(good))
