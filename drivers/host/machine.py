"""The computer that the daemon runs on, for the doctor: files, users, programs, who holds which device."""

from __future__ import annotations

import contextlib
import ctypes
import grp
import os
import pwd
import shutil
import stat
import subprocess
from dataclasses import dataclass
from pathlib import Path

_RUN_S = 10.0
"""That a command of the system may take; chosen."""
_PTY_MAKERS = {"/dev/ptmx", "/dev/pts/ptmx"}


def give_back_memory() -> None:
    """Free pages go back to the kernel, where the allocator is glibc: a bad minute is not kept for ever."""
    trim = getattr(ctypes.CDLL(None), "malloc_trim", None)
    if trim is not None:
        trim(ctypes.c_size_t(0))


@dataclass(frozen=True, slots=True)
class Done:
    """A program's exit code and all it printed."""

    code: int
    text: str


@dataclass(frozen=True)
class Machine:
    """The real one; `root` is elsewhere only in tests.

    Attributes:
        root: where /etc, /proc, /opt and so on are.
        user: whose rights count; "" = those of this process.
    """

    root: Path = Path("/")
    user: str = ""

    def path(self, name: str) -> Path:
        """An absolute path, below root."""
        return self.root / name.lstrip("/")

    def text(self, name: str) -> str | None:
        """A file's text, None when it cannot be read."""
        try:
            return self.path(name).read_text(errors="replace")
        except OSError:
            return None

    def run(self, *command: str) -> Done | None:
        """None when there is no such program, or when it hangs."""
        try:
            done = subprocess.run(
                command, capture_output=True, text=True, errors="replace", timeout=_RUN_S, check=False
            )
        except (OSError, subprocess.TimeoutExpired):
            return None
        return Done(done.returncode, (done.stdout + done.stderr).strip())

    def free_bytes(self, folder: Path) -> int:
        return shutil.disk_usage(folder).free

    def may_write(self, path: Path) -> bool:
        """Whether the user may read and write a file, or make files in a folder."""
        if not self.user:
            return os.access(path, os.R_OK | os.W_OK)
        status = path.stat()
        try:
            entry = pwd.getpwnam(self.user)
        except KeyError:
            return False
        if entry.pw_uid == 0:
            return True
        if status.st_uid == entry.pw_uid:
            return status.st_mode & (stat.S_IRUSR | stat.S_IWUSR) == stat.S_IRUSR | stat.S_IWUSR
        if status.st_gid in os.getgrouplist(self.user, entry.pw_gid):
            return status.st_mode & (stat.S_IRGRP | stat.S_IWGRP) == stat.S_IRGRP | stat.S_IWGRP
        return status.st_mode & (stat.S_IROTH | stat.S_IWOTH) == stat.S_IROTH | stat.S_IWOTH

    def has_user(self, name: str) -> bool:
        try:
            pwd.getpwnam(name)
        except KeyError:
            return False
        return True

    def group_of(self, path: Path) -> str:
        gid = path.stat().st_gid
        try:
            return grp.getgrgid(gid).gr_name
        except KeyError:
            return str(gid)

    def holders(self, node: str) -> list[str]:
        """`name (pid n)` of other processes that have a device open, as far as this user may see.

        Who made a pseudo-terminal keeps both ends open, and is not in the way.
        """
        found = []
        for process in self.path("/proc").glob("[0-9]*"):
            opened = _opened(process / "fd") if int(process.name) != os.getpid() else set()
            if node in opened and not (node.startswith("/dev/pts/") and _PTY_MAKERS & opened):
                name = (self.text(f"/proc/{process.name}/comm") or "?").strip()
                found.append(f"{name} (pid {process.name})")
        return sorted(found)


def _opened(descriptors: Path) -> set[str]:
    """What a process has open; empty where that may not be seen."""
    found = set()
    try:
        for entry in descriptors.iterdir():
            with contextlib.suppress(OSError):  # closed in between
                found.add(str(entry.readlink()))
    except OSError:
        return set()
    return found
