"""What survives a restart: the map and the last pose, in the state directory."""

from __future__ import annotations

import contextlib
import logging
import os
import threading
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from ceilvo.calibration import LEVEL_CEILING, CeilingShape
from ceilvo.daemon.map.database.faults import SupersededError
from ceilvo.daemon.map.kept.apart import Apart
from ceilvo.daemon.map.kept.change import Change, unmoved
from ceilvo.daemon.map.kept.found import Found
from ceilvo.daemon.map.kept.kept_map import OLD_NAME, KeptMap
from ceilvo.daemon.map.kept.smaller_map import SmallerMap, is_much_smaller
from ceilvo.daemon.map.kept.usable import usable
from ceilvo.daemon.map.key_poses import KeyPoses
from ceilvo.daemon.map.map_file import StoredMap, StoredState, load_state, save_state
from ceilvo.errors import CeilvoError
from ceilvo.types import Array, Estimate, Landmarks, Pose

_log = logging.getLogger("ceilvo.store")

MAP_NAME, STATE_NAME = "map.db", "state.json"
SHELF = "maps"
"""A folder of maps beside the one in use, see daemon.shelf."""
BESIDE_NAME = "map.smaller.json"
"""A map that is much smaller than the one that is kept."""
VAGUE_M, VAGUE_RAD = 100.0, np.pi
"""A sigma from which on a pose or a landmark says nothing; chosen: more than a building, any heading. Far larger ones,
of hours in the dark, leave no digits for the filter."""
_VAGUE_COV = np.diag([1e2 * VAGUE_M**2, 1e2 * VAGUE_M**2, 1e2 * VAGUE_RAD**2])
"""Stored for all of them."""
_NOT_SAVED = "map and pose not saved"


def state_folder(configured: str) -> Path | None:
    """service.state_dir, else the directory that systemd made, else none."""
    name = configured or os.environ.get("STATE_DIRECTORY", "").split(":")[0]
    return Path(name) if name else None


@dataclass(frozen=True)
class Kept:
    """What an earlier run left.

    Attributes:
        state: the last pose; None where it is not known.
        said: what was loaded, for people.
        floors: the map of each floor that the robot can get to, the home floor's first; empty for one.
        floor: that the last pose is on.
    """

    map: StoredMap
    state: StoredState | None
    said: str
    floors: tuple[Found, ...] = ()
    floor: str = ""


