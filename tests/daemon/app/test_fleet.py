"""Daemons of a fleet and their map service as they are run: three programs and a router, simulated cameras."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
import zenoh
from kept_maps import count, load_database
from simulated_daemon import SimulatedDaemon

from ceilvo.bench.fleet.robots import SERVICE, key_of
from ceilvo.bench.fleet.site import Service, Watcher, free_port, router
from ceilvo.daemon.fleet.replies import MANIFEST, STATUS, service_key
from ceilvo.daemon.fleet.service.ledger import Ledger
from ceilvo.daemon.fleet.service.tables import ledger_of
from ceilvo.daemon.map.database.copies import open_map
from ceilvo.daemon.map.kept.store import MAP_NAME

TRUSTED, UNKNOWN = 0, 7
"""Robots by their keys."""


@dataclass
class Site:
    """A router and a service with one trusted key, which is not started yet."""

    folder: Path
    port: int
    service: Service

    def robot(self, number: int, *settings: str) -> SimulatedDaemon:
        """A daemon; its state stays from one of this number to the next."""
        state = self.folder / f"robot{number}"
        state.mkdir(exist_ok=True)
        key = self.folder / f"{number}.key"
        key.write_text(bytes([number + 1] * 32).hex())
        key.chmod(0o600)
        about = (f"fleet.service={SERVICE}", f"fleet.key_file={key}", "fleet.period_s=1")
        return SimulatedDaemon(state, state, *about, f"zenoh.connect=[tcp/127.0.0.1:{self.port}]", *settings)

    def map_of(self, number: int) -> Path:
        return self.folder / f"robot{number}" / MAP_NAME


@pytest.fixture
def site(tmp_path: Path) -> Iterator[Site]:
    port = free_port()
    service = Service(tmp_path, port, 0.2, policy="trusted")
    with open_map(service.path, "", create=True), Ledger(ledger_of(service.path)) as ledger:
        ledger.add_key(key_of(TRUSTED).public, "robot0", True, 0.0)
    session = router(port)
    try:
        yield Site(tmp_path, port, service)
    finally:
        service.kill()
        session.close()  # type: ignore[no-untyped-call]


def fleets(robot: SimulatedDaemon, name: str) -> object:
    """A figure of the health message's `fleet`; None before there is one."""
    found = robot.health("fleet")
    return found.get(name) if isinstance(found, dict) else None


def offered(robot: SimulatedDaemon) -> int:
    found = fleets(robot, "offered")
    return found if isinstance(found, int) else 0


def test_a_second_robot_begins_on_what_the_first_learnt(site: Site) -> None:
    site.service.start()
    with site.robot(TRUSTED) as first:
        first.until(lambda: count(site.service.path) >= 100, "offers that are taken")
        first.until(lambda: fleets(first, "newest"), "a version of them")
        assert first.end() == 0, first.said()
    learnt = load_database(site.map_of(TRUSTED))
    watcher = Watcher(site.port)
    watcher.until_up()
    watcher.close()
    assert learnt is not None
    with site.robot(1) as second:
        second.until(lambda: "stored map loaded, " in second.said(), "the fleet's map")
        assert "fleet: map of the fleet taken, " in second.said()
        second.until(lambda: fleets(second, "version"), "its version")
        second.until_poses(5)  # on half a lap's map a busy computer is not always sure of its place
        assert second.end() == 0, second.said()
    fetched = load_database(site.map_of(1))
    assert fetched is not None
    assert len(fetched.landmarks) >= 100
    apart = np.hypot(*(learnt.landmarks.xy_map_m[:, None] - fetched.landmarks.xy_map_m[None]).T).min(axis=0)
    assert np.mean(apart < 0.02) > 0.8, "one frame: the rest was learnt after its last offer"
    with site.robot(TRUSTED) as again:  # its own map has become the fleet's
        again.until(lambda: fleets(again, "version"), "a version that it stands on")
        assert "fleet: map of the fleet taken, " in again.said() and "none of the fleet's" not in again.said()


def test_it_drives_while_the_service_is_away_and_meets_it_when_it_is_back(site: Site) -> None:
    with site.robot(TRUSTED) as robot:
        robot.until(lambda: "-> TRACKING" in robot.said(), "localisation")
        assert robot.said().count("map service away") == 1
        robot.until(lambda: fleets(robot, "waiting"), "an offer that waits")
        assert fleets(robot, "contact_age_s") is None and "map service away" in str(fleets(robot, "error"))
        site.service.start()
        robot.until(lambda: offered(robot) >= 1, "an offer that is taken")
        robot.until(lambda: fleets(robot, "error") == "", "a contact")
        site.service.kill()
        robot.until(lambda: "map service away" in str(fleets(robot, "error")), "that it is away again")
        before = offered(robot)
        site.service.start()
        robot.until(lambda: fleets(robot, "error") == "" and fleets(robot, "waiting") == 0, "that it is back")
        robot.until(lambda: offered(robot) > before, "more offers")
        assert robot.end() == 0, robot.said()
    with open_map(site.service.path, "") as db:
        assert len(db.content().landmarks) >= 20


def test_a_stranger_teaches_the_fleet_nothing_and_drives_on(site: Site) -> None:
    site.service.start()
    with site.robot(UNKNOWN) as robot:
        robot.until(lambda: "fleet: an offer waits: key " in robot.said(), "that it is said")
        robot.until_poses(5)
        assert offered(robot) == 0
    assert count(site.service.path) == 0


def test_a_service_that_answers_nonsense_is_one_line_and_changes_nothing(site: Site) -> None:
    with site.robot(1, "fleet.service=") as robot:
        robot.until(lambda: count(site.map_of(1)) >= 20 and "-> TRACKING" in robot.said(), "a map of its own")
        assert robot.health("fleet") is None
        assert robot.end() == 0
    own = count(site.map_of(1))
    conf = zenoh.Config()
    conf.insert_json5("mode", '"client"')
    conf.insert_json5("connect/endpoints", f'["tcp/127.0.0.1:{site.port}"]')
    with zenoh.open(conf) as forger:
        for word in (STATUS, MANIFEST):
            key = service_key("ceilvo", SERVICE, word)
            forger.declare_queryable(key, lambda query, key=key: query.reply(key, b"\x28\xb5\x2f\xfd nonsense"))
        with site.robot(1, "fleet.key_file=") as robot:  # it fetches only
            robot.until(lambda: "fleet: manifest" in robot.said(), "that it is said")
            robot.until_poses(5)
            assert "fleet's map taken" not in robot.said()
            assert f"stored map loaded, {own} landmarks" in robot.said()
            assert robot.end() == 0
