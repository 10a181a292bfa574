"""`ceilvod map fetch`, `map offer` and `map key`."""

from __future__ import annotations

import argparse
import os
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass

from ceilvo.config import Config
from ceilvo.config.checks import cross_check
from ceilvo.config.reader import load_config
from ceilvo.config.reader import replace as replace_keys
from ceilvo.daemon.editing.joining import matches_by_id
from ceilvo.daemon.fleet import keys
from ceilvo.daemon.fleet.robot.client import Sent, Who, recover, send, take_in, trial
from ceilvo.daemon.fleet.robot.fetching import fetch as fetch_tiles
from ceilvo.daemon.fleet.robot.link import AwayError, linked
from ceilvo.daemon.fleet.robot.store import FleetStore
from ceilvo.daemon.fleet.robot.sync import make_offers, store_of, who_of
from ceilvo.daemon.map.database.content import MapContent
from ceilvo.daemon.map.database.copies import keep_copy, open_map
from ceilvo.daemon.map.database.database import MapDatabase
from ceilvo.drivers.host.ownership import owner_of_folder
from ceilvo.errors import ConfigError


@dataclass(frozen=True)
class _Robot:
    config: Config
    who: Who | None
    db: MapDatabase
    store: FleetStore


def fetch(options: argparse.Namespace) -> int:
    held = nullcontext() if options.dry_run else owner_of_folder(options.file.parent)
    with held, _opened(options) as robot:
        service = robot.config.fleet.service
        try:
            with linked(robot.config.zenoh, service) as link:
                if robot.who is not None and not options.dry_run:
                    _offer(robot, robot.who)
                    _say_sent(send(robot.store, robot.who, link))
                found = fetch_tiles(robot.store, link, robot.config.fleet.floor)
                bytes_in = link.bytes_in
        except AwayError as e:
            print(f"{service}: {e}")
            return 1
        refused = f", {found.refused} refused" if found.refused else ""
        came = f"{found.tiles} tiles came, {bytes_in} bytes{refused}" if found.is_new else "is the newest one"
        print(f"{service}: version {found.version} {came}")
        return _take(robot, options, found.version)


def _take(robot: _Robot, options: argparse.Namespace, version: int) -> int:
    before = robot.db.content()

    def write(content: MapContent) -> None:
        m = matches_by_id(before.landmarks, content.landmarks)
        moved = int((m.chi2 > 0).sum())
        would = "would get" if options.dry_run else "gets"
        print(
            f"{options.file}: {would} {len(m.only_b)} landmarks, loses {len(m.only_a)}, {moved} are moved; "
            f"{len(content.landmarks)} then"
        )
        if not options.dry_run:
            robot.db.edit(content, f"fetch version {version}")
            keep_copy(robot.db)

    if options.dry_run:
        write(trial(robot.store, before, options.replace).content)
        return 0
    new = take_in(robot.store, before, write, options.replace)
    print(f"{options.file}: done, hash {robot.db.hash[:12]}, {new.own} landmarks are this robot's own; start it again")
    return 0


def offer(options: argparse.Namespace) -> int:
    with _opened(options) as robot:
        if robot.who is None:
            raise ConfigError(
                "fleet.key_file: found nothing, expected this robot's key; ceilvod map key FILE makes one"
            )
        made = _offer(robot, robot.who)
        waiting = len(robot.store.waiting())
        print(f"{options.file}: {made} offers made, {waiting} wait")
        if options.dry_run or not waiting:
            return 0
        try:
            with linked(robot.config.zenoh, robot.who.service) as link:
                _say_sent(send(robot.store, robot.who, link))
        except AwayError as e:
            print(f"{robot.who.service}: {e}")
            return 1
    return 0


def key(options: argparse.Namespace) -> int:
    signer = keys.Signer.read(options.file) if os.path.lexists(options.file) else keys.make(options.file)
    print(signer.public.hex())
    return 0


def _offer(robot: _Robot, who: Who) -> int:
    return make_offers(robot.db, robot.store, who, robot.config.fleet.waiting_bytes)


def _say_sent(sent: Sent) -> None:
    if sent.taken:
        print(f"{sent.taken} offers are with the service")
    for line in sent.refused:
        print(f"refused: {line}")
    if sent.waits:
        print(f"waits {sent.wait_s:g} s: {sent.waits}")


@contextmanager
def _opened(options: argparse.Namespace) -> Iterator[_Robot]:
    config = replace_keys(Config(), options.set) if options.config is None else load_config(options.config, options.set)
    cross_check(config, None, str(options.config or "config"))
    if not config.fleet.service:
        raise ConfigError("fleet.service: found nothing, expected the building's name at its map service")
    who = who_of(config)
    with (
        open_map(options.file, config.fleet.floor or None, create=True) as db,
        FleetStore(store_of(options.file)) as store,
    ):
        stored = db.load()
        if stored is not None:
            recover(store, stored.landmarks)
        yield _Robot(config, who, db, store)