class Store:
    """Map and last pose of one robot; without a folder nothing is kept. Problems are logged, once each. Thread-safe.

    A file that cannot be used is set aside before it would be overwritten. Maps of earlier runs stay as generations,
    and a map never gives way to a much smaller one.

    Attributes:
        given_up: how often its owner gave the map up.
    """

    def __init__(self, folder: Path | None, generations: int = 5, session: str = "robot", floor: str = "") -> None:
        """session: names the drive, as in KeyPoses; floor: of the map, "" for the only one or the first."""
        self._folder, self._session = folder, session
        self._complained = ""
        self._in_use = False
        self.given_up = 0
        self._lock = threading.Lock()
        at = Path() if folder is None else folder
        self._generations = generations
        self._map = KeptMap(at / MAP_NAME, generations, session, floor)
        self._others: dict[str, KeptMap] = {}
        self._apart = Apart(at / MAP_NAME)
        self._beside = SmallerMap(at / BESIDE_NAME)

    @property
    def error(self) -> str:
        """Why the last saving failed, "" when it did not."""
        return self._complained

    @staticmethod
    def choose(configured: str, generations: int, session: str = "robot", floor: str = "") -> Store:
        """Of state_folder()."""
        return Store(state_folder(configured), generations, session, floor)

    def load(self) -> Kept | None:
        """The map of an earlier run and its last pose; None where no map can be used."""
        if self._folder is None:
            return None
        self._sweep(self._folder)
        with self._lock:
            found = self._map.read()
            floors = () if found is None else self._map.floors(found)
            self._others = {f.floor: self._kept_map(f.floor) for f in floors[1:]}
        state = usable(self._folder / STATE_NAME, load_state)
        if found is None:
            return None
        self._in_use = True
        self._apart.begin(found.map if len(floors) == 1 else None, self._map.hash)
        said, on = "its last pose is a hypothesis until landmarks confirm it", found
        if state is not None and state.frame is not None:
            on = next((f for f in floors if f.frame == state.frame), found)
        if state is not None and state.frame not in (None, on.frame):
            state, said = None, "its last pose was on another map: the robot is searched for on all of it"
        elif state is None or _is_vague(state.cov) or _is_off(state.pose, on.map.landmarks):
            state, said = None, "without a pose: the robot is searched for on all of it"
        said = f"{_which(found, floors)}, {sum(len(f.map.landmarks) for f in floors)} landmarks; {said}"
        several = tuple(replace(f, map=_bounded(f.map)) for f in floors) if len(floors) > 1 else ()
        return Kept(_bounded(found.map), state, said, several, on.floor)

    def _kept_map(self, floor: str) -> KeptMap:
        assert self._folder is not None
        return KeptMap(self._folder / MAP_NAME, self._generations, self._session, floor)

    def map_of(self, floor: str) -> tuple[str, int | None]:
        """Name and version of the map of a floor; of the home floor's for "". None while it is not kept."""
        kept = self._on(floor)
        return kept.name, kept.version

    def _on(self, floor: str) -> KeptMap:
        """Where the map of a floor is kept; the home floor's for any other name."""
        return self._others.get(floor, self._map)

    def close(self) -> None:
        """At the end: what was saved is in the good copy then, too, and the database is whole without its log."""
        self.keep_copy()
        with self._lock:
            for kept in (self._map, *self._others.values()):
                kept.close()

    @staticmethod
    def _sweep(folder: Path) -> None:
        """What a process left that was killed while it wrote."""
        for name in (STATE_NAME, BESIDE_NAME):
            with contextlib.suppress(OSError):  # of the folder, too: it may not be looked into
                for left in folder.glob(f".*{name}.*.tmp"):
                    left.unlink(missing_ok=True)

    def begin_anew(self, floor: str = "") -> bool:
        """The map was given up by its owner: what is saved next may be smaller. True where the old one stays as the
        newest generation.

        Args:
            floor: that the robot is on: it is the home floor then, and the others are left as they are.
        """
        if self._folder is None:
            return False
        with self._lock:
            self._in_use = False
            self._map, self._others = self._on(floor), {}
            self.given_up += 1
            self._apart.begin(None, "")
            try:
                return self._map.give_up()
            except (CeilvoError, OSError) as e:
                return self._complain(f"map not kept as a generation: {e}")

    def save(
        self,
        landmarks: Landmarks,
        map_axis_rad: float | None,
        estimate: Estimate,
        elsewhere: float = 0.0,
        key_poses: KeyPoses | None = None,
        refused: int = 0,
        ceiling: CeilingShape = LEVEL_CEILING,
    ) -> bool:
        """Write map and pose; False when they were not, with the reason in the log.

        The map goes first: a state without its map would be a pose in another map.

        Args:
            elsewhere: probability that the robot is at another place.
            key_poses: of this session, that were not saved yet.
            refused: landmarks that the map did not take since it was last saved.
            ceiling: as in StoredState.
        """
        if self._folder is None or map_axis_rad is None:
            return False
        with self._lock:
            kept = self._on(estimate.floor)
            try:
                if not self._written(kept, landmarks, map_axis_rad, key_poses, refused):
                    return False
                self._write_pose(self._folder, estimate, elsewhere, ceiling)
            except (CeilvoError, OSError) as e:
                return self._complain(f"{_NOT_SAVED}: {e}")
            if self._complained:
                _log.info("map and pose are saved again")
            self._complained, self._in_use = "", True
            return True

    def save_left(self, floor: str, landmarks: Landmarks, map_axis_rad: float, key_poses: KeyPoses | None) -> bool:
        """As save(), of a floor that the robot has left, without a pose."""
        if self._folder is None:
            return False
        with self._lock:
            try:
                return self._written(self._on(floor), landmarks, map_axis_rad, key_poses, 0)
            except (CeilvoError, OSError) as e:
                return self._complain(f"{_NOT_SAVED}: {e}")

    def _written(
        self, kept: KeptMap, landmarks: Landmarks, map_axis_rad: float, key_poses: KeyPoses | None, refused: int
    ) -> bool:
        ours = StoredMap(landmarks, map_axis_rad)
        try:
            return self._write(kept, ours, key_poses, refused)
        except SupersededError:  # another program, between the look and the writing
            return self._write(kept, ours, key_poses, refused)

    def _write(self, kept: KeptMap, ours: StoredMap, key_poses: KeyPoses | None, refused: int) -> bool:
        kept.look()
        alone = kept is self._map and not self._others
        whole = self._apart.onto(ours, kept.stored, kept.hash, kept.copied_hash) if alone else ours
        if is_much_smaller(len(whole.landmarks), kept.landmarks):
            return self._save_beside(kept, ours.landmarks, ours.map_axis_rad)
        before = kept.content
        landmarks = whole.landmarks if before is None or kept is self._map else unmoved(whole.landmarks, before)

        def written(map_hash: str) -> None:
            if alone:
                self._apart.written(ours, map_hash)

        kept.write(landmarks, whole.map_axis_rad, key_poses, refused, written)
        return True

    # -- another program's changes

    @property
    def change(self) -> Change | None:
        """From the robot's map to the one in the database; None where they are one."""
        return self._apart.change

    def moved(self, ours: StoredMap, pose: Array) -> tuple[StoredMap, Pose]:
        """The robot's map and its pose (3,) as they are on the database's map; the robot is on that from now on."""
        with self._lock:
            change, theirs = self._apart.change, self._map.stored
            if change is None or theirs is None:
                return ours, Pose(pose)
            whole = self._apart.onto(ours, theirs, self._map.hash, self._map.copied_hash)
            self._apart.begin(theirs, self._map.hash)
            return whole, change.pose(pose)

    def stay(self) -> None:
        """The robot is on a map of its own again: that is saved next, and the database's stays as a generation."""
        with self._lock:
            self._apart.begin(None, "")
            self._map.keep_next()

    def save_pose(self, estimate: Estimate, elsewhere: float = 0.0, ceiling: CeilingShape = LEVEL_CEILING) -> bool:
        """Write the pose alone; False where the map that lies in the folder is not the one in use, or saving failed of
        late: then it waits for the map."""
        if self._folder is None:
            return False
        with self._lock:
            if not self._in_use or self._complained or not self._on(estimate.floor).is_ours():
                return False
            try:
                self._write_pose(self._folder, estimate, elsewhere, ceiling)
            except (CeilvoError, OSError) as e:
                return self._complain(f"{_NOT_SAVED}: {e}")
            return True

    def keep_copy(self) -> None:
        """Make the last good copy of the map what was saved since; trouble is logged."""
        with self._lock:
            try:
                for kept in (*self._others.values(), self._map):
                    kept.keep_copy()
            except (CeilvoError, OSError) as e:
                _log.warning("%s", e)

    def _write_pose(self, folder: Path, e: Estimate, elsewhere: float, ceiling: CeilingShape) -> None:
        cov = _VAGUE_COV if _is_vague(e.cov) else e.cov
        pose = e.pose if self.change is None else self.change.pose(e.pose)
        save_state(folder / STATE_NAME, pose, cov, e.state, e.stamp_ns, elsewhere, self._on(e.floor).frame, ceiling)

    def _save_beside(self, kept: KeptMap, landmarks: Landmarks, map_axis_rad: float) -> bool:
        if self._beside.write(landmarks, map_axis_rad):
            there = f"that one is in {BESIDE_NAME}"
        else:
            there = f"{BESIDE_NAME} of an earlier run has more, too, and stays"
        return self._complain(
            f"{MAP_NAME} with {kept.landmarks} landmarks is kept, for the map in use has only {len(landmarks)}; "
            f"{there}. If it is the right one: cmd/reset without the map, then save"
        )

    def _complain(self, why: str) -> bool:
        """Once for each kind of trouble: figures in it change at every save."""
        if why[:20] != self._complained[:20]:
            _log.error("%s", why)
        self._complained = why
        return False

    @property
    def session(self) -> str | None:
        """Of this run; None where nothing is kept."""
        return None if self._folder is None else self._session

    @property
    def folder(self) -> Path | None:
        return self._folder


def _which(found: Found, floors: Sequence[Found]) -> str:
    if len(floors) > 1:
        return f"stored maps of {len(floors)} floors loaded ({', '.join(repr(f.floor) for f in floors)})"
    if found.name == MAP_NAME:
        return "stored map loaded"
    if found.name.startswith(OLD_NAME):
        return f"{found.name} imported into {MAP_NAME}, it stays as it was"
    return f"an earlier map loaded, {found.name}"


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
