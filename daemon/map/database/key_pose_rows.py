"""Key poses as rows of the table, one each with its view as a blob; and a session that some of them were taken from."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ceilvo.crossing_types import CROSSING_TYPES
from ceilvo.daemon.map.checks import Damage, covariance, floats, ints, shown
from ceilvo.daemon.map.database.rows import digest
from ceilvo.daemon.map.database.spatial import cells
from ceilvo.daemon.map.key_poses import KeyPoses
from ceilvo.json_values import MAX_ANGLE_RAD, MAX_COORDINATE_M, MAX_ID
from ceilvo.se2 import compose, compose_cov
from ceilvo.types import Array

SPACE_M = 1.0
"""Side of the squares in which key poses are counted; chosen: about what one view shows."""
MOST_IN_SPACE = 4
"""Key poses in one square, the newest; chosen: a view in each of four directions."""
_FEATURE = np.dtype([("xy", "<f8", (2,)), ("cov", "<f8", (3,)), ("landmark", "<i8"), ("kind", "u1")])
_MOTION_FLOATS = 3 + 9 + 2
"""Motion, its covariance, tilt."""


@dataclass(frozen=True, slots=True)
class KeyPoseRow:
    """One key pose as it is stored; `values` are the columns from stamp_ns on."""

    session: str
    values: tuple[Any, ...]

    @property
    def stamp_ns(self) -> int:
        return int(self.values[0])

    @property
    def digest(self) -> bytes:
        return bytes(self.values[-1])


def rows_of_key_poses(k: KeyPoses) -> list[KeyPoseRow]:
    """In their order of time.

    Raises:
        Damage: a value that cannot be; names the column.
    """
    _check(k)
    features = np.empty(k.features, _FEATURE)
    features["xy"], features["cov"] = k.xy_base_m, k.cov_base_m2.reshape(-1, 4)[:, [0, 1, 3]]
    features["landmark"], features["kind"] = k.landmark, k.crossing_type
    motion = np.hstack([k.motion, k.motion_cov.reshape(-1, 9), _direction(k)]).astype("<f8")
    pose = np.asarray(k.pose, np.float64) + 0.0  # SQLite knows no negative zero
    start = np.searchsorted(k.view, np.arange(len(k) + 1))
    cell = cells(pose[:, :2], SPACE_M).tolist()
    out = []
    for i, stamp_ns in enumerate(k.stamp_ns.tolist()):
        values = (
            stamp_ns,
            *pose[i].tolist(),
            cell[i],
            motion[i].tobytes(),
            features[start[i] : start[i + 1]].tobytes(),
        )
        out.append(KeyPoseRow(k.session, (*values, _digest(k.session, values))))
    return out


def key_poses_of(session: str, rows: Iterable[tuple[Any, ...]]) -> KeyPoses:
    """From columns stamp_ns to digest, checked.

    Raises:
        Damage: a row is not what was written.
    """
    table = list(rows)
    for row in table:
        if row[-1] != _digest(session, row[:-1]):
            raise Damage(f"key pose {shown(row[0])} of session {shown(session)} is not what was written")
    try:
        k = _from_table(session, table)
    except ValueError as e:
        raise Damage(f"key poses of session {session[:40]!r}: {e}") from e
    _check(k)
    return k


def _from_table(session: str, table: list[tuple[Any, ...]]) -> KeyPoses:
    motion = np.frombuffer(b"".join(r[5] for r in table), "<f8").reshape(-1, _MOTION_FLOATS)
    views = [np.frombuffer(r[6], _FEATURE) for r in table]
    features = np.concatenate(views) if views else np.empty(0, _FEATURE)
    return KeyPoses(
        session=session,
        stamp_ns=np.array([r[0] for r in table], np.int64),
        pose=np.array([r[1:4] for r in table], np.float64).reshape(-1, 3),
        motion=motion[:, :3].copy(),
        motion_cov=motion[:, 3:12].reshape(-1, 3, 3).copy(),
        direction_rad=motion[:, 12].copy(),
        direction_sigma_rad=motion[:, 13].copy(),
        view=np.repeat(np.arange(len(table)), [len(v) for v in views]).astype(np.int64),
        xy_base_m=features["xy"].copy(),
        cov_base_m2=features["cov"][:, [0, 1, 1, 2]].reshape(-1, 2, 2),
        crossing_type=features["kind"].astype(np.int64),
        landmark=features["landmark"].astype(np.int64),
    )


def _direction(k: KeyPoses) -> Array:
    """(K, 2) direction and its standard deviation."""
    return np.column_stack([k.direction_rad, k.direction_sigma_rad])


def _digest(session: str, values: tuple[Any, ...]) -> bytes:
    numbers = repr(values[:-2]).encode()
    blobs = (v if isinstance(v, bytes) else repr(v).encode() for v in values[-2:])
    return digest(b"\n".join([session.encode("utf-8", "surrogatepass"), numbers, *map(digest, blobs)]))


def _check(k: KeyPoses) -> None:
    n, o = len(k), k.features
    ints(k.stamp_ns, "key_poses.stamp_ns", 0, MAX_ID)
    if np.any(np.diff(k.stamp_ns) <= 0):
        raise Damage("key_poses.stamp_ns does not ascend")
    floats(np.asarray(k.pose), "key_poses.pose", (n, 3), MAX_COORDINATE_M)
    floats(np.asarray(k.motion), "key_poses.motion", (n, 3), MAX_COORDINATE_M)
    floats(_direction(k), "key_poses.direction_rad", (n, 2), MAX_ANGLE_RAD)
    if np.any(np.isnan(k.motion_cov) | (k.motion_cov == -np.inf)):
        raise Damage("key_poses.motion_cov has a value that is neither finite nor unknown")
    known = np.all(np.isfinite(k.motion_cov), axis=(1, 2))
    covariance(k.motion_cov[known], "key_poses.motion_cov")
    ints(k.view, "key_poses.view", 0, max(n - 1, 0))
    if np.any(np.diff(k.view) < 0):
        raise Damage("key_poses.view does not ascend")
    floats(np.asarray(k.xy_base_m), "key_poses.xy_base_m", (o, 2), MAX_COORDINATE_M)
    floats(np.asarray(k.cov_base_m2), "key_poses.cov_base_m2", (o, 2, 2), MAX_COORDINATE_M**2)
    covariance(np.asarray(k.cov_base_m2), "key_poses.cov_base_m2")
    ints(k.crossing_type, "key_poses.crossing_type", 0, CROSSING_TYPES - 1)
    ints(k.landmark, "key_poses.landmark", -1, MAX_ID)


def kept(k: KeyPoses, keep: NDArray[np.bool_]) -> KeyPoses:
    """The key poses (K,) of a mask; the motion to each is from the one before that is still there."""
    if np.all(keep):
        return k
    motion, cov = k.motion.copy(), k.motion_cov.copy()
    for i in range(1, len(k)):
        if not keep[i - 1]:
            cov[i] = _motion_cov(motion[i - 1], cov[i - 1], motion[i], cov[i])
            motion[i] = compose(motion[i - 1], motion[i])
    which = np.flatnonzero(keep)
    if len(which) and which[0]:
        motion[which[0]], cov[which[0]] = 0.0, np.diag(np.full(3, np.inf))
    seen = keep[k.view]
    number = np.cumsum(keep) - 1
    return replace(
        k,
        stamp_ns=k.stamp_ns[which],
        pose=k.pose[which],
        motion=motion[which],
        motion_cov=cov[which],
        direction_rad=k.direction_rad[which],
        direction_sigma_rad=k.direction_sigma_rad[which],
        view=number[k.view[seen]],
        xy_base_m=k.xy_base_m[seen],
        cov_base_m2=k.cov_base_m2[seen],
        crossing_type=k.crossing_type[seen],
        landmark=k.landmark[seen],
    )


def _motion_cov(first: Array, first_cov: Array, second: Array, second_cov: Array) -> Array:
    if not (np.all(np.isfinite(first_cov)) and np.all(np.isfinite(second_cov))):
        return np.diag(np.full(3, np.inf))
    cov = compose_cov(first, first_cov, second, second_cov)
    return np.asarray(0.5 * (cov + cov.T), np.float64)


def spaced(sessions: Iterable[KeyPoses]) -> tuple[KeyPoses, ...]:
    """Sessions, the oldest first, with no more than MOST_IN_SPACE key poses in a square: those of the newest stay."""
    count: dict[int, int] = {}
    out: list[KeyPoses] = []
    for k in reversed(list(sessions)):
        keep = np.zeros(len(k), bool)
        for i, cell in reversed(list(enumerate(cells(k.pose[:, :2], SPACE_M).tolist()))):
            keep[i] = count.get(cell, 0) < MOST_IN_SPACE
            count[cell] = count.get(cell, 0) + 1
        out.append(kept(k, keep))
    return tuple(k for k in reversed(out) if len(k))
