"""The robot's map in its database: opened, made good where it is damaged, and never lost to what is written."""

from __future__ import annotations

import contextlib
import logging
import os
from collections.abc import Callable
from pathlib import Path

from ceilvo.daemon.map.database.content import MapContent
from ceilvo.daemon.map.database.copies import (
    copy_of,
    floors_in,
    is_ahead,
    keep_copy,
    open_map,
    put_in_place,
    set_aside_with_log,
)
from ceilvo.daemon.map.database.database import MapDatabase
from ceilvo.daemon.map.database.faults import DamagedError, HeldError, SupersededError
from ceilvo.daemon.map.kept.found import Found, floors_around, found_in
from ceilvo.daemon.map.kept.generations import Generations
from ceilvo.daemon.map.kept.usable import copy_in_place_of_link, out_of_the_way, usable
from ceilvo.daemon.map.key_poses import KeyPoses
from ceilvo.daemon.map.map_file import StoredMap, load_map
from ceilvo.errors import FileFormatError
from ceilvo.files import set_aside
from ceilvo.types import Landmarks

_log = logging.getLogger("ceilvo.store")

GROWN = 2.0
"""A map that has so many times the landmarks of its good copy gets another one; chosen: an hour is long on the day when
a robot learns a building."""
OLD_NAME = "map.json"
"""The map of a ceilvo that had no database; it is read where there is none, and stays as it is."""

Told = Callable[[str], None]
"""Hears the hash of what was written."""


