"""The JSON that ceilvo speaks on Zenoh: pure functions from quantities to bytes and back (docs/zenoh.md).

Every message is one JSON object on one line whose "schema" is "ceilvo.<name>.<version>". Within a version fields
are only added, so readers must ignore what they do not know; a field that changes its meaning makes a new version.
Units are in the field names; a quantity that is unknown or not finite is null. A covariance of (x, y, theta) is nine
numbers, row by row, in products of metres and radians.
"""

from __future__ import annotations

import json
import math
import reprlib
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ceilvo.calibration import Calibration
from ceilvo.config import Config
from ceilvo.config.zenoh_names import segment_problem
from ceilvo.drivers.ports import Stamp
from ceilvo.errors import BusError, one_line
from ceilvo.json_values import json_value
from ceilvo.types import Estimate, Landmarks, State

VERSION = 1
"""Of every schema; a field that changes its meaning makes a new one."""
_NANOMETRE = 9
"""Decimals of metres."""
_COV_NUMBERS = 9
"""A covariance of (x, y, theta), row by row."""
MAX_PARTICLES = 2000
"""A larger set is thinned uniformly: the message is for looking at, and this many are about 150 kB."""


QUERIES = ("map", "calibration", "config", "pose")


def robot_key(prefix: str, robot: str) -> str:
    """`<prefix>/<robot>`, the stem of every key.

    Raises:
        BusError: zenoh.prefix or robot.name cannot be part of a key.
    """
    for name, value in (("zenoh.prefix", prefix), ("robot.name", robot)):
        if problem := segment_problem(value):
            raise BusError(f"{name}: {problem}")
    return f"{prefix}/{robot}"


# encoding


def encode_pose(
    robot: str,
    estimate: Estimate,
    stamp_unix_ns: int,
    sent_ns: int,
    map_id: str = "",
    map_version: int | None = None,
    predicted_ms: float | None = None,
) -> bytes:
    """Pose of base in map, how good it is and why; sent_ns (monotonic) minus the capture time is its age.

    Args:
        map_id: name of the floor's map; map_version: as it was last kept, None where it is not.
        predicted_ms: by which pose and cov were moved on from the stamp; None where nobody asked for that.
    """
    e, d = estimate, estimate.health
    sigma = np.sqrt(np.maximum(np.diag(e.cov), 0.0))
    return _message(
        "pose",
        robot,
        {
            "seq": e.seq,
            "stamp_ns": e.stamp_ns,
            "stamp_unix_ns": stamp_unix_ns,
            "age_ms": (sent_ns - e.stamp_ns) / 1e6,
            "state": e.state.name,
            "state_number": int(e.state),
            "quality": e.quality,
            "reason": e.reason,
            "map_id": map_id,
            "map_version": map_version,
            **_pose_fields(e.pose),
            "cov": e.cov.ravel(),
            "sigma_x_m": sigma[0],
            "sigma_y_m": sigma[1],
            "sigma_theta_rad": sigma[2],
            "nis": d.nis,
            "nis_dof": d.nis_dof,
            "particles": d.particles,
            "ess": d.ess,
            "unique_ancestors": d.unique_ancestors,
            "fit_residual": d.fit_residual,
            "crossings": e.crossings,
            "landmarks": e.landmarks,
            "inliers": e.motion.inliers,
            "motion_rms_m": e.motion.rms_m,
            "motion_failure": e.motion.failure,
            "latency_ms": e.latency_ms,
            **({} if predicted_ms is None else {"predicted_ms": predicted_ms}),
        },
    )


def encode_odom(robot: str, estimate: Estimate, stamp_unix_ns: int) -> bytes:
    """Pose of base in odom (smooth, may drift), twist in base, and the last step with its covariance for fusion."""
    e, step = estimate, estimate.motion
    return _message(
        "odom",
        robot,
        {
            "seq": e.seq,
            "stamp_ns": e.stamp_ns,
            "stamp_unix_ns": stamp_unix_ns,
            **_pose_fields(e.odom),
            "vx_mps": e.twist[0],
            "vy_mps": e.twist[1],
            "omega_radps": e.twist[2],
            "step_x_m": step.prev_from_curr[0],
            "step_y_m": step.prev_from_curr[1],
            "step_theta_rad": step.prev_from_curr[2],
            "step_cov": step.cov.ravel(),
            "step_measured": step.ok,
        },
    )


