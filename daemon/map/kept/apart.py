"""A robot's map and the one in its database, where another program changed that: what is written then."""

from __future__ import annotations

import logging
from dataclasses import replace
from pathlib import Path

import numpy as np

from ceilvo.daemon.map.kept.change import Change
from ceilvo.daemon.map.map_file import StoredMap
from ceilvo.types import Landmarks

_log = logging.getLogger("ceilvo.store")


class Apart:
    """While a robot goes on on the map that it has, what it learns is written onto the one that was made of it.

    Attributes:
        change: from the robot's map to the one in the database; None where they are one.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self.change: Change | None = None
        self._base: StoredMap | None = None
        self._hash = ""
        self._own: frozenset[int] = frozenset()
        self._names: dict[int, int] = {}

    def begin(self, stored: StoredMap | None, map_hash: str) -> None:
        """The robot is on the map with this hash now; None: on none of the database."""
        self.change, self._base, self._hash, self._names = None, stored, map_hash, {}
        self._own = _ids(stored)

    def written(self, ours: StoredMap, map_hash: str) -> None:
        """The robot's map, as it was then, is in the database in whatever way onto() said."""
        self._base, self._hash, self._own = self._named(ours), map_hash, _ids(ours)

    def onto(self, ours: StoredMap, theirs: StoredMap | None, map_hash: str, copied_hash: str) -> StoredMap:
        """What is to be written.

        Args:
            ours: the robot's map.
            theirs: what the database holds, with its hash.
            copied_hash: of the good copy, which takes the place of a damaged database: an earlier one of ours.
        """
        base = self._base
        is_ours = self.change is None and map_hash in (self._hash, copied_hash)
        if base is None or theirs is None or is_ours:
            return ours
        self.change = Change.between(base, theirs)
        if self.change is None:
            self._names = {}
            _log.warning(
                "%s: another program put a map there that is not this robot's with changes; the robot's own is kept, "
                "that one stays as %s.1; to drive on it stop the service and import it", self._path, self._path.name
            )  # fmt: skip
            return ours
        self._give_names(base.landmarks, ours.landmarks, theirs.landmarks)
        whole = self.change.carried(base.landmarks, self._named(ours).landmarks, theirs.landmarks)
        return StoredMap(whole, theirs.map_axis_rad)

    def _give_names(self, base: Landmarks, ours: Landmarks, theirs: Landmarks) -> None:
        """What the robot learnt since has other ids in the database where its own are in use there, or were given."""
        new = np.setdiff1d(ours.ids, [*self._own, *self._names])
        taken = new[np.isin(new, [*theirs.ids.tolist(), *self._names.values()])].tolist()
        above = int(max(np.max(a.ids, initial=-1) for a in (base, ours, theirs))) + 1
        above = max(above, *(n + 1 for n in self._names.values()), 0)
        self._names |= {i: above + n for n, i in enumerate(taken)}

    def _named(self, ours: StoredMap) -> StoredMap:
        if not self._names:
            return ours
        ids = np.array([self._names.get(i, i) for i in ours.landmarks.ids.tolist()], np.int64)
        return replace(ours, landmarks=replace(ours.landmarks, ids=ids))


def _ids(stored: StoredMap | None) -> frozenset[int]:
    return frozenset() if stored is None else frozenset(stored.landmarks.ids.tolist())
