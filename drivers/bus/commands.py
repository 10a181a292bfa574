"""Requests that reach the daemon as Zenoh queries: strict parsers from payload bytes to frozen dataclasses."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from ceilvo.drivers.bus import messages
from ceilvo.errors import BusError
from ceilvo.se2 import wrap
from ceilvo.senses.prediction import MAX_AHEAD_S

MAX_COMMAND_BYTES = 4096
"""docs/zenoh.md; far more than any command needs."""
COMMANDS = ("initial_pose", "relocalise", "save_map", "reset")


@dataclass(frozen=True, slots=True)
class InitialPose:
    """Where somebody says the robot is, map_from_base, with standard deviations.

    Attributes:
        map_id: the floor; "" for the one that the robot is on.
    """

    x_m: float
    y_m: float
    theta_rad: float
    sigma_m: float = 0.25
    sigma_theta_rad: float = 0.15
    map_id: str = ""


@dataclass(frozen=True, slots=True)
class Relocalise:
    """Look for the pose anywhere in the map."""


@dataclass(frozen=True, slots=True)
class SaveMap:
    """Write map and pose to disk now."""


@dataclass(frozen=True, slots=True)
class Reset:
    """Start again at the configured initial pose; the landmarks are forgotten too unless keep_map."""

    keep_map: bool = True


@dataclass(frozen=True, slots=True)
class PoseAt:
    """The last pose, moved on to so many milliseconds from now; None: as it is, of its picture."""

    predict_ms: float | None = None


Command = InitialPose | Relocalise | SaveMap | Reset

_POSE_RANGES: Mapping[str, tuple[float, float]] = {
    "x_m": (-1e5, 1e5),
    "y_m": (-1e5, 1e5),
    "theta_rad": (-1e3, 1e3),
    "sigma_m": (1e-4, 100.0),
    "sigma_theta_rad": (1e-4, math.pi),
}
"""Beyond them units are mixed up."""
_MOST_AHEAD_MS = 1e3 * MAX_AHEAD_S


def parse_pose_at(payload: bytes) -> PoseAt:
    """The question in the payload of a query for the pose; an empty payload asks for the last one as it is.

    Raises:
        BusError: too large, not JSON, unknown field, wrong type, out of range.
    """
    where = "query pose"
    if len(payload) > MAX_COMMAND_BYTES:
        raise BusError(f"{where}: payload too large, expected at most {MAX_COMMAND_BYTES} bytes; send less")
    fields = messages.load_object(payload, where) if payload.strip() else {}
    _check_names(where, fields, ("predict_ms",))
    ms = fields.get("predict_ms")
    if ms is not None and (isinstance(ms, bool) or not isinstance(ms, int | float) or not 0.0 <= ms <= _MOST_AHEAD_MS):
        expected = f"a number in [0, {_MOST_AHEAD_MS:g}], counted from now"
        raise BusError(f"{where}: predict_ms is {messages.short(ms)}, expected {expected}")
    return PoseAt(None if ms is None else float(ms))


def parse_command(command: str, payload: bytes, *, exact: bool = True) -> Command:
    """The request in a command's payload; an empty payload is an empty object.

    Args:
        exact: whether the request named this one key, without wildcards.

    Raises:
        BusError: asked of many keys at once, unknown command, too large, not JSON, unknown or missing field, wrong
            type, out of range, not finite.
    """
    where = f"command {command}"
    if command not in COMMANDS:
        raise BusError(f"command {messages.short(command)} is unknown, expected one of {', '.join(COMMANDS)}")
    if not exact:
        raise BusError(f"{where}: asked with a wildcard, expected the robot's full key; commands go to one robot")
    if len(payload) > MAX_COMMAND_BYTES:
        raise BusError(f"{where}: payload too large, expected at most {MAX_COMMAND_BYTES} bytes; send less")
    fields = messages.load_object(payload, where) if payload.strip() else {}
    if command == "initial_pose":
        return _parse_initial_pose(where, fields)
    if command == "reset":
        _check_names(where, fields, ("keep_map",))
        keep = fields.get("keep_map", True)
        if not isinstance(keep, bool):
            raise BusError(f"{where}: keep_map is {messages.short(keep)}, expected true or false")
        return Reset(keep)
    _check_names(where, fields, ())
    return Relocalise() if command == "relocalise" else SaveMap()


def _parse_initial_pose(where: str, fields: Mapping[str, Any]) -> InitialPose:
    _check_names(where, fields, (*_POSE_RANGES, "map_id"))
    map_id = fields.get("map_id", "")
    if not isinstance(map_id, str):
        raise BusError(f"{where}: map_id is {messages.short(map_id)}, expected the name of a floor")
    missing = [n for n in ("x_m", "y_m", "theta_rad") if n not in fields]
    if missing:
        raise BusError(f"{where}: {missing[0]} is missing, expected x_m, y_m and theta_rad")
    values = {n: _number(where, n, v) for n, v in fields.items() if n != "map_id"}
    values["theta_rad"] = wrap(values["theta_rad"])
    return InitialPose(**values, map_id=map_id)


def _check_names(where: str, fields: Mapping[str, Any], known: tuple[str, ...]) -> None:
    unknown = [n for n in fields if n not in known]
    if unknown:
        expected = f"only {', '.join(known)}" if known else "no fields"
        raise BusError(f"{where}: field {messages.short(unknown[0])} is unknown, expected {expected}")


def _number(where: str, name: str, value: Any) -> float:
    low, high = _POSE_RANGES[name]
    if isinstance(value, bool) or not isinstance(value, int | float) or not low <= value <= high:
        raise BusError(f"{where}: {name} is {messages.short(value)}, expected a number in [{low:g}, {high:g}]")
    return float(value)
