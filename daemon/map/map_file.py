"""Map and last pose on disk: JSON, versioned, checksummed, replaced in one step (docs/files.md).

What load_state returns is a hypothesis and never the truth: the robot may have been carried while the daemon was not
running.
"""

from __future__ import annotations

import base64
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from ceilvo.calibration import LEVEL_CEILING, SLOPE_NUMBERS, CeilingShape
from ceilvo.daemon.map.checks import Damage, covariance, floats, ints, keys, landmarks_of, shown
from ceilvo.daemon.map.document import content_bytes, content_of, document_of
from ceilvo.errors import FileFormatError
from ceilvo.files import write_atomic
from ceilvo.json_values import MAX_ANGLE_RAD, MAX_COORDINATE_M, MAX_ID
from ceilvo.types import Landmarks, Pose, State

Array = NDArray[np.float64]
_T = TypeVar("_T")

MAP_VERSION, STATE_VERSION = 2, 5
"""docs/files.md; a map of version 1 has lists of numbers, and no count of how often landmarks were expected. A state of
version 1 does not say how likely the robot was elsewhere, one of version 2 not which map it is on,
one of version 3 not at which heights the ceiling hangs."""
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
_STATE_KEYS = {"pose_map_from_base", "cov", "state", "stamp_ns"}
_LATER_KEYS = {"elsewhere": 2, "frame": 3, "drops_m": 4, "slope": 5}
"""Of a state, and the version that brought them."""
_MOST_DROPS, _MOST_DROP_M = 100, 100.0
"""Heights of a ceiling in a state, and by how much one differs from the calibrated one; a dozen are kept."""
_MOST_SLOPE = 100.0
"""The largest number of a slope: a height over the calibrated one where a map's origin is far from the robot."""
_FRAME_CHARS = 80
"""Of a frame's name; one has some 40."""
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
        frame: of the map that the pose is on, as in MapDatabase; None where that is not known.
        ceiling: its shape, on that map.
    """

    pose: Pose
    cov: Array
    state: State
    stamp_ns: int
    elsewhere: float = 0.0
    frame: str | None = None
    ceiling: CeilingShape = LEVEL_CEILING


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


def save_state(
    path: Path,
    pose: Array,
    cov: Array,
    state: State,
    stamp_ns: int,
    elsewhere: float = 0.0,
    frame: str | None = None,
    ceiling: CeilingShape = LEVEL_CEILING,
) -> None:
    """Replace the state file; raises as save_map."""
    content = {
        "pose_map_from_base": {"x_m": float(pose[0]), "y_m": float(pose[1]), "theta_rad": float(pose[2])},
        "cov": np.asarray(cov, np.float64).tolist(),
        "state": state.name,
        "stamp_ns": int(stamp_ns),
        "elsewhere": float(elsewhere),
        "frame": frame,
        "drops_m": list(ceiling.drops_m),
        "slope": list(ceiling.slope),
    }
    _save(path, _STATE_FORMAT, content, _read_state, MAX_STATE_BYTES)


def load_state(path: Path) -> StoredState | None:
    """The stored pose as a hypothesis, None when there is no such file; raises as load_map."""
    return _load(path, _STATE_FORMAT, _read_state, MAX_STATE_BYTES)


def _save(path: Path, kind: str, content: dict[str, Any], read: Callable[[Any, int], Any], limit: int) -> None:
    try:
        version = _VERSIONS[kind]
        read(content, version)
        text = document_of(kind, version, content)
        if len(text) > limit:
            raise Damage(f"{len(text)} bytes, expected at most {limit}")
    except Damage as e:
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
        raw = content_bytes(path, limit)
        return None if raw is None else read(*content_of(raw, kind, _VERSIONS[kind], limit))
    except (Damage, RecursionError) as e:
        raise FileFormatError(f"{path}: {e}; {_REMEDY[kind]}") from e


def _read_map(content: Any, version: int) -> StoredMap:
    keys(content, {"map_axis_rad", "landmarks"}, "content")
    table = content["landmarks"]
    keys(table, _COLUMNS.keys() - ({"expected"} if version == 1 else set()), "landmarks")
    if version > 1:
        table = {k: _from_text(table[k], f"landmarks.{k}", *_COLUMNS[k]) for k in _COLUMNS}
    if version == 1:
        table = {**table, "expected": table["sightings"]}
    landmarks = landmarks_of(table)
    return StoredMap(landmarks, float(floats(content["map_axis_rad"], "map_axis_rad", (), MAX_ANGLE_RAD)))


def _read_state(content: Any, version: int) -> StoredState:
    keys(content, _STATE_KEYS | {k for k, since in _LATER_KEYS.items() if version >= since}, "content")
    pose = content["pose_map_from_base"]
    keys(pose, {"x_m", "y_m", "theta_rad"}, "pose_map_from_base")
    values = floats([pose["x_m"], pose["y_m"], pose["theta_rad"]], "pose_map_from_base", (3,), MAX_COORDINATE_M)
    cov = floats(content["cov"], "cov", (3, 3), MAX_COORDINATE_M**2)
    covariance(cov[None], "cov")
    name = content["state"]
    if not isinstance(name, str) or name not in State.__members__:
        raise Damage(f"state is {shown(name)}, expected one of {', '.join(State.__members__)}")
    stamp = ints([content["stamp_ns"]], "stamp_ns", 0, MAX_ID)
    elsewhere = 0.0 if version == 1 else float(floats(content["elsewhere"], "elsewhere", (), 1.0))
    if elsewhere < 0.0:
        raise Damage(f"elsewhere is {elsewhere}, expected a probability")
    frame = content.get("frame")
    if frame is not None and not (isinstance(frame, str) and len(frame) <= _FRAME_CHARS):
        raise Damage(f"frame is {shown(frame)}, expected the name of a map's frame")
    drops = content.get("drops_m", [])
    if not isinstance(drops, list) or len(drops) > _MOST_DROPS:
        raise Damage(f"drops_m is {shown(drops)}, expected up to {_MOST_DROPS} numbers")
    drops_m = tuple(floats(drops, "drops_m", (len(drops),), _MOST_DROP_M).tolist())
    slope = content.get("slope", [])
    if not isinstance(slope, list) or len(slope) not in (0, SLOPE_NUMBERS):
        raise Damage(f"slope is {shown(slope)}, expected {SLOPE_NUMBERS} numbers, or none for a level ceiling")
    ceiling = CeilingShape(drops_m, tuple(floats(slope, "slope", (len(slope),), _MOST_SLOPE).tolist()))
    return StoredState(Pose(values), cov, State[name], int(stamp[0]), elsewhere, frame, ceiling)


def _as_text(column: NDArray[Any], dtype: str) -> str:
    """Eight bytes a number: decimals take nine times as long, and no other thread runs meanwhile."""
    return base64.b64encode(np.asarray(column, dtype).tobytes()).decode("ascii")


def _from_text(value: Any, where: str, dtype: str, width: int) -> NDArray[Any]:
    """(N,), or (N, width) where a landmark has several numbers."""
    if not isinstance(value, str):
        raise Damage(f"{where} is {shown(value)}, expected numbers of 8 bytes in base64")
    try:
        data = base64.b64decode(value, validate=True)
    except ValueError as e:
        raise Damage(f"{where} is not base64: {e}") from e
    if len(data) % (8 * width):
        raise Damage(f"{where} has {len(data)} bytes, expected a multiple of {8 * width}")
    numbers = np.frombuffer(data, dtype).astype(np.dtype(dtype).newbyteorder("="))
    return numbers if width == 1 else numbers.reshape(-1, width)
