"""VDA 5050's messages from ceilvo's, and its instant actions to ceilvo's commands: pure functions (docs/fleets.md)."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime, timezone
from typing import Any

from ceilvo.drivers.bus.messages import Pose, load_object
from ceilvo.errors import BusError, one_line
from ceilvo.types import State

LOST = (State.LOST, State.RELOCALISING)
"""States of LOCALIZATION_ERROR, fatal: the robot must not drive by this pose."""
LOCALIZED = (State.TRACKING, State.DEGRADED, State.DEAD_RECKONING)
_SIGMAS = 3.0
"""Of the deviation range: a robot is further off once in some hundred times."""
INITIAL_POSE = ("initPosition", "initializePosition")
"""VDA 5050 2.x and 3.0."""
_MOST_ACTIONS = 20
"""In one message; chosen."""


@dataclass(frozen=True, slots=True)
class Robot:
    """Who speaks, as every header has it."""

    version: str
    manufacturer: str
    serial_number: str

    @property
    def is_3(self) -> bool:
        return self.version.startswith("3")


@dataclass(frozen=True, slots=True)
class Action:
    """An instant action; parameters by key."""

    kind: str
    id: str
    parameters: Mapping[str, Any]


def header(robot: Robot, number: int, unix_ns: int) -> dict[str, object]:
    at = datetime.fromtimestamp(unix_ns / 1e9, timezone.utc)
    stamp = at.strftime("%Y-%m-%dT%H:%M:%S.") + f"{at.microsecond // 1000:03d}Z"
    return {
        "headerId": number,
        "timestamp": stamp,
        "version": robot.version,
        "manufacturer": robot.manufacturer,
        "serialNumber": robot.serial_number,
    }


def connection(robot: Robot, number: int, unix_ns: int, state: str) -> bytes:
    """state: ONLINE, OFFLINE or CONNECTIONBROKEN, which 3.0 writes with a line in it."""
    word = "CONNECTION_BROKEN" if robot.is_3 and state == "CONNECTIONBROKEN" else state
    return _bytes({**header(robot, number, unix_ns), "connectionState": word})


def position(robot: Robot, pose: Pose, map_id: str) -> dict[str, object] | None:
    """mobileRobotPosition of 3.0, agvPosition of 2.x; None where the pose has no numbers."""
    if not all(map(math.isfinite, (pose.x_m, pose.y_m, pose.theta_rad))):
        return None
    localized = pose.state in LOCALIZED
    out: dict[str, object] = {"x": pose.x_m, "y": pose.y_m, "theta": pose.theta_rad, "mapId": map_id}
    out["localized" if robot.is_3 else "positionInitialized"] = localized
    if math.isfinite(pose.quality):
        out["localizationScore"] = min(max(pose.quality, 0.0), 1.0)
    if localized and math.isfinite(pose.cov[0] + pose.cov[4]):
        out["deviationRange"] = _SIGMAS * math.sqrt(max(pose.cov[0], pose.cov[4], 0.0))
    return out


def floor_of(pose: Pose) -> str:
    """The floor that the pose's message names, "" for the only one."""
    told = pose.fields.get("map_id")
    return told if isinstance(told, str) else ""


def visualization(robot: Robot, number: int, unix_ns: int, pose: Pose, map_id: str) -> bytes | None:
    where = position(robot, pose, map_id)
    if where is None:
        return None
    name = "mobileRobotPosition" if robot.is_3 else "agvPosition"
    return _bytes({**header(robot, number, unix_ns), name: where})


