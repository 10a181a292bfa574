"""`ceilvod mapd`: the service itself, and a curator's words beside it. They work on its files, running or not."""

from __future__ import annotations

import argparse
import json
import logging
import time

from ceilvo.config import Config
from ceilvo.config.checks import cross_check
from ceilvo.config.reader import load_config
from ceilvo.config.reader import replace as replace_keys
from ceilvo.daemon.editing.picture import Change, draw
from ceilvo.daemon.editing.sources import write_picture
from ceilvo.daemon.fleet.keys import public_of
from ceilvo.daemon.fleet.offers import Offer, places_of
from ceilvo.daemon.fleet.service.curator import Curator
from ceilvo.daemon.fleet.service.ledger import APPROVED, PENDING, REJECTED, Entry, Key, Ledger
from ceilvo.daemon.fleet.service.server import Server
from ceilvo.daemon.fleet.service.tables import ledger_of
from ceilvo.daemon.map.database.copies import open_map
from ceilvo.drivers.host.signals import stop_on_signals
from ceilvo.drivers.host.systemd_notify import Notifier
from ceilvo.errors import CeilvoError, one_line

log = logging.getLogger("ceilvo.mapd")


def run(options: argparse.Namespace) -> int:
    config = replace_keys(Config(), options.set) if options.config is None else load_config(options.config, options.set)
    cross_check(config, None, str(options.config or "config"))
    curator = Curator(options.db, config.mapd)
    try:
        with Notifier() as notifier:
            server = Server(curator, config)
            log.info("%s: %s, policy %s", options.db, config.mapd.building, config.mapd.policy)
            with stop_on_signals(server.stopping):
                server.serve(notifier.ready, notifier.watchdog)
            notifier.stopping("stopping")
    finally:
        curator.close()
    return 0


def pending(options: argparse.Namespace) -> int:
    with Ledger(ledger_of(options.db), create=False) as ledger:
        entries = ledger.entries(PENDING)
        for e in entries:
            print(_line(e))
    print(f"{len(entries)} offers wait")
    return 0


def _line(e: Entry) -> str:
    when = time.strftime("%Y-%m-%d %H:%M:%S", time.localtime(e.at_s))
    session = f", {one_line(e.session, 60)}" if e.session else ""
    floor = f", floor {one_line(e.floor, 40)}" if e.floor else ""
    return f"{e.number:6d}  {when}  {one_line(e.key, 40)}{floor}: {e.landmarks} landmarks{session}"


def approve(options: argparse.Namespace) -> int:
    return _decide(options, APPROVED, "approved; the service takes them in at its next version")


def reject(options: argparse.Namespace) -> int:
    return _decide(options, REJECTED, "rejected")


def _decide(options: argparse.Namespace, state: str, said: str) -> int:
    with Ledger(ledger_of(options.db), create=False) as ledger:
        waiting = {e.number: e for e in ledger.entries(PENDING)}
        numbers = list(waiting) if options.all else options.numbers
        if unknown := [n for n in numbers if n not in waiting]:
            raise CeilvoError(
                f"offer {unknown[0]}: does not wait, expected one of those that 'ceilvod mapd pending' lists"
            )
        if not numbers:
            raise CeilvoError("no offer was named, expected their numbers, or --all")
        if options.png is not None:
            _draw(options, ledger, waiting[numbers[0]])
            return 0
        print(f"{ledger.set_state(numbers, PENDING, state)} offers {said}")
    return 0


def _draw(options: argparse.Namespace, ledger: Ledger, entry: Entry) -> None:
    rows = Offer.unpacked(ledger.body(entry.number)).rows
    with open_map(options.db, entry.floor, create=True) as db:
        content = db.content()
    new = places_of(rows[rows["ref"] < 0])
    image = draw(content, f"offer {entry.number} of {one_line(entry.key, 40)}: what is new", Change(added=new))
    write_picture(options.png, image)
    print(f"{options.png}: picture written")


def stats(options: argparse.Namespace) -> int:
    with Ledger(ledger_of(options.db), create=False) as ledger:
        floors = ledger.floor_names()
        counts = ledger.counters()
        versions = {name: ledger.floor(name)[0] for name in floors}
        waiting = {name: len(ledger.claims(name)) for name in floors}
        about = {
            "floors": versions,
            "keys": sum(not k.gone for k in ledger.keys().values()),
            "pending": len(ledger.entries(PENDING)),
            "waiting_landmarks": waiting,
            "counters": counts,
        }
    if options.json:
        print(json.dumps(about, indent=2))
        return 0
    for name in floors:
        print(f"{name or 'map':20} version {versions[name]}, {waiting[name]} landmarks wait for agreement")
    print(f"{'keys':20} {about['keys']}\n{'offers pending':20} {about['pending']}")
    for name, count in counts.items():
        print(f"{name.replace('_', ' '):20} {count}")
    return 0


def keys(options: argparse.Namespace) -> int:
    with open_map(options.db, "", create=True), Ledger(ledger_of(options.db)) as ledger:
        if options.add is not None:
            if options.key is None:
                raise CeilvoError(f"--add {options.add}: needs --key HEX, as 'ceilvod map key' prints it on the robot")
            _name_is_free(ledger, options.add, public_of(options.key))
            ledger.add_key(public_of(options.key), options.add, options.trusted, time.time())
        if options.remove is not None:
            ledger.remove_key(_named(ledger, options.remove).number, time.time())
        for k in ledger.keys().values():
            state = "taken back" if k.gone else "trusted" if k.trusted else "known"
            print(f"{k.public.hex()}  {state:10}  {one_line(k.name, 60)}")
    return 0


def _name_is_free(ledger: Ledger, name: str, public: bytes) -> None:
    if any(k.name == name and k.public != public and not k.gone for k in ledger.keys().values()):
        raise CeilvoError(f"--add {name}: another key has this name, expected a new one; --remove {name} first")


def _named(ledger: Ledger, name: str) -> Key:
    found = [k for k in ledger.keys().values() if k.name == name and not k.gone]
    if not found:
        raise CeilvoError(f"--remove {name}: no key of this name; 'ceilvod mapd keys' lists them")
    return found[0]
