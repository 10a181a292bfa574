"""The fleet's part of a daemon: a meeting in a process of its own, and the newest map taken at the start."""

from __future__ import annotations

import queue
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from fleet_parts import HALL, SERVICE, SIZE_M, held, running, survey, surveyed
from kept_maps import count
from patience import PATIENCE_S, until
from zenoh_world import free_port

from ceilvo.bench.fleet.robots import AXIS_RAD, key_of
from ceilvo.bench.fleet.world import Region, driven
from ceilvo.config import Config, Fleet, Zenoh
from ceilvo.daemon.fleet.robot.client import send
from ceilvo.daemon.fleet.robot.link import linked
from ceilvo.daemon.fleet.robot.part import part
from ceilvo.daemon.fleet.robot.store import FleetStore
from ceilvo.daemon.fleet.robot.sync import Met, Standing, make_offers, meet, standing_of, store_of, take_held, who_of
from ceilvo.daemon.fleet.service.ledger import Ledger
from ceilvo.daemon.fleet.service.server import Server
from ceilvo.daemon.fleet.service.tables import ledger_of
from ceilvo.daemon.fleet.tiles import joined
from ceilvo.daemon.map.database.content import MapContent
from ceilvo.daemon.map.database.copies import open_map
from ceilvo.errors import CeilvoError


@pytest.fixture
def port() -> int:
    return free_port()


@pytest.fixture
def server(tmp_path: Path, port: int) -> Iterator[Server]:
    yield from running(surveyed(tmp_path / "b.db", trusted=(0, 1)), port)


@pytest.fixture
def config(tmp_path: Path, port: int) -> Config:
    key = tmp_path / "robot.key"
    key.write_text(bytes([1] * 32).hex())
    key.chmod(0o600)
    zenoh = Zenoh(connect=(f"tcp/127.0.0.1:{port}",), multicast=False)
    return replace(Config(), zenoh=zenoh, fleet=Fleet(service=SERVICE, key_file=str(key), period_s=1.0))


def test_a_robot_begins_with_the_fleets_map_learns_offers_and_takes_the_next(
    server: Server, config: Config, tmp_path: Path
) -> None:
    path = tmp_path / "map.db"
    assert take_held(config, path) == ""
    met = meet(config, path, may_offer=True)
    assert met.is_news and met.reached and met.newer and met.said == ""
    assert met.standing == Standing(version=0, newest=1)
    assert take_held(config, path) == f"map of the fleet taken, {len(survey())} landmarks, 0 of them this robot's own"
    assert take_held(config, path) == ""
    with open_map(path) as db:
        region = Region(np.zeros(2), np.array(SIZE_M))
        learnt = driven(db.content().landmarks, HALL, region, np.zeros(2), np.random.default_rng(1))
        db.save(learnt, AXIS_RAD, "robot1/drive")
        frame = db.frame
    heard: queue.Queue[Met] = queue.Queue()
    offering = [False]
    with part(config, path, lambda: offering[0], heard.put, first_s=0.1):
        until(lambda: server.status()["requests"], "a meeting")
        assert server.status()["floors"] == {"": 1}, "nothing is offered while the robot does not know where it is"
        offering[0] = True
        met = heard.get(timeout=PATIENCE_S)
        while met.standing is None or met.standing.newest != 2:
            met = heard.get(timeout=PATIENCE_S)
        assert met.newer and met.standing == Standing(version=1, newest=2, offered=1)
    taken = take_held(config, path)
    assert taken.endswith("0 of them this robot's own")
    with open_map(path) as db:
        assert len(db.content().landmarks) == len(learnt)
        assert db.frame == frame, "the stored pose counts at the next start"
    assert standing_of(path) == Standing(version=2, newest=2, offered=1)


def test_a_map_that_was_reset_is_neither_offered_nor_mixed_with_the_fleets(
    server: Server, config: Config, tmp_path: Path
) -> None:
    path = tmp_path / "map.db"
    meet(config, path, may_offer=False)
    take_held(config, path)
    with open_map(path) as db:
        own = survey()
        turned = replace(own, xy_map_m=own.xy_map_m[:, ::-1] + 3.0)  # the same ids, elsewhere
        db.save(turned, AXIS_RAD, "robot1/anew", anew=True)
        found = db.hash
    met = meet(config, path, may_offer=True)
    assert met.reached and met.standing == Standing(version=1, newest=1)
    grown(tmp_path / "b.db", config, tmp_path)
    meet(config, path, may_offer=True)
    with pytest.raises(CeilvoError, match="none of the fleet's"):
        take_held(config, path)
    with open_map(path) as db:
        assert db.hash == found


