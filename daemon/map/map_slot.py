"""A map file, and what we know it to hold: nothing replaces a map that is better than what comes."""

from __future__ import annotations

from pathlib import Path

from ceilvo.daemon.map.map_file import StoredMap, load_map, save_map
from ceilvo.daemon.map.usable import usable
from ceilvo.types import Landmarks

SMALLER = 0.5
"""A map with less than this share of the landmarks does not replace the one that is kept; chosen: what was renovated
or forgotten is less, and a robot that begins again on another ceiling has less for minutes."""

_Mark = tuple[int, int, int, int]


class MapSlot:
    """One map file. A map that somebody else puts there meanwhile is noticed: a disk that was mounted late, a backup.

    Attributes:
        path: of the file.
        landmarks: in the file, when it was last read or written.
        unkept: it becomes a generation before it is replaced, whatever its age; somebody else wrote it.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.landmarks = 0
        self.unkept = False
        self._mark: _Mark | None = None

    def read(self) -> StoredMap | None:
        """The map; one that cannot be used is set aside."""
        stored = usable(self.path, load_map)
        self._hold(0 if stored is None else len(stored.landmarks))
        return stored

    def is_ours(self) -> bool:
        """Whether nobody else put a map there since it was read or written."""
        return _mark(self.path) in (None, self._mark)

    def look(self) -> None:
        """See to a map that somebody else put there since."""
        if not self.is_ours():
            self.unkept = self.read() is not None

    def is_better_than(self, count: int) -> bool:
        """Whether the map that is kept has so many more landmarks that one of so many must not replace it."""
        return count < SMALLER * self.landmarks

    def write(self, landmarks: Landmarks, map_axis_rad: float) -> None:
        """Replace the map.

        Raises:
            FileFormatError: as save_map.
        """
        save_map(self.path, landmarks, map_axis_rad)
        self._hold(len(landmarks))
        self.unkept = False

    def give_up(self, kept: bool) -> None:
        """Any map may replace it now, however small; kept: it is a generation already."""
        self._hold(0)
        self.unkept = not kept

    def _hold(self, count: int) -> None:
        self.landmarks, self._mark = count, _mark(self.path)


def _mark(path: Path) -> _Mark | None:
    """What changes when somebody writes a file; None where there is none."""
    try:
        s = path.stat()
    except (OSError, ValueError):  # the latter of an impossible name
        return None
    return s.st_dev, s.st_ino, s.st_size, s.st_mtime_ns
