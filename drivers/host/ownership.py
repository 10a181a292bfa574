"""One owner of a state directory and of a robot's name: two daemons would overwrite each other's map, and one command
would move both robots."""

from __future__ import annotations

import contextlib
import fcntl
import os
import socket
import struct
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from ceilvo.errors import CeilvoError

LOCK_NAME = ".owner"


@contextmanager
def owner_of_folder(folder: Path) -> Iterator[None]:
    """Hold a state directory, by a lock that goes with the process; a folder that cannot be written to is not held.

    Raises:
        CeilvoError: another process holds it; names that process.
    """
    try:
        fd = os.open(folder / LOCK_NAME, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600)
    except OSError:
        yield
        return
    try:
        try:
            fcntl.flock(fd, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            pid = os.pread(fd, 20, 0).decode(errors="replace").strip()
            raise CeilvoError(
                f"service.state_dir: {folder} is in use by {_named(pid)}, expected no other daemon there; "
                "stop that one, or give this one a folder of its own"
            ) from None
        os.ftruncate(fd, 0)
        os.pwrite(fd, f"{os.getpid()}\n".encode(), 0)
        yield
    finally:
        os.close(fd)


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