class KeptMap:
    """One database, open while it can be. What somebody else wrote into it meanwhile, or put in its place, is noticed.

    Attributes:
        path: of the database.
        landmarks: in it, when it was last read or written.
        copied_hash: of the good copy, as it was last made here.
    """

    def __init__(self, path: Path, generations: int, session: str, floor: str = "") -> None:
        """floor: which map of the database; "": the only one, or the first."""
        self.path, self._session, self._floor = path, session, floor
        self.landmarks = 0
        self._db: MapDatabase | None = None
        self._hash = ""
        self._unkept = False
        self._anew = False
        self._written = False
        self._copied = 0
        self.copied_hash = ""
        self._generations = Generations(path, generations)
        self._old = Generations(path.with_name(OLD_NAME), generations)

    @property
    def stored(self) -> StoredMap | None:
        """What it holds, as of the last look(); None where nothing."""
        return None if self._db is None else self._db.load()

    @property
    def hash(self) -> str:
        """Of that; "" where there is none."""
        return self._hash

    @property
    def frame(self) -> str:
        """Of the database as it is written; "" where none is open."""
        return "" if self._db is None else self._db.frame

    @property
    def name(self) -> str:
        """Of the floor."""
        return self._floor if self._db is None else self._db.floor

    @property
    def version(self) -> int | None:
        """How often the map was written; None where it is not open."""
        return None if self._db is None else self._db.version

    @property
    def content(self) -> Landmarks | None:
        """What the database holds, as it was last read or written."""
        stored = None if self._db is None else self._db.load()
        return None if stored is None else stored.landmarks

    # -- reading

    def floors(self, home: Found) -> tuple[Found, ...]:
        """The map that was read, and those of the floors that one can get to from it; for one, itself."""
        return (home,) if self._db is None else floors_around(home, self._db.floor, self.path)

    def read(self) -> Found | None:
        """The map; what cannot be used is set aside, and the next best takes its place: the good copy, a map of an
        earlier run, one of an older ceilvo."""
        try:
            self._db = self._opened()
        except HeldError as e:
            _log.warning("%s; its last good copy is used", e)
            return usable(copy_of(self.path), self._of_database)
        if self._db is None or not (self._db.version or floors_in(self.path)):
            return self._earlier()
        self._hold(self._db)
        return found_in(self._db)

    def _opened(self) -> MapDatabase | None:
        """What lies there, or the good copy of it; None where neither can be used.

        Raises:
            HeldError: another program holds it.
        """
        for attempt in range(2):
            if not (os.path.lexists(self.path) or os.path.lexists(copy_of(self.path))):
                break
            try:
                copy_in_place_of_link(self.path)
                return self._open()
            except HeldError:
                raise
            except FileFormatError as e:  # a copy that took nobody's place was of no use, either
                _log.warning("%s; %s", e, self._out_of_the_way(isinstance(e, DamagedError) or attempt > 0))
        return None

    def _open(self) -> MapDatabase:
        floor = self._floor
        for path in (self.path, copy_of(self.path)):
            with contextlib.suppress(FileFormatError):  # open_map says so
                floor = self._chosen(floors_in(path))
                break
        return open_map(self.path, floor, views=False)

    def _chosen(self, floors: tuple[str, ...]) -> str:
        """The floor that was asked for, else the first."""
        return self._floor if self._floor or not floors else floors[0]

    def _out_of_the_way(self, copy_too: bool) -> str:
        try:
            aside = [set_aside_with_log(self.path)]
            if copy_too and copy_of(self.path).exists():
                aside.append(set_aside(copy_of(self.path)))
        except OSError as e:
            return f"it cannot be set aside: {e.strerror or e}"
        return f"set aside as {' and '.join(p.name for p in aside if p is not None)}"

    def _earlier(self) -> Found | None:
        """The newest map of an earlier run that can be used; it becomes the one in the database, if that can be."""
        for path in self._generations.paths():
            found = usable(path, self._of_database)
            if found is not None:
                self._become(lambda p=path: put_in_place(p, self.path), path)  # type: ignore[misc]
                return found
        for path in (self.path.with_name(OLD_NAME), *self._old.paths()):
            stored = usable(path, load_map)
            if stored is not None:
                self._become(lambda m=stored, p=path: self._import(m, p.name), path)  # type: ignore[misc]
                return Found(stored, "", path.name)
        return None

    def _of_database(self, path: Path) -> Found | None:
        """The map in a database that is nobody's own.

        Raises:
            FileFormatError: as MapDatabase.
        """
        if not os.path.lexists(path):
            return None
        with MapDatabase(path, self._chosen(floors_in(path))) as db:
            return found_in(db)

    def _become(self, put: Callable[[], object], source: Path) -> None:
        """A disk that refuses costs nothing but the next start's time."""
        try:
            if self._db is not None:
                self._db.close()
            self._db = None
            put()
            self._db = self._open()
            self._hold(self._db)
        except (OSError, FileFormatError) as e:
            _log.warning("%s: not made from %s yet: %s", self.path, source.name, e)

    def _import(self, stored: StoredMap, name: str) -> None:
        with open_map(self.path, self._floor, create=True) as db:
            db.edit(MapContent.of(stored.landmarks, stored.map_axis_rad), f"import {name}")
            self._copy_of(db)

    # -- writing

    def look(self) -> None:
        """Open what lies there, and see to what somebody else put or wrote there.

        Raises:
            FileFormatError: it cannot be used now.
        """
        if self._db is not None and (self._db.provisional or not self._db.in_place):
            self.close()
        if not self.path.parent.is_dir():
            raise FileFormatError(f"{self.path.parent}: no such folder; expected one that the daemon may write to")
        if self._db is None:
            self._db = self._opened() or open_map(self.path, self._floor, create=True, views=False)
        try:
            self._db.follow()
        except DamagedError:
            self.close()
            return self.look()
        if self._db.version and self._db.hash != self._hash:
            self._hold(self._db)
            self._unkept = True

    def is_ours(self) -> bool:
        """Whether the map that lies there is as it was last read or written here."""
        db = self._db
        if db is None or not db.in_place:
            return False
        try:
            db.follow()
        except FileFormatError:
            return False
        return bool(db.version) and db.hash == self._hash and not self._anew

    def write(
        self,
        landmarks: Landmarks,
        map_axis_rad: float,
        key_poses: KeyPoses | None,
        refused: int,
        written: Told,
    ) -> None:
        """Write what changed, after look(). A map that somebody else wrote, or that was given up, becomes a generation
        first.

        Args:
            written: told once the landmarks are there, and again with the key poses; what fails later leaves them.

        Raises:
            FileFormatError, OSError: it cannot be written; what lies there stays. SupersededError where another program
                has written since look().
        """
        try:
            self._write(landmarks, map_axis_rad, key_poses, refused, written)
        except DamagedError:
            self.close()
            self.look()
            self._write(landmarks, map_axis_rad, key_poses, refused, written)
        except SupersededError:
            raise
        except FileFormatError:
            self.close()
            raise

    def _write(
        self, landmarks: Landmarks, map_axis_rad: float, key_poses: KeyPoses | None, refused: int, written: Told
    ) -> None:
        if self._db is None:
            raise FileFormatError(f"{self.path}: not open")
        is_new = self._anew or not self._db.version
        if self._db.version and (self._unkept or not self._written):
            self._keep(self._db)
        found = "" if is_new else self._hash
        self._db.save(landmarks, map_axis_rad, self._session, found=found, refused=refused, anew=self._anew)
        self._hold(self._db)
        self._anew = False
        written(self._hash)
        if key_poses is not None and len(key_poses):
            self._db.add_key_poses(key_poses)
            self._hold(self._db)
            written(self._hash)
        self._written = True
        if is_new or self.landmarks >= GROWN * self._copied:
            self._copy(self._db)

    def keep_copy(self) -> None:
        """Make the good copy what was written since.

        Raises:
            FileFormatError: it cannot be written, or the database is damaged: that is seen to at the next look().
        """
        if self._db is None or not self._written:
            return
        try:
            self._copy_of(self._db)
        except DamagedError:
            self.close()
            raise

    def give_up(self) -> bool:
        """Any map may replace it now, however small; True where it stays as the newest generation.

        Raises:
            FileFormatError, OSError: it does not yet; it will before it is replaced.
        """
        self._anew, self._unkept, self.landmarks = True, True, 0
        if self._db is None or not self._db.version:
            return False
        self._keep(self._db)
        self._written = True
        return bool(self._generations.paths())

    def keep_next(self) -> None:
        """What lies there becomes a generation before it is replaced, however young the last one is."""
        self._unkept = True

    def close(self) -> None:
        if self._db is not None:
            self._db.close()
        self._db = None

    def _keep(self, db: MapDatabase) -> None:
        """What the database holds becomes the good copy and a generation; without that, a map that somebody else wrote
        or that was given up is not replaced."""
        try:
            if is_ahead(copy_of(self.path), self.path):
                self._generations.keep(whatever_the_age=True)
            self._copy_of(db)
            self._generations.keep(whatever_the_age=self._unkept)
        except (OSError, FileFormatError) as e:
            if self._unkept:
                raise
            _log.warning("%s; the map is saved all the same", e)
        self._unkept = False

    def _copy(self, db: MapDatabase) -> None:
        self._copied = self.landmarks  # or not, for now
        try:
            self._copy_of(db)
        except FileFormatError as e:
            _log.warning("%s; the map is saved all the same", e)

    def _copy_of(self, db: MapDatabase) -> None:
        copy = copy_of(self.path)
        if os.path.lexists(copy) and not copy.is_file():
            _log.warning("%s: not a file, expected a good copy of the map; %s", copy, out_of_the_way(copy))
        keep_copy(db)
        self._copied, self.copied_hash = self.landmarks, db.hash

    def _hold(self, db: MapDatabase) -> None:
        stored = db.load()
        self.landmarks, self._hash = 0 if stored is None else len(stored.landmarks), db.hash
