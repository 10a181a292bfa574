"""A map that another program made of the robot's while it drives: when the robot goes over to it, and when back."""

from __future__ import annotations

import logging
from collections.abc import Callable

import numpy as np

from ceilvo import se2
from ceilvo.daemon.app.estimator import Estimator, Moved
from ceilvo.daemon.map.kept.change import Change
from ceilvo.daemon.map.kept.store import Store
from ceilvo.daemon.map.map_file import StoredMap
from ceilvo.types import Array, Estimate, Pose, State

Tell = Callable[[str, str, int], None]
"""Hears an event: its name, its text, its level of logging."""

SIGMA = np.array([0.02, 0.02, 0.01])
"""m, m, rad, of where a robot is on a map that was changed; chosen: as much as a refinement moves it."""
SURE = 1e-3
"""Probability of being elsewhere above which nothing is tried; chosen."""
CONFIRM_NS = 20 * 10**9
"""Until a map that landmarks do not confirm is given up; chosen: a robot that stands looks ten times a second."""


class MapSwap:
    """The main thread's. The relocaliser decides: the new map is tried where the robot stands and is sure of its place,
    as a stored map is at a start, and kept where landmarks confirm the place on it."""

    def __init__(self, estimator: Estimator, store: Store, tell: Tell) -> None:
        self._estimator, self._store, self._tell = estimator, store, tell
        self._announced = False
        self._before: Moved | None = None
        self._until_ns = self._given_up = 0

    def step(self, now_ns: int, stands: bool) -> None:
        """To be called often."""
        if self._before is not None:
            self._settle(self._before, now_ns)
            return
        change, last = self._store.change, self._estimator.last
        if change is None or last is None:
            self._announced = False
            return
        if not self._announced:
            self._announced = True
            text = f"another program changed the map, by {_mm(change, last)} here; what is learnt goes there, too; "
            self._tell("map", text + "the robot goes over to it where it stands and is sure of its place", logging.INFO)
        if stands and last.state is State.TRACKING and self._estimator.elsewhere() < SURE:
            self._before = self._estimator.move_to(self._store.moved, SIGMA)
            if self._before is None:
                return
            self._until_ns, self._given_up = now_ns + CONFIRM_NS, self._store.given_up
            text = f"on the changed map, {_mm(change, last)} from before; landmarks are to confirm it"
            self._tell("map", text, logging.INFO)

    def _settle(self, before: Moved, now_ns: int) -> None:
        last = self._estimator.last
        if self._store.given_up != self._given_up:  # by its owner, meanwhile
            self._before = None
        elif last is not None and last.stamp_ns > before.last.stamp_ns and last.state is State.TRACKING:
            self._before, self._announced = None, False
            self._tell("map", "landmarks confirm the changed map", logging.INFO)
        elif now_ns >= self._until_ns:
            self._before, self._announced = None, False
            self._store.stay()
            self._estimator.move_to(lambda now, pose: self._back(before), SIGMA)
            text = "landmarks do not confirm the changed map: back on the robot's own; the other stays as map.db.1"
            self._tell("map", text, logging.WARNING)

    def _back(self, before: Moved) -> tuple[StoredMap, Pose]:
        """The map of before, and where the robot is on it by odometry."""
        last = self._estimator.last
        assert last is not None  # there was one before
        way: Array = se2.between(before.last.odom, last.odom)
        return before.map, Pose(np.asarray(se2.compose(before.last.pose, way)))


def _mm(change: Change, last: Estimate) -> str:
    return f"{1e3 * change.moved_m(last.pose):.1f} mm"
