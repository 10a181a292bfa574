"""When map and pose are written: now and then, the pose where the robot has come to stand, and all of it at the end."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from ceilvo import se2
from ceilvo.calibration import CeilingShape
from ceilvo.config import Config
from ceilvo.daemon.app.estimator import Estimator
from ceilvo.daemon.app.swap import MapSwap, Tell
from ceilvo.daemon.integrity.states import UNUSABLE
from ceilvo.daemon.map.kept.store import SHELF, Kept, Store
from ceilvo.daemon.map.map_file import StoredMap
from ceilvo.daemon.relocalisation.floors import FloorMap, Transition, side_by_side
from ceilvo.types import Array, Estimate

STOOD_NS = 10**9
"""A robot that stood for so long has stopped; chosen: nobody who parks one is quicker at its switch."""
_STILL_M, _STILL_RAD = 0.01, 0.01
"""One that moved less in that time stands; chosen: half of what telemetry.py calls moving."""
_AWAY_M, _AWAY_RAD = 0.02, 0.02
"""A stored pose that is further off is stored anew; chosen: less than half of what a restart adds to its sigmas."""


COPY_NS = 3600 * 10**9
"""Between good copies of the map; chosen: one of 100,000 landmarks takes half a second."""


def no_events(name: str, text: str, level: int) -> None:
    """For runs that nobody listens to."""


def store_of(config: Config) -> Store:
    """Where map and pose of a run are kept, which begins a session of its own."""
    session = f"{config.robot.name}/{time.strftime('%Y-%m-%dT%H:%M:%SZ', time.gmtime())}"
    return Store.choose(config.service.state_dir, config.service.map_generations, session, config.service.floor)


def begin_on(estimator: Estimator, kept: Kept) -> None:
    """Begin on what an earlier run left."""
    if not kept.floors:
        return estimator.load_map(kept.map, kept.state)
    maps = [
        FloorMap(
            f.floor, f.map.landmarks, f.map.map_axis_rad, tuple(Transition(s.name, s.kind, *s.pose) for s in f.sides)
        )
        for f in kept.floors
    ]
    landmarks, floors = side_by_side(maps)
    state = kept.state
    if state is not None:
        pose, cov = floors.in_frame(kept.floor, state.pose, state.cov)
        state = replace(state, pose=pose, cov=cov)
    estimator.load_map(StoredMap(landmarks, maps[0].axis_rad), state, floors)


def load(config: Config, store: Store, tell: Callable[[str, str, int], None]) -> Kept | None:
    """What an earlier run left, on the map that was chosen meanwhile.

    Args:
        tell: hears of a chosen map: an event's name, its text, and the level of logging.
    """
    if store.folder is not None and (store.folder / SHELF).is_dir():
        from ceilvo.daemon.shelf.taking import take_chosen  # few robots have one, and it imports what edits maps

        taken = take_chosen(store.folder, config.service.floor, config.vda5050.map_id)
        if taken is not None:
            tell("map", taken.said, logging.INFO if taken.ok else logging.WARNING)
    return store.load()


class Keeper:
    """keep() is the main thread's; save() may be called by any."""

    def __init__(self, estimator: Estimator, store: Store, period_s: float, tell: Tell = no_events) -> None:
        self._estimator, self._store = estimator, store
        self._swap = MapSwap(estimator, store, tell)
        self._lock = threading.RLock()
        self._period_ns = round(1e9 * period_s)
        self._due_ns = 0
        self._copy_due_ns: int | None = None
        self._refused = 0
        self._began: Estimate | None = None
        self._kept: Estimate | None = None
        self._floor: str | None = None

    def keep(self, now_ns: int) -> None:
        """Write what is due; to be called often.

        Between two savings a killed robot's stored pose is as far off as it drove meanwhile. So that one which is
        switched off where it stands comes back there, its pose alone is written, a few hundred bytes, once it has
        stopped, and again where what is known of it changes.
        """
        if self._copy_due_ns is None:
            self._copy_due_ns = now_ns + COPY_NS
        last = self._estimator.last
        stands = last is not None and self._stands(last)
        with self._lock:
            self._swap.step(now_ns, stands)
        if now_ns >= self._due_ns:
            self._due_ns = now_ns + self._period_ns
            self.save()
        elif now_ns >= self._copy_due_ns:
            self._copy_due_ns = now_ns + COPY_NS
            self._store.keep_copy()
        elif last is not None and stands and self._is_news(last):
            self._began = last
            if self._store.save_pose(last, self._estimator.elsewhere(), self._ceiling()):
                self._kept = last

    def _ceiling(self) -> CeilingShape:
        """As it is on the map that is kept; where that is turned against the robot's, without its slope."""
        ceiling = self._estimator.ceiling()
        return ceiling if self._store.change is None else replace(ceiling, slope=())

    def save(self) -> bool:
        """Write map and pose; False when they were not, with the reason in the log."""
        with self._lock:  # what is saved is of one map
            return self._save()

    def _save(self) -> bool:
        last = self._estimator.last
        if last is None:
            return False
        if self._floor not in (None, last.floor):
            self._save_left(self._floor)
        landmarks, axis_rad = self._estimator.map_on(last.floor)
        key_poses, refused = self._estimator.key_poses(last.floor), self._estimator.refused()
        elsewhere, news = self._estimator.elsewhere(), max(refused - self._refused, 0)
        if not self._store.save(landmarks, axis_rad, last, elsewhere, key_poses, news, self._ceiling()):
            return False
        self._estimator.key_poses_kept(key_poses)
        self._kept, self._refused, self._floor = last, refused, last.floor
        return True

    def _save_left(self, floor: str) -> None:
        """What was learnt on a floor between its last saving and leaving it."""
        (landmarks, axis_rad), key_poses = self._estimator.map_on(floor), self._estimator.key_poses(floor)
        if axis_rad is not None and self._store.save_left(floor, landmarks, axis_rad, key_poses):
            self._estimator.key_poses_kept(key_poses)

    def _stands(self, last: Estimate) -> bool:
        """By odometry, which is of eye and wheels and never jumps."""
        began = self._began
        if began is None or _apart(began.odom, last.odom, _STILL_M, _STILL_RAD):
            self._began = last
            return False
        return last.stamp_ns - began.stamp_ns >= STOOD_NS

    def _is_news(self, last: Estimate) -> bool:
        kept = self._kept
        if kept is None or _apart(kept.pose, last.pose, _AWAY_M, _AWAY_RAD):
            return True
        return (kept.state in UNUSABLE) != (last.state in UNUSABLE)


def _apart(a: Array, b: Array, most_m: float, most_rad: float) -> bool:
    """Whether two poses (3,) differ by more."""
    return float(np.hypot(*(b - a)[:2])) > most_m or abs(se2.wrap(float(b[2] - a[2]))) > most_rad
