"""What survives a restart: the map and the last pose, in the state directory."""

from __future__ import annotations

import contextlib
import logging
import os
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

from ceilvo.daemon.map.map_file import StoredMap, StoredState, load_map, load_state, save_map, save_state
from ceilvo.errors import CeilvoError, FileFormatError
from ceilvo.types import Estimate, Landmarks

_log = logging.getLogger("ceilvo.store")

_T = TypeVar("_T")

MAP_NAME, STATE_NAME = "map.json", "state.json"
REJECTED = ".rejected"


class Store:
    """Map and state files of one robot; without a folder nothing is kept. Problems are logged, once each.

    A file that cannot be used is set aside as NAME.rejected before it would be overwritten: it may be mendable, or of
    a newer ceilvo.
    """

    def __init__(self, folder: Path | None) -> None:
        self._folder = folder
        self._complained = ""

    @property
    def error(self) -> str:
        """Why the last saving failed, "" when it did not."""
        return self._complained

    @staticmethod
    def choose(configured: str) -> Store:
        """service.state_dir, else the directory that systemd made, else none."""
        name = configured or os.environ.get("STATE_DIRECTORY", "").split(":")[0]
        return Store(Path(name) if name else None)

    def load(self) -> tuple[StoredMap, StoredState] | None:
        """Map and last pose of an earlier run, None when either is missing or damaged."""
        if self._folder is None:
            return None
        self._sweep(self._folder)
        stored_map = self._read(self._folder / MAP_NAME, load_map)
        state = self._read(self._folder / STATE_NAME, load_state)
        return (stored_map, state) if stored_map is not None and state is not None else None

    def _read(self, path: Path, load: Callable[[Path], _T | None]) -> _T | None:
        try:
            return load(path)
        except FileFormatError as e:
            _log.warning("starting without %s: %s", path.name, e)
        aside = path.with_name(path.name + REJECTED)
        try:
            path.replace(aside)
        except OSError as e:
            _log.warning("%s: cannot be set aside: %s", path, e.strerror or e)
        else:
            _log.warning("%s: set aside as %s", path, aside.name)
        return None

    @staticmethod
    def _sweep(folder: Path) -> None:
        """What a process left that was killed while it wrote."""
        for name in (MAP_NAME, STATE_NAME):
            for left in folder.glob(f".{name}.*.tmp"):
                with contextlib.suppress(OSError):
                    left.unlink()

    def save(self, landmarks: Landmarks, map_axis_rad: float | None, estimate: Estimate) -> bool:
        """Write both files; False when nothing was written, with the reason in the log.

        The map goes first: a state without its map would be a pose in another map.
        """
        if self._folder is None or map_axis_rad is None:
            return False
        try:
            save_map(self._folder / MAP_NAME, landmarks, map_axis_rad)
            save_state(self._folder / STATE_NAME, estimate.pose, estimate.cov, estimate.state, estimate.stamp_ns)
        except CeilvoError as e:
            if str(e) != self._complained:
                self._complained = str(e)
                _log.error("map and pose not saved: %s", e)
            return False
        if self._complained:
            _log.info("map and pose are saved again")
        self._complained = ""
        return True

    @property
    def folder(self) -> Path | None:
        return self._folder
