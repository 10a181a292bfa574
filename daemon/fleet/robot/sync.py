"""One meeting of a robot with its map service: offers go out, the newest map comes to the robot's disk."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from ceilvo.config import Config
from ceilvo.daemon.fleet.keys import Signer
from ceilvo.daemon.fleet.robot.client import Drive, Sent, Who, is_newer_held, queue, recover, send, take_in
from ceilvo.daemon.fleet.robot.fetching import Fetched, fetch
from ceilvo.daemon.fleet.robot.link import AwayError, linked
from ceilvo.daemon.fleet.robot.store import HELD, NAME, FleetStore
from ceilvo.daemon.map.database.content import MapContent
from ceilvo.daemon.map.database.copies import keep_copy, open_map
from ceilvo.daemon.map.database.database import MapDatabase
from ceilvo.errors import CeilvoError

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
class Met:
    """
    Attributes:
        said: what happened, one line; "" where nothing did.
        is_news: it is worth a line in the log.
    """

    said: str
    is_news: bool


def meet(config: Config, map_file: Path, may_offer: bool) -> Met:
    """Offer and fetch; the robot's map is not changed. Never raises what is ours: it is said.

    Args:
        may_offer: the robot knows where it is, so what its map has is worth an offer.
    """
    try:
        with FleetStore(store_of(map_file)) as store:
            who, made = who_of(config), 0
            if who is not None and may_offer and map_file.exists():
                with MapDatabase(map_file, config.fleet.floor or None) as db:  # the daemon mends it, nobody else
                    made = make_offers(db, store, who, config.fleet.waiting_bytes)
            with linked(config.zenoh, config.fleet.service) as link:
                sent = Sent(0) if who is None else send(store, who, link)
                found = fetch(store, link, config.fleet.floor)
            return _met(made, sent, found, is_newer_held(store))
    except AwayError as e:
        return Met(f"map service away: {e}", False)
    except CeilvoError as e:
        return Met(str(e), True)


def _met(made: int, sent: Sent, found: Fetched, is_newer: bool) -> Met:
    parts = [f"{sent.taken} offers taken"] if sent.taken else []
    parts += [f"offer refused: {line}" for line in sent.refused]
    parts += [f"an offer waits: {sent.waits}"] if sent.waits else []
    parts += [f"{found.refused} tiles refused"] if found.refused else []
    if is_newer:
        parts.append(f"version {found.version} of the map is here, the next start takes it")
    return Met("; ".join(parts), bool(made or found.is_new or sent.refused or found.refused))


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
        db.edit(new, "map of the fleet")
        keep_copy(db)

    new = take_in(store, content, write)
    count = len(new.content.landmarks)
    return f"map of the fleet taken, {count} landmarks, {new.own} of them this robot's own"
