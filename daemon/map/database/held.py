"""What a map in the database is: read as a whole, checked against its hash, and kept to save by difference."""

from __future__ import annotations

import sqlite3
from dataclasses import dataclass
from pathlib import Path
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
    digest_of,
    hash_of,
    landmarks_of_rows,
    rows_from,
    sum_of,
    total,
)
from ceilvo.daemon.map.key_poses import KeyPoses
from ceilvo.daemon.map.transitions import Side
from ceilvo.errors import FileFormatError, one_line
from ceilvo.json_values import MAX_ANGLE_RAD
from ceilvo.types import Array, Ints, Landmarks

_LANDMARKS = f"SELECT key, {', '.join(NAMES)} FROM landmarks WHERE map = ? ORDER BY id"
SESSION = "name, begun_s, last_s, saves, added, faded, refused"
"""Columns, as Session has them."""
_SOME = 900
"""Keys in one statement; every SQLite takes 999."""
_KEY_POSES = "SELECT stamp_ns, x, y, theta, cell, motion, views, digest FROM key_poses WHERE session = ?"


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
        frame: see MapDatabase.
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
    frame: str = ""

    @staticmethod
    def new(floor: str, number: int) -> Held:
        return Held(number, floor, 0, 0.0, *landmarks_of_rows(np.empty(0, ROW)), np.empty(0, np.int64), 0, 0)

    @property
    def hash(self) -> str:
        return hash_of(self.floor, self.axis_rad, self.landmark_sum, self.key_pose_sum)


def floors(db: sqlite3.Connection) -> dict[str, int]:
    """Names of the maps and their numbers."""
    return {str(name): int(number) for number, name in db.execute("SELECT id, floor FROM maps ORDER BY id")}


def read_verified(path: Path, db: sqlite3.Connection, floor: str | None) -> Held:
    """The map that was asked for, of a file that is whole: SQLite says so, and the others are as they were written.

    Args:
        floor: None: the only one, or "" where there is none yet.

    Raises:
        Damage: it is not whole.
        FileFormatError: there are several maps, and no floor was said.
    """
    problem = str(db.execute("PRAGMA quick_check(1)").fetchone()[0])
    if problem != "ok":
        raise Damage(f"quick_check says {one_line(problem)}")
    if orphan := db.execute("PRAGMA foreign_key_check").fetchone():
        raise Damage(f"a row of {shown(orphan[0])} belongs to nothing that is there")
    there = floors(db)
    if floor is None and len(there) > 1:
        raise FileFormatError(f"{path}: holds the floors {one_line(', '.join(there))}; say which with --floor")
    name = next(iter(there), "") if floor is None else floor
    all_of_them = {n: read_map(db, number) for n, number in there.items()}
    return all_of_them[name] if name in there else Held.new(name, 0)


def read_map(db: sqlite3.Connection, number: int) -> Held:
    """One map; in a transaction, so that nobody writes between its hash and its rows.

    Raises:
        Damage: what was read is not what was written.
    """
    columns = "floor, version, hash, axis, landmark_sum, key_pose_sum, frame"
    row = db.execute(f"SELECT {columns} FROM maps WHERE id = ?", (number,)).fetchone()
    floor, version, written, axis, landmark_sum, key_pose_sum, frame = row
    if type(version) is not int or version < 1:
        raise Damage(f"version of the map is {shown(version)}, expected a whole number from 1 up")
    held = gathered(db, number, str(floor), version)
    held.axis_rad = float(floats(axis, "axis", (), MAX_ANGLE_RAD))
    if (as_blob(held.landmark_sum), as_blob(held.key_pose_sum)) != (landmark_sum, key_pose_sum):
        which = "landmarks" if as_blob(held.landmark_sum) != landmark_sum else "key poses"
        raise Damage(f"{which} of map {floor!r} are not what was written")
    if held.hash != written:
        raise Damage(f"hash of map {floor!r} is {held.hash}, expected {shown(written)}")
    if not isinstance(frame, str) or not frame:
        raise Damage(f"frame of map {floor!r} is {shown(frame)}, expected a name")
    held.frame = frame
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


def read_key_poses(db: sqlite3.Connection, number: int) -> tuple[KeyPoses, ...]:
    """Of every session that has any, the oldest first.

    Raises:
        Damage: what was read is not what was written.
    """
    sessions = db.execute("SELECT id, name FROM sessions WHERE map = ? ORDER BY id", (number,)).fetchall()
    found = (key_poses_of(str(name), db.execute(f"{_KEY_POSES} ORDER BY stamp_ns", (key,))) for key, name in sessions)
    return tuple(k for k in found if len(k))


def read_some_key_poses(db: sqlite3.Connection, session: int, stamps_ns: list[int]) -> KeyPoses:
    """Those of one session with these stamps, which ascend.

    Raises:
        Damage: what was read is not what was written.
    """
    (name,) = db.execute("SELECT name FROM sessions WHERE id = ?", (session,)).fetchone()
    rows = (db.execute(f"{_KEY_POSES} AND stamp_ns = ?", (session, s)).fetchone() for s in stamps_ns)
    return key_poses_of(str(name), rows)


def read_sides(db: sqlite3.Connection, number: int) -> tuple[Side, ...]:
    """Where transitions are on one floor, by name.

    Raises:
        Damage: what was read is not what was written.
    """
    query = "SELECT name, kind, x, y, theta, digest FROM transitions WHERE map = ? ORDER BY name"
    rows = db.execute(query, (number,)).fetchall()
    for *values, written in rows:
        if written != digest_of(*values):
            raise Damage(f"transition {shown(values[0])} is not what was written")
    return tuple(Side(*row[:-1]) for row in rows)


def read_sessions(db: sqlite3.Connection, number: int) -> tuple[Session, ...]:
    """All of a map, the oldest first.

    Raises:
        Damage: what was read is not what was written.
    """
    query = f"SELECT {SESSION}, digest FROM sessions WHERE map = ? ORDER BY id"
    rows = db.execute(query, (number,)).fetchall()
    for *values, written in rows:
        if written != digest_of(*values):
            raise Damage(f"session {shown(values[0])} is not what was written")
        floats(values[1:3], "sessions.begun_s, last_s", (2,), LATEST_S)
    return tuple(Session(*row[:-1]) for row in rows)
