"""What a map service must not forget: keys, offers, claims, merges that the map may lack, what was published."""

from __future__ import annotations

import sqlite3
from collections.abc import Iterable, Mapping
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ceilvo.daemon.fleet.offers import Offer, Signed
from ceilvo.daemon.fleet.service.claims import CLAIM, VALUES, Claims
from ceilvo.daemon.fleet.service.tables import opened
from ceilvo.daemon.fleet.tiles import Place
from ceilvo.daemon.map.database.faults import reading, transaction
from ceilvo.daemon.map.database.rows import ROW, Rows
from ceilvo.types import Ints

PENDING, APPROVED, REJECTED, TAKEN = "pending", "approved", "rejected", "taken"
"""States of offers."""
KEPT_OFFERS = 1000
"""Of each key, that are known again, taken or rejected ones; chosen: a week's."""
EXPIRES_S = 90 * 86400.0
"""Claims that nobody agreed with for so long are forgotten; chosen."""


@dataclass(frozen=True)
class Key:
    """A robot's public key.

    Attributes:
        trusted: what it signs needs nobody else's agreement.
        gone: taken back; what it signs is refused.
        seq: of its last offer.
    """

    number: int
    public: bytes
    name: str
    trusted: bool
    gone: bool
    seq: int


@dataclass(frozen=True)
class Entry:
    """An offer in the ledger."""

    number: int
    key: str
    floor: str
    state: str
    at_s: float
    landmarks: int
    robot: str
    session: str


