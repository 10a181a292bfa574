"""Files of SQLite: transactions, how a file is made, and what is wrong with one as one line for people."""

from __future__ import annotations

import contextlib
import errno
import os
import sqlite3
import stat
import threading
import weakref
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from ceilvo.daemon.map.checks import Damage
from ceilvo.errors import FileFormatError, one_line

MAGIC = b"SQLite format 3\0"
"""What every such file begins with."""
BUSY_S = 5.0
"""Another program may hold the file for so long; chosen: an edit of 100,000 landmarks takes about 2 s."""
_NOT_WRITTEN = {
    "full": "make room on its disk",
    "readonly": "expected a file and a folder that you may write to, check their owner",
    "locked": f"another program held it for {BUSY_S:g} s, stop that one or try again",
    "disk I/O": "check its disk",
}
"""What SQLite's messages have in them, and what to do; nothing is wrong with the content then."""
_NOT_READ = {
    "unable to open": "expected a file and a folder that you may read, check their owner",
    "locked": _NOT_WRITTEN["locked"],
    "readonly": _NOT_WRITTEN["readonly"],
}


class DamagedError(FileFormatError):
    """The file is no map any more, or none yet; the last good copy takes its place."""


class SupersededError(FileFormatError):
    """The map is not the one that a change was made of; nothing was changed."""


class HeldError(FileFormatError):
    """Another program holds the file; nothing is wrong with it."""


def expect(path: Path, is_hash: str, found: str) -> None:
    """See that a map is still the one that a change was made of; found: its hash then, "" where that does not matter.

    Raises:
        SupersededError: it is another one.
    """
    if found not in ("", is_hash):
        raise SupersededError(
            f"{path}: nothing was written: another program has written to it since it was read, its hash is "
            f"{is_hash[:12]}, expected {found[:12]}; run it again"
        )


@contextmanager
def reading(path: Path) -> Iterator[None]:
    """Whatever SQLite or the checks of values find wrong becomes one line.

    Raises:
        FileFormatError: it cannot be read now; HeldError for another program; DamagedError where it never will.
    """
    try:
        yield
    except (sqlite3.Error, OverflowError, UnicodeError) as e:  # the last of a message that quotes what is damaged
        for word, remedy in _NOT_READ.items():
            if isinstance(e, sqlite3.OperationalError) and word in str(e):
                kind = HeldError if word == "locked" else FileFormatError
                raise kind(f"{path}: cannot be read: {e}; {remedy}") from e
        raise damaged(path, f"damaged: {one_line(e)}") from e
    except Damage as e:
        raise damaged(path, f"damaged: {e}") from e


@contextmanager
def writing(path: Path) -> Iterator[None]:
    """As reading(), of a transaction that came to nothing."""
    try:
        yield
    except sqlite3.OperationalError as e:
        for word, remedy in (_NOT_READ | _NOT_WRITTEN).items():
            if word in str(e):
                raise FileFormatError(f"{path}: cannot be written: {e}; nothing was changed, {remedy}") from e
        raise damaged(path, f"damaged: {one_line(e)}") from e
    except (sqlite3.Error, UnicodeError) as e:
        raise damaged(path, f"damaged: {one_line(e)}") from e
    except (Damage, OverflowError) as e:
        raise FileFormatError(f"{path}: not written, it holds what it held: {e}") from e


@contextmanager
def transaction(path: Path, db: sqlite3.Connection) -> Iterator[sqlite3.Connection]:
    """All of it or nothing, on the disk when it is done.

    Raises:
        FileFormatError: it could not be written; nothing was changed.
    """
    with writing(path):
        db.execute("BEGIN IMMEDIATE")
        try:
            yield db
            db.execute("COMMIT")
        except BaseException:
            if db.in_transaction:
                db.execute("ROLLBACK")
            raise


def make_file(path: Path, fill: Callable[[sqlite3.Connection], None]) -> None:
    """A new file, made beside and renamed: a kill meanwhile leaves none rather than half of one.

    Args:
        fill: makes its tables.

    Raises:
        FileFormatError: it cannot be written.
    """
    beside = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    try:
        beside.unlink(missing_ok=True)
        with writing(path), contextlib.closing(sqlite3.connect(beside, isolation_level=None)) as db:
            fill(db)
        beside.replace(path)
    except OSError as e:
        raise FileFormatError(f"{path}: cannot be written: {e.strerror or e}; check its folder and its owner") from e
    finally:
        with contextlib.suppress(OSError):
            beside.unlink(missing_ok=True)


def damaged(path: Path, what: str) -> DamagedError:
    return DamagedError(f"{path}: {what}; restore a backup, or begin with an earlier map or a new one")


class Connection(sqlite3.Connection):
    """A file of which this process knows that it is open."""

    file: tuple[int, int] | None = None

    def close(self) -> None:
        self.file = None
        super().close()


_open: weakref.WeakSet[Connection] = weakref.WeakSet()
_open_lock = threading.Lock()


def note_open(path: Path, db: Connection) -> None:
    """To be called for each connection that is to last."""
    found = path.stat()
    with _open_lock:
        db.file = found.st_dev, found.st_ino
        _open.add(db)


def is_open_here(found: os.stat_result) -> bool:
    """Whether SQLite has a file open in this process."""
    with _open_lock:
        return any(db.file == (found.st_dev, found.st_ino) for db in _open)


def look_at(path: Path) -> None:
    """See what lies under the name before SQLite does, which waits for a pipe and writes into an empty file.

    One that SQLite has open in this process is left to it: whoever opens and closes it by other means lets go of all
    locks that SQLite holds on it here (POSIX), and the next program that closes the database takes itself for the last
    one and removes the log, with all that is written to it since.

    Raises:
        FileFormatError: DamagedError where it is no database.
    """
    try:
        found = path.stat()
        if not stat.S_ISREG(found.st_mode):
            raise damaged(path, "a folder, a pipe or a device, expected a file")
        if is_open_here(found):
            return
        with path.open("rb") as f:
            head = f.read(len(MAGIC))
    except FileNotFoundError as e:
        what = f"a link to {path.readlink()}, which is not there" if path.is_symlink() else "no such file"
        raise damaged(path, f"{what}, expected a database of maps") from e
    except (OSError, ValueError) as e:
        if isinstance(e, OSError) and e.errno == errno.ELOOP:
            raise damaged(path, "a link to itself, expected a database of maps") from e
        why = (e.strerror or str(e)) if isinstance(e, OSError) else str(e)
        raise FileFormatError(f"{path}: cannot be read: {why}; check its name and its owner") from e
    if head != MAGIC:
        raise damaged(path, f"begins with {head!r}, expected a database of maps (SQLite)")
