"""A floor of a service: its map in the database, the merges that it has, and what of it is published."""

from __future__ import annotations

import logging
from pathlib import Path

import numpy as np

from ceilvo.daemon.fleet.manifests import GONE, Manifest
from ceilvo.daemon.fleet.service.ledger import Ledger
from ceilvo.daemon.fleet.service.published import Published, next_published
from ceilvo.daemon.fleet.tiles import cut, hash_of
from ceilvo.daemon.map.database.copies import open_map
from ceilvo.daemon.map.database.database import MapDatabase
from ceilvo.daemon.map.database.rows import ROW, Rows, landmarks_of_rows, rows_of
from ceilvo.daemon.map.map_file import StoredMap
from ceilvo.types import Ints, Landmarks

_log = logging.getLogger("ceilvo.mapd")

SESSION = "mapd"
"""Of the map; its number of saves is the last merge that the map has, written in one transaction with it."""


class Floor:
    """One thread at a time; `published` may be read by any."""

    def __init__(self, path: Path, name: str, ledger: Ledger, tile_m: int) -> None:
        """Open the map, bring merges into it that it does not have, and publish it.

        Raises:
            FileFormatError: database or ledger cannot be used.
        """
        self.name, self._ledger, self._tile_m = name, ledger, tile_m
        self.db: MapDatabase = open_map(path, name, create=True)
        self.published: Published | None = None
        content = self.db.content()
        self._applied = next((s.saves for s in content.sessions if s.name == SESSION), 0)
        highest = int(np.max(content.landmarks.ids, initial=-1))
        ledger.set_floor(name, highest + 1, self._applied)
        missing = ledger.floor(name)[3] - self._applied
        found = ledger.merges_after(name, self._applied)
        if len(found) < missing:
            _log.warning(
                "floor %r: its map has %d merges of %d, and %d are kept: robots will offer the rest again",
                *(name, self._applied, self._applied + missing, len(found)),
            )
        for at_s, rows, removed in found:
            self.apply(at_s, rows, removed)
        if len(found) < missing:
            ledger.recount(name, self._applied)
        self.publish()

    def stored(self) -> StoredMap | None:
        """Its map; None where there is none."""
        return self.db.load()

    def apply(self, at_s: float, rows: Rows, removed: Ints) -> None:
        """A merge of the ledger into the map, once."""
        stored = self.db.load()
        assert stored is not None  # a floor begins with an empty map
        self.db.save(_changed(stored.landmarks, rows, removed), stored.map_axis_rad, SESSION, at_s)
        self._applied += 1

    def begin(self, axis_rad: float, now_s: float) -> None:
        """An empty map, where there is none."""
        self.db.save(_changed(_no_landmarks(), np.empty(0, ROW), np.empty(0, np.int64)), axis_rad, now_s=now_s)
        self.publish()

    def is_copied(self) -> None:
        """The last good copy has all merges, and the ledger needs them no more."""
        self._ledger.drop_merges(self.name, self._applied)

    def publish(self) -> bool:
        """Make a new version where the map has changed; whether it has."""
        self.db.follow()
        stored = self.db.load()
        if stored is None:
            return False
        tiles = cut(stored.landmarks, self.db.seen_s, self._tile_m)
        hashes = {place: hash_of(data) for place, data in tiles.items()}
        version, root, _, _ = self._ledger.floor(self.name)
        manifest = Manifest(self.name, version, stored.map_axis_rad, self._tile_m, hashes)
        before = self._ledger.tiles(self.name)
        if manifest.root != root:
            manifest = Manifest(self.name, version + 1, stored.map_axis_rad, self._tile_m, hashes)
            changed = {place: h for place, h in hashes.items() if before.get(place, (GONE,))[0] != h}
            changed |= {place: GONE for place, (h, _) in before.items() if place not in hashes and h != GONE}
            self._ledger.publish(self.name, manifest.version, manifest.root, changed)
            before |= {place: (h, manifest.version) for place, h in changed.items()}
        elif self.published is not None:
            return False
        versions = {place: v for place, (_, v) in before.items()}
        self.published = next_published(self.published, manifest, tiles, versions)
        return True

    def close(self) -> None:
        self.db.close()


def _no_landmarks() -> Landmarks:
    return landmarks_of_rows(np.empty(0, ROW))[0]


def _changed(known: Landmarks, rows: Rows, removed: Ints) -> Landmarks:
    """The map with rows in the place of those of their ids, or new, and without those removed."""
    table = rows_of(known, np.zeros((len(known), 2)))
    gone = np.isin(table["id"], removed) | np.isin(table["id"], rows["id"])
    both = np.concatenate([table[~gone], rows])
    return landmarks_of_rows(both[np.argsort(both["id"], kind="stable")])[0]
