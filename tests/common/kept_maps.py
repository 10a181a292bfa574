"""Databases of maps as a robot keeps them, read and written beside the daemon."""

from __future__ import annotations

import contextlib
import hashlib
import os
import sqlite3
import tempfile
from pathlib import Path

from ceilvo.daemon.map.database.content import MapContent
from ceilvo.daemon.map.database.copies import open_map
from ceilvo.daemon.map.database.database import MapDatabase
from ceilvo.daemon.map.map_file import StoredMap
from ceilvo.types import Landmarks


def load_database(path: Path) -> StoredMap | None:
    """The map in a database; None where there is no file."""
    if not os.path.lexists(path):
        return None
    with MapDatabase(path) as db:
        return db.load()


def count(path: Path) -> int:
    """Landmarks in a database; 0 where there is none."""
    stored = load_database(path)
    return 0 if stored is None else len(stored.landmarks)


def write_database(path: Path, landmarks: Landmarks, map_axis_rad: float = 0.25) -> None:
    """A new one of a map in the place of any that is there."""
    with tempfile.TemporaryDirectory(dir=path.parent) as folder:
        made = Path(folder) / "made.db"
        with open_map(made, create=True) as db:
            db.edit(MapContent.of(landmarks, map_axis_rad), "put there")
        made.replace(path)


def as_version_1(path: Path) -> None:
    """What a database was before it had frames, transitions and counts of sessions."""
    with contextlib.closing(sqlite3.connect(path, isolation_level=None)) as db:
        db.execute("PRAGMA journal_mode = DELETE")
        sessions = db.execute("SELECT id, name, begun_s, last_s, saves FROM sessions").fetchall()
        for table, columns in {
            "maps": ("frame",),
            "edits": ("sides_before",),
            "sessions": ("added", "faded", "refused"),
        }.items():
            for column in columns:
                db.execute(f"ALTER TABLE {table} DROP COLUMN {column}")
        for number, *values in sessions:
            old = hashlib.blake2b(repr(tuple(values)).encode(), digest_size=16).digest()
            db.execute("UPDATE sessions SET digest = ? WHERE id = ?", (old, number))
        db.execute("DROP TABLE transitions")
        db.execute("PRAGMA user_version = 1")
