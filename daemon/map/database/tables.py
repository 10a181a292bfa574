"""The statements that change a map, by difference; where they are an edit, with the rows as they were."""

from __future__ import annotations

import sqlite3
from collections.abc import Sequence
from dataclasses import astuple, dataclass, replace

import numpy as np

from ceilvo.daemon.map.checks import Damage, floats, shown
from ceilvo.daemon.map.database.content import Session
from ceilvo.daemon.map.database.held import SESSION, Held, read_sessions, read_some_key_poses
from ceilvo.daemon.map.database.key_pose_rows import MOST_IN_SPACE, SPACE_M, KeyPoseRow, kept, rows_of_key_poses
from ceilvo.daemon.map.database.rows import (
    NAMES,
    Rows,
    as_blob,
    changed,
    dated,
    digest_of,
    landmarks_of_rows,
    ordered,
    pairs_of,
    redated,
    rows_of,
    sum_of,
    total,
)
from ceilvo.daemon.map.database.spatial import cells, spatial_of
from ceilvo.daemon.map.key_poses import KeyPoses
from ceilvo.daemon.map.transitions import Side
from ceilvo.json_values import MAX_ANGLE_RAD
from ceilvo.types import Array, Ints, Landmarks

_COLUMNS = ", ".join(NAMES)
_SET = ", ".join(f"{name} = ?" for name in NAMES[1:])
_KEY_POSE = "stamp_ns, x, y, theta, cell, motion, views, digest"


@dataclass(frozen=True)
class Written:
    """What a save or an edit did to the table of landmarks and to the key poses."""

    changed: int = 0
    added: int = 0
    removed: int = 0
    key_poses: int = 0

    def __bool__(self) -> bool:
        return bool(self.changed or self.added or self.removed or self.key_poses)


def write_landmarks(
    db: sqlite3.Connection,
    held: Held,
    landmarks: Landmarks,
    seen_s: Array | None = None,
    at_s: float = 0.0,
    edit: int | None = None,
) -> Written:
    """Make the table what `landmarks` say; `held` follows.

    Args:
        seen_s: (L, 2) when each was first and last seen; None: those that were seen since, at `at_s`.
        edit: rows that change are kept for its undoing.

    Raises:
        Damage: a row that no map may have.
    """
    new, new_s = ordered(landmarks, seen_s)
    if np.any(new.ids[1:] == new.ids[:-1]):
        raise Damage("landmarks.id has duplicates")
    pairs = pairs_of(held.landmarks, new)
    was, now = changed(pairs, held.landmarks, new)
    if seen_s is None:
        new_s = dated(pairs, (held.landmarks, held.seen_s), new, (was, now), at_s)
    else:
        was, now = (np.union1d(*both) for both in zip((was, now), redated(pairs, held.seen_s, new_s), strict=True))
    first = int(db.execute("SELECT coalesce(max(key), 0) FROM landmarks").fetchone()[0]) + 1
    keys = np.empty(len(new), np.int64)
    keys[pairs.new] = held.keys[pairs.old]
    keys[pairs.added] = np.arange(first, first + len(pairs.added))
    gone = held.keys[pairs.removed].tolist()
    if edit is not None:
        keep_before(db, edit, "landmarks", [*held.keys[was].tolist(), *gone], keys[pairs.added].tolist())
    out, back = (rows_of(held.landmarks.of(i), held.seen_s[i]) for i in (was, pairs.removed))
    update, insert = (rows_of(new.of(i), new_s[i]) for i in (now, pairs.added))
    landmarks_of_rows(np.concatenate([update, insert]))
    _delete(db, gone)
    _update(db, out, update, keys[now])
    _insert(db, held.number, insert, keys[pairs.added])
    held.landmark_sum += sum_of(update) - sum_of(out) + sum_of(insert) - sum_of(back)
    held.landmarks, held.seen_s, held.keys = new, new_s, keys
    return Written(len(now), len(pairs.added), len(gone))


def _delete(db: sqlite3.Connection, keys: list[int]) -> None:
    db.executemany("DELETE FROM landmarks WHERE key = ?", ((k,) for k in keys))
    spatial_of(db).remove(keys)


def _update(db: sqlite3.Connection, before: Rows, after: Rows, keys: Ints) -> None:
    values = ((*row[1:], key) for row, key in zip(after.tolist(), keys.tolist(), strict=True))
    db.executemany(f"UPDATE landmarks SET {_SET} WHERE key = ?", values)
    spatial = spatial_of(db)
    moved = spatial.moved(_places(before), _places(after))
    spatial.put(keys[moved].tolist(), _places(after[moved]))


def _insert(db: sqlite3.Connection, number: int, rows: Rows, keys: Ints) -> None:
    values = ((key, number, *row) for row, key in zip(rows.tolist(), keys.tolist(), strict=True))
    marks = ", ".join("?" * (len(NAMES) + 2))
    db.executemany(f"INSERT INTO landmarks (key, map, {_COLUMNS}) VALUES ({marks})", values)
    spatial_of(db).put(keys.tolist(), _places(rows))