def state(
    robot: Robot,
    number: int,
    unix_ns: int,
    pose: Pose | None,
    silence: str,
    maps: Sequence[tuple[str, str, bool]],
    actions: Sequence[object],
) -> bytes:
    """What a localisation knows of the state.

    Args:
        silence: why nothing is heard of the daemon, "" while it speaks.
        maps: id, version and whether it is in use; that one is the first.
    """
    map_id = maps[0][0]
    out: dict[str, object] = header(robot, number, unix_ns)
    where = None if pose is None else position(robot, pose, map_id)
    if where is not None and silence:
        where["localized" if robot.is_3 else "positionInitialized"] = False
    if where is not None:
        out["mobileRobotPosition" if robot.is_3 else "agvPosition"] = where
    out |= {
        "orderId": "",
        "orderUpdateId": 0,
        "lastNodeId": "",
        "lastNodeSequenceId": 0,
        "nodeStates": [],
        "edgeStates": [],
        "maps": [
            {"mapId": name, "mapVersion": version, "mapStatus": "ENABLED" if used else "DISABLED"}
            for name, version, used in maps
        ],
        "instantActionStates" if robot.is_3 else "actionStates": list(actions),
        "errors": list(errors(pose, silence)),
        "information": [],
    }
    if robot.is_3:
        out["actionStates"] = []
    return _bytes(out)


def errors(pose: Pose | None, silence: str) -> list[dict[str, object]]:
    """LOCALIZATION_ERROR: fatal when lost or silent, a warning before the first fix."""
    if silence:
        return [_error("FATAL", silence)]
    if pose is None or pose.state is State.INIT:
        return [_error("WARNING", "not localized yet" if pose is None else f"INIT: {pose.reason}")]
    if pose.state in LOST:
        return [_error("FATAL", f"{pose.state.name}: {pose.reason}")]
    return []


def _error(level: str, text: str) -> dict[str, object]:
    return {"errorType": "LOCALIZATION_ERROR", "errorReferences": [], "errorLevel": level, "errorDescription": text}


def instant_actions(payload: bytes) -> list[Action]:
    """
    Raises:
        BusError: it is no message of instantActions.
    """
    fields = load_object(payload, "instantActions")
    listed = fields.get("actions", fields.get("instantActions"))
    if not isinstance(listed, list) or len(listed) > _MOST_ACTIONS:
        raise BusError(f"instantActions: found no list of at most {_MOST_ACTIONS} actions, expected one")
    out = []
    for a in listed:
        if (
            not isinstance(a, dict)
            or not isinstance(a.get("actionType"), str)
            or not isinstance(a.get("actionId"), str)
        ):
            raise BusError("instantActions: found an action without actionType or actionId, expected both as texts")
        given = a.get("actionParameters") or []
        try:
            parameters = {str(p["key"]): p["value"] for p in given}
        except (KeyError, TypeError) as e:
            raise BusError("instantActions: found parameters that are no keys and values") from e
        out.append(Action(a["actionType"], a["actionId"], parameters))
    return out


def initial_pose(action: Action, floors: Mapping[str, str]) -> bytes:
    """The command's JSON.

    Args:
        floors: by mapId what the daemon calls the maps that are loaded; the one that the robot is on is the first.

    Raises:
        BusError: a number is missing, or the pose is on another map.
    """
    here = next(iter(floors))
    where = action.parameters.get("mapId", here)
    if not isinstance(where, str) or where not in floors:
        expected = f"{here!r}, the map that is loaded" if len(floors) == 1 else f"one of {', '.join(floors)}"
        raise BusError(f"mapId: found {one_line(repr(where), 60)}, expected {expected}")
    out: dict[str, object] = {"map_id": floors[where]} if floors[where] else {}
    for name, ours in (("x", "x_m"), ("y", "y_m"), ("theta", "theta_rad")):
        value = action.parameters.get(name)
        if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
            raise BusError(f"{name}: found {one_line(repr(value), 60)}, expected a number")
        out[ours] = float(value)
    return _bytes(out)


def action_state(robot: Robot, action: Action, status: str, text: str) -> dict[str, object]:
    """status: RUNNING, FINISHED or FAILED; text: what came of it."""
    return {
        "actionId": action.id,
        "actionType": action.kind,
        "actionStatus": status,
        "actionResult" if robot.is_3 else "resultDescription": one_line(text),
    }


def _bytes(body: Mapping[str, object]) -> bytes:
    return json.dumps(body, allow_nan=False, separators=(",", ":")).encode()
