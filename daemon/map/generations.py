"""Maps of earlier runs: NAME.1 is the last one's, NAME.2 the one's before, and so on."""

from __future__ import annotations

import contextlib
import os
from pathlib import Path

from ceilvo.files import write_atomic

APART_S = 3600.0
"""Two generations are so far apart at least; chosen: a service that restarts for ever must not push them out."""


class Generations:
    """Of one file; the oldest go."""

    def __init__(self, path: Path, most: int) -> None:
        self._path, self._most = path, most

    def paths(self) -> list[Path]:
        """Those that there are, the newest first."""
        return [p for p in (self._numbered(n) for n in range(1, self._most + 1)) if _is_there(p)]

    def keep(self, whatever_the_age: bool = False) -> None:
        """What the file holds now becomes the newest generation; the file itself stays where it is.

        Raises:
            OSError: the disk refuses; nothing is lost then.
        """
        if not self._most or not self._path.exists():
            return
        newest = self._numbered(1)
        if newest.exists():
            apart_s = abs(self._path.stat().st_mtime - newest.stat().st_mtime)
            if newest.samefile(self._path) or (apart_s < APART_S and not whatever_the_age):
                return
        for n in range(self._most, 1, -1):
            with contextlib.suppress(FileNotFoundError):
                self._numbered(n - 1).replace(self._numbered(n))
        self._copy_to(newest)

    def _copy_to(self, to: Path) -> None:
        """As a second name of the file, which the next save replaces; as a copy where the disk knows no such names."""
        name = to.with_name(f".{self._path.name}.{os.getpid()}.tmp")
        try:
            name.unlink(missing_ok=True)
            os.link(self._path, name)
            name.replace(to)
        except OSError:
            write_atomic(to, self._path.read_bytes())

    def _numbered(self, n: int) -> Path:
        return self._path.with_name(f"{self._path.name}.{n}")


def _is_there(path: Path) -> bool:
    """Not where the folder may not be looked into, or has an impossible name, which Path.exists() raises."""
    try:
        path.stat()
    except (OSError, ValueError):
        return False
    return True
