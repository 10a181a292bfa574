"""The last good copy of a database of maps: made from one that is whole, used where the database is not."""

from __future__ import annotations

import contextlib
import glob
import logging
import os
import shutil
import time
from pathlib import Path
from typing import Any

from ceilvo.daemon.map.database import schema
from ceilvo.daemon.map.database.database import MapDatabase
from ceilvo.daemon.map.database.faults import DamagedError, HeldError, reading
from ceilvo.daemon.map.database.held import floors, read_sides
from ceilvo.daemon.map.transitions import Side
from ceilvo.errors import FileFormatError
from ceilvo.files import set_aside

_log = logging.getLogger("ceilvo.store")

COPY = ".good"
"""What is added to the name of a database."""
LOG, SHARED = "-wal", "-shm"
"""What SQLite adds for the log, and for what programs share of it."""


def copy_of(path: Path) -> Path:
    return path.with_name(path.name + COPY)


def open_map(path: Path, floor: str | None = None, create: bool = False, views: bool = True) -> MapDatabase:
    """A map of a database. Where that is damaged or gone, the last good copy takes its place, and two lines say so.

    Args:
        create: make an empty one where there is none, nor a copy.
        views: look at those of the key poses, too; else they are looked at when they are read.

    Raises:
        FileFormatError: it cannot be used now; DamagedError where it is damaged and there is no good copy.
    """
    _sweep(path)
    missing = not os.path.lexists(path)
    if missing and create and not copy_of(path).exists():
        schema.create(path)
    try:
        return _verified(path, floor, views)
    except DamagedError as e:
        if not copy_of(path).exists():
            raise
        _take_copy(path, floor, e)
    return MapDatabase(path, floor)


def _verified(path: Path, floor: str | None, views: bool) -> MapDatabase:
    db = MapDatabase(path, floor)
    try:
        if views:
            db.content()
    except BaseException:
        db.close()
        raise
    return db


def keep_copy(db: MapDatabase) -> None:
    """Make the good copy what the database holds now; it is read back before it replaces the one before.

    Raises:
        FileFormatError: it cannot be written, or is not whole; the copy before stays.
    """
    target = copy_of(db.path)
    beside = _beside(target)
    try:
        with contextlib.suppress(OSError):
            beside.unlink(missing_ok=True)
        db.copy_to(beside, target)
        _verified(beside, db.floor, views=True).close()
        _flush(beside)
        beside.replace(target)
    except OSError as e:
        raise FileFormatError(f"{target}: cannot be written: {e.strerror or e}; the copy before stays") from e
    finally:
        _remove(beside)


def _take_copy(path: Path, floor: str | None, damage: DamagedError) -> None:
    """The copy stays a copy."""
    try:
        held = _held_by(copy_of(path), floor)
        made = time.strftime("%Y-%m-%d %H:%M:%S", time.localtime(copy_of(path).stat().st_mtime))
        aside = put_in_place(copy_of(path), path)
    except HeldError:
        raise
    except (OSError, FileFormatError) as e:
        raise DamagedError(f"{damage}; the last good copy {copy_of(path).name} is of no use, either: {e}") from e
    _log.warning("%s%s", damage, f"; set aside as {aside.name}" if aside else "")
    _log.warning("%s: the last good copy, %s of %s, is used: %s", path, copy_of(path).name, made, held)


def _held_by(path: Path, floor: str | None) -> str:
    """What a database holds, for people; all of it is read.

    Raises:
        FileFormatError: as open_map; its copy is not looked at.
    """
    with MapDatabase(path, floor) as db:
        return f"{len(db.content().landmarks)} landmarks, version {db.version}"


def put_in_place(source: Path, path: Path) -> Path | None:
    """Make a copy of a database the one at `path`; what lies there is set aside, None where there is nothing.

    Raises:
        OSError: it cannot be written; what lies there stays.
    """
    beside = _beside(path)
    try:
        shutil.copyfile(source, beside)
        _flush(beside)
        aside = set_aside_with_log(path)
        beside.replace(path)
    finally:
        _remove(beside)
    return aside


def set_aside_with_log(path: Path) -> Path | None:
    """As files.set_aside, with the log, which must not be applied to another database; None where there is nothing.

    Raises:
        OSError: the folder cannot be written to.
    """
    log, shared = (path.with_name(path.name + end) for end in (LOG, SHARED))
    shared.unlink(missing_ok=True)
    aside = set_aside(path) if os.path.lexists(path) else None
    if aside is None:
        log.unlink(missing_ok=True)
    elif log.exists():
        log.replace(aside.with_name(aside.name + LOG))
    return aside


def floors_in(path: Path) -> tuple[str, ...]:
    """Names of the maps in a database.

    Raises:
        FileFormatError: as schema.connect.
    """
    return tuple(_column(path, "floor"))


def sides_in(path: Path) -> dict[str, tuple[Side, ...]]:
    """Transitions of every map in a database, by floor.

    Raises:
        FileFormatError: as schema.connect; DamagedError where one is not what was written.
    """
    db = schema.connect(path)
    with contextlib.closing(db), reading(path):
        return {floor: read_sides(db, number) for floor, number in floors(db).items()}


def frames_in(path: Path) -> dict[str, str]:
    """Frames of the maps in a database by their names, in their order; see MapDatabase.frame.

    Raises:
        FileFormatError: as schema.connect.
    """
    return _column(path, "frame")


def same_maps(a: Path, b: Path) -> bool:
    """Whether two databases say the same by their hashes, however often they were written."""
    try:
        return _column(a, "hash") == _column(b, "hash")
    except FileFormatError:
        return False


def is_ahead(copy: Path, path: Path) -> bool:
    """Whether a copy has what a database does not have any more: a map that went another way, or a later one.

    False where the copy is of no use.
    """
    try:
        frames, theirs = _column(path, "frame"), _column(copy, "frame")
        versions, of_copy = _column(path, "version"), _column(copy, "version")
    except FileFormatError:
        return False
    return any(frames.get(floor) != theirs[floor] or versions[floor] < of_copy[floor] for floor in theirs)


def _column(path: Path, name: str) -> dict[str, Any]:
    """By floors."""
    with contextlib.closing(schema.connect(path)) as db, reading(path):
        return dict(db.execute(f"SELECT floor, {name} FROM maps ORDER BY id").fetchall())


def _beside(path: Path) -> Path:
    return path.with_name(f".{path.name}.{os.getpid()}.tmp")


def _remove(path: Path) -> None:
    for end in ("", LOG, SHARED):
        with contextlib.suppress(OSError):
            path.with_name(path.name + end).unlink(missing_ok=True)


def _sweep(path: Path) -> None:
    """What a process left that was killed while it made a copy; the number in its name is that process'."""
    with contextlib.suppress(OSError):  # of the folder, too: it may not be looked into
        for left in path.parent.glob(f".{glob.escape(path.name)}*.tmp*"):
            number = left.name.rpartition(".tmp")[0].rpartition(".")[2]
            if number.isdecimal() and not _runs(int(number)):
                left.unlink(missing_ok=True)


def _runs(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except (ProcessLookupError, OverflowError):
        return False
    except PermissionError:
        return True
    return True


def _flush(path: Path) -> None:
    """To the disk, before the name of another file goes to it."""
    with path.open("rb") as f:
        os.fsync(f.fileno())
