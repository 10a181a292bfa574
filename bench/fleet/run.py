"""One run: service, router, robots in processes, kills; then the map, judged by the building as it is."""

from __future__ import annotations

import multiprocessing
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from multiprocessing.connection import Connection, wait
from pathlib import Path
from typing import Any

import numpy as np

from ceilvo.bench.fleet.hostile import LIES
from ceilvo.bench.fleet.robots import Crew, work
from ceilvo.bench.fleet.site import Service, Watcher, free_port, router, survey
from ceilvo.bench.fleet.world import Building
from ceilvo.daemon.fleet.service.agreement import SAME_M as CLAIM_M
from ceilvo.daemon.fleet.service.claims import is_placed, places_and_covariances
from ceilvo.daemon.fleet.service.ledger import Ledger
from ceilvo.daemon.fleet.service.tables import ledger_of
from ceilvo.daemon.map.database.copies import open_map
from ceilvo.daemon.slam.spatial_index import IndexedMap
from ceilvo.errors import CeilvoError
from ceilvo.types import Landmarks

SAME_M = 0.03
"""A landmark of the map is one of the building's within this; chosen: ten sigmas of a survey."""
ROUNDS_PER_HOUR = 6.0
"""A robot fetches and offers every ten minutes (fleet.period_s)."""


@dataclass(frozen=True)
class Plan:
    """
    Attributes:
        robots: in all; as many of them as `lies` has lie.
        kills: of the service, spread over the rounds.
        region_m: sides of what a robot sees in ten minutes.
    """

    robots: int = 50
    processes: int = 5
    rounds: int = 12
    kills: int = 10
    size_m: tuple[float, float] = (60.0, 40.0)
    surveyed_m: float = 20.0
    region_m: tuple[float, float] = (24.0, 10.0)
    round_s: float = 10.0
    renovated_at: int = 6
    lies: tuple[str, ...] = tuple(LIES)
    merge_period_s: float = 0.5
    seed: int = 1


@dataclass
class Outcome:
    robots: list[dict[str, Any]] = field(default_factory=list)
    kills: int = 0
    seconds: float = 0.0
    service_cpu_s: float = 0.0
    down_s: list[float] = field(default_factory=list)
    version: int = 0
    root: str = ""
    counters: dict[str, int] = field(default_factory=dict)
    map: Landmarks | None = None
    building: Building | None = None
    before: Building | None = None
    claimed: np.ndarray = field(default_factory=lambda: np.empty((0, 3)))


def run(plan: Plan, folder: Path, say: Callable[[str], None] = lambda text: None) -> Outcome:
    """
    Raises:
        CeilvoError: the service does not come back, or a process of robots died.
    """
    rng = np.random.default_rng(plan.seed)
    before = Building.new(plan.size_m, rng)
    after = before.renovated(0.02, rng)
    port = free_port()
    service = Service(folder, port, plan.merge_period_s)
    survey(service.path, before, np.zeros(2), np.array([plan.surveyed_m, plan.size_m[1]]), plan.robots, plan.seed)
    front = router(port)
    crews = _crews(plan, folder, port, (before, after))
    out, began = Outcome(before=before, building=after), time.monotonic()
    watcher = Watcher(port)
    try:
        service.start()
        watcher.until_up()
        pipes = [_started(crew) for crew in crews]
        _drive(plan, service, watcher, [pipe for _, pipe in pipes], out, rng, say)
        _settle(plan, watcher, [pipe for _, pipe in pipes], say)
        for process, pipe in pipes:
            pipe.send("end")
            out.robots += _heard(pipe, "report")
            process.join()
    finally:
        service.end()
        watcher.close()
        front.close()  # type: ignore[no-untyped-call]
    out.seconds, out.service_cpu_s = time.monotonic() - began, service.cpu_s
    _read(service, out)
    return out


