"""Tables of a map database, their version, and how a file with them is made and opened."""

from __future__ import annotations

import contextlib
import os
import sqlite3
from collections.abc import Callable
from pathlib import Path

from ceilvo.daemon.map.checks import Damage
from ceilvo.daemon.map.database.faults import BUSY_S, Connection, look_at, make_file, note_open, reading
from ceilvo.daemon.map.database.rows import digest_of
from ceilvo.errors import FileFormatError

APPLICATION_ID = 0x6365696C
"""PRAGMA application_id: `ceil` in ASCII, so that other programs' databases are told apart."""
SCHEMA_VERSION = 2
"""PRAGMA user_version. Version 1 had no frames, no transitions, and did not count what a session did."""
CACHE_KIB = 20_000
"""Of the file in memory; chosen: 100,000 landmarks take 15 MB, and a save must not read from the disk."""
_LANDMARK = "x REAL, y REAL, xx REAL, xy REAL, yy REAL, kind INTEGER, sightings INTEGER, expected INTEGER"
_KEY_POSE = "stamp_ns INTEGER, x REAL, y REAL, theta REAL, cell INTEGER, motion BLOB, views BLOB, digest BLOB"
_FRAME = "frame TEXT NOT NULL DEFAULT ''"
_COUNTS = tuple(f"{name} INTEGER NOT NULL DEFAULT 0" for name in ("added", "faded", "refused"))
_SIDES_BEFORE = "sides_before BLOB"
_TRANSITIONS = (
    "CREATE TABLE transitions (id INTEGER PRIMARY KEY, name TEXT NOT NULL, kind TEXT NOT NULL,"
    " map INTEGER NOT NULL REFERENCES maps (id), x REAL NOT NULL, y REAL NOT NULL, theta REAL NOT NULL,"
    " digest BLOB NOT NULL, UNIQUE (name, map))"
)
"""A row is where one of them opens on one floor."""
TABLES = (
    "CREATE TABLE maps (id INTEGER PRIMARY KEY, floor TEXT NOT NULL UNIQUE, version INTEGER NOT NULL,"
    " hash TEXT NOT NULL, axis REAL NOT NULL, landmark_sum BLOB NOT NULL, key_pose_sum BLOB NOT NULL,"
    f" {_FRAME})",
    "CREATE TABLE landmarks (key INTEGER PRIMARY KEY, map INTEGER NOT NULL REFERENCES maps (id), id INTEGER NOT NULL,"
    f" {_LANDMARK}, first_seen_s REAL, last_seen_s REAL, UNIQUE (map, id))",
    "CREATE TABLE sessions (id INTEGER PRIMARY KEY, map INTEGER NOT NULL REFERENCES maps (id), name TEXT NOT NULL,"
    f" begun_s REAL, last_s REAL, saves INTEGER, edit INTEGER, digest BLOB, {', '.join(_COUNTS)}, UNIQUE (map, name))",
    "CREATE TABLE key_poses (key INTEGER PRIMARY KEY, map INTEGER NOT NULL REFERENCES maps (id),"
    f" session INTEGER NOT NULL REFERENCES sessions (id), {_KEY_POSE}, UNIQUE (session, stamp_ns))",
    "CREATE INDEX key_poses_by_cell ON key_poses (map, cell)",
    "CREATE TABLE edits (id INTEGER PRIMARY KEY AUTOINCREMENT, map INTEGER NOT NULL REFERENCES maps (id),"
    f" at_s REAL, what TEXT, hash_before TEXT, hash_after TEXT, axis_before REAL, {_SIDES_BEFORE})",
    "CREATE TABLE landmarks_before (edit INTEGER NOT NULL REFERENCES edits (id) ON DELETE CASCADE, key INTEGER,"
    f" map INTEGER, id INTEGER, {_LANDMARK}, first_seen_s REAL, last_seen_s REAL, PRIMARY KEY (edit, key))"
    " WITHOUT ROWID",
    "CREATE TABLE key_poses_before (edit INTEGER NOT NULL REFERENCES edits (id) ON DELETE CASCADE, key INTEGER,"
    f" map INTEGER, session INTEGER, {_KEY_POSE}, PRIMARY KEY (edit, key)) WITHOUT ROWID",
    _TRANSITIONS,
)
"""Of a landmark: place (m), covariance (m2), wall-clock times (s since 1970). `key` is the row, `id` the robot's name
for it. `frame` changes when an edit may have moved the map under a pose. In the tables `..._before` are rows as an edit
found them; with `map` NULL where it added one."""
RTREE = "CREATE VIRTUAL TABLE landmark_boxes USING rtree (key, x0, x1, y0, y1)"
GRID = (
    "CREATE TABLE landmark_cells (key INTEGER PRIMARY KEY, cell INTEGER NOT NULL)",
    "CREATE INDEX landmark_cells_by_cell ON landmark_cells (cell)",
)
"""Where a SQLite was compiled without R*Tree."""


