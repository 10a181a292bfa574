"""What a map in the database is: read as a whole, checked against its hash, and kept to save by difference."""

from __future__ import annotations

import sqlite3
from collections.abc import Container
from dataclasses import dataclass
from typing import Any

import numpy as np

from ceilvo.daemon.map.checks import Damage, floats, shown
from ceilvo.daemon.map.database.content import Session
from ceilvo.daemon.map.database.key_pose_rows import key_poses_of
from ceilvo.daemon.map.database.rows import (
    LATEST_S,
    NAMES,
    ROW,
    Rows,
    as_blob,
    digest,
    hash_of,
    landmarks_of_rows,
    rows_from,
    sum_of,
    total,
)
from ceilvo.daemon.map.key_poses import KeyPoses
from ceilvo.types import MAX_ANGLE_RAD, Array, Ints, Landmarks

_LANDMARKS = f"SELECT key, {', '.join(NAMES)} FROM landmarks WHERE map = ? ORDER BY id"
_SOME = 900
"""Keys in one statement; every SQLite takes 999."""
_KEY_POSES = (
    "SELECT stamp_ns, x, y, theta, cell, motion, views, digest FROM key_poses WHERE session = ? ORDER BY stamp_ns"
)


@dataclass
class Held:
    """A map as it was last read or written.

    Attributes:
        number: of its row in the table maps.
        version: how often it was written.
        landmarks: by ascending id.
        seen_s: (L, 2) when each was first and last seen.
        keys: (L,) of their rows.
        landmark_sum, key_pose_sum: of the digests of all rows.
    """

    number: int
    floor: str
    version: int
    axis_rad: float
    landmarks: Landmarks
    seen_s: Array
    keys: Ints
    landmark_sum: int
    key_pose_sum: int

    @staticmethod
    def new(floor: str, number: int) -> Held:
        return Held(number, floor, 0, 0.0, *landmarks_of_rows(np.empty(0, ROW)), np.empty(0, np.int64), 0, 0)

    @property
    def hash(self) -> str:
        return hash_of(self.floor, self.axis_rad, self.landmark_sum, self.key_pose_sum)


def floors(db: sqlite3.Connection) -> dict[str, int]:
    """Names of the maps and their numbers."""
    return {str(name): int(number) for number, name in db.execute("SELECT id, floor FROM maps ORDER BY id")}


def read_map(db: sqlite3.Connection, number: int) -> Held:
    """One map; in a transaction, so that nobody writes between its hash and its rows.

    Raises:
        Damage: what was read is not what was written.
    """
    columns = "floor, version, hash, axis, landmark_sum, key_pose_sum"
    row = db.execute(f"SELECT {columns} FROM maps WHERE id = ?", (number,)).fetchone()
    floor, version, written, axis, landmark_sum, key_pose_sum = row
    if type(version) is not int or version < 1:
        raise Damage(f"version of the map is {shown(version)}, expected a whole number from 1 up")
    held = gathered(db, number, str(floor), version)
    held.axis_rad = float(floats(axis, "axis", (), MAX_ANGLE_RAD))
    if (as_blob(held.landmark_sum), as_blob(held.key_pose_sum)) != (landmark_sum, key_pose_sum):
        which = "landmarks" if as_blob(held.landmark_sum) != landmark_sum else "key poses"
        raise Damage(f"{which} of map {floor!r} are not what was written")
    if held.hash != written:
        raise Damage(f"hash of map {floor!r} is {held.hash}, expected {shown(written)}")
    return held


def gathered(db: sqlite3.Connection, number: int, floor: str, version: int) -> Held:
    """What the rows of a map say, and their sums; its axis is another table's.

    Raises:
        Damage: a value of another type than its column.
    """
    fetched = db.execute(_LANDMARKS, (number,)).fetchall()
    rows, keys = rows_from([r[1:] for r in fetched]), np.array([r[0] for r in fetched], np.int64)
    digests = [d for (d,) in db.execute("SELECT digest FROM key_poses WHERE map = ?", (number,))]
    if not all(isinstance(d, bytes) for d in digests):
        raise Damage("a key pose has no digest")
    return Held(number, floor, version, 0.0, *landmarks_of_rows(rows), keys, sum_of(rows), total(digests))


def read_rows(db: sqlite3.Connection, number: int, keys: list[int] | None) -> Rows:
    """Landmarks of a map by their keys, those of other maps left out; None: all.

    Raises:
        Damage: a value of another type than its column.
    """
    if keys is None:
        return rows_from([r[1:] for r in db.execute(_LANDMARKS, (number,))])
    found: list[tuple[Any, ...]] = []
    for start in range(0, len(keys), _SOME):
        some = keys[start : start + _SOME]
        marks = ", ".join("?" * len(some))
        query = f"SELECT {', '.join(NAMES)} FROM landmarks WHERE map = ? AND key IN ({marks})"
        found += db.execute(query, (number, *some)).fetchall()
    rows = rows_from(found)
    return rows[np.argsort(rows["id"], kind="stable")]


def read_places(db: sqlite3.Connection) -> tuple[list[int], Array]:
    """Keys of the landmarks of all maps, and where they are (L, 2)."""
    rows = db.execute("SELECT key, x, y FROM landmarks").fetchall()
    return [r[0] for r in rows], np.array([r[1:] for r in rows], np.float64).reshape(-1, 2)


def read_key_poses(db: sqlite3.Connection, number: int, only: Container[str] | None = None) -> tuple[KeyPoses, ...]:
    """Of every session that has any, or of those that are named, the oldest first.

    Raises:
        Damage: what was read is not what was written.
    """
    sessions = db.execute("SELECT id, name FROM sessions WHERE map = ? ORDER BY id", (number,)).fetchall()
    wanted = ((key, str(name)) for key, name in sessions if only is None or name in only)
    found = (key_poses_of(name, db.execute(_KEY_POSES, (key,))) for key, name in wanted)
    return tuple(k for k in found if len(k))


def read_sessions(db: sqlite3.Connection, number: int) -> tuple[Session, ...]:
    """All of a map, the oldest first.

    Raises:
        Damage: what was read is not what was written.
    """
    query = "SELECT name, begun_s, last_s, saves, digest FROM sessions WHERE map = ? ORDER BY id"
    rows = db.execute(query, (number,)).fetchall()
    for *values, written in rows:
        if written != session_digest(*values):
            raise Damage(f"session {shown(values[0])} is not what was written")
        floats(values[1:3], "sessions.begun_s, last_s", (2,), LATEST_S)
    return tuple(Session(*row[:-1]) for row in rows)


def session_digest(*values: Any) -> bytes:
    """Of name, times and saves."""
    return digest(repr(values).encode("utf-8", "surrogatepass"))
