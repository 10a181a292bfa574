"""Map and last pose on disk: JSON, versioned, checksummed, replaced in one step (docs/files.md).

What load_state returns is a hypothesis and never the truth: the robot may have been carried while the daemon was not
running.
"""

from __future__ import annotations

import base64
import hashlib
import json
import stat
from collections.abc import Callable, Set
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NoReturn, TypeVar

import numpy as np
from numpy.typing import NDArray

from ceilvo.crossing_types import CROSSING_TYPES
from ceilvo.errors import FileFormatError
from ceilvo.files import write_atomic
from ceilvo.se2 import covariance_problem
from ceilvo.types import MAX_ANGLE_RAD, MAX_COORDINATE_M, MAX_ID, Landmarks, Pose, State, frozen

Array = NDArray[np.float64]
_T = TypeVar("_T")

MAP_VERSION, STATE_VERSION = 2, 2
"""docs/files.md; a map of version 1 has lists of numbers, and no count of how often landmarks were expected. A state of
version 1 does not say how likely the robot was elsewhere."""
MAX_MAP_BYTES = 256 * 2**20
"""Largest map file that is read; the most that filter.max_landmarks allows take 183 MiB."""
MAX_STATE_BYTES = 64 * 2**10
"""Largest state file that is read; one has less than 1 kB."""
_MAP_FORMAT, _STATE_FORMAT = "ceilvo-map", "ceilvo-state"
_VERSIONS = {_MAP_FORMAT: MAP_VERSION, _STATE_FORMAT: STATE_VERSION}
_COLUMNS = {
    "id": ("<i8", 1),
    "xy_map_m": ("<f8", 2),
    "cov_xx_xy_yy_m2": ("<f8", 3),
    "kind": ("<i8", 1),
    "sightings": ("<i8", 1),
    "expected": ("<i8", 1),
}
"""Of a map: type of the numbers and how many a landmark has."""
_STATE_KEYS = {"pose_map_from_base", "cov", "state", "stamp_ns", "elsewhere"}
_NOT_IN_1 = {"expected", "elsewhere"}
_REMEDY = {
    _MAP_FORMAT: "restore a backup, or go on with an earlier map or a new one",
    _STATE_FORMAT: "without it the robot is searched for on all of the map",
}


@dataclass(frozen=True, slots=True)
class StoredMap:
    """Landmarks, and the direction in map of axis 0 of their types (rad)."""

    landmarks: Landmarks
    map_axis_rad: float


@dataclass(frozen=True, slots=True)
class StoredState:
    """The last pose of an earlier run: map_from_base (3,), cov (3, 3), the state it was in, and its frame's stamp.

    The stamp is CLOCK_MONOTONIC of the boot it was written in: it orders saves, it does not tell the time since.

    Attributes:
        elsewhere: probability that the robot was at another place.
    """

    pose: Pose
    cov: Array
    state: State
    stamp_ns: int
    elsewhere: float = 0.0


class _Damage(Exception):
    """What is wrong with a document; becomes a FileFormatError with the file's name and what to do."""


def save_map(path: Path, landmarks: Landmarks, map_axis_rad: float) -> None:
    """Replace the map file.

    Raises:
        FileFormatError: the values are not a valid map, or the folder cannot be written; the old file is untouched.
    """
    table = {
        "id": landmarks.ids,
        "xy_map_m": landmarks.xy_map_m,
        "cov_xx_xy_yy_m2": np.asarray(landmarks.cov_m2).reshape(-1, 4)[:, [0, 1, 3]],
        "kind": landmarks.crossing_type,
        "sightings": landmarks.sightings,
        "expected": landmarks.expected,
    }
    content = {
        "map_axis_rad": float(map_axis_rad),
        "landmarks": {k: _as_text(column, _COLUMNS[k][0]) for k, column in table.items()},
    }
    _save(path, _MAP_FORMAT, content, _read_map, MAX_MAP_BYTES)


def load_map(path: Path) -> StoredMap | None:
    """The stored map, None when there is no such file.

    Raises:
        FileFormatError: the file cannot be read, is damaged, or is of a version this ceilvo does not know.
    """
    return _load(path, _MAP_FORMAT, _read_map, MAX_MAP_BYTES)


def save_state(path: Path, pose: Array, cov: Array, state: State, stamp_ns: int, elsewhere: float = 0.0) -> None:
    """Replace the state file; raises as save_map."""
    content = {
        "pose_map_from_base": {"x_m": float(pose[0]), "y_m": float(pose[1]), "theta_rad": float(pose[2])},
        "cov": np.asarray(cov, np.float64).tolist(),
        "state": state.name,
        "stamp_ns": int(stamp_ns),
        "elsewhere": float(elsewhere),
    }
    _save(path, _STATE_FORMAT, content, _read_state, MAX_STATE_BYTES)


def load_state(path: Path) -> StoredState | None:
    """The stored pose as a hypothesis, None when there is no such file; raises as load_map."""
    return _load(path, _STATE_FORMAT, _read_state, MAX_STATE_BYTES)


