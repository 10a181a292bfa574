"""What survives a restart: the map and the last pose, in the state directory."""

from __future__ import annotations

import logging
import os
from pathlib import Path

from ceilvo.daemon.map_file import StoredMap, StoredState, load_map, load_state, save_map, save_state
from ceilvo.errors import CeilvoError, FileFormatError
from ceilvo.types import Estimate, Landmarks

_log = logging.getLogger("ceilvo.store")

MAP_NAME, STATE_NAME = "map.json", "state.json"


class Store:
    """Map and state files of one robot; without a folder nothing is kept. Problems are logged, once each."""

    def __init__(self, folder: Path | None) -> None:
        self._folder = folder
        self._complained = ""

    @staticmethod
    def choose(configured: str) -> Store:
        """service.state_dir, else the directory that systemd made, else none."""
        name = configured or os.environ.get("STATE_DIRECTORY", "").split(":")[0]
        return Store(Path(name) if name else None)

    def load(self) -> tuple[StoredMap, StoredState] | None:
        """Map and last pose of an earlier run, None when either is missing or damaged."""
        if self._folder is None:
            return None
        try:
            stored_map, state = load_map(self._folder / MAP_NAME), load_state(self._folder / STATE_NAME)
        except FileFormatError as e:
            _log.warning("starting without the stored map: %s", e)
            return None
        return (stored_map, state) if stored_map is not None and state is not None else None

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
        self._complained = ""
        return True

    @property
    def folder(self) -> Path | None:
        return self._folder
