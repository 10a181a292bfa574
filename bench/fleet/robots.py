"""Light robots in a process of their own, each with its Zenoh session, its store on disk and a map that is learnt."""

from __future__ import annotations

import json
import os
import re
import subprocess
import time
from collections import Counter
from dataclasses import dataclass, field, replace
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import numpy as np
import zenoh

from ceilvo.bench.fleet.hostile import Liar, told
from ceilvo.bench.fleet.world import BIAS_M, Building, Region, driven
from ceilvo.daemon.fleet.keys import Signer
from ceilvo.daemon.fleet.offers import Offer, Signed, signed
from ceilvo.daemon.fleet.replies import OFFER
from ceilvo.daemon.fleet.robot import client
from ceilvo.daemon.fleet.robot.fetching import fetch
from ceilvo.daemon.fleet.robot.link import AwayError, RefusedError, ZenohLink
from ceilvo.daemon.fleet.robot.store import HELD, FleetStore
from ceilvo.daemon.fleet.tiles import joined
from ceilvo.daemon.fleet.wire import WireError
from ceilvo.daemon.map.database.content import MapContent

SERVICE, AXIS_RAD = "hall", 0.1
WAITING_BYTES = 20_000_000


@dataclass(frozen=True)
class Crew:
    """What a process of robots is told.

    Attributes:
        numbers: of the robots.
        lies: kind of lie by number; the others are honest.
        region_m: sides of what a robot sees in a round.
        round_s: that a round takes at least; ten minutes pass in it.
        renovated_at: round from which on the building is another one.
    """

    folder: Path
    port: int
    numbers: tuple[int, ...]
    lies: dict[int, str]
    buildings: tuple[Building, Building]
    region_m: tuple[float, float]
    rounds: int
    round_s: float
    renovated_at: int
    seed: int


@dataclass
class Robot:
    number: int
    link: NotingLink
    store: FleetStore
    who: client.Who
    bias_m: np.ndarray
    rng: np.random.Generator
    content: MapContent | None = None
    away: int = 0
    answers: Counter[str] = field(default_factory=Counter)


@dataclass
class NotingLink(ZenohLink):
    """Notes what the service said that it has: own landmarks of the robot as x, y, kind (N, 3)."""

    acknowledged: list[np.ndarray] = field(default_factory=list)

    def ask(self, word: str, payload: bytes) -> list[bytes]:
        answers = super().ask(word, payload)
        if word == OFFER:
            rows = Offer.unpacked(Signed.unpacked(payload).body).rows
            own = rows[rows["ref"] < 0]
            self.acknowledged.append(np.column_stack([own[name] for name in ("x", "y", "kind")]))
        return answers


def key_of(number: int) -> Signer:
    return Signer.of(bytes([number + 1]) * 32)


def session(port: int) -> zenoh.Session:
    conf = zenoh.Config()
    for name, value in {
        "mode": "client",
        "connect/endpoints": [f"tcp/127.0.0.1:{port}"],
        "scouting/multicast/enabled": False,
        "transport/shared_memory/enabled": False,
    }.items():
        conf.insert_json5(name, json.dumps(value))
    return zenoh.open(conf)


def work(crew: Crew, to: Connection) -> None:
    """Rounds of fetching, driving and offering; then, as the parent says, all that waits, and the last version."""
    robots = [_robot(crew, n) for n in crew.numbers]
    heard: list[bytes] = []
    for turn in range(crew.rounds):
        building, began = crew.buildings[turn >= crew.renovated_at], time.monotonic()
        for robot in robots:
            if robot.number in crew.lies:
                _lie(robot, crew.lies[robot.number], heard)
            else:
                _drive(robot, crew, building, heard)
        time.sleep(max(0.0, crew.round_s - (time.monotonic() - began)))
        to.send(("round", turn))
    to.send(("driven", None))
    while (word := to.recv()) != "end":
        done = [_settle(robot, crew, word == "take") for robot in robots]
        to.send(("settled", all(done)))
    share = _socket_bytes(crew.port) / len(robots)
    to.send(("report", [_report(r, crew.lies.get(r.number, "")) | {"socket_bytes": share} for r in robots]))
    for robot in robots:
        robot.store.close()
        robot.link.session.close()  # type: ignore[no-untyped-call]


