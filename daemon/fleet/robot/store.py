"""What a robot keeps of its fleet in a file beside its map: the floor's tiles, what it told of, offers that wait.

Everything is committed piece by piece, so that whatever is cut off goes on where it stopped.
"""

from __future__ import annotations

import sqlite3
from collections.abc import Iterable, Mapping
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ceilvo.daemon.fleet.learnt import Told
from ceilvo.daemon.fleet.manifests import Manifest
from ceilvo.daemon.fleet.tiles import Place, hash_of
from ceilvo.daemon.map.database.faults import BUSY_S, DamagedError, make_file, reading, transaction
from ceilvo.daemon.map.database.rows import ROW, landmarks_of_rows, rows_of
from ceilvo.errors import FileFormatError
from ceilvo.files import set_aside
from ceilvo.types import Landmarks

NAME = "fleet.db"
APPLICATION_ID = 0x63656672
"""PRAGMA application_id: `cefr` in ASCII."""
VERSION = 1
HELD, NEXT, TAKEN, TAKING = "held", "next", "taken", "taking"
"""Manifests: the newest one that is here whole, the one that is being fetched, the one that the robot's map stands on,
and the one that it is being put on."""
OFFERS_TAKEN, OFFERS_REFUSED = "offers_taken", "offers_refused"
"""Counters of what the service said."""
_TABLES = (
    "CREATE TABLE tiles (hash BLOB PRIMARY KEY, data BLOB NOT NULL, size INTEGER NOT NULL) WITHOUT ROWID",
    "CREATE TABLE manifests (which TEXT PRIMARY KEY, floor TEXT NOT NULL, version INTEGER NOT NULL, axis REAL NOT NULL,"
    " tile_m INTEGER NOT NULL)",
    "CREATE TABLE entries (which TEXT NOT NULL, ix INTEGER NOT NULL, iy INTEGER NOT NULL, hash BLOB NOT NULL,"
    " PRIMARY KEY (which, ix, iy)) WITHOUT ROWID",
    "CREATE TABLE told (id INTEGER PRIMARY KEY, ref INTEGER NOT NULL, landmark BLOB NOT NULL)",
    "CREATE TABLE told_next (id INTEGER PRIMARY KEY, ref INTEGER NOT NULL, landmark BLOB NOT NULL)",
    "CREATE TABLE intended (digest BLOB NOT NULL)",
    "CREATE TABLE waiting (seq INTEGER PRIMARY KEY, body BLOB NOT NULL)",
    "CREATE TABLE counters (name TEXT PRIMARY KEY, value INTEGER NOT NULL) WITHOUT ROWID",
)
"""Of a tile that is on its way `data` is what has come of `size` bytes. `told` has landmarks as the robot last told of
them, where that is not as the fleet's map has them."""


@dataclass(frozen=True)
class Waiting:
    seq: int
    body: bytes


