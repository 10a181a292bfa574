"""Landmarks as rows of the table: which differ, and sums that tell whether they are what was written."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ceilvo.daemon.map.checks import Damage, floats, landmarks_of
from ceilvo.types import Array, Ints, Landmarks

Rows = NDArray[Any]
"""(L,) of ROW, by ascending id."""
ROW = np.dtype(
    [
        ("id", "<i8"),
        *((name, "<f8") for name in ("x", "y", "xx", "xy", "yy")),
        *((name, "<i8") for name in ("kind", "sightings", "expected")),
        *((name, "<f8") for name in ("first_seen_s", "last_seen_s")),
    ]
)
NAMES: tuple[str, ...] = ROW.names or ()
_COMPARED = ("sightings", "expected", "crossing_type", "xy_map_m", "cov_m2")
DIGEST_BYTES = 16
"""Of BLAKE2b over a row; chosen: damage goes unnoticed once in 2^128."""
LATEST_S = 1e11
"""Times beyond it are damage: the year 5138."""


Index = slice | Ints
"""All of the first so many, or which."""


@dataclass(frozen=True)
class Pairs:
    """Which of the old landmarks are which of the new ones; both ascend by id.

    Attributes:
        old, new: (P,) the same landmark, before and after.
        added: of the new ones.
        removed: of the old ones.
    """

    old: Index
    new: Index
    added: Ints
    removed: Ints


def ordered(landmarks: Landmarks, seen_s: Array | None = None) -> tuple[Landmarks, Array]:
    """Copies by ascending id, and their times (L, 2), 0 where there are none."""
    times = np.zeros((len(landmarks), 2)) if seen_s is None else np.asarray(seen_s, np.float64).reshape(-1, 2)
    ids = np.asarray(landmarks.ids)
    if np.all(ids[1:] > ids[:-1]):
        copies = Landmarks(
            np.array(landmarks.ids),
            np.array(landmarks.xy_map_m),
            np.array(landmarks.cov_m2),
            np.array(landmarks.crossing_type),
            np.array(landmarks.sightings),
            np.array(landmarks.expected),
        )
        return copies, times.copy()
    order = np.argsort(ids, kind="stable")
    return landmarks.of(order), times[order]


def rows_of(landmarks: Landmarks, seen_s: Array) -> Rows:
    """Rows (L,) of landmarks and their times (L, 2)."""
    out = np.empty(len(landmarks), ROW)
    out["id"], out["kind"] = landmarks.ids, landmarks.crossing_type
    out["sightings"], out["expected"] = landmarks.sightings, landmarks.expected
    # SQLite knows no negative zero
    out["x"], out["y"] = (np.asarray(landmarks.xy_map_m, np.float64).reshape(-1, 2) + 0.0).T
    out["xx"], out["xy"], _, out["yy"] = (np.asarray(landmarks.cov_m2, np.float64).reshape(-1, 4) + 0.0).T
    out["first_seen_s"], out["last_seen_s"] = (np.asarray(seen_s, np.float64).reshape(-1, 2) + 0.0).T
    return out


def landmarks_of_rows(rows: Rows) -> tuple[Landmarks, Array]:
    """Landmarks and their times (L, 2), checked as those of a map file.

    Raises:
        Damage: names the column.
    """
    seen_s = np.column_stack([rows["first_seen_s"], rows["last_seen_s"]])
    floats(seen_s, "landmarks.seen_s", seen_s.shape, LATEST_S)
    table = {
        "id": rows["id"],
        "xy_map_m": np.column_stack([rows["x"], rows["y"]]),
        "cov_xx_xy_yy_m2": np.column_stack([rows["xx"], rows["xy"], rows["yy"]]),
        **{name: rows[name] for name in ("kind", "sightings", "expected")},
    }
    return landmarks_of(table), seen_s


def rows_from(fetched: list[tuple[Any, ...]]) -> Rows:
    """What SQLite gave: it keeps any type in any column.

    Raises:
        Damage: a value is of another type than its column.
    """
    out = np.empty(len(fetched), ROW)
    for name, values in zip(NAMES, zip(*fetched, strict=True), strict=True) if fetched else ():
        kind: type = float if ROW[name].kind == "f" else int
        if any(type(v) is not kind for v in values):
            odd = next(v for v in values if type(v) is not kind)
            raise Damage(f"landmarks.{name} holds {str(odd)[:40]!r}, expected a number")
        out[name] = values
    return out


def pairs_of(old: Landmarks, new: Landmarks) -> Pairs:
    """By their ids."""
    n = len(old)
    if n <= len(new) and np.array_equal(old.ids, new.ids[:n]):  # a drive adds at the end
        return Pairs(slice(0, n), slice(0, n), np.arange(n, len(new)), np.empty(0, np.int64))
    at = np.searchsorted(old.ids, new.ids)
    there = np.zeros(len(new), bool)
    there[at < n] = old.ids[at[at < n]] == new.ids[at < n]
    removed = np.ones(n, bool)
    removed[at[there]] = False
    return Pairs(at[there], np.flatnonzero(there), np.flatnonzero(~there), np.flatnonzero(removed))


def changed(pairs: Pairs, old: Landmarks, new: Landmarks) -> tuple[Ints, Ints]:
    """Of pairs that differ, whatever their times, the indices into the old landmarks and into the new ones."""
    i, j = pairs.old, pairs.new
    columns = ((getattr(old, name)[i], getattr(new, name)[j]) for name in _COMPARED)
    return _at(pairs, np.unique(np.concatenate([_unlike(a, b) for a, b in columns])))


def redated(pairs: Pairs, old_s: Array, new_s: Array) -> tuple[Ints, Ints]:
    """As changed(), of their times (L, 2)."""
    return _at(pairs, np.unique(_unlike(old_s[pairs.old], new_s[pairs.new])))


def _unlike(a: NDArray[Any], b: NDArray[Any]) -> Ints:
    """Which of the first axis differ, with repetitions: far quicker than any() along the others."""
    width = a.size // max(len(a), 1)
    return np.asarray(np.flatnonzero(a.ravel() != b.ravel()) // max(width, 1), np.int64)


def _at(pairs: Pairs, which: Ints) -> tuple[Ints, Ints]:
    i, j = pairs.old, pairs.new
    return which if isinstance(i, slice) else i[which], which if isinstance(j, slice) else j[which]


def dated(pairs: Pairs, old: tuple[Landmarks, Array], new: Landmarks, which: tuple[Ints, Ints], at_s: float) -> Array:
    """(L, 2) when landmarks were first and last seen: new ones now, and of those that changed what was seen since."""
    (before, before_s), (was, now) = old, which
    seen_s = np.full((len(new), 2), at_s)
    seen_s[pairs.new] = before_s[pairs.old]
    seen_s[now[new.sightings[now] != before.sightings[was]], 1] = at_s
    return seen_s


def sum_of(rows: Rows) -> int:
    """Of the digests of all rows, whatever their order, so that a save needs those only that it changes."""
    data, size = rows.tobytes(), ROW.itemsize
    return total(digest(data[i : i + size]) for i in range(0, len(data), size))


def digest(data: bytes) -> bytes:
    return hashlib.blake2b(data, digest_size=DIGEST_BYTES).digest()


def digest_of(*values: Any) -> bytes:
    """Of numbers and texts."""
    return digest(repr(values).encode("utf-8", "surrogatepass"))


def total(digests: Iterable[bytes]) -> int:
    return sum(int.from_bytes(d, "little") for d in digests) % (1 << 8 * DIGEST_BYTES)


def as_blob(value: int) -> bytes:
    """A sum, as it is stored."""
    return (value % (1 << 8 * DIGEST_BYTES)).to_bytes(DIGEST_BYTES, "little")


def hash_of(floor: str, axis_rad: float, landmark_sum: int, key_pose_sum: int) -> str:
    """Of all that a map says, in hexadecimal."""
    text = f"{floor}\n{float(axis_rad).hex()}\n".encode("utf-8", "surrogatepass")
    return digest(text + as_blob(landmark_sum) + as_blob(key_pose_sum)).hex()
