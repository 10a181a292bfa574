"""A map service without a bus, robots that ask it, and maps of a small hall for both."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from patience import PATIENCE_S

from ceilvo.bench.fleet.robots import AXIS_RAD, key_of
from ceilvo.bench.fleet.world import Building, Region, driven
from ceilvo.config import Config, Mapd, Zenoh
from ceilvo.daemon.fleet.manifests import Manifest, Request, packed_page
from ceilvo.daemon.fleet.offers import Measured, Offer, measured, signed
from ceilvo.daemon.fleet.parts import unpacked_wanted
from ceilvo.daemon.fleet.replies import GONE_AGAIN, MANIFEST, OFFER, Refusal, Reply
from ceilvo.daemon.fleet.robot.client import Drive, Who, queue, send, take_in
from ceilvo.daemon.fleet.robot.fetching import fetch
from ceilvo.daemon.fleet.robot.link import AwayError, RefusedError
from ceilvo.daemon.fleet.robot.store import HELD, FleetStore
from ceilvo.daemon.fleet.service.curator import Curator
from ceilvo.daemon.fleet.service.ledger import Ledger
from ceilvo.daemon.fleet.service.server import Server
from ceilvo.daemon.fleet.service.tables import ledger_of
from ceilvo.daemon.map.database.content import MapContent
from ceilvo.daemon.map.database.copies import open_map
from ceilvo.types import Landmarks

SERVICE = "hall"
SIZE_M = (14.0, 10.0)
HALL = Building.new(SIZE_M, np.random.default_rng(5))
ALL = Region(np.zeros(2), np.array(SIZE_M))
KNOWN_M = 9.0
"""The survey goes so far along x."""
NOBODY = Landmarks(*(np.empty(shape) for shape in ((0,), (0, 2), (0, 2, 2), (0,), (0,)))).of(np.empty(0, np.int64))


def mapd(**changes: object) -> Mapd:
    return Mapd(**({"building": SERVICE, "policy": "quorum", "quorum": 2, "offers_per_hour": 1e6} | changes))  # type: ignore[arg-type]


def survey(known_m: float = KNOWN_M) -> Landmarks:
    which = HALL.within(np.zeros(2), np.array([known_m, SIZE_M[1]]))
    return HALL.as_map(which, 0.003, np.random.default_rng(6))


def surveyed(path: Path, robots: int = 4, known_m: float = KNOWN_M, trusted: tuple[int, ...] = ()) -> Path:
    """A database with the survey, and a ledger with the keys of robots."""
    with open_map(path, "", create=True) as db:
        db.edit(MapContent.of(survey(known_m), AXIS_RAD), "survey")
    with Ledger(ledger_of(path)) as ledger:
        for n in range(robots):
            ledger.add_key(key_of(n).public, f"robot{n}", n in trusted, 0.0)
    return path


@dataclass
class DirectLink:
    """Asks a curator in this process; `away` and `spoil` are faults of the way there and of answers."""

    curator: Curator
    away: bool = False
    spoil: Callable[[str, list[bytes]], list[bytes]] = lambda word, answers: answers
    asked: list[tuple[str, bytes]] = field(default_factory=list)

    def ask(self, word: str, payload: bytes) -> list[bytes]:
        if self.away:
            raise AwayError("away")
        self.asked.append((word, payload))
        return self.spoil(word, self._answers(word, payload))

    def _answers(self, word: str, payload: bytes) -> list[bytes]:
        if word == OFFER:
            (answer,) = self.curator.take([payload])
            if isinstance(answer, Refusal):
                raise RefusedError(answer)
            return [answer.packed()]
        if word == MANIFEST:
            request = Request.unpacked(payload)
            published = self.curator.published(request.floor)
            assert published is not None
            return [packed_page(published.page(request))]
        floor, wanted = unpacked_wanted(payload)
        published = self.curator.published(floor)
        assert published is not None
        parts = published.parts(wanted)
        if not parts:
            raise RefusedError(Refusal(GONE_AGAIN, "gone", 1.0))
        return parts


@dataclass
class Robot:
    """A robot with its store and its map."""

    number: int
    link: DirectLink
    store: FleetStore
    content: MapContent = field(default_factory=lambda: MapContent.of(NOBODY, AXIS_RAD))
    seed: int = 0

    @property
    def who(self) -> Who:
        return Who(SERVICE, "", f"robot{self.number}", key_of(self.number))

    def fetch(self) -> None:
        fetch(self.store, self.link, "")
        take_in(self.store, self.content, self._keep)

    def drive(self, region: Region = ALL, building: Building = HALL) -> None:
        rng = np.random.default_rng([self.number, self.seed])
        self.seed += 1
        m = driven(self.content.landmarks, building, region, np.zeros(2), rng)
        self.content = MapContent(m, np.zeros((len(m), 2)), AXIS_RAD)

    def tell(self, most_bytes: int = 10**8) -> int:
        """How many offers were made."""
        return queue(self.store, self.who, self.content.landmarks, AXIS_RAD, Drive("d", 1.0, 2.0), most_bytes)

    def offer(self) -> int:
        """How many offers were taken."""
        self.tell()
        return send(self.store, self.who, self.link).taken

    def _keep(self, content: MapContent) -> None:
        self.content = content


def robot(folder: Path, link: DirectLink, number: int) -> Robot:
    return Robot(number, link, FleetStore(folder / f"robot{number}.db"))


def rows_of(m: Landmarks, sigma_m: float = 0.004, views: int = 10) -> Measured:
    """As measured to be where they are."""
    n = np.full(len(m), views)
    cov = np.tile(sigma_m**2 * np.eye(2), (len(m), 1, 1))
    return measured(m.ids, m.xy_map_m, cov, m.crossing_type, n, n)


def offer(rows: Measured, number: int = 0, seq: int = 1, **changes: object) -> Offer:
    fields = {"service": SERVICE, "floor": "", "robot": f"robot{number}", "seq": seq, "base": 1, "axis_rad": AXIS_RAD}
    fields |= {"session": "d", "begun_s": 1.0, "last_s": 2.0, "rows": rows}
    return Offer(**(fields | changes))  # type: ignore[arg-type]


def told(curator: Curator, plain: Offer, number: int = 0) -> Reply | Refusal:
    """What the service says of an offer that a robot signed."""
    return curator.take([signed(plain, key_of(number)).packed()])[0]


MAP = survey()
TRUTH = HALL.xy_m[HALL.within(np.zeros(2), np.array([KNOWN_M, SIZE_M[1]]))]
"""(L, 2) where the survey's landmarks are."""
NEW = HALL.within(np.array([KNOWN_M + 0.01, 0.0]), np.array(SIZE_M))


