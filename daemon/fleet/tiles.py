"""A map cut into square tiles, each with one form in bytes, which its hash names.

A tile's bytes are a head (magic, place, count) and the columns of its landmarks by ascending id, little-endian. Places
are whole steps of STEP_M from the tile's corner, covariances are of single precision, times whole seconds: what a map
service publishes is rounded to that, and to nothing coarser on its way.
"""

from __future__ import annotations

import struct
from collections.abc import Mapping

import numpy as np

from ceilvo.daemon.fleet.wire import WireError
from ceilvo.daemon.map.checks import Damage
from ceilvo.daemon.map.database.rows import ROW, Rows, digest, landmarks_of_rows, rows_of
from ceilvo.types import Array, Ints, Landmarks

STEP_M = 2.0**-20
"""Of places; chosen: a thousandth of what the best landmark is known to."""
MOST_TILE_M = 64
COLUMNS: tuple[tuple[str, str], ...] = (
    ("id", "<i8"),
    *((name, "<i4") for name in ("x", "y")),
    *((name, "<f4") for name in ("xx", "xy", "yy")),
    ("kind", "u1"),
    *((name, "<u4") for name in ("sightings", "expected", "first_seen_s", "last_seen_s")),
)
ROW_BYTES = sum(np.dtype(kind).itemsize for _, kind in COLUMNS)
_MAGIC = b"CT01"
_HEAD = struct.Struct("<4siiI")
MOST_IN_TILE = 50_000
"""Landmarks; chosen: ten times what 64 m2 of the densest ceiling have."""
MOST_TILE_BYTES = _HEAD.size + ROW_BYTES * MOST_IN_TILE
_SINGULAR = 1e-6
"""By which a covariance is made less correlated before it is rounded to single precision (6e-8)."""
_MOST_COUNT = 2**32 - 1

Place = tuple[int, int]
"""Column and row of a tile; (0, 0) has its corner at the map's origin."""


def rounded(rows: Rows) -> Rows:
    """Rows as a tile has them; rounding them again changes nothing."""
    out: Rows = rows.copy()
    for name in ("x", "y"):
        out[name] = np.round(rows[name] / STEP_M) * STEP_M
    for name in ("xx", "yy"):
        out[name] = rows[name].astype(np.float32)
    is_single = rows["xy"] == rows["xy"].astype(np.float32)
    for name in ("xx", "yy"):
        is_single &= rows[name] == out[name]
    out["xy"] = np.where(is_single, rows["xy"], (rows["xy"] * (1.0 - _SINGULAR)).astype(np.float32))
    for name in ("sightings", "expected"):
        out[name] = np.minimum(rows[name], _MOST_COUNT)
    for name in ("first_seen_s", "last_seen_s"):
        out[name] = np.clip(np.floor(rows[name]), 0, _MOST_COUNT)
    return out


def cut(landmarks: Landmarks, seen_s: Array, tile_m: int) -> dict[Place, bytes]:
    """The tiles that hold any of the landmarks, which are by ascending id.

    Raises:
        WireError: a tile would hold too many.
    """
    rows = rounded(rows_of(landmarks, seen_s))
    at = np.stack([np.floor(rows["x"] / tile_m), np.floor(rows["y"] / tile_m)]).astype(np.int64)
    number = at[0] * 2**32 + at[1]
    order = np.argsort(number, kind="stable")
    _, first = np.unique(number[order], return_index=True)
    parts = np.split(order, first[1:]) if len(order) else []
    return {(int(at[0, i[0]]), int(at[1, i[0]])): _bytes(rows[i], at[:, i[0]], tile_m) for i in parts}


def _bytes(rows: Rows, at: Ints, tile_m: int) -> bytes:
    if len(rows) > MOST_IN_TILE:
        raise WireError(f"tile {at[0]},{at[1]} has {len(rows)} landmarks, expected {MOST_IN_TILE} or fewer")
    values = {name: rows[name] for name, _ in COLUMNS}
    for name, corner in zip(("x", "y"), at, strict=True):
        values[name] = np.round((rows[name] - corner * tile_m) / STEP_M)
    columns = (values[name].astype(kind).tobytes() for name, kind in COLUMNS)
    return _HEAD.pack(_MAGIC, int(at[0]), int(at[1]), len(rows)) + b"".join(columns)


def hash_of(data: bytes) -> bytes:
    """Of a tile's bytes: BLAKE2b, DIGEST_BYTES long."""
    return digest(data)


def rows_of_tile(data: bytes, place: Place, tile_m: int) -> Rows:
    """Rows (L,) of a tile, by ascending id.

    Raises:
        WireError: the bytes are no tile of that place.
    """
    where = f"tile {place[0]},{place[1]}"
    if len(data) < _HEAD.size:
        raise WireError(f"{where}: {len(data)} bytes, expected at least {_HEAD.size}")
    magic, ix, iy, count = _HEAD.unpack_from(data)
    if magic != _MAGIC or (ix, iy) != place:
        raise WireError(f"{where}: begins with {magic!r} of {ix},{iy}, expected {_MAGIC!r} of its place")
    if not 0 < count <= MOST_IN_TILE or len(data) != _HEAD.size + ROW_BYTES * count:
        raise WireError(f"{where}: {len(data)} bytes for {count} landmarks of {ROW_BYTES}")
    out, start = np.empty(count, ROW), _HEAD.size
    for name, kind in COLUMNS:
        values = np.frombuffer(data, kind, count, start)
        start += values.nbytes
        out[name] = values
    for name, corner in (("x", ix), ("y", iy)):
        if not np.all((out[name] >= 0) & (out[name] * STEP_M < tile_m)):
            raise WireError(f"{where}: a landmark lies outside")
        out[name] = out[name] * STEP_M + corner * tile_m
    if np.any(np.diff(out["id"]) <= 0):
        raise WireError(f"{where}: ids do not ascend")
    try:
        landmarks_of_rows(out)
    except Damage as e:
        raise WireError(f"{where}: {e}") from e
    return out


def joined(tiles: Mapping[Place, bytes], tile_m: int) -> tuple[Landmarks, Array]:
    """Landmarks by ascending id and their times (L, 2), of a whole floor.

    Raises:
        WireError: a tile is none, or two have a landmark of one id.
    """
    parts = [rows_of_tile(data, place, tile_m) for place, data in tiles.items()]
    rows = np.concatenate([np.empty(0, ROW), *parts])
    rows = rows[np.argsort(rows["id"], kind="stable")]
    try:
        return landmarks_of_rows(rows)
    except Damage as e:
        raise WireError(f"tiles do not fit together: {e}") from e


def root_of(floor: str, axis_rad: float, tile_m: int, hashes: Mapping[Place, bytes]) -> bytes:
    """One hash of a whole floor: of its axis and of the places and hashes of its tiles."""
    head = f"{floor}\n{float(axis_rad).hex()}\n{tile_m}\n".encode("utf-8", "surrogatepass")
    return digest(head + b"".join(struct.pack("<ii", *place) + hashes[place] for place in sorted(hashes)))