def _places(rows: Rows) -> Array:
    return np.column_stack([rows["x"], rows["y"]])


def keep_before(db: sqlite3.Connection, edit: int, table: str, there: list[int], added: list[int]) -> None:
    """Rows as they are before an edit, and the keys of those that it adds; `table` is one of ours."""
    query = f"INSERT INTO {table}_before SELECT ?, * FROM {table} WHERE key = ?"
    db.executemany(query, ((edit, k) for k in there))
    db.executemany(f"INSERT INTO {table}_before (edit, key) VALUES (?, ?)", ((edit, k) for k in added))


def write_session(db: sqlite3.Connection, held: Held, session: Session, edit: int | None = None) -> None:
    """What a session did so far; a new one, or in the place of what is there of that name."""
    values = astuple(replace(session, begun_s=float(session.begun_s) + 0.0, last_s=float(session.last_s) + 0.0))
    columns = SESSION.split(", ")[1:]
    db.execute(
        f"INSERT INTO sessions ({SESSION}, map, edit, digest) VALUES ({', '.join('?' * (len(values) + 3))})"
        f" ON CONFLICT (map, name) DO UPDATE SET {', '.join(f'{c} = excluded.{c}' for c in (*columns, 'digest'))}",
        (*values, held.number, edit, digest_of(*values)),
    )


def count_save(db: sqlite3.Connection, held: Held, done: Session) -> None:
    """Add what a save did to what its session did before."""
    known = next((s for s in read_sessions(db, held.number) if s.name == done.name), None)
    if known is not None:
        counts = {n: getattr(known, n) + getattr(done, n) for n in ("saves", "added", "faded", "refused")}
        done = replace(done, begun_s=known.begun_s, **counts)
    write_session(db, held, done)


def write_key_poses(
    db: sqlite3.Connection, held: Held, sessions: Sequence[KeyPoses], edit: int | None = None, others_go: bool = True
) -> int:
    """Make the key poses what `sessions` say; `held` follows.

    Args:
        others_go: of sessions that are not named; key poses that are there and not in their session always go.

    Returns:
        How many rows changed.
    """
    number = dict(db.execute("SELECT name, id FROM sessions WHERE map = ?", (held.number,)).fetchall())
    named = {k.session: {r.stamp_ns: r for r in rows_of_key_poses(k)} for k in sessions}
    if unknown := sorted(named.keys() - number.keys()):
        raise Damage(f"key poses of {shown(unknown[0])}, which is none of the sessions")
    count = 0
    for name, session in number.items():
        if name in named or others_go:
            count += _write_session_rows(db, held, session, named.get(name, {}), edit)
    return count


def add_key_poses(db: sqlite3.Connection, held: Held, key_poses: KeyPoses, at_s: float) -> int:
    """Add to a session, or put in the place of those of the same stamp, and thin out; how many rows changed."""
    if key_poses.session not in {s.name for s in read_sessions(db, held.number)}:
        write_session(db, held, Session(key_poses.session, at_s, at_s))
    query = "SELECT id FROM sessions WHERE map = ? AND name = ?"
    (session,) = db.execute(query, (held.number, key_poses.session)).fetchone()
    rows = {r.stamp_ns: r for r in rows_of_key_poses(key_poses)}
    count = _write_session_rows(db, held, session, rows, None, others_go=False)
    return count + thin_out(db, held, set(cells(key_poses.pose[:, :2], SPACE_M).tolist()))


def _write_session_rows(
    db: sqlite3.Connection,
    held: Held,
    session: int,
    rows: dict[int, KeyPoseRow],
    edit: int | None,
    others_go: bool = True,
) -> int:
    query = "SELECT key, stamp_ns, digest FROM key_poses WHERE session = ?"
    if others_go:
        found = db.execute(query, (session,)).fetchall()
    else:
        found = [r for s in rows for r in db.execute(f"{query} AND stamp_ns = ?", (session, s))]
    old = {stamp: (key, digest) for key, stamp, digest in found}
    going = [stamp for stamp in old if stamp not in rows] if others_go else []
    other = [r for stamp, r in rows.items() if stamp in old and old[stamp][1] != r.digest]
    added = [r for stamp, r in rows.items() if stamp not in old]
    gone = [old[stamp][0] for stamp in going]
    first = int(db.execute("SELECT coalesce(max(key), 0) FROM key_poses").fetchone()[0]) + 1
    new_keys = list(range(first, first + len(added)))
    if edit is not None:
        keep_before(db, edit, "key_poses", [*gone, *(old[r.stamp_ns][0] for r in other)], new_keys)
    db.executemany("DELETE FROM key_poses WHERE key = ?", ((k,) for k in gone))
    columns = ", ".join(f"{c} = ?" for c in _KEY_POSE.split(", "))
    db.executemany(f"UPDATE key_poses SET {columns} WHERE key = ?", ((*r.values, old[r.stamp_ns][0]) for r in other))
    db.executemany(
        f"INSERT INTO key_poses (key, map, session, {_KEY_POSE}) VALUES ({', '.join('?' * 11)})",
        ((key, held.number, session, *r.values) for key, r in zip(new_keys, added, strict=True)),
    )
    before = total(old[stamp][1] for stamp in (*going, *(r.stamp_ns for r in other)))
    held.key_pose_sum += total(r.digest for r in (*other, *added)) - before
    return len(gone) + len(other) + len(added)


