"""The last good copy of a database of maps: made from one that is whole, used where the database is not."""

from __future__ import annotations

import contextlib
import glob
import logging
import os
import shutil
import time
from pathlib import Path

from ceilvo.daemon.map.database import schema
from ceilvo.daemon.map.database.database import MapDatabase
from ceilvo.daemon.map.database.faults import DamagedError
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
        _take_copy(path, e)
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


def _take_copy(path: Path, damage: DamagedError) -> None:
    """The copy stays a copy; what is damaged is set aside with its log, which must not be applied to the copy."""
    beside = _beside(path)
    try:
        shutil.copyfile(copy_of(path), beside)
        with MapDatabase(beside) as good:
            held = f"{len(good.content().landmarks)} landmarks, version {good.version}"
        _flush(beside)
        made = time.strftime("%Y-%m-%d %H:%M:%S", time.localtime(copy_of(path).stat().st_mtime))
        aside = _set_aside(path)
        beside.replace(path)
    except (OSError, DamagedError) as e:
        raise DamagedError(f"{damage}; the last good copy {copy_of(path).name} is of no use, either: {e}") from e
    finally:
        _remove(beside)
    _log.warning("%s%s", damage, f"; set aside as {aside.name}" if aside else "")
    _log.warning("%s: the last good copy, %s of %s, is used: %s", path, copy_of(path).name, made, held)


def _set_aside(path: Path) -> Path | None:
    """None where there is nothing but a log, perhaps."""
    log, shared = (path.with_name(path.name + end) for end in (LOG, SHARED))
    shared.unlink(missing_ok=True)
    aside = set_aside(path) if os.path.lexists(path) else None
    if aside is None:
        log.unlink(missing_ok=True)
    elif log.exists():
        log.replace(aside.with_name(aside.name + LOG))
    return aside


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
