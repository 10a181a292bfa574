"""A database of maps that is open: one map of it, saved by difference, edited, undone."""

from __future__ import annotations

import contextlib
import logging
import sqlite3
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np

from ceilvo.daemon.map.checks import Damage
from ceilvo.daemon.map.database import edits, schema, tables
from ceilvo.daemon.map.database.content import MapContent, Session
from ceilvo.daemon.map.database.edits import Edit
from ceilvo.daemon.map.database.faults import expect, reading, transaction, writing
from ceilvo.daemon.map.database.held import (
    Held,
    floors,
    read_key_poses,
    read_map,
    read_places,
    read_rows,
    read_sessions,
    read_sides,
    read_verified,
)
from ceilvo.daemon.map.database.key_pose_rows import spaced
from ceilvo.daemon.map.database.rows import landmarks_of_rows
from ceilvo.daemon.map.database.spatial import spatial_of
from ceilvo.daemon.map.database.tables import Written
from ceilvo.daemon.map.key_poses import KeyPoses
from ceilvo.daemon.map.map_file import StoredMap
from ceilvo.errors import FileFormatError
from ceilvo.types import Array, Landmarks

_log = logging.getLogger("ceilvo.store")


class MapDatabase:
    """One map of a file, verified when it is opened. One thread at a time.

    Another program may write to it meanwhile: that is noticed at the next save, which then is the difference to what
    that program wrote.

    Attributes:
        path: of the file.
    """

    def __init__(self, path: Path, floor: str | None = None) -> None:
        """Open what is there; schema.create makes a new one.

        Args:
            floor: which map; None: the only one, or "" where there is none yet.

        Raises:
            FileFormatError: the file cannot be used now, or has several maps and no floor was said; DamagedError where
                its content is not what was written.
        """
        self.path = path
        self._db = schema.connect(path)
        try:
            with reading(path):
                self._index_is_good = False
                self._inode = path.stat().st_ino
                with self._snapshot():
                    self._held = read_verified(path, self._db, floor)
                    self._seen_version = schema.pragma(self._db, "data_version")
        except BaseException:
            self._db.close()
            raise

    def close(self) -> None:
        """What is in the log goes into the file, which is whole without it then.

        SQLite leaves the log where the file was replaced meanwhile, and would apply it to the new one.
        """
        if not self.in_place:
            with contextlib.suppress(sqlite3.Error):
                self._db.execute("PRAGMA wal_checkpoint(TRUNCATE)")
        self._db.close()

    def __enter__(self) -> MapDatabase:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    # -- what it holds

    @property
    def floor(self) -> str:
        return self._held.floor

    @property
    def floors(self) -> tuple[str, ...]:
        """Of all maps of the file, by their age."""
        with reading(self.path):
            return tuple(floors(self._db))

    @property
    def version(self) -> int:
        """How often the map was written; 0: there is none yet."""
        return self._held.version

    @property
    def hash(self) -> str:
        """Of all that the map says, in hexadecimal; sessions and the undo log aside."""
        return self._held.hash

    @property
    def seen_s(self) -> Array:
        """(L, 2) when each landmark of load() was first and last seen, s since 1970; 0 where nobody knows."""
        return self._held.seen_s

    def follow(self) -> bool:
        """Read anew where another program wrote; whether the map is another one then.

        Raises:
            FileFormatError: as when it is opened.
        """
        before = self.hash
        with reading(self.path), self._snapshot():
            self._follow()
        return self.hash != before

    @property
    def frame(self) -> str:
        """Poses on the map stay right while it is the same; an edit that moves the map, or a new one, changes it."""
        return self._held.frame

    @property
    def in_place(self) -> bool:
        """Whether the file is still the one that was opened."""
        return schema.is_same(self.path, self._inode)

    @property
    def provisional(self) -> bool:
        """Whether it must be opened again to save: its disk was full or read-only."""
        return schema.is_provisional(self._db)

    def load(self) -> StoredMap | None:
        """Landmarks and axis as of the last reading or saving; None where there is no map yet."""
        return StoredMap(self._held.landmarks, self._held.axis_rad) if self.version else None

    def content(self) -> MapContent:
        """Everything, read anew where another program wrote.

        Raises:
            FileFormatError: as when it is opened.
        """
        with reading(self.path), self._snapshot():
            self._follow()
            key_poses = read_key_poses(self._db, self._held.number)
            sessions = read_sessions(self._db, self._held.number)
            sides = read_sides(self._db, self._held.number)
        held = self._held
        return MapContent(held.landmarks, held.seen_s, held.axis_rad, key_poses, sessions, held.floor, sides)

    def within(self, low_m: Array, high_m: Array) -> Landmarks:
        """Landmarks in a box with corners (2,) and (2,), by ascending id, read from the file.

        Raises:
            FileFormatError: as when it is opened.
        """
        if not self._index_is_good and self.mend_index():
            _log.warning("%s: its index of places did not say where landmarks are; made anew", self.path)
        low, high = np.asarray(low_m, np.float64), np.asarray(high_m, np.float64)
        with reading(self.path), self._snapshot():
            keys = spatial_of(self._db).candidates(low, high)
            rows = read_rows(self._db, self._held.number, keys)
        inside = (rows["x"] >= low[0]) & (rows["x"] <= high[0]) & (rows["y"] >= low[1]) & (rows["y"] <= high[1])
        return landmarks_of_rows(rows[inside])[0]

    def history(self) -> tuple[Edit, ...]:
        """Edits that can be undone, the last one first."""
        with reading(self.path):
            return edits.history(self._db, self._held.number)

    # -- what changes it

    def save(
        self,
        landmarks: Landmarks,
        map_axis_rad: float,
        session: str = "",
        now_s: float | None = None,
        found: str = "",
        refused: int = 0,
        anew: bool = False,
    ) -> Written:
        """Write what is other than what was last written or read.

        Args:
            session: of the drive, as in KeyPoses; "" for none.
            now_s: wall-clock time, s since 1970; None: the clock's.
            found: hash of the map that these landmarks began with; "" where that does not matter.
            refused: that the session saw and the map did not take, since its last save.
            anew: first forget all that the map was, sessions and the undo log, too.

        Raises:
            SupersededError: the map is another one than was found: one that was refined, say.
            FileFormatError: the values are no map, or the file cannot be written; it holds what it held.
        """
        at_s = time.time() if now_s is None else now_s
        with self._change() as held:
            expect(self.path, held.hash, found)
            if anew:
                tables.wipe(self._db, held)
            written = tables.write_landmarks(self._db, held, landmarks, at_s=at_s)
            if session:
                done = Session(session, at_s, at_s, 1, written.added, written.removed, refused)
                tables.count_save(self._db, held, done)
            tables.write_map(self._db, held, map_axis_rad)
        return written

    def add_key_poses(self, key_poses: KeyPoses, now_s: float | None = None) -> int:
        """Add to a session; where a square holds more than MOST_IN_SPACE then, its oldest go. How many rows changed.

        Raises:
            FileFormatError: as save.
        """
        at_s = time.time() if now_s is None else now_s
        with self._change() as held:
            if not held.version:
                raise Damage("key poses come before their map")
            count = tables.add_key_poses(self._db, held, key_poses, at_s)
            tables.write_map(self._db, held, held.axis_rad)
        return count

    def edit(
        self, after: MapContent, what: str, found: str = "", now_s: float | None = None, same_frame: bool = False
    ) -> Written:
        """Make the map what an edit made of it, so that it can be undone.

        Args:
            what: the command, for the log.
            found: hash of the map that the edit was made of; "" where that does not matter.
            same_frame: poses on the map stay right, although landmarks are moved.

        Raises:
            FileFormatError: as save.
        """
        at_s = time.time() if now_s is None else now_s
        after = replace(after, key_poses=spaced(after.key_poses))
        with self._change() as held:
            expect(self.path, held.hash, found)
            return edits.write_edit(self._db, held, after, what, at_s, same_frame)

    def edit_floors(
        self, after: Mapping[str, tuple[MapContent, str]], what: str, now_s: float | None = None
    ) -> dict[str, Written]:
        """edit() of several floors, all or none.

        Args:
            after: by the floor's name what it becomes, and the hash of the map that it was made of.

        Raises:
            FileFormatError: as save.
        """
        at_s = time.time() if now_s is None else now_s
        with self._change() as own:
            there, written = floors(self._db), {}
            for name, (content, found) in after.items():
                if name not in there:
                    raise Damage(f"floor {name!r} is not there any more")
                held = own if name == own.floor else read_map(self._db, there[name])
                expect(self.path, held.hash, found)
                content = replace(content, key_poses=spaced(content.key_poses))
                written[name] = edits.write_edit(self._db, held, content, what, at_s)
        return written

    def undo(self) -> Edit:
        """Put the map back to before the last edit.

        Raises:
            FileFormatError: there is none, or the map has changed since; DamagedError where the log is not what was
                written. Nothing is changed then.
        """
        last = edits.last_of(self.path, self.history())
        with self._change() as held:
            edits.expect_unchanged(self.path, held, last)
            self._held = edits.undo(self._db, held, last)
        return last

    def mend_index(self) -> bool:
        """Make the index of places anew where it does not say where landmarks are; whether that was so."""
        with reading(self.path):
            self._index_is_good = not spatial_of(self._db).misplaced()
        if self._index_is_good:
            return False
        with self._change():
            spatial_of(self._db).clear()
            spatial_of(self._db).put(*read_places(self._db))
        self._index_is_good = True
        return True

    def copy_to(self, path: Path, name: Path | None = None) -> None:
        """Everything into a file that is not there yet, by SQLite's backup.

        Args:
            name: what errors call it, where it will be renamed.

        Raises:
            FileFormatError: it cannot be written.
        """
        with writing(name or path), contextlib.closing(sqlite3.connect(path)) as target:
            self._db.backup(target)

    # -- how

    def _follow(self) -> None:
        """What another program wrote becomes what is known."""
        now = schema.pragma(self._db, "data_version")
        if now != self._seen_version:
            there = floors(self._db).get(self.floor)
            self._held = Held.new(self.floor, 0) if there is None else read_map(self._db, there)
            self._seen_version = now

    @contextmanager
    def _snapshot(self) -> Iterator[None]:
        """Nobody else's writing is seen meanwhile."""
        self._db.execute("BEGIN")
        try:
            yield
        finally:
            self._db.execute("ROLLBACK")

    @contextmanager
    def _change(self) -> Iterator[Held]:
        """One transaction: all of it or nothing, also of what is known here."""
        if not self.in_place:
            raise FileFormatError(
                f"{self.path}: replaced or removed while it was open; nothing was written, open it again"
            )
        before = self._held
        try:
            with transaction(self.path, self._db):
                self._follow()
                before = self._held
                self._held = replace(before) if before.number else tables.make_map(self._db, before.floor)
                yield self._held
        except BaseException:
            self._held = before
            raise
