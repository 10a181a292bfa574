"""A robot of a fleet: what it learnt goes out, what others learnt comes in. Each step is on disk before the next."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from ceilvo.daemon.editing.joining import GATE_CHI2, REACH_M, matches_by_place
from ceilvo.daemon.fleet.keys import Signer
from ceilvo.daemon.fleet.learnt import Told, gained, parts
from ceilvo.daemon.fleet.manifests import Manifest
from ceilvo.daemon.fleet.offers import Offer, signed
from ceilvo.daemon.fleet.replies import OFFER, REPLAYED, UNCHECKED, Reply
from ceilvo.daemon.fleet.robot.link import Link, RefusedError
from ceilvo.daemon.fleet.robot.store import HELD, OFFERS_REFUSED, OFFERS_TAKEN, TAKEN, TAKING, FleetStore, Waiting
from ceilvo.daemon.fleet.robot.taking import SAME_M, Renewed, taken_in
from ceilvo.daemon.fleet.tiles import joined
from ceilvo.daemon.map.database.content import MapContent
from ceilvo.errors import CeilvoError
from ceilvo.types import Landmarks

_LAST_SEQ = "last_seq"
FEWEST_KNOWN, SAME_SHARE = 8, 0.8
"""Landmarks that two maps of one frame must have in common, and how many of them where both say; chosen: as the service
asks of an offer."""
_NO_IDS = np.empty(0, np.int64)


@dataclass(frozen=True)
class Who:
    """A robot, as it signs its offers."""

    service: str
    floor: str
    robot: str
    signer: Signer


@dataclass(frozen=True)
class Drive:
    """The session that a map was learnt in; wall-clock times, s since 1970."""

    name: str = ""
    begun_s: float = 0.0
    last_s: float = 0.0


@dataclass(frozen=True)
class Sent:
    """
    Attributes:
        taken: offers that are on the service's disk.
        refused: what it said of those that it will never take; they wait no more.
        waits: what it said of the one that may be sent again, and when, s; "" and 0 where none waits.
    """

    taken: int
    refused: tuple[str, ...] = ()
    waits: str = ""
    wait_s: float = 0.0


def queue(
    store: FleetStore,
    who: Who,
    learnt: Landmarks,
    axis_rad: float,
    drive: Drive,
    most_bytes: int,
    clock_ns: Callable[[], int] = time.time_ns,
) -> int:
    """What the robot measured since it last told becomes offers that wait on its disk; how many.

    Where there is no room for an offer nothing is lost: the robot has not told of it then, and tells more later.

    Raises:
        FileFormatError: the store cannot be written.
    """
    recover(store, learnt)
    base, told = store.manifest(TAKEN), store.told()
    if base is not None:
        fleet = stands_on(store, base, learnt)
        if fleet is None:
            return 0
        told = Told(fleet, fleet.ids).with_(told)
    elif len(told.landmarks):  # the fleet may have begun with it; until that is here nothing more can be checked there
        base = store.manifest(HELD)
        fleet = None if base is None else joined(store.tiles(base), base.tile_m)[0]
        named = None if fleet is None else _as_the_fleet_calls(store, learnt, fleet)
        if named is None:
            return 0
        told = named
    news = gained(told, learnt)
    seq = max(clock_ns() // 1000, store.counters().get(_LAST_SEQ, 0))
    made, room = 0, most_bytes - store.waiting_bytes()
    for part in parts(news):
        seq += 1
        version = 0 if base is None else base.version
        times = drive.name, drive.begun_s, drive.last_s
        offer = Offer(who.service, who.floor, who.robot, seq, version, axis_rad, *times, news.rows[part])
        body = offer.packed()
        room -= len(body)
        if room < 0:
            store.count(offers_no_room=1)
            break
        which = part[np.argsort(news.now.landmarks.ids[part], kind="stable")]
        store.add_offers({seq: body}, Told(news.now.landmarks.of(which), news.now.refs[which]))
        store.raise_to(_LAST_SEQ, seq)
        made += 1
    return made


def send(store: FleetStore, who: Who, link: Link) -> Sent:
    """Send what waits, the oldest first, until the service has all of it or wants none now.

    Raises:
        AwayError: the service does not answer; what waits goes on waiting.
        FileFormatError: the store cannot be written.
    """
    taken, renumbered, again = 0, False, 0
    refused: list[str] = []
    said, wait_s = "", 0.0
    while waiting := store.waiting():
        first = waiting[0]
        if first.seq == again:
            return Sent(taken, tuple(refused), said, wait_s)
        offer = Offer.unpacked(first.body)
        try:
            Reply.unpacked(link.ask(OFFER, signed(offer, who.signer).packed())[0])
        except RefusedError as e:
            if e.refusal.why == REPLAYED and not renumbered:
                renumbered = True
                _renumber(store, waiting, e.refusal.last)
                continue
            if e.refusal.why == UNCHECKED and len(waiting) > 1:  # the others need not wait for it
                said, wait_s = str(e), e.refusal.wait_s
                last = _postpone(store, first)
                again = again or last
                continue
            if e.refusal.wait_s > 0.0:
                return Sent(taken, tuple(refused), str(e), e.refusal.wait_s)
            refused.append(str(e))
            store.offered(first.seq)
            store.count(**{OFFERS_REFUSED: 1})
            continue
        store.offered(first.seq)
        store.count(**{OFFERS_TAKEN: 1})
        taken += 1
    return Sent(taken, tuple(refused))


def _postpone(store: FleetStore, one: Waiting) -> int:
    """Behind all that wait; its new number."""
    seq = store.counters()[_LAST_SEQ] + 1
    store.raise_to(_LAST_SEQ, seq)
    store.renumber({one.seq: None, seq: replace(Offer.unpacked(one.body), seq=seq).packed()})
    return seq


def _renumber(store: FleetStore, waiting: list[Waiting], last: int) -> None:
    """Another disk of this robot, or a clock that was ahead, has used up these numbers."""
    seq = max(last, store.counters().get(_LAST_SEQ, 0))
    bodies: dict[int, bytes | None] = {one.seq: None for one in waiting}
    for one in waiting:
        seq += 1
        bodies[seq] = replace(Offer.unpacked(one.body), seq=seq).packed()
    store.renumber(bodies)
    store.raise_to(_LAST_SEQ, seq)


def is_newer_held(store: FleetStore) -> bool:
    """Whether a version is here whole, and not empty, that the robot's map does not stand on."""
    held, taken = store.manifest(HELD), store.manifest(TAKEN)
    return held is not None and bool(held.hashes) and (taken is None or held.root != taken.root)


