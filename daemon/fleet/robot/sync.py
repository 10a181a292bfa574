"""One meeting of a robot with its map service: offers go out, the newest map comes to the robot's disk."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from ceilvo.config import Config
from ceilvo.daemon.fleet.keys import Signer
from ceilvo.daemon.fleet.robot.client import Drive, Sent, Who, is_newer_held, queue, recover, send, take_in
from ceilvo.daemon.fleet.robot.fetching import Fetched, fetch
from ceilvo.daemon.fleet.robot.link import AwayError, RefusedError, linked
from ceilvo.daemon.fleet.robot.store import HELD, NAME, OFFERS_REFUSED, OFFERS_TAKEN, TAKEN, FleetStore
from ceilvo.daemon.fleet.robot.taking import SAME_M
from ceilvo.daemon.fleet.wire import WireError
from ceilvo.daemon.map.database.content import MapContent
from ceilvo.daemon.map.database.copies import keep_copy, open_map
from ceilvo.daemon.map.database.database import MapDatabase
from ceilvo.daemon.map.kept.change import Change
from ceilvo.daemon.map.map_file import StoredMap
from ceilvo.errors import CeilvoError
from ceilvo.types import Array

OLD_NAME = "map.json"
"""The map of a daemon that has no database yet."""


def store_of(map_file: Path) -> Path:
    """Beside the map."""
    return map_file.with_name(NAME if map_file.name == "map.db" else f"{map_file.name}.{NAME}")


def who_of(config: Config) -> Who | None:
    """None for a robot that fetches only.

    Raises:
        ConfigError: its key cannot be used.
    """
    if not config.fleet.key_file:
        return None
    signer = Signer.read(Path(config.fleet.key_file))
    return Who(config.fleet.service, config.fleet.floor, config.robot.name, signer)


def make_offers(db: MapDatabase, store: FleetStore, who: Who, most_bytes: int) -> int:
    """What the robot's map has that the fleet was not told of waits as offers; how many were made.

    Raises:
        FileFormatError: a file cannot be read or written.
    """
    content = db.content()
    if not db.version:
        return 0
    recover(store, content.landmarks)
    last = content.sessions[-1:]
    drive = Drive(last[0].name, last[0].begun_s, last[0].last_s) if last else Drive()
    return queue(store, who, content.landmarks, content.axis_rad, drive, most_bytes)


@dataclass(frozen=True)
class Standing:
    """How a robot stands with its fleet.

    Attributes:
        version: that its map stands on; 0: none.
        newest: that is here whole; 0: none.
        offered: offers that the service took, since the store was made.
        refused: offers that it will never take.
        waiting: offers that wait to be sent.
    """

    version: int = 0
    newest: int = 0
    offered: int = 0
    refused: int = 0
    waiting: int = 0

    @staticmethod
    def of(store: FleetStore) -> Standing:
        """
        Raises:
            FileFormatError: the store cannot be read.
        """
        held, taken, counts = store.manifest(HELD), store.manifest(TAKEN), store.counters()
        version, newest = (0 if m is None else m.version for m in (taken, held))
        offered, refused = (counts.get(name, 0) for name in (OFFERS_TAKEN, OFFERS_REFUSED))
        return Standing(version, newest, offered, refused, len(store.waiting()))


@dataclass(frozen=True)
class Met:
    """
    Attributes:
        said: what happened, one line; "" where nothing did.
        is_news: it is worth a line in the log.
        reached: the service answered.
        newer: a version is here whole that the robot's map does not stand on.
        standing: afterwards; None where nobody knows.
    """

    said: str
    is_news: bool
    reached: bool = False
    newer: bool = False
    standing: Standing | None = None


def meet(config: Config, map_file: Path, may_offer: bool) -> Met:
    """Offer and fetch; the robot's map is not changed. Never raises what is ours: it is said.

    Args:
        may_offer: the robot knows where it is, so what its map has is worth an offer.
    """
    try:
        with FleetStore(store_of(map_file)) as store:
            try:
                met = _meet(config, map_file, store, may_offer)
            except AwayError as e:
                met = Met(f"map service away: {e}", False)
            except CeilvoError as e:
                met = Met(str(e), True, reached=isinstance(e, (RefusedError, WireError)))
            if store.rejected:
                met = replace(met, said="; ".join(filter(None, (store.rejected, met.said))), is_news=True)
            return replace(met, standing=Standing.of(store))
    except CeilvoError as e:
        return Met(str(e), True)


def _meet(config: Config, map_file: Path, store: FleetStore, may_offer: bool) -> Met:
    who, made = who_of(config), 0
    if who is not None and may_offer and map_file.exists():
        with MapDatabase(map_file, config.fleet.floor or None) as db:  # the daemon mends it, nobody else
            made = make_offers(db, store, who, config.fleet.waiting_bytes)
    with linked(config.zenoh, config.fleet.service) as link:
        sent = Sent(0) if who is None else send(store, who, link)
        try:
            found, wrong = fetch(store, link, config.fleet.floor), ""
        except (RefusedError, WireError) as e:
            found, wrong = Fetched(0, False, 0, 0), str(e)
    return _met(made, sent, found, is_newer_held(store), wrong)


def _met(made: int, sent: Sent, found: Fetched, is_newer: bool, wrong: str) -> Met:
    parts = [f"{sent.taken} offers taken"] if sent.taken else []
    parts += [f"offer refused: {line}" for line in sent.refused]
    parts += [f"an offer waits: {sent.waits}"] if sent.waits else []
    parts += [f"{found.refused} tiles refused"] if found.refused else []
    parts += [wrong] if wrong else []
    is_news = bool(made or found.is_new or sent.refused or found.refused)
    return Met("; ".join(parts), is_news, reached=True, newer=is_newer)


def take_held(config: Config, map_file: Path) -> str:
    """Put the robot's map on the newest version that is here, before anything reads it; what was done, for people.

    Raises:
        CeilvoError: it cannot be done; the map is as it was.
    """
    old = map_file.with_name(OLD_NAME)
    if not map_file.exists() and old.exists():  # the daemon imports it first
        return ""
    with FleetStore(store_of(map_file)) as store:
        if store.manifest(HELD) is None:
            return ""
        with open_map(map_file, config.fleet.floor or None, create=True) as db:
            return _take_held(config, db, store)


def _take_held(config: Config, db: MapDatabase, store: FleetStore) -> str:
    content = db.content()
    recover(store, content.landmarks)
    if not is_newer_held(store):
        return ""
    who = who_of(config)
    if who is not None:
        make_offers(db, store, who, config.fleet.waiting_bytes)

    def write(new: MapContent) -> None:
        db.edit(new, "map of the fleet", same_frame=_is_same_frame(content, new))
        keep_copy(db)

    new = take_in(store, content, write)
    count = len(new.content.landmarks)
    return f"map of the fleet taken, {count} landmarks, {new.own} of them this robot's own"


def _is_same_frame(before: MapContent, after: MapContent) -> bool:
    """Whether a pose on one is as good on the other: a start then looks for the robot where it was."""
    one, other = (StoredMap(c.landmarks, c.axis_rad) for c in (before, after))
    change = Change.between(one, other)
    return change is not None and all(change.moved_m(np.array([*xy, 0.0])) < SAME_M for xy in _corners(before))


def _corners(content: MapContent) -> Array:
    """(2, 2) of all its landmarks."""
    xy = content.landmarks.xy_map_m
    return np.stack([xy.min(axis=0), xy.max(axis=0)])


def standing_of(map_file: Path) -> Standing:
    """How the robot with this map stands with its fleet.

    Raises:
        FileFormatError: its store cannot be used.
    """
    with FleetStore(store_of(map_file)) as store:
        return Standing.of(store)
