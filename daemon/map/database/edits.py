"""The undo log: every edit keeps the rows that it changed, and the last one can be taken back to the bit."""

from __future__ import annotations

import json
import sqlite3
from collections.abc import Sequence
from dataclasses import astuple, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ceilvo.daemon.map.checks import Damage
from ceilvo.daemon.map.database.content import MapContent
from ceilvo.daemon.map.database.held import Held, gathered, read_sessions, read_sides
from ceilvo.daemon.map.database.spatial import spatial_of
from ceilvo.daemon.map.database.tables import (
    Written,
    write_key_poses,
    write_landmarks,
    write_map,
    write_session,
    write_sides,
)
from ceilvo.daemon.map.transitions import Side
from ceilvo.errors import FileFormatError, one_line

MOST_EDITS = 20
"""That can be undone, of one map; chosen: each holds what it changed, all of the map where it was turned."""
_TABLES = {
    "key_poses": "key, map, session, stamp_ns, x, y, theta, cell, motion, views, digest",
    "landmarks": "key, map, id, x, y, xx, xy, yy, kind, sightings, expected, first_seen_s, last_seen_s",
}


@dataclass(frozen=True, slots=True)
class Edit:
    """One line of the log.

    Attributes:
        number: the highest is undone first.
        at_s: wall-clock time, s since 1970.
        what: the command, in words.
        landmarks, key_poses: how many it changed, added or removed.
    """

    number: int
    at_s: float
    what: str
    hash_before: str
    hash_after: str
    landmarks: int
    key_poses: int


def write_edit(
    db: sqlite3.Connection, held: Held, after: MapContent, what: str, at_s: float, same_frame: bool = False
) -> Written:
    """Make the map what `after` says, and keep what it was, if it was anything. Sessions that are new come with it.

    Args:
        same_frame: poses on the map stay right, although landmarks are moved.
    """
    number = _begun(db, held, what, at_s) if held.version else None
    known = {s.name for s in read_sessions(db, held.number)}
    for session in after.sessions:
        if session.name not in known:
            write_session(db, held, session, number)
    axis_before, sides, before = held.axis_rad, read_sides(db, held.number), len(held.landmarks)
    if number is not None:
        text = json.dumps([astuple(s) for s in sides])
        db.execute("UPDATE edits SET sides_before = ? WHERE id = ?", (text.encode(), number))
    write_sides(db, held, after.sides)
    written = write_landmarks(db, held, after.landmarks, after.seen_s, edit=number)
    key_poses = write_key_poses(db, held, after.key_poses, number)
    stays = not before or written.removed < before  # a map of which nothing stays is another one
    unmoved = stays and not written.changed and after.axis_rad == axis_before
    write_map(db, held, after.axis_rad, same_frame=same_frame or unmoved)
    db.execute("UPDATE edits SET hash_after = ? WHERE id = ?", (held.hash, number))
    old = "SELECT id FROM edits WHERE map = ? ORDER BY id DESC LIMIT -1 OFFSET ?"
    db.execute(f"DELETE FROM edits WHERE id IN ({old})", (held.number, MOST_EDITS))
    return Written(written.changed, written.added, written.removed, key_poses)


def _begun(db: sqlite3.Connection, held: Held, what: str, at_s: float) -> int:
    made = db.execute(
        "INSERT INTO edits (map, at_s, what, hash_before, axis_before) VALUES (?, ?, ?, ?, ?)",
        (held.number, float(at_s), what, held.hash, held.axis_rad),
    )
    return int(made.lastrowid or 0)


def history(db: sqlite3.Connection, number: int) -> tuple[Edit, ...]:
    """Edits of a map that can be undone, the last one first."""
    counts = (f"(SELECT count(*) FROM {table}_before AS b WHERE b.edit = edits.id)" for table in _TABLES)
    key_poses, landmarks = counts
    query = f"SELECT id, at_s, what, hash_before, hash_after, {landmarks}, {key_poses} FROM edits"
    return tuple(Edit(*row) for row in db.execute(f"{query} WHERE map = ? ORDER BY id DESC", (number,)))


def last_of(path: Path, log: Sequence[Edit]) -> Edit:
    """The edit that is undone first.

    Raises:
        FileFormatError: there is none.
    """
    if not log:
        raise FileFormatError(f"{path}: no edit to undo; 'ceilvod map history' shows those that there are")
    return log[0]


def expect_unchanged(path: Path, held: Held, last: Edit) -> None:
    """See that nobody saved since an edit.

    Raises:
        FileFormatError: somebody did.
    """
    if held.hash != last.hash_after:
        raise FileFormatError(
            f"{path}: changed since '{one_line(last.what)}': its hash is {held.hash[:12]}, expected "
            f"{last.hash_after[:12]}; a robot has saved, so undoing would mix two maps: import a copy instead"
        )


def undo(db: sqlite3.Connection, held: Held, edit: Edit) -> Held:
    """Put back what the last edit found; the map as it is then.

    Raises:
        Damage: the log does not lead back to the map that there was.
    """
    removed, put = _restored_keys(db, edit.number)
    for table, columns in _TABLES.items():
        db.execute(f"DELETE FROM {table} WHERE key IN (SELECT key FROM {table}_before WHERE edit = ?)", (edit.number,))
        names = columns.replace("key, ", "", 1)
        db.execute(
            f"INSERT INTO {table} (key, {names}) SELECT key, {names} FROM {table}_before"
            " WHERE edit = ? AND map IS NOT NULL",
            (edit.number,),
        )
    spatial = spatial_of(db)
    spatial.remove(removed)
    _put_again(db, put)
    axis = db.execute("SELECT axis_before FROM edits WHERE id = ?", (edit.number,)).fetchone()[0]
    (text,) = db.execute("SELECT sides_before FROM edits WHERE id = ?", (edit.number,)).fetchone()
    if text is not None:  # one of version 1 has none
        write_sides(db, held, _sides(text))
    db.execute("DELETE FROM sessions WHERE edit = ?", (edit.number,))
    db.execute("DELETE FROM edits WHERE id = ?", (edit.number,))
    back = gathered(db, held.number, held.floor, held.version)
    write_map(db, back, axis)
    if back.hash != edit.hash_before:
        raise Damage(f"the undo log leads to {back.hash}, expected {edit.hash_before}")
    return back


def _sides(text: Any) -> list[Side]:
    try:
        return [Side(*row) for row in json.loads(text)]
    except (TypeError, ValueError, RecursionError) as e:
        raise Damage(f"transitions in the undo log: {e}") from e


def _restored_keys(db: sqlite3.Connection, edit: int) -> tuple[list[int], list[int]]:
    rows = db.execute("SELECT key, map IS NULL FROM landmarks_before WHERE edit = ?", (edit,)).fetchall()
    return [key for key, added in rows if added], [key for key, added in rows if not added]


def _put_again(db: sqlite3.Connection, keys: list[int]) -> None:
    found = [db.execute("SELECT x, y FROM landmarks WHERE key = ?", (k,)).fetchone() for k in keys]
    spatial_of(db).put(keys, np.array(found, np.float64).reshape(-1, 2))
