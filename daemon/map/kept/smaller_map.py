"""A map that is much smaller than the one that is kept: it goes beside, into a file that `ceilvod map` reads."""

from __future__ import annotations

from pathlib import Path

from ceilvo.daemon.map.kept.usable import usable
from ceilvo.daemon.map.map_file import load_map, save_map
from ceilvo.types import Landmarks

SMALLER = 0.5
"""A map with less than this share of the landmarks does not replace the one that is kept; chosen: what was renovated
or forgotten is less, and a robot that begins again on another ceiling has less for minutes."""


def is_much_smaller(count: int, kept: int) -> bool:
    """Whether a map of `count` landmarks must not replace one of so many that is kept."""
    return count < SMALLER * kept


class SmallerMap:
    """Where one of an earlier run lies there that is itself much larger than what comes, it stays."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._landmarks: int | None = None

    def write(self, landmarks: Landmarks, map_axis_rad: float) -> bool:
        """Write it, but over a much larger one; whether it was written.

        Raises:
            FileFormatError: as save_map.
        """
        if self._landmarks is None:
            stored = usable(self._path, load_map)
            self._landmarks = 0 if stored is None else len(stored.landmarks)
        if is_much_smaller(len(landmarks), self._landmarks):
            return False
        save_map(self._path, landmarks, map_axis_rad)
        self._landmarks = len(landmarks)
        return True
