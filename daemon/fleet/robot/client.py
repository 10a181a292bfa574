"""A robot of a fleet: what it learnt goes out, what others learnt comes in. Each step is on disk before the next."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from ceilvo.daemon.fleet.keys import Signer
from ceilvo.daemon.fleet.learnt import Told, gained, parts
from ceilvo.daemon.fleet.offers import Offer, signed
from ceilvo.daemon.fleet.replies import OFFER, REPLAYED, UNCHECKED, Reply
from ceilvo.daemon.fleet.robot.link import Link, RefusedError
from ceilvo.daemon.fleet.robot.store import HELD, TAKEN, TAKING, FleetStore, Waiting
from ceilvo.daemon.fleet.robot.taking import Renewed, taken_in
from ceilvo.daemon.fleet.tiles import joined
from ceilvo.daemon.map.database.content import MapContent
from ceilvo.errors import CeilvoError
from ceilvo.types import Landmarks

_LAST_SEQ = "last_seq"


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
    base = store.manifest(TAKEN)
    told = store.told()
    if base is not None:
        fleet, _ = joined(store.tiles(base), base.tile_m)
        told = Told(fleet, fleet.ids).with_(told)
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
            store.count(offers_refused=1)
            continue
        store.offered(first.seq)
        store.count(offers_taken=1)
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
    """Whether a version is here whole that the robot's map does not stand on."""
    held, taken = store.manifest(HELD), store.manifest(TAKEN)
    return held is not None and (taken is None or held.root != taken.root)


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
    held, taken = store.manifest(HELD), store.manifest(TAKEN)
    if held is None:
        raise CeilvoError(f"{store.path}: no whole map of the fleet is here yet; fetch it first")
    if taken is None and len(learnt.landmarks) and not replace_all:
        raise CeilvoError(
            f"the robot's map has {len(learnt.landmarks)} landmarks and is none of the fleet's, so their frames may "
            "differ; --replace takes the fleet's in its place"
        )
    fleet, seen_s = joined(store.tiles(held), held.tile_m)
    if taken is None:
        learnt = replace(learnt, landmarks=learnt.landmarks.of(np.arange(0)), seen_s=np.empty((0, 2)), key_poses=())
        before, told = np.empty(0, np.int64), store.told().of_none()
    else:
        before, told = joined(store.tiles(taken), taken.tile_m)[0].ids, store.told()
    return taken_in(learnt, before, told, fleet, seen_s, held.axis_rad)


def recover(store: FleetStore, learnt: Landmarks) -> None:
    """After a process that was killed while it put the map on another version: was the map written?"""
    if store.manifest(TAKING) is not None:
        store.settle(not store.is_as_intended_from(learnt))