class Ledger:
    """One file, one thread at a time; another program may approve and reject meanwhile."""

    def __init__(self, path: Path, create: bool = True) -> None:
        """
        Raises:
            FileFormatError: it cannot be used.
        """
        self.path = path
        self._db = opened(path, create)

    def close(self) -> None:
        self._db.close()

    def __enter__(self) -> Ledger:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def change(self) -> AbstractContextManager[sqlite3.Connection]:
        """One transaction, see faults.transaction."""
        return transaction(self.path, self._db)

    # -- keys

    def keys(self) -> dict[bytes, Key]:
        with reading(self.path):
            rows = self._db.execute(
                "SELECT number, public, name, trusted, gone_s IS NOT NULL, seq FROM keys"
            ).fetchall()
        return {r[1]: Key(r[0], r[1], r[2], bool(r[3]), bool(r[4]), r[5]) for r in rows}

    def add_key(self, public: bytes, name: str, trusted: bool, now_s: float) -> None:
        """New, or known under another name, with other trust, or taken back."""
        with self.change() as db:
            db.execute(
                "INSERT INTO keys (public, name, trusted, added_s) VALUES (?, ?, ?, ?) ON CONFLICT (public) DO UPDATE"
                " SET name = excluded.name, trusted = excluded.trusted, gone_s = NULL",
                (public, name, int(trusted), now_s),
            )

    def remove_key(self, number: int, now_s: float) -> None:
        """Its claims and its waiting offers go as well: whoever has the key may have made them."""
        with self.change() as db:
            db.execute("UPDATE keys SET gone_s = ? WHERE number = ?", (now_s, number))
            db.execute("DELETE FROM claims WHERE key = ?", (number,))
            db.execute(
                f"UPDATE offers SET state = '{REJECTED}', body = NULL WHERE key = ? AND state IN (?, ?)",
                (number, PENDING, APPROVED),
            )

    # -- offers

    def known(self, id_: bytes) -> str | None:
        """State of an offer that is known already."""
        with reading(self.path):
            row = self._db.execute("SELECT state FROM offers WHERE id = ?", (id_,)).fetchone()
        return None if row is None else str(row[0])

    def note(self, db: sqlite3.Connection, signed: Signed, offer: Offer, key: Key, state: str, now_s: float) -> None:
        """In a change."""
        body = signed.body if state == PENDING else None
        values = (signed.id, key.number, offer.seq, offer.floor, state, now_s, len(offer.rows), offer.robot)
        db.execute(
            "INSERT INTO offers (id, key, seq, floor, state, at_s, landmarks, robot, session, begun_s, last_s, body)"
            " VALUES (?, ?, ?, ?, ?, ?, ?, ?, ?, ?, ?, ?)",
            (*values, offer.session, offer.begun_s, offer.last_s, body),
        )
        db.execute("UPDATE keys SET seq = max(seq, ?) WHERE number = ?", (offer.seq, key.number))
        old = "SELECT number FROM offers WHERE key = ? AND state IN (?, ?) ORDER BY number DESC LIMIT -1 OFFSET ?"
        db.execute(f"DELETE FROM offers WHERE number IN ({old})", (key.number, TAKEN, REJECTED, KEPT_OFFERS))

    def entries(self, state: str) -> list[Entry]:
        """The oldest first."""
        query = (
            "SELECT o.number, k.name, o.floor, o.state, o.at_s, o.landmarks, o.robot, o.session FROM offers AS o"
            " JOIN keys AS k ON k.number = o.key WHERE o.state = ? ORDER BY o.number"
        )
        with reading(self.path):
            return [Entry(*row) for row in self._db.execute(query, (state,))]

    def pending_of(self, key: int) -> int:
        """How many of a key's offers wait for a person."""
        with reading(self.path):
            query = "SELECT count(*) FROM offers WHERE key = ? AND state = ?"
            return int(self._db.execute(query, (key, PENDING)).fetchone()[0])

    def body(self, number: int) -> bytes:
        """Of an offer that waits; b"" where none does."""
        with reading(self.path):
            row = self._db.execute("SELECT body FROM offers WHERE number = ?", (number,)).fetchone()
        return b"" if row is None or row[0] is None else bytes(row[0])

    def approved(self) -> list[tuple[int, int, bytes]]:
        """Number, key and body of offers that a person has approved and that have not been taken yet."""
        query = "SELECT number, key, body FROM offers WHERE state = ? ORDER BY number"
        with reading(self.path):
            return [(n, k, bytes(b)) for n, k, b in self._db.execute(query, (APPROVED,))]

    def set_state(self, numbers: Iterable[int], before: str, after: str) -> int:
        """Of offers that are in a state; how many were."""
        keep = after in (PENDING, APPROVED)
        body = "body" if keep else "NULL"
        with self.change() as db:
            done = (
                db.execute(
                    f"UPDATE offers SET state = ?, body = {body} WHERE number = ? AND state = ?", (after, n, before)
                )
                for n in numbers
            )
            return sum(cursor.rowcount for cursor in done)

    # -- claims

    def add_claims(self, db: sqlite3.Connection, floor: str, claims: Claims, now_s: float) -> None:
        """In a change: information adds to what its key has claimed of the landmark before."""
        names = ("key", "ref", *VALUES)
        rows = ((floor, *row, now_s) for row in claims[list(names)].tolist())
        added = ", ".join(f"{n} = {n} + excluded.{n}" for n in VALUES[1:-1])
        db.executemany(
            f"INSERT INTO claims (floor, {', '.join(names)}, at_s) VALUES ({', '.join('?' * (len(names) + 2))})"
            f" ON CONFLICT DO UPDATE SET {added}, alone = max(alone, excluded.alone), kind = excluded.kind,"
            " at_s = excluded.at_s",
            rows,
        )

    def claims(self, floor: str) -> Claims:
        """All that wait, by key and landmark."""
        names = CLAIM.names or ()
        query = f"SELECT {', '.join(names)} FROM claims WHERE floor = ?"
        with reading(self.path):
            return np.array(self._db.execute(query, (floor,)).fetchall(), CLAIM)

    def claimed_by(self, key: int) -> int:
        """How many of a key's claims wait."""
        with reading(self.path):
            return int(self._db.execute("SELECT count(*) FROM claims WHERE key = ?", (key,)).fetchone()[0])

    def forget(self, db: sqlite3.Connection, floor: str, claims: Claims) -> None:
        """In a change."""
        rows = ((floor, *row) for row in claims[["key", "ref"]].tolist())
        db.executemany("DELETE FROM claims WHERE floor = ? AND key = ? AND ref = ?", rows)

    def expire(self, now_s: float) -> int:
        with self.change() as db:
            return db.execute("DELETE FROM claims WHERE at_s < ?", (now_s - EXPIRES_S,)).rowcount

    # -- merges

    def add_merge(
        self, db: sqlite3.Connection, floor: str, rows: Rows, removed: Ints, next_id: int, now_s: float
    ) -> None:
        """In a change."""
        number = int(db.execute("SELECT merged FROM floors WHERE floor = ?", (floor,)).fetchone()[0]) + 1
        blobs = rows.tobytes(), np.asarray(removed, "<i8").tobytes()
        db.execute("INSERT INTO merges VALUES (?, ?, ?, ?, ?)", (floor, number, now_s, *blobs))
        db.execute("UPDATE floors SET merged = ?, next_id = ? WHERE floor = ?", (number, next_id, floor))

    def merges_after(self, floor: str, number: int) -> list[tuple[float, Rows, Ints]]:
        """Time, landmarks and ids that went, the first merge first."""
        query = "SELECT at_s, landmarks, removed FROM merges WHERE floor = ? AND number > ? ORDER BY number"
        with reading(self.path):
            found = self._db.execute(query, (floor, number)).fetchall()
        return [(s, np.frombuffer(rows, ROW), np.frombuffer(gone, "<i8")) for s, rows, gone in found]

    def recount(self, floor: str, merged: int) -> None:
        """Go on from what the map has, where merges are lost."""
        with self.change() as db:
            db.execute("DELETE FROM merges WHERE floor = ?", (floor,))
            db.execute("UPDATE floors SET merged = ? WHERE floor = ?", (merged, floor))

    def drop_merges(self, floor: str, up_to: int) -> None:
        """Those that the last good copy of the map has."""
        with self.change() as db:
            db.execute("DELETE FROM merges WHERE floor = ? AND number <= ?", (floor, up_to))

    # -- floors

    def floor_names(self) -> list[str]:
        with reading(self.path):
            return [str(name) for (name,) in self._db.execute("SELECT floor FROM floors ORDER BY floor")]

    def floor(self, floor: str) -> tuple[int, bytes, int, int]:
        """Version, root, next id and merges; of a new one zeros."""
        with reading(self.path):
            query = "SELECT version, root, next_id, merged FROM floors WHERE floor = ?"
            row = self._db.execute(query, (floor,)).fetchone()
        return (0, b"", 0, 0) if row is None else (int(row[0]), bytes(row[1]), int(row[2]), int(row[3]))

    def set_floor(self, floor: str, next_id: int, merged: int) -> None:
        """Make it known; numbers never fall."""
        with self.change() as db:
            db.execute(
                "INSERT INTO floors VALUES (?, 0, x'', ?, ?) ON CONFLICT DO UPDATE SET"
                " next_id = max(next_id, excluded.next_id), merged = max(merged, excluded.merged)",
                (floor, next_id, merged),
            )

    def tiles(self, floor: str) -> dict[Place, tuple[bytes, int]]:
        """Hash and version of every tile that was ever published."""
        query = "SELECT ix, iy, hash, version FROM tiles WHERE floor = ?"
        with reading(self.path):
            return {(ix, iy): (bytes(h), int(v)) for ix, iy, h, v in self._db.execute(query, (floor,))}

    def publish(self, floor: str, version: int, root: bytes, changed: Mapping[Place, bytes]) -> None:
        with self.change() as db:
            db.execute("UPDATE floors SET version = ?, root = ? WHERE floor = ?", (version, root, floor))
            rows = ((floor, *place, h, version) for place, h in changed.items())
            db.executemany("INSERT OR REPLACE INTO tiles VALUES (?, ?, ?, ?, ?)", rows)

    # -- counters

    def count(self, more: Mapping[str, int]) -> None:
        with self.change() as db:
            query = "INSERT INTO counters VALUES (?, ?) ON CONFLICT DO UPDATE SET value = value + excluded.value"
            db.executemany(query, ((name, value) for name, value in more.items() if value))

    def counters(self) -> dict[str, int]:
        with reading(self.path):
            return {str(n): int(v) for n, v in self._db.execute("SELECT name, value FROM counters ORDER BY name")}