def take_in(
    store: FleetStore, learnt: MapContent, write: Callable[[MapContent], None], replace_all: bool = False
) -> Renewed:
    """Put the robot's map on the newest version of the fleet's that is here.

    Args:
        write: brings the new map to the disk, all of it or nothing.
        replace_all: a map that does not stand on any version of the fleet's gives way to it.

    Raises:
        CeilvoError: there is none; or the robot's map is one of its own, so nobody knows how the two frames lie.
        FileFormatError: the store or the map cannot be read or written.
    """
    recover(store, learnt.landmarks)
    new = trial(store, learnt, replace_all)
    held = store.manifest(HELD)
    assert held is not None  # trial() looked
    store.intend(held, new.told, learnt.landmarks)
    write(new.content)
    store.settle(True)
    return new


def trial(store: FleetStore, learnt: MapContent, replace_all: bool = False) -> Renewed:
    """What take_in() would make of the robot's map; arguments and errors as there."""
    held, taken, told = store.manifest(HELD), store.manifest(TAKEN), store.told()
    if held is None:
        raise CeilvoError(f"{store.path}: no whole map of the fleet is here yet; fetch it first")
    fleet, seen_s = joined(store.tiles(held), held.tile_m)
    if len(fleet) < FEWEST_KNOWN:
        raise CeilvoError(
            f"version {held.version} of the fleet's map has {len(fleet)} landmarks, expected {FEWEST_KNOWN} or more: "
            "nobody could tell whether a map stands on it; it is taken once others have offered more"
        )
    before = _NO_IDS
    known = None if taken is None else stands_on(store, taken, learnt.landmarks)
    if known is not None:
        before = known.ids
    elif taken is not None or _as_the_fleet_calls(store, learnt.landmarks, fleet) is None:
        if len(learnt.landmarks) and not replace_all:
            raise CeilvoError(
                f"the robot's map has {len(learnt.landmarks)} landmarks and is none of the fleet's, so their frames "
                "may differ; ceilvod map fetch --replace takes the fleet's in its place"
            )
        learnt = replace(learnt, landmarks=learnt.landmarks.of(np.arange(0)), seen_s=np.empty((0, 2)), key_poses=())
        told = told.of_none()
    return taken_in(learnt, before, told, fleet, seen_s, held.axis_rad)


def stands_on(store: FleetStore, taken: Manifest, learnt: Landmarks) -> Landmarks | None:
    """The fleet's landmarks as the robot's map was put on them; None where it does not stand on them any more: it was
    reset, or another one is in its place.

    Raises:
        FileFormatError: the store cannot be read.
    """
    fleet, _ = joined(store.tiles(taken), taken.tile_m)
    return fleet if _agree(fleet, learnt) else None


def _agree(known: Landmarks, learnt: Landmarks) -> bool:
    """Whether what is known under the same ids is where it was."""
    _, i, j = np.intersect1d(known.ids, learnt.ids, assume_unique=True, return_indices=True)
    apart_m = np.hypot(*(known.xy_map_m[i] - learnt.xy_map_m[j]).T)
    same = (apart_m <= REACH_M) & (known.crossing_type[i] == learnt.crossing_type[j])
    return len(i) >= FEWEST_KNOWN and int(np.count_nonzero(same)) >= SAME_SHARE * len(i)


def _as_the_fleet_calls(store: FleetStore, learnt: Landmarks, fleet: Landmarks) -> Told | None:
    """What a robot told of before it took any map of the fleet's, by the names there, if that began with its own: the
    service took an offer, and all lies there where it lies on the robot's map. Else None.

    Places alone do not say so: a ceiling of tiles fits itself a tile further on. A version that is older than the last
    offers has only a part of them.
    """
    told = store.told()
    if not store.counters().get(OFFERS_TAKEN, 0) or not _agree(told.landmarks, learnt):
        return None
    m = matches_by_place(told.landmarks, fleet, GATE_CHI2)
    near = np.hypot(*(told.landmarks.xy_map_m[m.a] - fleet.xy_map_m[m.b]).T) <= SAME_M
    count = int(np.count_nonzero(near))
    if count < FEWEST_KNOWN or count < SAME_SHARE * min(len(told.landmarks), len(fleet)):
        return None
    refs = told.refs.copy()
    refs[m.a[near]] = fleet.ids[m.b[near]]
    return replace(told, refs=refs)


def recover(store: FleetStore, learnt: Landmarks) -> None:
    """After a process that was killed while it put the map on another version: was the map written?"""
    if store.manifest(TAKING) is not None:
        store.settle(not store.is_as_intended_from(learnt))