class FleetStore:
    """One thread at a time."""

    def __init__(self, path: Path) -> None:
        """Open, or make where there is none. One that is damaged is set aside: the fleet has all that was in it, but
        for offers that waited, which come from the map again.

        Raises:
            FileFormatError: it cannot be used.
        """
        self.path = path
        try:
            self._db = _opened(path)
        except DamagedError as e:
            for end in ("-wal", "-shm"):
                path.with_name(path.name + end).unlink(missing_ok=True)
            self.rejected = f"{e}; set aside as {set_aside(path).name}, all is fetched again"
            self._db = _opened(path)
        else:
            self.rejected = ""

    def close(self) -> None:
        self._db.close()

    def __enter__(self) -> FleetStore:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def change(self) -> AbstractContextManager[sqlite3.Connection]:
        """One transaction, see faults.transaction."""
        return transaction(self.path, self._db)

    # -- manifests and tiles

    def manifest(self, which: str) -> Manifest | None:
        with reading(self.path):
            query = "SELECT floor, version, axis, tile_m FROM manifests WHERE which = ?"
            row = self._db.execute(query, (which,)).fetchone()
            if row is None:
                return None
            found = self._db.execute("SELECT ix, iy, hash FROM entries WHERE which = ?", (which,))
            hashes = {(int(ix), int(iy)): bytes(h) for ix, iy, h in found}
        return Manifest(str(row[0]), int(row[1]), float(row[2]), int(row[3]), hashes)

    def set_manifest(self, which: str, manifest: Manifest) -> None:
        with self.change() as db:
            _set_manifest(db, which, manifest)

    def complete(self, manifest: Manifest) -> None:
        """All of its tiles are here: it becomes what is held, and tiles that nothing needs go."""
        with self.change() as db:
            _set_manifest(db, HELD, manifest)
            _remove_manifest(db, NEXT)
            db.execute("DELETE FROM tiles WHERE hash NOT IN (SELECT hash FROM entries)")

    def missing(self, manifest: Manifest) -> dict[bytes, tuple[int, int]]:
        """Hashes of tiles that are not here whole: how many bytes are, and of how many (0: not known)."""
        with reading(self.path):
            rows = self._db.execute("SELECT hash, length(data), size FROM tiles")
            there = {bytes(h): (int(n), int(size)) for h, n, size in rows}
        parts = {h: there.get(h, (0, 0)) for h in manifest.hashes.values()}
        return {h: part for h, part in parts.items() if not part[1] or part[0] < part[1]}

    def add_parts(self, parts: Iterable[tuple[bytes, int, int, bytes]]) -> tuple[int, int]:
        """Hash, size, at and bytes of parts that follow what is here; how many tiles are whole now, and how many were
        not what their hash says: they are thrown away."""
        whole = refused = 0
        with self.change() as db:
            for name, size, at, data in parts:
                row = db.execute("SELECT data FROM tiles WHERE hash = ?", (name,)).fetchone()
                so_far = b"" if row is None else bytes(row[0])
                if at != len(so_far):
                    continue
                so_far += data
                if len(so_far) == size and hash_of(so_far) != name:
                    refused += 1
                    db.execute("DELETE FROM tiles WHERE hash = ?", (name,))
                    continue
                whole += len(so_far) == size
                db.execute("INSERT OR REPLACE INTO tiles VALUES (?, ?, ?)", (name, so_far, size))
        return whole, refused

    def tiles(self, manifest: Manifest) -> dict[Place, bytes]:
        """All of a manifest that is here whole.

        Raises:
            FileFormatError: one is not here, or is not what its hash says.
        """
        out = {}
        with reading(self.path):
            for place, name in manifest.hashes.items():
                row = self._db.execute("SELECT data FROM tiles WHERE hash = ?", (name,)).fetchone()
                if row is None or hash_of(bytes(row[0])) != name:
                    raise FileFormatError(f"{self.path}: damaged: tile {place} is not what its hash says; remove it")
                out[place] = bytes(row[0])
        return out

    # -- what was told

    def told(self) -> Told:
        """Landmarks that the robot told of since it took the fleet's map."""
        with reading(self.path):
            rows = self._db.execute("SELECT ref, landmark FROM told ORDER BY id").fetchall()
        table = np.frombuffer(b"".join(bytes(data) for _, data in rows), ROW)
        return Told(landmarks_of_rows(table)[0], np.array([ref for ref, _ in rows], np.int64))

    def intend(self, manifest: Manifest, told: Told, learnt: Landmarks) -> None:
        """The robot's map, as it is now, is about to be put on a manifest, its own landmarks staying told as here."""
        with self.change() as db:
            _set_manifest(db, TAKING, manifest)
            db.execute("DELETE FROM intended")
            db.execute("INSERT INTO intended VALUES (?)", (_digest(learnt),))
            db.execute("DELETE FROM told_next")
            _tell(db, told, "told_next")

    def is_as_intended_from(self, learnt: Landmarks) -> bool:
        """Whether the map is still as it was when it was about to be put on another manifest."""
        with reading(self.path):
            row = self._db.execute("SELECT digest FROM intended").fetchone()
        return row is not None and bytes(row[0]) == _digest(learnt)

    def settle(self, done: bool) -> None:
        """Whether it was."""
        with self.change() as db:
            if done:
                _remove_manifest(db, TAKEN)
                db.execute("UPDATE manifests SET which = ? WHERE which = ?", (TAKEN, TAKING))
                db.execute("UPDATE entries SET which = ? WHERE which = ?", (TAKEN, TAKING))
                db.execute("DELETE FROM told")
                db.execute("INSERT INTO told SELECT * FROM told_next")
            _remove_manifest(db, TAKING)
            db.execute("DELETE FROM told_next")

    # -- offers that wait

    def add_offers(self, bodies: Mapping[int, bytes], told: Told) -> None:
        """Offers by their numbers, and with them what the robot has told."""
        with self.change() as db:
            db.executemany("INSERT INTO waiting VALUES (?, ?)", bodies.items())
            _tell(db, told)

    def waiting(self) -> list[Waiting]:
        """The oldest first."""
        with reading(self.path):
            return [
                Waiting(int(seq), bytes(body)) for seq, body in self._db.execute("SELECT * FROM waiting ORDER BY seq")
            ]

    def waiting_bytes(self) -> int:
        with reading(self.path):
            return int(self._db.execute("SELECT coalesce(sum(length(body)), 0) FROM waiting").fetchone()[0])

    def offered(self, seq: int) -> None:
        """One waits no more."""
        with self.change() as db:
            db.execute("DELETE FROM waiting WHERE seq = ?", (seq,))

    def renumber(self, bodies: Mapping[int, bytes | None]) -> None:
        """Offers that wait under other numbers; None where one goes."""
        with self.change() as db:
            db.executemany("DELETE FROM waiting WHERE seq = ?", ((seq,) for seq in bodies))
            rows = [(seq, body) for seq, body in bodies.items() if body is not None]
            db.executemany("INSERT INTO waiting VALUES (?, ?)", rows)

    # -- counters

    def count(self, **more: int) -> None:
        with self.change() as db:
            query = "INSERT INTO counters VALUES (?, ?) ON CONFLICT DO UPDATE SET value = value + excluded.value"
            db.executemany(query, ((name, value) for name, value in more.items() if value))

    def raise_to(self, name: str, value: int) -> None:
        with self.change() as db:
            query = "INSERT INTO counters VALUES (?, ?) ON CONFLICT DO UPDATE SET value = max(value, excluded.value)"
            db.execute(query, (name, value))

    def counters(self) -> dict[str, int]:
        with reading(self.path):
            return {str(n): int(v) for n, v in self._db.execute("SELECT name, value FROM counters ORDER BY name")}


