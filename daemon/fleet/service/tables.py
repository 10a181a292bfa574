"""Tables of a service's ledger, and how its file is opened; what is in them is ledger.py's."""

from __future__ import annotations

import sqlite3
from pathlib import Path

from ceilvo.daemon.map.database.faults import BUSY_S, make_file, reading
from ceilvo.errors import FileFormatError

APPLICATION_ID = 0x63656D64
"""PRAGMA application_id: `cemd` in ASCII."""
VERSION = 1
"""PRAGMA user_version."""
TABLES = (
    "CREATE TABLE keys (number INTEGER PRIMARY KEY AUTOINCREMENT, public BLOB NOT NULL UNIQUE, name TEXT NOT NULL,"
    " trusted INTEGER NOT NULL, added_s REAL NOT NULL, gone_s REAL, seq INTEGER NOT NULL DEFAULT 0)",
    "CREATE TABLE offers (number INTEGER PRIMARY KEY AUTOINCREMENT, id BLOB NOT NULL UNIQUE, key INTEGER NOT NULL,"
    " seq INTEGER NOT NULL, floor TEXT NOT NULL, state TEXT NOT NULL, at_s REAL NOT NULL, landmarks INTEGER NOT NULL,"
    " robot TEXT NOT NULL, session TEXT NOT NULL, begun_s REAL NOT NULL, last_s REAL NOT NULL, body BLOB)",
    "CREATE INDEX offers_by_key ON offers (key, number)",
    "CREATE INDEX offers_by_state ON offers (state)",
    "CREATE TABLE claims (floor TEXT NOT NULL, key INTEGER NOT NULL, ref INTEGER NOT NULL, kind INTEGER NOT NULL,"
    " lxx REAL NOT NULL, lxy REAL NOT NULL, lyy REAL NOT NULL, ex REAL NOT NULL, ey REAL NOT NULL,"
    " seen INTEGER NOT NULL, expected INTEGER NOT NULL, alone INTEGER NOT NULL, at_s REAL NOT NULL,"
    " PRIMARY KEY (floor, key, ref)) WITHOUT ROWID",
    "CREATE TABLE merges (floor TEXT NOT NULL, number INTEGER NOT NULL, at_s REAL NOT NULL, landmarks BLOB NOT NULL,"
    " removed BLOB NOT NULL, PRIMARY KEY (floor, number))",
    "CREATE TABLE floors (floor TEXT PRIMARY KEY, version INTEGER NOT NULL, root BLOB NOT NULL,"
    " next_id INTEGER NOT NULL, merged INTEGER NOT NULL)",
    "CREATE TABLE tiles (floor TEXT NOT NULL, ix INTEGER NOT NULL, iy INTEGER NOT NULL, hash BLOB NOT NULL,"
    " version INTEGER NOT NULL, PRIMARY KEY (floor, ix, iy)) WITHOUT ROWID",
    "CREATE TABLE counters (name TEXT PRIMARY KEY, value INTEGER NOT NULL) WITHOUT ROWID",
)
"""Offers keep their body until they are taken or rejected. Claims are what robots measured, as sums of information.
A merge is what claims became, kept until the last good copy of the map has it; the map counts the merges that it has
in its session `mapd`. Floors and tiles are what was published. No secret is in here."""
BESIDE = ".mapd"
"""What is added to the name of the database of maps."""


def ledger_of(path: Path) -> Path:
    return path.with_name(path.name + BESIDE)


def opened(path: Path, create: bool) -> sqlite3.Connection:
    """A ledger; every transaction is on the disk when it is done.

    Raises:
        FileFormatError: it cannot be used; DamagedError where it is damaged.
    """
    if not path.exists():
        if not create:
            raise FileFormatError(
                f"{path}: no such file, expected the ledger of a map service; 'ceilvod mapd run' makes it"
            )
        make_file(path, _make)
    with reading(path):
        db = sqlite3.connect(path, timeout=BUSY_S, isolation_level=None, check_same_thread=False)
        try:
            found = db.execute("PRAGMA application_id").fetchone()[0], db.execute("PRAGMA user_version").fetchone()[0]
            if found[0] != APPLICATION_ID or found[1] > VERSION:
                raise FileFormatError(
                    f"{path}: is {found}, expected the ledger {APPLICATION_ID, VERSION} of a map service"
                )
            db.execute("PRAGMA journal_mode = WAL")
            db.execute("PRAGMA synchronous = FULL")
            problem = db.execute("PRAGMA quick_check(1)").fetchone()[0]
            if problem != "ok":
                raise sqlite3.DatabaseError(f"quick_check says {problem}")
        except BaseException:
            db.close()
            raise
    return db


def _make(db: sqlite3.Connection) -> None:
    for statement in TABLES:
        db.execute(statement)
    db.execute(f"PRAGMA application_id = {APPLICATION_ID}")
    db.execute(f"PRAGMA user_version = {VERSION}")