def has_rtree() -> bool:
    with contextlib.closing(sqlite3.connect(":memory:")) as db:
        try:
            db.execute(RTREE)
        except sqlite3.OperationalError:
            return False
    return True


def create(path: Path, rtree: bool | None = None) -> None:
    """A new file with empty tables.

    Args:
        rtree: an R*Tree of landmarks, else a grid; None: as SQLite was compiled.

    Raises:
        FileFormatError: it cannot be written.
    """

    def fill(db: sqlite3.Connection) -> None:
        db.execute("PRAGMA journal_mode = DELETE")
        _make(db, has_rtree() if rtree is None else rtree)

    make_file(path, fill)


def _make(db: sqlite3.Connection, rtree: bool) -> None:
    for statement in (*TABLES, *((RTREE,) if rtree else GRID)):
        db.execute(statement)
    db.execute(f"PRAGMA application_id = {APPLICATION_ID}")
    db.execute(f"PRAGMA user_version = {SCHEMA_VERSION}")


_NO_ROOM = ("disk I/O", "unable to open", "full")
"""What SQLite's messages have in them where the disk has no room for the file that programs share, NAME-shm."""


def connect(path: Path) -> sqlite3.Connection:
    """Open a file that is there, and bring older tables up to date.

    The journal is a write-ahead log: readers do not wait for a save, and a save that is cut off by kill -9 is not in
    it. `synchronous = FULL` flushes it at every save: robots are switched off at the wall, and with NORMAL all saves
    since the last checkpoint, minutes of them, could go then. It costs 2 to 7 ms of a save on an SSD. On a disk without
    room for NAME-shm it is read all the same, with that in memory and nobody else's meanwhile.

    Raises:
        FileFormatError: it cannot be read, or is of a newer ceilvo; DamagedError where it is none of our databases.
    """
    look_at(path)
    with reading(path):
        try:
            return _connected(path, shared=True)
        except sqlite3.OperationalError as e:
            if not any(word in str(e) for word in _NO_ROOM):
                raise
            return _connected(path, shared=False)


def _connected(path: Path, shared: bool) -> sqlite3.Connection:
    name, journal = (_unchanging(path), "OFF") if _is_read_only(path) else (path, "WAL")
    db = Connection(name, timeout=BUSY_S, isolation_level=None, check_same_thread=False, uri=name != path)
    try:
        note_open(path, db)
        if not shared:
            db.execute("PRAGMA locking_mode = EXCLUSIVE")
        _look_at_version(path, db)
        db.execute("PRAGMA foreign_keys = ON")
        db.execute("PRAGMA trusted_schema = OFF")
        db.execute(f"PRAGMA journal_mode = {journal}")
        db.execute("PRAGMA synchronous = FULL")
        db.execute(f"PRAGMA cache_size = -{CACHE_KIB}")
        _migrate(db)
        _look_at_tables(path, db)
    except BaseException:
        db.close()
        raise
    return db


