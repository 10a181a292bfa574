"""What survives a restart: the map and the last pose, in the state directory."""

from __future__ import annotations

import contextlib
import logging
import os
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

from ceilvo.daemon.map.generations import Generations
from ceilvo.daemon.map.map_file import StoredMap, StoredState, load_map, load_state, save_map, save_state
from ceilvo.errors import CeilvoError, FileFormatError
from ceilvo.types import Estimate, Landmarks

_log = logging.getLogger("ceilvo.store")

_T = TypeVar("_T")

MAP_NAME, STATE_NAME = "map.json", "state.json"
BESIDE_NAME = "map.smaller.json"
"""A map that is much smaller than the one that is kept."""
REJECTED = ".rejected"
_NOT_SAVED = "map and pose not saved"
SMALLER = 0.5
"""A map with less than this share of the landmarks does not replace the one that is kept; chosen: what was renovated
or forgotten is less, and a robot that begins again on another ceiling has less for minutes."""


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
    """Map and state files of one robot; without a folder nothing is kept. Problems are logged, once each.

    A file that cannot be used is set aside as NAME.rejected before it would be overwritten: it may be mendable, or of
    a newer ceilvo. Maps of earlier runs stay as generations, and a map never gives way to a much smaller one.
    """

    def __init__(self, folder: Path | None, generations: int = 5) -> None:
        self._folder = folder
        self._complained = ""
        self._landmarks = 0
        self._written = False
        self._in_use = False
        self._generations = None if folder is None else Generations(folder / MAP_NAME, generations)

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
        stored = self._read(self._folder / MAP_NAME, load_map)
        state = self._read(self._folder / STATE_NAME, load_state)
        said = "stored map loaded; its last pose is a hypothesis until landmarks confirm it"
        if stored is None:
            stored, said = self._earlier(), "an earlier map loaded, for the last one is missing or damaged"
        elif state is None:
            said = "stored map loaded without a pose: the robot is searched for on all of it"
        if stored is None:
            return None
        self._landmarks, self._in_use = len(stored.landmarks), True
        return Kept(stored, state, said)

    def _earlier(self) -> StoredMap | None:
        """The newest generation that can be used."""
        for path in [] if self._generations is None else self._generations.paths():
            stored = self._read(path, load_map)
            if stored is not None:
                _log.warning("%s: used instead of %s", path.name, MAP_NAME)
                return stored
        return None

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
        for name in (MAP_NAME, STATE_NAME, BESIDE_NAME):
            with contextlib.suppress(OSError):  # of the folder, too: it may not be looked into
                for left in folder.glob(f".{name}.*.tmp"):
                    left.unlink(missing_ok=True)

    def begin_anew(self) -> bool:
        """The map was given up by its owner: what is saved next may be smaller. True where the old one stays as the
        newest generation."""
        self._landmarks, self._written, self._in_use = 0, False, False
        if self._generations is None:
            return False
        try:
            self._generations.keep(whatever_the_age=True)
        except OSError as e:
            return self._complain(f"map not kept as a generation: {e}")
        return bool(self._generations.paths())

    def save(
        self, landmarks: Landmarks, map_axis_rad: float | None, estimate: Estimate, elsewhere: float = 0.0
    ) -> bool:
        """Write both files; False when they were not, with the reason in the log.

        The map goes first: a state without its map would be a pose in another map.

        Args:
            elsewhere: probability that the robot is at another place.
        """
        if self._folder is None or self._generations is None or map_axis_rad is None:
            return False
        smaller = len(landmarks) < SMALLER * self._landmarks
        try:
            if smaller:
                save_map(self._folder / BESIDE_NAME, landmarks, map_axis_rad)
            else:
                if not self._written:
                    self._generations.keep()
                save_map(self._folder / MAP_NAME, landmarks, map_axis_rad)
                self._write_pose(self._folder, estimate, elsewhere)
        except (CeilvoError, OSError) as e:
            return self._complain(f"{_NOT_SAVED}: {e}")
        if smaller:
            return self._complain(
                f"{MAP_NAME} with {self._landmarks} landmarks is kept, for the map in use has only {len(landmarks)}; "
                f"that one is in {BESIDE_NAME}. If it is the right one: cmd/reset without the map, then save"
            )
        if self._complained:
            _log.info("map and pose are saved again")
        self._complained, self._landmarks, self._written, self._in_use = "", len(landmarks), True, True
        return True

    def save_pose(self, estimate: Estimate, elsewhere: float = 0.0) -> bool:
        """Write the pose alone; False where the map that lies in the folder is not the one in use, or saving failed of
        late: then it waits for the map."""
        if self._folder is None or not self._in_use or self._complained:
            return False
        try:
            self._write_pose(self._folder, estimate, elsewhere)
        except (CeilvoError, OSError) as e:
            return self._complain(f"{_NOT_SAVED}: {e}")
        return True

    @staticmethod
    def _write_pose(folder: Path, e: Estimate, elsewhere: float) -> None:
        save_state(folder / STATE_NAME, e.pose, e.cov, e.state, e.stamp_ns, elsewhere)

    def _complain(self, why: str) -> bool:
        """Once for each kind of trouble: figures in it change at every save."""
        if why[:20] != self._complained[:20]:
            _log.error("%s", why)
        self._complained = why
        return False

    @property
    def folder(self) -> Path | None:
        return self._folder
