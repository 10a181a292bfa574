"""Maps of earlier runs: NAME.1 is the last one's, NAME.2 the one's before, and so on."""

from __future__ import annotations

import logging
import os
from pathlib import Path

from ceilvo.daemon.map.database.copies import copy_of, same_maps
from ceilvo.daemon.map.kept.usable import out_of_the_way
from ceilvo.files import write_atomic

_log = logging.getLogger("ceilvo.store")

APART_S = 3600.0
"""Two generations are so far apart at least; chosen: a service that restarts for ever must not push them out."""


class Generations:
    """Of one database; the oldest go."""

    def __init__(self, path: Path, most: int) -> None:
        self._path, self._most = path, most

    def paths(self) -> list[Path]:
        """Those that there are, the newest first."""
        return [p for p in (self._numbered(n) for n in range(1, self._most + 1)) if os.path.lexists(p)]

    def keep(self, whatever_the_age: bool = False) -> None:
        """The last good copy becomes the newest generation, unless that says the same; it stays the good copy.

        Raises:
            OSError: the disk refuses; nothing is lost then.
        """
        copy = copy_of(self._path)
        if not self._most or not copy.exists():
            return
        self._clear()
        newest = self._numbered(1)
        if newest.exists():
            apart_s = abs(copy.stat().st_mtime - newest.stat().st_mtime)
            if (apart_s < APART_S and not whatever_the_age) or same_maps(copy, newest):
                return
        made = self._copied(copy)
        for n in range(self._first_free(), 1, -1):
            self._numbered(n - 1).replace(self._numbered(n))
        made.replace(newest)

    def _clear(self) -> None:
        """A folder or a broken link in the place of a generation would be in the way of every later one."""
        for path in self.paths():
            if not path.is_file():
                _log.warning("%s: not a file, expected an earlier map; %s", path, out_of_the_way(path))

    def _first_free(self) -> int:
        """Where there is a gap, nothing beyond it needs to move."""
        return next((n for n in range(1, self._most) if not os.path.lexists(self._numbered(n))), self._most)

    def _copied(self, copy: Path) -> Path:
        """A second name of the good copy, which the next one replaces; a copy where the disk knows no such names.

        It is made before anything moves: a disk that is full must not cost a generation at every attempt.
        """
        name = self._path.with_name(f".{self._path.name}.{os.getpid()}.tmp")
        name.unlink(missing_ok=True)
        try:
            os.link(copy, name)
        except OSError:
            write_atomic(name, copy.read_bytes())
            stamp = copy.stat()
            os.utime(name, ns=(stamp.st_atime_ns, stamp.st_mtime_ns))
        return name

    def _numbered(self, n: int) -> Path:
        return self._path.with_name(f"{self._path.name}.{n}")