def is_provisional(db: sqlite3.Connection) -> bool:
    """Whether it was opened on a disk that was full or read-only: to write to it later it must be opened again."""
    modes = (str(db.execute(f"PRAGMA {name}").fetchone()[0]) for name in ("locking_mode", "journal_mode"))
    return tuple(modes) != ("normal", "wal")


def _is_read_only(path: Path) -> bool:
    """Whether nobody can write a log beside it, and none is left there: it can be read as it lies."""
    log = path.with_name(f"{path.name}-wal")
    return not os.access(path.parent, os.W_OK) and not log.exists()


def _unchanging(path: Path) -> str:
    return f"{path.absolute().as_uri()}?immutable=1"


def _look_at_version(path: Path, db: sqlite3.Connection) -> None:
    ours = pragma(db, "application_id")
    if ours != APPLICATION_ID:
        raise Damage(f"application_id is {ours}, expected {APPLICATION_ID} of a database of maps")
    version = pragma(db, "user_version")
    if version > SCHEMA_VERSION:
        raise FileFormatError(
            f"{path}: tables of version {version} were written by a newer ceilvo, this one reads up to "
            f"{SCHEMA_VERSION}; update it"
        )
    if version < 1:
        raise Damage(f"user_version is {version}, expected a whole number from 1 to {SCHEMA_VERSION}")


def _migrate(db: sqlite3.Connection) -> None:
    for version in range(pragma(db, "user_version"), SCHEMA_VERSION):
        db.execute("BEGIN IMMEDIATE")
        MIGRATIONS[version](db)
        db.execute(f"PRAGMA user_version = {version + 1}")
        db.execute("COMMIT")


def _from_1(db: sqlite3.Connection) -> None:
    db.execute(f"ALTER TABLE maps ADD COLUMN {_FRAME}")
    db.execute("UPDATE maps SET frame = hash")
    db.execute(f"ALTER TABLE edits ADD COLUMN {_SIDES_BEFORE}")
    before = db.execute("SELECT id, name, begun_s, last_s, saves, digest FROM sessions").fetchall()
    for count in _COUNTS:
        db.execute(f"ALTER TABLE sessions ADD COLUMN {count}")
    for number, *values, written in before:
        if written == digest_of(*values):  # what was damaged stays so
            db.execute("UPDATE sessions SET digest = ? WHERE id = ?", (digest_of(*values, 0, 0, 0), number))
    db.execute(_TRANSITIONS)


MIGRATIONS: dict[int, Callable[[sqlite3.Connection], None]] = {1: _from_1}
"""From a version to the next, within a transaction."""


def _look_at_tables(path: Path, db: sqlite3.Connection) -> None:
    """Exactly ours: a trigger or a view of somebody else's would run with our statements."""
    found = _tables(db)
    with contextlib.closing(sqlite3.connect(":memory:")) as fresh:
        rtree = "landmark_boxes" in found
        if rtree and not has_rtree():
            raise FileFormatError(
                f"{path}: has an R*Tree, which this SQLite cannot read; export it on the other computer"
            )
        _make(fresh, rtree)
        wrong = sorted(name for name, _ in found.items() ^ _tables(fresh).items())
    if wrong:
        raise Damage(f"tables are not those of version {SCHEMA_VERSION}: {', '.join(wrong)[:60]}")


def _tables(db: sqlite3.Connection) -> dict[str, str]:
    """Names and how they were made; what the R*Tree makes for itself differs between versions of SQLite."""
    rows = db.execute("SELECT name, sql FROM sqlite_master WHERE name NOT LIKE 'sqlite_%'")
    return {name: "" if name.startswith("landmark_boxes_") else str(sql) for name, sql in rows}


def pragma(db: sqlite3.Connection, name: str) -> int:
    """One of SQLite's settings, by a name that is ours."""
    return int(db.execute(f"PRAGMA {name}").fetchone()[0])


def is_same(path: Path, inode: int) -> bool:
    """Whether the file is still the one that was opened."""
    try:
        return path.stat().st_ino == inode
    except OSError:
        return False
