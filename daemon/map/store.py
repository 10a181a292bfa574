"""What survives a restart: the map and the last pose, in the state directory."""

from __future__ import annotations

import contextlib
import logging
import os
import threading
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from ceilvo.daemon.map.generations import Generations
from ceilvo.daemon.map.map_file import StoredMap, StoredState, load_map, load_state, save_state
from ceilvo.daemon.map.map_slot import MapSlot
from ceilvo.daemon.map.usable import usable
from ceilvo.errors import CeilvoError
from ceilvo.types import Array, Estimate, Landmarks

_log = logging.getLogger("ceilvo.store")

MAP_NAME, STATE_NAME = "map.json", "state.json"
BESIDE_NAME = "map.smaller.json"
"""A map that is much smaller than the one that is kept."""
VAGUE_M, VAGUE_RAD = 100.0, np.pi
"""A sigma from which on a pose or a landmark says nothing; chosen: more than a building, any heading. Far larger ones,
of hours in the dark, leave no digits for the filter."""
_VAGUE_COV = np.diag([1e2 * VAGUE_M**2, 1e2 * VAGUE_M**2, 1e2 * VAGUE_RAD**2])
"""Stored for all of them."""
_NOT_SAVED = "map and pose not saved"


@dataclass(frozen=True)
class Kept:
    """What an earlier run left.

    Attributes:
        state: the last pose on this map; None where it is not known.
        said: what was loaded, for people.
    """

    map: StoredMap
    state: StoredState | None
    said: str