def measured_known(count: int = 100, seed: int = 1, sigma_m: float = 0.004) -> Measured:
    """Known landmarks as a robot measures them."""
    rng = np.random.default_rng(seed)
    m = replace(MAP, xy_map_m=TRUTH + rng.normal(0.0, sigma_m, TRUTH.shape))
    return rows_of(m.of(np.sort(rng.permutation(len(MAP))[:count])), sigma_m)


def measured_new(count: int = 30, seed: int = 1, shift_m: float = 0.0) -> Measured:
    """Landmarks beyond the survey, as a robot measures them."""
    rng, which = np.random.default_rng(seed), NEW[:count]
    at = HALL.xy_m[which] + shift_m + rng.normal(0.0, 0.004, (count, 2))
    n = np.full(count, 10)
    return measured(
        -1 - 5000 - np.arange(count), at, np.tile(1.6e-5 * np.eye(2), (count, 1, 1)), HALL.kind[which], n, n
    )


def measured_both(seed: int = 1) -> Measured:
    return np.concatenate([measured_known(seed=seed), measured_new(seed=seed)])


def map_of(path: Path) -> Landmarks:
    with open_map(path, "") as db:
        return db.content().landmarks


def root(curator: Curator) -> bytes:
    published = curator.published("")
    assert published is not None
    return published.root


@dataclass
class Site:
    """A service on the survey of a part of the hall, with a quorum of two, and robots."""

    folder: Path
    curator: Curator
    link: DirectLink
    robots: list[Robot] = field(default_factory=list)

    def robot(self, number: int) -> Robot:
        self.robots.append(robot(self.folder, self.link, number))
        return self.robots[-1]

    @property
    def manifest(self) -> Manifest:
        published = self.curator.published("")
        assert published is not None
        return published.manifest

    def grows(self) -> None:
        """Two other robots drive through all of the hall and offer it."""
        for number in (2, 3):
            other = robot(self.folder, self.link, number)
            other.fetch()
            other.drive()
            assert other.offer() == 1
            other.store.close()
        assert self.curator.tick()


def held(store: FleetStore) -> Manifest:
    found = store.manifest(HELD)
    assert found is not None
    return found


def running(path: Path, port: int, policy: str = "approve") -> Iterator[Server]:
    """A service on a port, in a thread of this process."""
    mapd = Mapd(building=SERVICE, policy=policy, quorum=2, merge_period_s=0.1)
    zenoh = Zenoh(listen=(f"tcp/127.0.0.1:{port}",), multicast=False)
    curator = Curator(path, mapd)
    server, up = Server(curator, replace(Config(), mapd=mapd, zenoh=zenoh)), threading.Event()
    thread = threading.Thread(target=server.serve, args=(lambda text: up.set(),))
    thread.start()
    try:
        assert up.wait(PATIENCE_S)
        yield server
    finally:
        server.stopping.set()
        thread.join(PATIENCE_S)
        assert not thread.is_alive()
        curator.close()