def _set_manifest(db: sqlite3.Connection, which: str, m: Manifest) -> None:
    _remove_manifest(db, which)
    db.execute("INSERT INTO manifests VALUES (?, ?, ?, ?, ?)", (which, m.floor, m.version, m.axis_rad, m.tile_m))
    db.executemany("INSERT INTO entries VALUES (?, ?, ?, ?)", ((which, *place, h) for place, h in m.hashes.items()))


def _remove_manifest(db: sqlite3.Connection, which: str) -> None:
    db.execute("DELETE FROM manifests WHERE which = ?", (which,))
    db.execute("DELETE FROM entries WHERE which = ?", (which,))


def _tell(db: sqlite3.Connection, told: Told, table: str = "told") -> None:
    rows = rows_of(told.landmarks, np.zeros((len(told.landmarks), 2)))
    values = ((int(r["id"]), int(ref), r.tobytes()) for r, ref in zip(rows, told.refs, strict=True))
    db.executemany(f"INSERT OR REPLACE INTO {table} VALUES (?, ?, ?)", values)


def _digest(landmarks: Landmarks) -> bytes:
    return hash_of(rows_of(landmarks, np.zeros((len(landmarks), 2))).tobytes())


def _opened(path: Path) -> sqlite3.Connection:
    if not path.exists():
        make_file(path, _make)
    with reading(path):
        db = sqlite3.connect(path, timeout=BUSY_S, isolation_level=None, check_same_thread=False)
        try:
            _look(path, db)
            db.execute("PRAGMA journal_mode = WAL")
            db.execute("PRAGMA synchronous = FULL")
        except BaseException:
            db.close()
            raise
    return db


def _make(db: sqlite3.Connection) -> None:
    for statement in _TABLES:
        db.execute(statement)
    db.execute(f"PRAGMA application_id = {APPLICATION_ID}")
    db.execute(f"PRAGMA user_version = {VERSION}")


def _look(path: Path, db: sqlite3.Connection) -> None:
    found = db.execute("PRAGMA application_id").fetchone()[0], db.execute("PRAGMA user_version").fetchone()[0]
    if found[0] == APPLICATION_ID and found[1] > VERSION:
        raise FileFormatError(f"{path}: version {found[1]} is a newer ceilvo's, expected {VERSION}; update it")
    problem = db.execute("PRAGMA quick_check(1)").fetchone()[0]
    if found[0] != APPLICATION_ID or problem != "ok":
        raise sqlite3.DatabaseError(f"application_id is {found[0]}, quick_check says {problem}")