def _crews(plan: Plan, folder: Path, port: int, buildings: tuple[Building, Building]) -> list[Crew]:
    every = max(plan.robots // max(len(plan.lies), 1), 1)
    lies = {min(n * every, plan.robots - 1): kind for n, kind in enumerate(plan.lies)}
    parts = np.array_split(np.arange(plan.robots), plan.processes)
    return [
        Crew(
            folder,
            port,
            tuple(part.tolist()),
            {n: k for n, k in lies.items() if n in part},
            buildings,
            plan.region_m,
            plan.rounds,
            plan.round_s,
            plan.renovated_at,
            plan.seed,
        )
        for part in parts
    ]


def _started(crew: Crew) -> tuple[multiprocessing.Process, Connection]:
    context = multiprocessing.get_context("spawn")
    here, there = context.Pipe()
    process = context.Process(target=work, args=(crew, there))
    process.start()
    there.close()
    return process, here  # type: ignore[return-value]


def _drive(
    plan: Plan,
    service: Service,
    watcher: Watcher,
    pipes: list[Connection],
    out: Outcome,
    rng: np.random.Generator,
    say: Callable[[str], None],
) -> None:
    """Until all rounds are driven; the service is killed while they are, at times that nobody planned."""
    driving, rounds = list(pipes), 0
    every = plan.rounds * plan.processes / max(plan.kills, 1)
    while driving or out.kills < plan.kills:
        ready = wait(driving, timeout=0.05)
        for pipe in [p for p in driving if p in ready]:
            word, turn = _recv(pipe)
            if word == "driven":
                driving.remove(pipe)
            else:
                rounds += 1
                say(f"round {turn + 1} of {plan.rounds} of a crew, {out.kills} kills")
        if out.kills < plan.kills and rounds >= (out.kills + 0.5) * every:
            time.sleep(rng.uniform(0.0, 1.0))
            service.kill()
            time.sleep(rng.uniform(0.0, 1.5))
            service.start()
            out.down_s.append(watcher.until_up())
            out.kills += 1


def _settle(plan: Plan, watcher: Watcher, pipes: list[Connection], say: Callable[[str], None]) -> None:
    """All that waits goes out, until the map grows no more; then everybody takes the last version."""
    while True:
        version, sent = _version(watcher), _all(pipes, "send")
        time.sleep(4.0 * plan.merge_period_s)
        say(f"settling, version {version}")
        if sent and version == _version(watcher):
            break
    while not _all(pipes, "take"):
        time.sleep(plan.merge_period_s)


def _version(watcher: Watcher) -> int:
    status = watcher.status()
    floors = {} if status is None else status["floors"]
    return int(floors.get("", -1)) if isinstance(floors, dict) else -1


def _all(pipes: list[Connection], word: str) -> bool:
    for pipe in pipes:
        pipe.send(word)
    answers = [_heard(pipe, "settled") for pipe in pipes]
    return all(answers)


def _heard(pipe: Connection, word: str) -> Any:
    while True:
        found, what = _recv(pipe)
        if found == word:
            return what


def _recv(pipe: Connection) -> tuple[str, Any]:
    try:
        word, what = pipe.recv()
    except EOFError as e:
        raise CeilvoError("a process of robots died; its error is above") from e
    return str(word), what


def _read(service: Service, out: Outcome) -> None:
    with open_map(service.path, "") as db, Ledger(ledger_of(service.path)) as ledger:
        out.map = db.content().landmarks
        claims = ledger.claims("")
        claims = claims[is_placed(claims)]
        out.claimed = np.column_stack([places_and_covariances(claims)[0], claims["kind"]])
        version, root, _, _ = ledger.floor("")
        out.version, out.root, out.counters = version, root.hex(), ledger.counters()


@dataclass(frozen=True)
class Judgement:
    """
    Attributes:
        landmarks: on the final map.
        covered: share of the building's landmarks that are on it.
        rms_m, worst_m: of their places against the building's.
        invented: landmarks of the map that the building never had.
        stale: landmarks that the building had before it was renovated.
        acknowledged, lost: new landmarks that honest robots were told the service has; and those of them that are still
            there, but neither on the map nor waiting for others to agree.
        behind: honest robots that do not hold the final version.
        waiting: offers of honest robots that still wait, for the map does not reach their ground.
    """

    landmarks: int
    covered: float
    rms_m: float
    worst_m: float
    invented: int
    stale: int
    acknowledged: int
    lost: int
    behind: int
    waiting: int


def judged(out: Outcome) -> Judgement:
    """By the building, which no robot knows."""
    assert out.map is not None and out.building is not None and out.before is not None
    m = out.map
    now, off = _nearest(_as_map(out.building), m.xy_map_m, m.crossing_type)
    before, _ = _nearest(_as_map(out.before), m.xy_map_m, m.crossing_type)
    there = now >= 0
    honest = [r for r in out.robots if not r["lie"]]
    return Judgement(
        len(m),
        len(np.unique(now[there])) / len(out.building.kind),
        float(np.sqrt(np.mean(off[there] ** 2))),
        float(np.max(off[there], initial=0.0)),
        int(np.count_nonzero(~there & (before < 0))),
        int(np.count_nonzero(~there & (before >= 0))),
        *_lost(out, m, [r["acknowledged"] for r in honest]),
        sum(r["root"] != out.root for r in honest),
        sum(r["waiting"] for r in honest),
    )


def _lost(out: Outcome, m: Landmarks, acknowledged: list[np.ndarray]) -> tuple[int, int]:
    """How many were acknowledged, and how many of them are lost."""
    assert out.building is not None
    said = np.concatenate(acknowledged)
    xy, kind = said[:, :2], said[:, 2].astype(np.int64)
    there = _nearest(_as_map(out.building), xy, kind)[0] >= 0
    on_map = _nearest(m, xy, kind, CLAIM_M)[0] >= 0
    count = len(out.claimed)
    zero, kinds = np.zeros(count, np.int64), out.claimed[:, 2].astype(np.int64)
    waiting = Landmarks(np.arange(count), out.claimed[:, :2], np.zeros((count, 2, 2)), kinds, zero, zero)
    waits = _nearest(waiting, xy, kind, CLAIM_M)[0] >= 0
    return len(said), int(np.count_nonzero(there & ~on_map & ~waits))


def _as_map(building: Building) -> Landmarks:
    count = len(building.kind)
    zero = np.zeros(count, np.int64)
    return Landmarks(np.arange(count), building.xy_m, np.zeros((count, 2, 2)), building.kind, zero, zero)


def _nearest(
    m: Landmarks, xy_m: np.ndarray, kind: np.ndarray, reach_m: float = SAME_M
) -> tuple[np.ndarray, np.ndarray]:
    return IndexedMap(m).nearest(xy_m, kind, reach_m)
