"""A floor as the service publishes it: a version, and the hash of every tile."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from ceilvo.daemon.fleet.tiles import MOST_TILE_M, Place, root_of
from ceilvo.daemon.fleet.wire import Fields, WireError, packed
from ceilvo.daemon.map.database.rows import DIGEST_BYTES
from ceilvo.json_values import MAX_ANGLE_RAD, MAX_ID

KIND, REQUEST = "manifest.1", "manifest_request.1"
MOST_TILES = 2_000_000
"""Of a floor; chosen: 11 km by 11 km of 8 m."""
PAGE = 2000
"""Entries in a message: 48 KB."""
GONE = bytes(DIGEST_BYTES)
"""In the place of a hash: the tile is there no more."""
_ENTRY = np.dtype([("ix", "<i4"), ("iy", "<i4"), ("hash", f"V{DIGEST_BYTES}")])


@dataclass(frozen=True)
class Manifest:
    """What a floor consisted of at a version.

    Attributes:
        version: of the service's own counting; it ascends.
        axis_rad: direction in the map of axis 0 of the types.
        tile_m: side of a tile.
        hashes: of the tiles that hold any landmark.
    """

    floor: str
    version: int
    axis_rad: float
    tile_m: int
    hashes: dict[Place, bytes]

    @property
    def root(self) -> bytes:
        """One hash of all that the floor's map says."""
        return root_of(self.floor, self.axis_rad, self.tile_m, self.hashes)


@dataclass(frozen=True)
class Page:
    """Some of what changed since a version that the asker has.

    Attributes:
        head: the manifest that it leads to, without its hashes.
        since: the version that it begins from; 0: from nothing.
        root: of that manifest.
        total: entries in all pages.
        at: which of them comes first here.
        entries: places and hashes, GONE where there is no tile any more.
    """

    head: Manifest
    since: int
    root: bytes
    total: int
    at: int
    entries: dict[Place, bytes]


@dataclass(frozen=True)
class Request:
    """What a robot asks for: entries from `at` up of what changed since it had a floor at a version with a root; 0 and
    GONE where it has nothing."""

    floor: str
    since: int
    root: bytes
    at: int = 0

    def packed(self) -> bytes:
        return packed(REQUEST, {"floor": self.floor, "since": self.since, "root": self.root, "at": self.at})

    @staticmethod
    def unpacked(data: bytes) -> Request:
        """
        Raises:
            WireError: it is none.
        """
        f = Fields(REQUEST, data)
        since = f.whole("since", 0, MAX_ID)
        return Request(f.text("floor"), since, f.raw("root", DIGEST_BYTES), f.whole("at", 0, MOST_TILES))


def packed_page(page: Page) -> bytes:
    table = np.empty(len(page.entries), _ENTRY)
    if page.entries:
        table["ix"], table["iy"] = np.array(list(page.entries), np.int64).T
        table["hash"] = np.frombuffer(b"".join(page.entries.values()), f"V{DIGEST_BYTES}")
    head = page.head
    fields = {"floor": head.floor, "version": head.version, "axis_rad": head.axis_rad, "tile_m": head.tile_m}
    fields |= {"since": page.since, "root": page.root, "total": page.total, "at": page.at}
    return packed(KIND, fields | {"entries": table.tobytes()})


def unpacked_page(data: bytes) -> Page:
    """
    Raises:
        WireError: it is none.
    """
    f = Fields(KIND, data)
    raw = f.raw("entries")
    if len(raw) % _ENTRY.itemsize:
        raise WireError(f"{KIND}: entries are {len(raw)} bytes, expected {_ENTRY.itemsize} each")
    table = np.frombuffer(raw, _ENTRY)
    places = zip(table["ix"].tolist(), table["iy"].tolist(), strict=True)
    entries = dict(zip(places, (h.tobytes() for h in table["hash"]), strict=True))
    total, at = f.whole("total", 0, MOST_TILES), f.whole("at", 0, MOST_TILES)
    if len(entries) != len(table) or at + len(entries) > total:
        raise WireError(f"{KIND}: {len(entries)} different entries from {at} on of {total}")
    axis, tile_m = f.number("axis_rad", MAX_ANGLE_RAD), f.whole("tile_m", 1, MOST_TILE_M)
    head = Manifest(f.text("floor"), f.whole("version", 0, MAX_ID), axis, tile_m, {})
    return Page(head, f.whole("since", 0, MAX_ID), f.raw("root", DIGEST_BYTES), total, at, entries)


def advanced(held: Manifest | None, pages: list[Page]) -> Manifest:
    """The manifest that all pages of one version lead to.

    Raises:
        WireError: they lead to another one than they say.
    """
    head = pages[0].head
    hashes = dict(held.hashes) if held is not None and pages[0].since == held.version else {}
    for page in pages:
        hashes |= page.entries
    out = replace(head, hashes={place: h for place, h in hashes.items() if h != GONE})
    if out.root != pages[0].root:
        raise WireError(f"{KIND}: its root is {out.root.hex()}, expected {pages[0].root.hex()}; all of it is needed")
    return out