def encode_health(robot: str, stamp: Stamp, uptime_s: float, state: State, counters: Mapping[str, object]) -> bytes:
    """Every counter of the process, by name."""
    return _message(
        "health",
        robot,
        {**_stamp_fields(stamp), "uptime_s": uptime_s, "state": state.name, "counters": counters},
    )


def encode_event(
    robot: str, stamp: Stamp, event: str, severity: str, text: str, data: Mapping[str, object] | None = None
) -> bytes:
    """Something that happened once: `event` is a stable word, severity info, warning or error, text for people."""
    return _message(
        "event",
        robot,
        {**_stamp_fields(stamp), "event": event, "severity": severity, "text": text, "data": data or {}},
    )


def encode_landmarks(robot: str, stamp: Stamp, landmarks: Landmarks) -> bytes:
    """The map as estimated, one list a column."""
    return _message("landmarks", robot, {**_stamp_fields(stamp), **_landmark_columns(landmarks)})


def encode_map(robot: str, stamp: Stamp, landmarks: Landmarks) -> bytes:
    """Reply of `/map`: the same columns."""
    return _message("map", robot, {**_stamp_fields(stamp), **_landmark_columns(landmarks)})


def encode_particles(
    robot: str, seq: int, stamp: Stamp, poses: NDArray[np.float64], weights: NDArray[np.float64]
) -> bytes:
    """Pose hypotheses (N, 3) map_from_base with weights (N,); `count` is N even where the set was thinned."""
    step = max(1, -(-len(poses) // MAX_PARTICLES))
    p, w = poses[::step], weights[::step]
    columns = {"x_m": p[:, 0], "y_m": p[:, 1], "theta_rad": p[:, 2], "weight": w}
    return _message("particles", robot, {"seq": seq, **_stamp_fields(stamp), "count": len(poses), **columns})


def encode_calibration(robot: str, calibration: Calibration) -> bytes:
    """Reply of `/calibration`: the file's values and the mounting that follows from them."""
    c = calibration
    return _message(
        "calibration",
        robot,
        {
            "camera_id": c.camera_id,
            "created": c.created,
            "camera": asdict(c.camera),
            "projection": c.projection.ravel(),
            "noise": asdict(c.noise),
            "tile_m": c.tile_m,
            "mount_x_m": _rounded(c.mount_xy_m[0]),
            "mount_y_m": _rounded(c.mount_xy_m[1]),
            "ceiling_height_m": _rounded(c.ceiling_height_m),
            "meta": c.meta,
        },
    )


def encode_config(robot: str, config: Config) -> bytes:
    """Reply of `/config`: the configuration in effect, defaults included."""
    return _message("config", robot, {"config": asdict(config)})


def encode_reply(robot: str, command: str, result: Mapping[str, object]) -> bytes:
    """What a command did."""
    return _message("reply", robot, {"command": command, "ok": True, "result": result})


def encode_error(robot: str, command: str, error: str) -> bytes:
    """Why a command or query was not carried out."""
    return _message("reply", robot, {"command": command, "ok": False, "error": error})


def _message(name: str, robot: str, fields: Mapping[str, object]) -> bytes:
    body = {"schema": f"ceilvo.{name}.{VERSION}", "robot": robot, **fields}
    return json.dumps(json_value(body), allow_nan=False, separators=(",", ":")).encode("ascii")


def _pose_fields(pose: NDArray[np.float64]) -> dict[str, object]:
    return {"x_m": pose[0], "y_m": pose[1], "theta_rad": pose[2]}


def _rounded(value_m: float) -> float:
    """To a nanometre and without -0: derived by an SVD, whose last bits differ from computer to computer."""
    return round(float(value_m), _NANOMETRE) + 0.0


def _stamp_fields(stamp: Stamp) -> dict[str, object]:
    return {"stamp_ns": stamp.ns, "stamp_unix_ns": stamp.unix_ns}


def _landmark_columns(m: Landmarks) -> dict[str, object]:
    return {
        "id": m.ids,
        "x_m": m.xy_map_m[:, 0],
        "y_m": m.xy_map_m[:, 1],
        "cov_xx_m2": m.cov_m2[:, 0, 0],
        "cov_xy_m2": m.cov_m2[:, 0, 1],
        "cov_yy_m2": m.cov_m2[:, 1, 1],
        "kind": m.crossing_type,
        "sightings": m.sightings,
    }


# decoding


@dataclass(frozen=True, slots=True)
class Pose:
    """A pose message as a subscriber gets it; what was null is nan. `fields` is the whole message."""

    robot: str
    seq: int
    stamp_ns: int
    stamp_unix_ns: int
    age_ms: float
    state: State
    quality: float
    reason: str
    x_m: float
    y_m: float
    theta_rad: float
    cov: tuple[float, ...]
    nis: float
    ess: float
    fields: Mapping[str, Any]


def decode(payload: bytes, name: str) -> dict[str, Any]:
    """The fields of a message of one schema.

    Raises:
        BusError: not JSON, another schema, or another version.
    """
    fields = load_object(payload, f"{name} message")
    want = f"ceilvo.{name}.{VERSION}"
    if fields.get("schema") != want:
        raise BusError(f"{name} message: schema is {short(fields.get('schema'))}, expected {want!r}; update one side")
    return fields


def decode_pose(payload: bytes) -> Pose:
    """A pose message.

    Raises:
        BusError: see decode(); also a field that is missing or of the wrong type.
    """
    f = decode(payload, "pose")
    try:
        return Pose(
            robot=str(f["robot"]),
            seq=int(f["seq"]),
            stamp_ns=int(f["stamp_ns"]),
            stamp_unix_ns=int(f["stamp_unix_ns"]),
            age_ms=_or_nan(f["age_ms"]),
            state=State(f["state_number"]),
            quality=_or_nan(f["quality"]),
            reason=str(f["reason"]),
            x_m=_or_nan(f["x_m"]),
            y_m=_or_nan(f["y_m"]),
            theta_rad=_or_nan(f["theta_rad"]),
            cov=_nine(f["cov"]),
            nis=_or_nan(f["nis"]),
            ess=_or_nan(f["ess"]),
            fields=f,
        )
    except (KeyError, TypeError, ValueError, OverflowError) as e:
        raise BusError(f"pose message: {type(e).__name__} {one_line(e)}, expected the fields of docs/zenoh.md") from e


def _nine(value: Any) -> tuple[float, ...]:
    cov = tuple(_or_nan(v) for v in value)
    if len(cov) != _COV_NUMBERS:
        raise ValueError(f"cov has {len(cov)} numbers, not {_COV_NUMBERS}")
    return cov


def _or_nan(value: Any) -> float:
    return math.nan if value is None else float(value)


def load_object(payload: bytes, where: str) -> dict[str, Any]:
    """A JSON object without NaN, Infinity or repeated names.

    Raises:
        BusError: it is anything else; `where` starts the message.
    """
    try:
        value = json.loads(payload.decode("utf-8"), parse_constant=_refuse_constant, object_pairs_hook=_unique)
    except (ValueError, RecursionError) as e:
        raise BusError(f"{where}: payload is not JSON ({one_line(e) or type(e).__name__}), expected one object") from e
    if not isinstance(value, dict):
        raise BusError(f"{where}: payload is {short(value)}, expected a JSON object")
    return value


def _refuse_constant(text: str) -> float:
    raise ValueError(f"{text} is not a JSON number")


def _unique(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    out = dict(pairs)
    if len(out) != len(pairs):
        raise ValueError("a field is given twice")
    return out


def short(value: object) -> str:
    """A value for an error message: printable, on one line, not long."""
    return reprlib.repr(value)
