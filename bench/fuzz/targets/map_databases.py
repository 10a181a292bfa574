"""A robot's map in its database, which decides where the robot believes that it is, and which programs edit."""

from __future__ import annotations

import contextlib
import shutil
import sqlite3
from dataclasses import replace
from pathlib import Path
from random import Random
from typing import Any

import numpy as np

from ceilvo.bench.fuzz.engine.mutations import mutated
from ceilvo.bench.fuzz.engine.target import Target, file, folder
from ceilvo.daemon.map.database import schema
from ceilvo.daemon.map.database.content import MapContent, Session
from ceilvo.daemon.map.database.copies import keep_copy, open_map
from ceilvo.daemon.map.database.database import MapDatabase
from ceilvo.daemon.map.database.held import gathered
from ceilvo.daemon.map.database.rows import as_blob, hash_of
from ceilvo.daemon.map.key_poses import KeyPoses
from ceilvo.types import Landmarks

_COUNT = 40
_VALUES: tuple[Any, ...] = (
    *(None, 0, 1, -1, 2, 13, 2**31, 2**53, 2**62, 2**63 - 1, -(2**63)),
    *(0.0, -0.0, 0.5, 1e-320, 1e6, 1e18, 1e308, float("inf"), float("-inf")),
    *("", "x", "nan", "\x1b[2J", "7" * 5000, b"", b"\0", b"\xff" * 16, bytes(4096)),
)


def _database(data: bytes) -> None:
    """As it comes, and with the sums that belong to its rows; a robot drives on where it can be used."""
    shutil.rmtree(folder() / "maps", ignore_errors=True)
    path = file("maps/map.db", data)
    _signed(path)
    with open_map(path) as db:
        content = db.content()
        db.history()
        db.within(np.array([0.0, 0.0]), np.array([2.0, 2.0]))
        db.save(replace(_landmarks(), sightings=np.full(_COUNT, 9), expected=np.full(_COUNT, 9)), 0.2, "drive")
        db.add_key_poses(_key_poses("drive"))
        db.edit(replace(content, axis_rad=0.1), "again")
        keep_copy(db)
        db.undo()


def _signed(path: Path) -> None:
    """With the sums of its rows, where these can be had."""
    try:
        with contextlib.closing(sqlite3.connect(path, isolation_level=None)) as db:
            for number, floor, axis in db.execute("SELECT id, floor, axis FROM maps").fetchall():
                held = gathered(db, number, floor, 1)
                blobs = as_blob(held.landmark_sum), as_blob(held.key_pose_sum)
                name = hash_of(floor, axis, held.landmark_sum, held.key_pose_sum)
                statement = "UPDATE maps SET hash = ?, landmark_sum = ?, key_pose_sum = ? WHERE id = ?"
                db.execute(statement, (name, *blobs, number))
    except Exception:
        return


def _mutated(data: bytes, rng: Random) -> bytes:
    """A few bytes of the file changed, or some values in its tables."""
    if rng.random() < 0.3:
        return mutated(data, rng)
    path = file("mutated.db", data)
    try:
        with contextlib.closing(sqlite3.connect(path, isolation_level=None)) as db:
            db.execute("PRAGMA journal_mode = DELETE")
            for _ in range(rng.choice((1, 1, 1, 2, 3))):
                _row_changed(db, rng)
        return path.read_bytes()
    except (sqlite3.Error, OverflowError):
        return mutated(data, rng)


def _row_changed(db: sqlite3.Connection, rng: Random) -> None:
    table = rng.choice([name for (name,) in db.execute("SELECT name FROM sqlite_master WHERE type = 'table'")])
    columns = [row[1] for row in db.execute(f"PRAGMA table_info({table})")]
    column, key = rng.choice(columns), columns[0]
    rows = db.execute(f"SELECT {key}, {column} FROM {table}").fetchall()
    if not rows:
        return
    at, old = rng.choice(rows)
    how = rng.random()
    if how < 0.1:
        db.execute(f"DELETE FROM {table} WHERE {key} = ?", (at,))
    elif how < 0.2:
        names = ", ".join(columns[1:])
        db.execute(f"INSERT INTO {table} ({names}) SELECT {names} FROM {table} WHERE {key} = ?", (at,))
    else:
        new = mutated(old, rng) if isinstance(old, bytes) and how < 0.6 else rng.choice((*_VALUES, rng.choice(rows)[1]))
        db.execute(f"UPDATE {table} SET {column} = ? WHERE {key} = ?", (new, at))


def _landmarks() -> Landmarks:
    n = np.arange(_COUNT)
    xy = np.column_stack([0.6 * (n % 8), 0.6 * (n // 8)])
    return Landmarks(n, xy, np.tile(1e-4 * np.eye(2), (_COUNT, 1, 1)), n % 9, np.full(_COUNT, 3), np.full(_COUNT, 4))


def _key_poses(session: str) -> KeyPoses:
    k, o = 3, 6
    cov = np.tile(1e-4 * np.eye(3), (k, 1, 1))
    cov[0] = np.diag([np.inf] * 3)
    return KeyPoses(
        session=session,
        stamp_ns=1 + np.arange(k),
        pose=0.5 * np.arange(3 * k, dtype=np.float64).reshape(k, 3),
        motion=np.full((k, 3), 0.1),
        motion_cov=cov,
        direction_rad=np.zeros(k),
        direction_sigma_rad=np.full(k, 1e-3),
        view=np.repeat(np.arange(k), 2),
        xy_base_m=np.linspace(-1.0, 1.0, 2 * o).reshape(o, 2),
        cov_base_m2=np.tile(1e-4 * np.eye(2), (o, 1, 1)),
        crossing_type=np.full(o, 4),
        landmark=np.arange(o),
    )


def _seeds() -> tuple[bytes, ...]:
    """With an R*Tree and with a grid; an edit, sessions and key poses."""
    out = []
    for rtree in sorted({False, schema.has_rtree()}):
        path = folder() / f"seed-{rtree}.db"
        schema.create(path, rtree)
        sessions = (Session("drive", 1.7e9, 1.7e9 + 60.0, 6, 40, 1, 2),)
        first = replace(MapContent.of(_landmarks(), 0.2), sessions=sessions, key_poses=(_key_poses("drive"),))
        with MapDatabase(path, "") as db:
            db.edit(first, "import")
            db.edit(replace(first, landmarks=first.landmarks.of(np.arange(30)), seen_s=first.seen_s[:30]), "crop")
        out.append(path.read_bytes())
    return tuple(out)


TARGETS = {"map_database": Target(_database, _seeds, _mutated)}