def _save(path: Path, kind: str, content: dict[str, Any], read: Callable[[Any, int], Any], limit: int) -> None:
    try:
        version = _VERSIONS[kind]
        read(content, version)
        document = {"format": kind, "version": version, "sha256": _digest(content), "content": content}
        text = json.dumps(document, allow_nan=False, sort_keys=False) + "\n"
        if len(text) > limit:
            raise _Damage(f"{len(text)} bytes, expected at most {limit}")
    except _Damage as e:
        raise FileFormatError(f"{path}: not written, the old file stays: {e}") from e
    try:
        write_atomic(path, text)
    except OSError as e:
        raise FileFormatError(
            f"{path}: cannot be written: {e.strerror or e}; expected a folder that the daemon may write to, "
            "check service.state_dir and its owner (nothing was changed)"
        ) from e


def _load(path: Path, kind: str, read: Callable[[Any, int], _T], limit: int) -> _T | None:
    try:
        raw = _bytes(path, limit)
        return None if raw is None else read(*_content(raw, kind, limit))
    except (_Damage, RecursionError) as e:
        raise FileFormatError(f"{path}: {e}; {_REMEDY[kind]}") from e


def _bytes(path: Path, limit: int) -> bytes | None:
    """What a file holds, one more than the limit at most; None where there is none. A pipe would never end."""
    try:
        if not stat.S_ISREG(path.stat().st_mode):
            raise _Damage("a folder, a pipe or a device, expected a file")
        with path.open("rb") as f:
            return f.read(limit + 1)
    except FileNotFoundError:
        if path.is_symlink():
            raise _Damage(f"a link to {path.readlink()}, which is not there") from None
        return None
    except (OSError, ValueError) as e:
        why = (e.strerror or str(e)) if isinstance(e, OSError) else str(e)
        raise _Damage(f"cannot be read: {why}, check its owner") from e


def _content(raw: bytes, kind: str, limit: int) -> tuple[Any, int]:
    """What a document holds, and its version."""
    if len(raw) > limit:
        raise _Damage(f"longer than the largest allowed {limit} bytes")
    try:
        document = json.loads(raw.decode("utf-8"), parse_constant=_no_constant)
    except (ValueError, RecursionError) as e:
        raise _Damage(f"damaged or cut short: {str(e).splitlines()[0][:120]}") from e
    if not isinstance(document, dict) or document.get("format") != kind:
        raise _Damage(f"not a {kind} file")
    version, newest = document.get("version"), _VERSIONS[kind]
    if type(version) is not int or version < 1:
        raise _Damage(f"version is {_shown(version)}, expected a whole number from 1 to {newest}")
    if version > newest:
        raise _Damage(f"version {version} was written by a newer ceilvo, this one reads up to {newest}; update it")
    _keys(document, {"format", "version", "sha256", "content"}, "file")
    if document["sha256"] != _digest(document["content"]):
        raise _Damage("checksum does not match, the content was changed or damaged")
    return document["content"], version


def _no_constant(name: str) -> NoReturn:
    raise ValueError(f"{name} is not a number")


def _digest(content: Any) -> str:
    """SHA-256 of the canonical form; floats survive because Python writes the shortest text that reads back equal."""
    try:
        text = json.dumps(content, sort_keys=True, separators=(",", ":"), allow_nan=False)
        return hashlib.sha256(text.encode("utf-8", "surrogatepass")).hexdigest()
    except (ValueError, RecursionError) as e:
        raise _Damage(f"values that cannot be stored: {e}") from e


def _read_map(content: Any, version: int) -> StoredMap:
    _keys(content, {"map_axis_rad", "landmarks"}, "content")
    table = content["landmarks"]
    _keys(table, _COLUMNS.keys() - (_NOT_IN_1 if version == 1 else set()), "landmarks")
    if version > 1:
        table = {k: _from_text(table[k], f"landmarks.{k}", *_COLUMNS[k]) for k in _COLUMNS}
    ids = _ints(table["id"], "landmarks.id", 0, MAX_ID)
    n = len(ids)
    if len(np.unique(ids)) != n:
        raise _Damage("landmarks.id has duplicates")
    packed = _floats(table["cov_xx_xy_yy_m2"], "landmarks.cov_xx_xy_yy_m2", (n, 3), MAX_COORDINATE_M**2)
    cov = packed[:, [0, 1, 1, 2]].reshape(n, 2, 2)
    _covariance(cov, "landmarks.cov_xx_xy_yy_m2")
    sightings = _ints(table["sightings"], "landmarks.sightings", 0, MAX_ID, n)
    expected = sightings if version == 1 else _ints(table["expected"], "landmarks.expected", 0, MAX_ID, n)
    if np.any(expected < sightings):
        i = int(np.argmax(expected < sightings))
        raise _Damage(f"landmarks.expected[{i}] is {expected[i]}, expected at least its sightings, {sightings[i]}")
    landmarks = Landmarks(
        ids=ids,
        xy_map_m=_floats(table["xy_map_m"], "landmarks.xy_map_m", (n, 2), MAX_COORDINATE_M),
        cov_m2=frozen(cov),
        crossing_type=_ints(table["kind"], "landmarks.kind", 0, CROSSING_TYPES - 1, n),
        sightings=sightings,
        expected=expected,
    )
    return StoredMap(landmarks, float(_floats(content["map_axis_rad"], "map_axis_rad", (), MAX_ANGLE_RAD)))