def test_the_robot_whose_map_the_fleets_began_with_takes_the_next(tmp_path: Path, config: Config, port: int) -> None:
    service = tmp_path / "empty.db"
    with open_map(service, "", create=True), Ledger(ledger_of(service)) as ledger:
        for n in (0, 1):
            ledger.add_key(key_of(n).public, f"robot{n}", True, 0.0)
    with contextmanager(running)(service, port):
        path = tmp_path / "map.db"
        with open_map(path, create=True) as db:
            learnt = survey()
            db.save(replace(learnt, ids=learnt.ids + 70, expected=learnt.sightings), AXIS_RAD, "robot0/drive")
        met = meet(config, path, may_offer=True)
        assert met.reached and met.standing is not None and met.standing.offered == 1
        grown(service, config, tmp_path)
        met = meet(config, path, may_offer=True)
        assert met.newer and met.standing is not None
        said = take_held(config, path)
        assert said.startswith("map of the fleet taken, ") and said.endswith(" 0 of them this robot's own")
        with open_map(path) as db, open_map(service) as fleets:
            taken = db.content().landmarks.ids
            assert len(taken) > len(learnt) and np.all(np.isin(taken, fleets.content().landmarks.ids))
        met = meet(config, path, may_offer=True)
        assert met.standing is not None and met.standing.version >= 2
        assert met.standing.offered == 1, "nothing is told twice"


def test_a_version_that_is_older_than_the_last_offers_is_taken_too(tmp_path: Path, config: Config, port: int) -> None:
    """The robot was switched off between an offer and the version with it: its own map seemed to be none of the
    fleet's."""
    service, path = tmp_path / "empty.db", tmp_path / "map.db"
    with open_map(service, "", create=True), Ledger(ledger_of(service)) as ledger:
        ledger.add_key(key_of(0).public, "robot0", True, 0.0)
    whole, who = survey(), who_of(config)
    learnt, part_of_it = replace(whole, expected=whole.sightings), whole.xy_map_m[:, 0] < 4.0
    assert who is not None and 8 < np.count_nonzero(part_of_it) < 0.6 * len(whole)
    with contextmanager(running)(service, port), open_map(path, create=True) as db:
        db.save(learnt.of(part_of_it), AXIS_RAD, "robot0/drive")
        met = meet(config, path, may_offer=True)
        assert met.standing is not None and met.standing.offered == 1
        until(lambda: meet(config, path, may_offer=False).newer, "a version with it")
        before = count_held(path)
        twice = 2 * learnt.sightings  # what it told of it has seen again
        again = replace(learnt, cov_m2=0.5 * learnt.cov_m2, sightings=twice, expected=twice)
        db.save(again, AXIS_RAD, "robot0/drive")
        with FleetStore(store_of(path)) as store, linked(config.zenoh, config.fleet.service) as link:
            make_offers(db, store, who, 10**8)
            assert send(store, who, link).taken >= 1
        assert count_held(path) == before
        assert take_held(config, path).startswith(f"map of the fleet taken, {len(learnt)} landmarks, ")


def grown(service: Path, config: Config, tmp_path: Path) -> None:
    """Another robot drives through all of the hall and offers it; the service has it, but for what is at its gates."""
    folder = tmp_path / "other"
    folder.mkdir()
    key, path = folder / "robot.key", folder / "map.db"
    key.write_text(bytes([2] * 32).hex())
    key.chmod(0o600)
    other = replace(config, fleet=replace(config.fleet, key_file=str(key)))
    until(lambda: meet(other, path, may_offer=False).newer, "a version that is not empty")
    take_held(other, path)
    with open_map(path) as db:
        region = Region(np.zeros(2), np.array(SIZE_M))
        learnt = driven(db.content().landmarks, HALL, region, np.zeros(2), np.random.default_rng(2))
        db.save(learnt, AXIS_RAD, "other")
    met = meet(other, path, may_offer=True)
    assert met.standing is not None and met.standing.offered == 1, met
    most = round(0.95 * len(learnt))
    until(lambda: count(service) >= most, "all of it")
    until(lambda: meet(other, path, may_offer=False).reached and count_held(path) >= most, "its version")


def count_held(path: Path) -> int:
    """Landmarks of the newest version that is beside a robot's map."""
    with FleetStore(store_of(path)) as store:
        newest = held(store)
        return len(joined(store.tiles(newest), newest.tile_m)[0])


def test_a_service_that_is_away_is_said_once(config: Config, tmp_path: Path) -> None:
    met = meet(config, tmp_path / "map.db", may_offer=True)
    assert met.said.startswith("map service away: ") and not met.is_news and "\n" not in met.said


def test_a_map_of_its_own_is_not_replaced_at_a_start(server: Server, config: Config, tmp_path: Path) -> None:
    path = tmp_path / "map.db"
    with open_map(path, create=True) as db:
        db.edit(MapContent.of(survey(), AXIS_RAD), "learnt alone")
    assert meet(config, path, may_offer=False).is_news
    with pytest.raises(CeilvoError, match="none of the fleet's"):
        take_held(config, path)
    with open_map(path) as db:
        assert db.history()[0].what == "learnt alone" if db.history() else db.version == 1