def thin_out(db: sqlite3.Connection, held: Held, cells: set[int]) -> int:
    """Key poses in these cells beyond MOST_IN_SPACE go, the oldest first; how many rows that changed."""
    query = (
        "SELECT session, stamp_ns, key, digest FROM key_poses WHERE map = ? AND cell = ?"
        " ORDER BY key DESC LIMIT -1 OFFSET ?"
    )
    gone: dict[int, dict[int, tuple[int, bytes]]] = {}
    for cell in cells:
        for session, stamp_ns, key, digest in db.execute(query, (held.number, cell, MOST_IN_SPACE)):
            gone.setdefault(session, {})[stamp_ns] = key, digest
    return sum(_thin_out_session(db, held, session, rows) for session, rows in gone.items())


def _thin_out_session(db: sqlite3.Connection, held: Held, session: int, gone: dict[int, tuple[int, bytes]]) -> int:
    """Only what is beside those that go is read: the motion to the next one is added up over them."""
    beside = {stamp_ns for s in gone for stamp_ns in _neighbours(db, session, s)}
    while new := {n for s in beside & gone.keys() for n in _neighbours(db, session, s)} - beside:
        beside |= new
    k = read_some_key_poses(db, session, sorted(beside | gone.keys()))
    rows = {r.stamp_ns: r for r in rows_of_key_poses(kept(k, np.array([s not in gone for s in k.stamp_ns.tolist()])))}
    db.executemany("DELETE FROM key_poses WHERE key = ?", ((key,) for key, _ in gone.values()))
    held.key_pose_sum -= total(digest for _, digest in gone.values())
    return len(gone) + _write_session_rows(db, held, session, rows, None, others_go=False)


def _neighbours(db: sqlite3.Connection, session: int, stamp_ns: int) -> list[int]:
    """The key poses of a session before one and after it."""
    before = "SELECT max(stamp_ns) FROM key_poses WHERE session = ? AND stamp_ns < ?"
    after = "SELECT min(stamp_ns) FROM key_poses WHERE session = ? AND stamp_ns > ?"
    found = (db.execute(query, (session, stamp_ns)).fetchone()[0] for query in (before, after))
    return [s for s in found if s is not None]


def write_sides(db: sqlite3.Connection, held: Held, sides: Sequence[Side]) -> None:
    """Make where transitions are on one floor what `sides` say.

    Raises:
        Damage: two of one name.
    """
    if len({s.name for s in sides}) != len(sides):
        raise Damage("two transitions of one name")
    db.execute("DELETE FROM transitions WHERE map = ?", (held.number,))
    rows = (astuple(side) for side in sides)
    db.executemany(
        "INSERT INTO transitions (name, kind, x, y, theta, map, digest) VALUES (?, ?, ?, ?, ?, ?, ?)",
        ((*row, held.number, digest_of(*row)) for row in rows),
    )


def write_map(db: sqlite3.Connection, held: Held, axis_rad: float, same_frame: bool = True) -> None:
    """The map's own row, last in a transaction.

    Raises:
        Damage: the axis is no direction.
    """
    held.axis_rad = float(floats(float(axis_rad), "map_axis_rad", (), MAX_ANGLE_RAD)) + 0.0
    held.version += 1
    held.frame = held.frame if held.frame and same_frame else f"{held.hash}.{held.version}"
    blobs = as_blob(held.landmark_sum), as_blob(held.key_pose_sum)
    db.execute(
        "UPDATE maps SET version = ?, hash = ?, axis = ?, landmark_sum = ?, key_pose_sum = ?, frame = ? WHERE id = ?",
        (held.version, held.hash, held.axis_rad, *blobs, held.frame, held.number),
    )


def wipe(db: sqlite3.Connection, held: Held) -> None:
    """Forget all of a map but its floor and how often it was written; `held` follows."""
    spatial_of(db).remove(held.keys.tolist())
    for table in ("landmarks", "key_poses", "sessions", "edits", "transitions"):
        db.execute(f"DELETE FROM {table} WHERE map = ?", (held.number,))
    empty = Held.new(held.floor, held.number)
    held.landmarks, held.seen_s, held.keys = empty.landmarks, empty.seen_s, empty.keys
    held.landmark_sum, held.key_pose_sum, held.frame = 0, 0, ""


def make_map(db: sqlite3.Connection, floor: str) -> Held:
    """A row for a new map, to be completed by write_map."""
    columns = "floor, version, hash, axis, landmark_sum, key_pose_sum"
    made = db.execute(f"INSERT INTO maps ({columns}) VALUES (?, 0, '', 0, x'', x'')", (floor,))
    return Held.new(floor, int(made.lastrowid or 0))