def _read_state(content: Any, version: int) -> StoredState:
    _keys(content, _STATE_KEYS - (_NOT_IN_1 if version == 1 else set()), "content")
    pose = content["pose_map_from_base"]
    _keys(pose, {"x_m", "y_m", "theta_rad"}, "pose_map_from_base")
    values = _floats([pose["x_m"], pose["y_m"], pose["theta_rad"]], "pose_map_from_base", (3,), MAX_COORDINATE_M)
    cov = _floats(content["cov"], "cov", (3, 3), MAX_COORDINATE_M**2)
    _covariance(cov[None], "cov")
    name = content["state"]
    if not isinstance(name, str) or name not in State.__members__:
        raise _Damage(f"state is {_shown(name)}, expected one of {', '.join(State.__members__)}")
    stamp = _ints([content["stamp_ns"]], "stamp_ns", 0, MAX_ID)
    elsewhere = 0.0 if version == 1 else float(_floats(content["elsewhere"], "elsewhere", (), 1.0))
    if elsewhere < 0.0:
        raise _Damage(f"elsewhere is {elsewhere}, expected a probability")
    return StoredState(Pose(values), cov, State[name], int(stamp[0]), elsewhere)


def _keys(value: Any, expected: Set[str], where: str) -> None:
    if not isinstance(value, dict):
        raise _Damage(f"{where} is {_shown(value)}, expected a mapping")
    missing, unknown = sorted(expected - value.keys()), sorted(value.keys() - expected)
    if missing or unknown:
        raise _Damage(
            f"{where}: missing keys {missing or 'none'}, unknown keys {_shown(unknown) if unknown else 'none'}"
        )


def _as_text(column: NDArray[Any], dtype: str) -> str:
    """Eight bytes a number: decimals take nine times as long, and no other thread runs meanwhile."""
    return base64.b64encode(np.asarray(column, dtype).tobytes()).decode("ascii")


def _from_text(value: Any, where: str, dtype: str, width: int) -> NDArray[Any]:
    """(N,), or (N, width) where a landmark has several numbers."""
    if not isinstance(value, str):
        raise _Damage(f"{where} is {_shown(value)}, expected numbers of 8 bytes in base64")
    try:
        data = base64.b64decode(value, validate=True)
    except ValueError as e:
        raise _Damage(f"{where} is not base64: {e}") from e
    if len(data) % (8 * width):
        raise _Damage(f"{where} has {len(data)} bytes, expected a multiple of {8 * width}")
    numbers = np.frombuffer(data, dtype).astype(np.dtype(dtype).newbyteorder("="))
    return numbers if width == 1 else numbers.reshape(-1, width)


def _ints(value: Any, where: str, low: int, high: int, n: int | None = None) -> NDArray[np.int64]:
    """Of a list, or of an array that has been read already."""
    if isinstance(value, np.ndarray):
        good = bool(np.all((value >= low) & (value <= high)))
    else:
        good = isinstance(value, list) and all(type(v) is int and low <= v <= high for v in value)
    if not good:
        raise _Damage(f"{where} is not a list of whole numbers from {low} to {high}")
    if n is not None and len(value) != n:
        raise _Damage(f"{where} has {len(value)} values, expected {n}")
    out = np.array(value, np.int64)
    out.setflags(write=False)
    return out


def _floats(value: Any, where: str, shape: tuple[int, ...], limit: float) -> Array:
    """An array of that shape, finite and within the limit; numbers only, so that no text or bool slips in."""
    if not (value.shape == shape if isinstance(value, np.ndarray) else _has_shape(value, shape)):
        raise _Damage(f"{where} is not an array of numbers of shape {shape}")
    try:
        out = np.array(value, np.float64).reshape(shape)
    except OverflowError as e:
        raise _Damage(f"{where} has a number that is too large") from e
    if not np.all(np.abs(out) <= limit):
        raise _Damage(f"{where} has a value that is not finite or beyond {limit:g}")
    return frozen(out)


def _has_shape(value: Any, shape: tuple[int, ...]) -> bool:
    if not shape:
        return type(value) in (int, float)
    return isinstance(value, list) and len(value) == shape[0] and all(_has_shape(v, shape[1:]) for v in value)


def _covariance(cov: Array, where: str) -> None:
    """(K, n, n) symmetric and positive semi-definite to rounding."""
    if problem := covariance_problem(cov):
        raise _Damage(f"{where} {problem}")


def _shown(value: Any) -> str:
    text = repr(value)
    return text if len(text) <= 60 else f"{text[:57]}..."
