"""A real disk of some megabytes, to be filled and made read-only: a tmpfs in a mount namespace of its own."""

from __future__ import annotations

import errno
import os
import shutil
import subprocess
from pathlib import Path

_KEEPER = 'echo ready; while read -r line; do eval "$line" && echo done || echo failed; done'


class SmallDisk:
    """Seen through /proc from outside of its namespace, so that any process can use it.

    Attributes:
        path: where it is.
        folder: where it is to inside().
    """

    def __init__(self, folder: Path, size: str = "4m") -> None:
        folder.mkdir()
        self.folder = folder
        self._keeper = subprocess.Popen(
            [*_unshare(), "sh", "-c", f"mount -t tmpfs -o size={size},mode=755 ceilvo {folder} && {_KEEPER}"],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
        )
        assert self._keeper.stdout is not None
        said = self._keeper.stdout.readline()
        assert said == "ready\n", said
        self.path = Path(f"/proc/{self._keeper.pid}/root{folder}")
        self._filler = self.path / "filler"

    def fill(self) -> None:
        """Until not a byte more goes in."""
        with self._filler.open("ab", buffering=0) as f:
            for size in (65536, 1):
                try:
                    while f.write(bytes(size)):
                        pass
                except OSError as e:
                    assert e.errno == errno.ENOSPC

    def free(self) -> None:
        self._filler.unlink()

    def make_read_only(self) -> None:
        """By a second mount of it, which lies above the first: a mount with open files cannot be made read-only."""
        self._do(f"mount --bind {self.folder} {self.folder} && mount -o remount,bind,ro {self.folder}")

    def make_writable(self) -> None:
        self._do(f"umount {self.folder}")

    def inside(self, *command: str | Path) -> subprocess.CompletedProcess[str]:
        """Run a command that sees the disk as `folder`: SQLite follows links, and /proc's lead nowhere."""
        return subprocess.run([*self.enter, *map(str, command)], capture_output=True, text=True, check=False)

    @property
    def enter(self) -> list[str]:
        """What to put before a command that shall see the disk as `folder`."""
        user = [] if os.geteuid() == 0 else ["--user", "--preserve-credentials"]
        return ["nsenter", "--target", str(self._keeper.pid), "--mount", *user, "--"]

    def close(self) -> None:
        self._keeper.communicate("")

    def _do(self, command: str) -> None:
        assert self._keeper.stdin is not None and self._keeper.stdout is not None
        self._keeper.stdin.write(command + "\n")
        self._keeper.stdin.flush()
        said = self._keeper.stdout.readline()
        assert said == "done\n", f"{command}: {said}"


def why_not() -> str:
    """Why no such disk can be made here; "" where it can."""
    for tool in ("unshare", "nsenter"):
        if not shutil.which(tool):
            return f"{tool} is not installed (util-linux)"
    tried = subprocess.run(
        [*_unshare(), "mount", "-t", "tmpfs", "none", "/mnt"], capture_output=True, text=True, check=False
    )
    return "" if tried.returncode == 0 else f"nothing may be mounted here: {tried.stderr.strip()}"


def _unshare() -> list[str]:
    return ["unshare", "--mount"] if os.geteuid() == 0 else ["unshare", "--user", "--map-root-user", "--mount"]