class Store:
    """Map and state files of one robot; without a folder nothing is kept. Problems are logged, once each. Thread-safe.

    A file that cannot be used is set aside before it would be overwritten. Maps of earlier runs stay as generations,
    and a map never gives way to a much smaller one.
    """

    def __init__(self, folder: Path | None, generations: int = 5) -> None:
        self._folder = folder
        self._complained = ""
        self._written = False
        self._in_use = False
        self._lock = threading.Lock()
        at = Path() if folder is None else folder
        self._map, self._beside = MapSlot(at / MAP_NAME), MapSlot(at / BESIDE_NAME)
        self._generations = Generations(self._map.path, generations)

    @property
    def error(self) -> str:
        """Why the last saving failed, "" when it did not."""
        return self._complained

    @staticmethod
    def choose(configured: str, generations: int) -> Store:
        """service.state_dir, else the directory that systemd made, else none."""
        name = configured or os.environ.get("STATE_DIRECTORY", "").split(":")[0]
        return Store(Path(name) if name else None, generations)

    def load(self) -> Kept | None:
        """The map of an earlier run and its last pose; None where no map can be used."""
        if self._folder is None:
            return None
        self._sweep(self._folder)
        stored, name = self._map.read(), MAP_NAME
        state = usable(self._folder / STATE_NAME, load_state)
        if stored is None:
            stored, name = self._earlier()
        if stored is None:
            return None
        self._map.landmarks, self._in_use = len(stored.landmarks), True
        said = "its last pose is a hypothesis until landmarks confirm it"
        if state is None or _is_vague(state.cov) or _is_off(state.pose, stored.landmarks):
            state, said = None, "without a pose: the robot is searched for on all of it"
        which = "stored map loaded" if name == MAP_NAME else f"an earlier map loaded, {name}"
        return Kept(_bounded(stored), state, f"{which}, {len(stored.landmarks)} landmarks; {said}")

    def _earlier(self) -> tuple[StoredMap | None, str]:
        """The newest generation that can be used, and its name."""
        for path in self._generations.paths():
            stored = usable(path, load_map)
            if stored is not None:
                return stored, path.name
        return None, ""

    @staticmethod
    def _sweep(folder: Path) -> None:
        """What a process left that was killed while it wrote."""
        for name in (MAP_NAME, STATE_NAME, BESIDE_NAME):
            with contextlib.suppress(OSError):  # of the folder, too: it may not be looked into
                for left in folder.glob(f".*{name}.*.tmp"):
                    left.unlink(missing_ok=True)

    def begin_anew(self) -> bool:
        """The map was given up by its owner: what is saved next may be smaller. True where the old one stays as the
        newest generation."""
        if self._folder is None:
            return False
        with self._lock:
            self._written, self._in_use = False, False
            try:
                self._generations.keep(whatever_the_age=True)
            except OSError as e:
                self._map.give_up(kept=False)
                return self._complain(f"map not kept as a generation: {e}")
            self._map.give_up(kept=True)
            return bool(self._generations.paths())

    def save(
        self, landmarks: Landmarks, map_axis_rad: float | None, estimate: Estimate, elsewhere: float = 0.0
    ) -> bool:
        """Write both files; False when they were not, with the reason in the log.

        The map goes first: a state without its map would be a pose in another map.

        Args:
            elsewhere: probability that the robot is at another place.
        """
        if self._folder is None or map_axis_rad is None:
            return False
        with self._lock:
            try:
                self._map.look()
                if self._map.is_better_than(len(landmarks)):
                    return self._save_beside(landmarks, map_axis_rad)
                if not self._written or self._map.unkept:
                    self._generations.keep(whatever_the_age=self._map.unkept)
                self._map.write(landmarks, map_axis_rad)
                self._write_pose(self._folder, estimate, elsewhere)
            except (CeilvoError, OSError) as e:
                return self._complain(f"{_NOT_SAVED}: {e}")
            if self._complained:
                _log.info("map and pose are saved again")
            self._complained, self._written, self._in_use = "", True, True
            return True

    def save_pose(self, estimate: Estimate, elsewhere: float = 0.0) -> bool:
        """Write the pose alone; False where the map that lies in the folder is not the one in use, or saving failed of
        late: then it waits for the map."""
        if self._folder is None:
            return False
        with self._lock:
            if not self._in_use or self._complained or not self._map.is_ours():
                return False
            try:
                self._write_pose(self._folder, estimate, elsewhere)
            except (CeilvoError, OSError) as e:
                return self._complain(f"{_NOT_SAVED}: {e}")
            return True

    @staticmethod
    def _write_pose(folder: Path, e: Estimate, elsewhere: float) -> None:
        cov = _VAGUE_COV if _is_vague(e.cov) else e.cov
        save_state(folder / STATE_NAME, e.pose, cov, e.state, e.stamp_ns, elsewhere)

    def _save_beside(self, landmarks: Landmarks, map_axis_rad: float) -> bool:
        """Where a smaller map of another run lies that is itself better than this one, nothing is written."""
        self._beside.look()
        there = f"{BESIDE_NAME} of an earlier run has more, too, and stays"
        if not self._beside.is_better_than(len(landmarks)):
            self._beside.write(landmarks, map_axis_rad)
            there = f"that one is in {BESIDE_NAME}"
        return self._complain(
            f"{MAP_NAME} with {self._map.landmarks} landmarks is kept, for the map in use has only {len(landmarks)}; "
            f"{there}. If it is the right one: cmd/reset without the map, then save"
        )

    def _complain(self, why: str) -> bool:
        """Once for each kind of trouble: figures in it change at every save."""
        if why[:20] != self._complained[:20]:
            _log.error("%s", why)
        self._complained = why
        return False

    @property
    def folder(self) -> Path | None:
        return self._folder


def _is_vague(cov: Array) -> bool:
    """Whether a pose with this covariance (3, 3) may as well be anywhere."""
    sigma = np.sqrt(np.diag(cov))
    return not (max(sigma[:2]) < VAGUE_M and sigma[2] < VAGUE_RAD)


def _is_off(pose: Array, landmarks: Landmarks) -> bool:
    """Whether a pose (3,) is so far from all of the map that it is as good as none."""
    if not len(landmarks):
        return False
    low, high = landmarks.xy_map_m.min(axis=0), landmarks.xy_map_m.max(axis=0)
    return bool(np.any(np.maximum(low - pose[:2], pose[:2] - high) > VAGUE_M))


def _bounded(stored: StoredMap) -> StoredMap:
    """The map with no landmark vaguer than VAGUE_M."""
    cov_m2 = stored.landmarks.cov_m2
    largest_m2 = np.maximum(cov_m2[:, 0, 0], cov_m2[:, 1, 1])
    share = np.minimum(1.0, VAGUE_M**2 / np.maximum(largest_m2, VAGUE_M**2))
    return replace(stored, landmarks=replace(stored.landmarks, cov_m2=share[:, None, None] * cov_m2))
