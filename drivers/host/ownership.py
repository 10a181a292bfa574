"""One owner of a state directory and of a robot's name: two daemons would overwrite each other's map, and one command
would move both robots."""

from __future__ import annotations

import contextlib
import errno
import fcntl
import logging
import os
import socket
import stat
import struct
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from ceilvo.errors import CeilvoError
from ceilvo.files import set_aside

_log = logging.getLogger("ceilvo.owner")

LOCK_NAME = ".owner"
_MOST_BYTES = 20
"""Of a process id and a line's end."""


@contextmanager
def owner_of_folder(folder: Path) -> Iterator[None]:
    """Hold a state directory, by a lock that goes with the process; where it cannot be held, a line says so.

    Raises:
        CeilvoError: another process holds it; names that process.
    """
    path = folder / LOCK_NAME
    try:
        fd = _opened(path, folder)
    except FileNotFoundError:
        yield  # there is no such folder, as the first saving says
        return
    except OSError as e:
        _log.warning(
            "%s: cannot be locked: %s; a second daemon there would not be noticed, remove it", path, e.strerror
        )
        yield
        return
    try:
        with contextlib.suppress(OSError):  # a full disk; the lock holds all the same
            os.ftruncate(fd, 0)
            os.pwrite(fd, f"{os.getpid()}\n".encode(), 0)
        yield
    finally:
        os.close(fd)


def _opened(path: Path, folder: Path) -> int:
    """The lock file. What is no lock file has somebody's data in it and makes way, unless a daemon holds it.

    Raises:
        CeilvoError: another process holds what lies there.
        OSError: it cannot be opened.
    """
    flags = os.O_RDWR | os.O_CREAT | os.O_CLOEXEC | os.O_NOFOLLOW | os.O_NONBLOCK
    for _ in range(2):
        try:
            fd = os.open(path, flags, 0o600)
        except OSError as e:
            if e.errno not in (errno.EISDIR, errno.ELOOP):
                raise
        else:
            seen = os.fstat(fd)
            if stat.S_ISREG(seen.st_mode):
                _lock(fd, folder)
                if seen.st_size <= _MOST_BYTES:
                    return fd
            os.close(fd)
        _log.warning(
            "%s: found something else, expected the daemon's lock; set aside as %s", path, set_aside(path).name
        )
    raise OSError(errno.EEXIST, os.strerror(errno.EEXIST))


def _lock(fd: int, folder: Path) -> None:
    """Lock a file, or close it and raise."""
    try:
        fcntl.flock(fd, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        pid = os.pread(fd, _MOST_BYTES, 0).decode(errors="replace").strip()
        os.close(fd)
        raise CeilvoError(
            f"service.state_dir: {folder} is in use by {_named(pid)}, expected no other daemon there; "
            "stop that one, or give this one a folder of its own"
        ) from None


@contextmanager
def owner_of_name(name: str) -> Iterator[None]:
    """Hold a name on this computer, by an abstract socket that goes with the process.

    Raises:
        CeilvoError: another process of this network namespace holds it; names that process.
    """
    address = f"\0ceilvo/{name}"
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as held:
        try:
            held.bind(address)
            held.listen(1)
        except OSError:
            raise CeilvoError(
                f"robot.name: {name} is in use by {_named(_holder(address))}, expected no other daemon of this name "
                "on this computer; stop that one, or give this one another name"
            ) from None
        yield


def _holder(address: str) -> str:
    """Process id of who holds an abstract socket, "" where it is gone by now."""
    with contextlib.suppress(OSError), socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as s:
        s.settimeout(1.0)
        s.connect(address)
        pid: int = struct.unpack("3i", s.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, 12))[0]
        return str(pid)
    return ""


def _named(pid: str) -> str:
    """A process by its id and command, for people."""
    if not pid.isdigit():
        return "another process"
    with contextlib.suppress(OSError):
        words = Path(f"/proc/{pid}/cmdline").read_bytes().replace(b"\0", b" ").decode(errors="replace").strip()
        return f"process {pid} ({words[:80]})" if words else f"process {pid}"
    return f"process {pid}"
