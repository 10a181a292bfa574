"""Tiles on their way: asked for by their hashes, sent in parts: one that was cut off goes on where it stopped."""

from __future__ import annotations

from dataclasses import dataclass

from ceilvo.daemon.fleet.wire import Fields, WireError, packed
from ceilvo.daemon.map.database.rows import DIGEST_BYTES

REQUEST, PART = "tiles_request.1", "tile_part.1"
PART_BYTES = 48_000
"""Of a tile in one message."""
MOST_WANTED = 64
"""Tiles in one request."""


def packed_wanted(floor: str, wanted: list[tuple[bytes, int]]) -> bytes:
    """A request for tiles: hashes, and how many bytes of each are there already."""
    return packed(REQUEST, {"floor": floor, "wanted": [[h, at] for h, at in wanted[:MOST_WANTED]]})


def unpacked_wanted(data: bytes) -> tuple[str, list[tuple[bytes, int]]]:
    """
    Raises:
        WireError: it is none.
    """
    f = Fields(REQUEST, data)
    wanted = f.pairs("wanted", DIGEST_BYTES, 2**31)
    if len(wanted) > MOST_WANTED:
        raise WireError(f"{REQUEST}: {len(wanted)} tiles, expected {MOST_WANTED} or fewer")
    return f.text("floor"), wanted


def packed_part(name: bytes, size: int, at: int, data: bytes) -> bytes:
    return packed(PART, {"hash": name, "size": size, "at": at, "data": data})


@dataclass(frozen=True)
class Part:
    """Bytes of a tile from `at` on, of `size` in all."""

    name: bytes
    size: int
    at: int
    data: bytes


def unpacked_part(data: bytes, most_bytes: int) -> Part:
    """
    Raises:
        WireError: it is none, or of a tile larger than any may be.
    """
    f = Fields(PART, data)
    out = Part(f.raw("hash", DIGEST_BYTES), f.whole("size", 1, most_bytes), f.whole("at", 0, most_bytes), f.raw("data"))
    if not out.data or out.at + len(out.data) > out.size:
        raise WireError(f"{PART}: {len(out.data)} bytes from {out.at} on of {out.size}")
    return out