def _robot(crew: Crew, number: int) -> Robot:
    rng = np.random.default_rng([crew.seed, number])
    who = client.Who(SERVICE, "", f"robot{number}", key_of(number))
    link = NotingLink(session(crew.port), "ceilvo", SERVICE, timeout_s=5.0)
    store = FleetStore(crew.folder / f"robot{number}.db")
    return Robot(number, link, store, who, rng.normal(0.0, BIAS_M, 2), rng)


def _drive(robot: Robot, crew: Crew, building: Building, heard: list[bytes]) -> None:
    """A robot's ten minutes; what the service does not take or give now comes later."""
    _fetch_and_take(robot)
    if robot.content is None:
        return
    region = Region.anywhere(building.size_m, crew.region_m, robot.rng)
    learnt = driven(robot.content.landmarks, building, region, robot.bias_m, robot.rng)
    robot.content = replace(robot.content, landmarks=learnt, seen_s=np.zeros((len(learnt), 2)))
    _queue(robot)
    waiting = robot.store.waiting()
    heard += [signed(Offer.unpacked(w.body), robot.who.signer).packed() for w in waiting[:1]]
    _send(robot)


def _queue(robot: Robot) -> None:
    assert robot.content is not None
    drive = client.Drive(f"robot{robot.number}/drive", 1.0, 2.0)
    client.queue(robot.store, robot.who, robot.content.landmarks, AXIS_RAD, drive, WAITING_BYTES)


def _fetch_and_take(robot: Robot) -> bool:
    """Whether the newest version is here and under the robot's map."""
    try:
        fetch(robot.store, robot.link, "")
    except (AwayError, RefusedError, WireError):
        robot.away += 1
        return False
    if not client.is_newer_held(robot.store):
        return True
    if robot.content is not None:
        _queue(robot)
    empty = MapContent.of(joined({}, 8)[0], AXIS_RAD)

    def keep(content: MapContent) -> None:
        robot.content = content

    client.take_in(robot.store, robot.content or empty, keep)
    return True


def _send(robot: Robot) -> bool:
    """Whether nothing waits any more, but for what the map does not reach yet."""
    try:
        sent = client.send(robot.store, robot.who, robot.link)
    except AwayError:
        robot.away += 1
        return False
    robot.answers["taken"] += sent.taken
    for line in sent.refused:
        robot.answers[line] += 1
    if sent.waits:
        robot.answers["later"] += 1
    return not sent.waits or "known" in sent.waits


def _settle(robot: Robot, crew: Crew, take: bool) -> bool:
    if robot.number in crew.lies:
        return True
    return _fetch_and_take(robot) if take else _send(robot)


def _lie(robot: Robot, kind: str, heard: list[bytes]) -> None:
    try:
        fetch(robot.store, robot.link, "")
    except (AwayError, RefusedError, WireError):
        robot.away += 1
    held = robot.store.manifest(HELD)
    if held is None:
        return
    known, _ = joined(robot.store.tiles(held), held.tile_m)
    seq = time.time_ns() // 1000
    liar = Liar(SERVICE, f"robot{robot.number}", robot.who.signer, known, held.version, AXIS_RAD, robot.rng, heard, seq)
    for data in told(kind, liar):
        try:
            robot.link.ask(OFFER, data)
            robot.answers["taken"] += 1
        except RefusedError as e:
            robot.answers[e.refusal.why] += 1
        except AwayError:
            robot.away += 1


def _report(robot: Robot, lie: str) -> dict[str, Any]:
    held = robot.store.manifest(HELD)
    return {
        "robot": robot.number,
        "lie": lie,
        "version": 0 if held is None else held.version,
        "root": "" if held is None else held.root.hex(),
        "bytes_in": robot.link.bytes_in,
        "bytes_out": robot.link.bytes_out,
        "away": robot.away,
        "waiting": len(robot.store.waiting()),
        "acknowledged": np.concatenate([np.empty((0, 3)), *robot.link.acknowledged]),
        "counters": robot.store.counters(),
        "answers": dict(robot.answers),
    }


def _socket_bytes(port: int) -> float:
    """Both ways, TCP's payload of all connections of this process to the router; not a number without `ss`."""
    try:
        command = ["ss", "-tinpH", "dst", f"127.0.0.1:{port}"]
        lines = subprocess.run(command, capture_output=True, text=True, check=True).stdout.splitlines()
    except (OSError, subprocess.CalledProcessError):
        return float("nan")
    mine = [both for head, both in zip(lines[::2], lines[1::2], strict=False) if f"pid={os.getpid()}," in head]
    return float(sum(int(n) for text in mine for n in re.findall(r"bytes_(?:acked|received):(\d+)", text)))
