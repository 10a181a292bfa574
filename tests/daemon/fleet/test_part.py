"""The fleet's part of a daemon: a meeting in a process of its own, and the newest map taken at the start."""

from __future__ import annotations

import logging
import queue
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from fleet_parts import HALL, SERVICE, SIZE_M, running, survey, surveyed
from patience import PATIENCE_S, until
from zenoh_world import free_port

from ceilvo.bench.fleet.robots import AXIS_RAD
from ceilvo.bench.fleet.world import Region, driven
from ceilvo.config import Config, Fleet, Zenoh
from ceilvo.daemon.fleet.robot.part import part
from ceilvo.daemon.fleet.robot.sync import meet, take_held
from ceilvo.daemon.fleet.service.server import Server
from ceilvo.daemon.map.database.content import MapContent
from ceilvo.daemon.map.database.copies import open_map
from ceilvo.errors import CeilvoError


@pytest.fixture
def port() -> int:
    return free_port()


@pytest.fixture
def server(tmp_path: Path, port: int) -> Iterator[Server]:
    yield from running(surveyed(tmp_path / "b.db", trusted=(0,)), port)


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
    assert met.is_news and met.said == "version 1 of the map is here, the next start takes it"
    assert take_held(config, path) == f"map of the fleet taken, {len(survey())} landmarks, 0 of them this robot's own"
    assert take_held(config, path) == ""
    with open_map(path) as db:
        region = Region(np.zeros(2), np.array(SIZE_M))
        learnt = driven(db.content().landmarks, HALL, region, np.zeros(2), np.random.default_rng(1))
        db.save(learnt, AXIS_RAD, "robot1/drive")
    said: queue.Queue[tuple[str, int]] = queue.Queue()
    offering = [False]
    with part(config, path, lambda: offering[0], lambda text, level: said.put((text, level)), first_s=0.1):
        until(lambda: server.status()["requests"], "a meeting")
        assert server.status()["floors"] == {"": 1}, "nothing is offered while the robot does not know where it is"
        offering[0] = True
        text, level = said.get(timeout=PATIENCE_S)
        while "version 2" not in text:
            text, level = said.get(timeout=PATIENCE_S)
        assert level == logging.INFO and text.startswith("fleet: ")
    taken = take_held(config, path)
    assert taken.endswith("0 of them this robot's own")
    with open_map(path) as db:
        assert len(db.content().landmarks) == len(learnt)


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
