"""Everything that changes what a pipeline will say, as data: what is recorded, and what a replay does again.

A pipeline is a function of its configuration, its calibration and the inputs in their order, so inputs that are read
back equal give estimates that are equal to the last bit. The JSON here keeps every float64 (shortest text that reads
back equal); frames travel beside it.
"""

from __future__ import annotations

import json
import math
import reprlib
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np

from ceilvo.calibration import LEVEL_CEILING, SLOPE_NUMBERS, CeilingShape
from ceilvo.daemon.pipeline import Pipeline
from ceilvo.daemon.relocalisation.doubts import JUST_NOW_S
from ceilvo.daemon.relocalisation.floors import Floors
from ceilvo.daemon.replay.plausible import (
    belief_problem,
    crossings_problem,
    landmarks_problem,
    turn_problem,
    wheels_problem,
)
from ceilvo.daemon.replay.snapshot import read_value, restore, value_json
from ceilvo.daemon.vision.finder.crossing_finder import OnStageDone, ignore
from ceilvo.errors import FileFormatError, one_line
from ceilvo.json_values import MAX_ANGLE_RAD, MAX_COORDINATE_M, MAX_ID
from ceilvo.senses.beacons import Beacons
from ceilvo.senses.heard import NOTHING, Heard
from ceilvo.types import Array, Crossings, Displacement, Estimate, Frame, Landmarks, Pose, WheelMotion


@dataclass(frozen=True, slots=True)
class FrameInput:
    """A frame, with what the wheels did since the step before, and what other senses heard."""

    frame: Frame
    wheels: WheelMotion | None = None
    heard: Heard = NOTHING


@dataclass(frozen=True, slots=True)
class Silence:
    """No frame came until stamp_ns."""

    stamp_ns: int
    reason: str
    wheels: WheelMotion | None = None
    heard: Heard = NOTHING


@dataclass(frozen=True, slots=True)
class LoadMap:
    """The map of an earlier run, with the pose (3,) and cov (3, 3) to look for it at.

    Attributes:
        ago_s: since that pose was stored; inf where nobody knows.
        elsewhere: probability that the robot was at another place when the pose was stored.
        floors: of the map, where it has several.
        ceiling: its shape, on that map.
    """

    landmarks: Landmarks
    map_axis_rad: float
    pose: Pose
    cov: Array
    ago_s: float = math.inf
    elsewhere: float = 0.0
    floors: Floors = field(default_factory=Floors)
    ceiling: CeilingShape = LEVEL_CEILING


@dataclass(frozen=True, slots=True)
class SetPose:
    """A pose (3,) with cov (3, 3) that somebody says, on a floor, or on the one that the robot is on."""

    pose: Pose
    cov: Array
    why: str
    floor: str = ""


@dataclass(frozen=True, slots=True)
class Reset:
    keep_map: bool


@dataclass(frozen=True, slots=True)
class KnownBeacons:
    """Anchors and marks, from now on."""

    beacons: Beacons


@dataclass(frozen=True, slots=True)
class Sighting:
    """What vision had found in a frame, where the frame itself is not at hand."""

    stamp_ns: int
    crossings: Crossings | None
    wheels: WheelMotion | None = None
    heard: Heard = NOTHING


@dataclass(frozen=True, slots=True)
class Continuation:
    """The state of another pipeline (snapshot.snapshot_json), from which to go on."""

    state: Any


Input = FrameInput | Sighting | Silence | LoadMap | SetPose | Reset | Continuation | KnownBeacons


def apply(pipeline: Pipeline, given: Input, on_stage_done: OnStageDone = ignore) -> Estimate | None:
    """Do what an input says; an estimate from frames, sightings and silences, None from the others."""
    if isinstance(given, FrameInput):
        return pipeline.step(given.frame, given.wheels, on_stage_done, given.heard)
    if isinstance(given, Sighting):
        return pipeline.step_crossings(given.stamp_ns, given.crossings, given.wheels, heard=given.heard)
    if isinstance(given, Silence):
        return pipeline.step_crossings(given.stamp_ns, None, given.wheels, missing=given.reason, heard=given.heard)
    if isinstance(given, LoadMap):
        g = given
        pipeline.load_map(g.landmarks, g.map_axis_rad, g.pose, g.cov, g.ago_s, g.elsewhere, g.floors, g.ceiling)
    elif isinstance(given, SetPose):
        pipeline.set_pose(given.pose, given.cov, given.why, given.floor)
    elif isinstance(given, Continuation):
        restore(pipeline, given.state)
    elif isinstance(given, KnownBeacons):
        pipeline.relocaliser.know(given.beacons)
    else:
        pipeline.reset(given.keep_map)
    return None


# -- as JSON


def input_json(given: Input, number: int) -> bytes:
    """One object on one line; `number` counts the inputs of a run, so that a missing one is noticed."""
    body: dict[str, Any]
    if isinstance(given, FrameInput):
        frame = given.frame
        body = {"input": "frame", "seq": frame.seq, "stamp_ns": frame.stamp_ns, "wheels": _wheels(given.wheels)}
        body |= _heard(given.heard)
    elif isinstance(given, Silence):
        body = {
            "input": "silence",
            "stamp_ns": given.stamp_ns,
            "reason": given.reason,
            "wheels": _wheels(given.wheels),
        }
        body |= _heard(given.heard)
    elif isinstance(given, LoadMap):
        body = {"input": "known_map", "map_axis_rad": given.map_axis_rad, **_belief(given.pose, given.cov)}
        body |= {"ago_s": given.ago_s if math.isfinite(given.ago_s) else None, "elsewhere": given.elsewhere}
        body |= {name: list(numbers) for name, numbers in asdict(given.ceiling).items() if numbers}
        if given.floors:
            body["floors"] = json.loads(value_json(given.floors))
        body["landmarks"] = {key: getattr(given.landmarks, name).tolist() for key, (name, _, _) in _LANDMARKS.items()}
    elif isinstance(given, SetPose):
        body = {"input": "assumption", "why": given.why, **_belief(given.pose, given.cov)}
        body |= {"floor": given.floor} if given.floor else {}
    elif isinstance(given, KnownBeacons):
        body = {"input": "beacons", "beacons": json.loads(value_json(given.beacons))}
    elif isinstance(given, Continuation):
        body = {"input": "continuation", "state": given.state}
    elif isinstance(given, Sighting):
        raise TypeError("a sighting is recorded as its frame, with value_json(crossings) beside it")
    else:
        body = {"input": "reset", "keep_map": given.keep_map}
    return json.dumps({"number": number, **body}, separators=(",", ":"), allow_nan=False).encode("ascii")


def read_input(data: bytes, frame_of: Callable[[int, int], Frame]) -> tuple[int, Input]:
    """The number and the input in a line of input_json(); frame_of(seq, stamp_ns) fetches a frame's pixels.

    Raises:
        FileFormatError: it is anything else.
    """
    try:
        body = json.loads(data)
        return _whole(body["number"]), _READERS[body["input"]](body, frame_of)
    except (KeyError, TypeError, ValueError, OverflowError, RecursionError) as e:
        raise FileFormatError(f"input {data[:60]!r}: {type(e).__name__} {one_line(e)}; the recording is damaged") from e


def check_plausible(given: Input) -> None:
    """Refuse what no run has: arrays that do not fit each other, numbers that are none.

    Raises:
        FileFormatError: it is from a damaged recording.
    """
    if problem := _problem(given):
        raise FileFormatError(f"{type(given).__name__} in the recording: {problem}; the recording is damaged")


def _problem(given: Input) -> str:
    if isinstance(given, LoadMap):
        return belief_problem(given.pose, given.cov) or landmarks_problem(given.landmarks) or _map_problem(given)
    if isinstance(given, SetPose):
        return belief_problem(given.pose, given.cov)
    if isinstance(given, Sighting) and given.crossings is not None:
        return crossings_problem(given.crossings) or _told_problem(given)
    return _told_problem(given) if isinstance(given, FrameInput | Sighting | Silence) else ""


def _told_problem(given: FrameInput | Sighting | Silence) -> str:
    return wheels_problem(given.wheels) or turn_problem(given.heard.turn)


def _map_problem(given: LoadMap) -> str:
    if not 0.0 <= given.elsewhere <= 1.0:
        return f"elsewhere is {given.elsewhere:g}, expected a probability"
    if not given.ago_s >= 0.0:
        return f"ago_s is {given.ago_s:g}, expected a time that has passed"
    if not all(abs(number) <= MAX_COORDINATE_M for number in (*given.ceiling.drops_m, *given.ceiling.slope)):
        return f"the ceiling is {given.ceiling}"
    if len(given.ceiling.slope) not in (0, SLOPE_NUMBERS):
        return f"the slope has {len(given.ceiling.slope)} numbers, expected {SLOPE_NUMBERS}"
    return "" if abs(given.map_axis_rad) <= MAX_ANGLE_RAD else f"map_axis_rad is {given.map_axis_rad:g}"


_LANDMARKS: Mapping[str, tuple[str, type, tuple[int, ...]]] = {
    "ids": ("ids", np.int64, (-1,)),
    "xy_map_m": ("xy_map_m", np.float64, (-1, 2)),
    "cov_m2": ("cov_m2", np.float64, (-1, 2, 2)),
    "kind": ("crossing_type", np.int64, (-1,)),
    "sightings": ("sightings", np.int64, (-1,)),
    "expected": ("expected", np.int64, (-1,)),
}
"""Columns of a map by their key in JSON: field of Landmarks, dtype and shape."""
_LATER = ("expected",)
"""Columns that older recordings lack; Landmarks has defaults for them."""

FrameOf = Callable[[int, int], Frame]


def _read_frame(body: Mapping[str, Any], frame_of: FrameOf) -> Input:
    return FrameInput(
        frame_of(_whole(body["seq"]), _whole(body["stamp_ns"])), _read_wheels(body["wheels"]), _read_heard(body)
    )


def _read_silence(body: Mapping[str, Any], frame_of: FrameOf) -> Input:
    return Silence(_whole(body["stamp_ns"]), str(body["reason"]), _read_wheels(body["wheels"]), _read_heard(body))


def _read_map(body: Mapping[str, Any], frame_of: FrameOf) -> Input:
    m = body["landmarks"]
    columns: dict[str, Any] = {
        name: np.array(m[key], dtype).reshape(shape)
        for key, (name, dtype, shape) in _LANDMARKS.items()
        if key in m or key not in _LATER
    }
    if len({len(c) for c in columns.values()}) != 1:
        raise ValueError("columns of the map differ in length")
    ago_s, elsewhere = body.get("ago_s"), float(body.get("elsewhere", 0.0))
    if ago_s is None:  # older recordings say whether it was recent
        ago_s = JUST_NOW_S if body.get("recent", False) else math.inf
    floors = read_value(json.dumps(body.get("floors")).encode("ascii"), Floors) or Floors()
    knows = Landmarks(**columns), float(body["map_axis_rad"]), *_read_belief(body)
    drops_m, slope = (tuple(float(number) for number in body.get(name, ())) for name in ("drops_m", "slope"))
    return LoadMap(*knows, float(ago_s), elsewhere, floors, CeilingShape(drops_m, slope))


def _read_assumption(body: Mapping[str, Any], frame_of: FrameOf) -> Input:
    return SetPose(*_read_belief(body), str(body["why"]), str(body.get("floor", "")))


def _read_reset(body: Mapping[str, Any], frame_of: FrameOf) -> Input:
    return Reset(bool(body["keep_map"]))


def _read_continuation(body: Mapping[str, Any], frame_of: FrameOf) -> Input:
    return Continuation(body["state"])


def _read_beacons(body: Mapping[str, Any], frame_of: FrameOf) -> Input:
    return KnownBeacons(read_value(json.dumps(body["beacons"]).encode("ascii"), Beacons) or Beacons())


_READERS: Mapping[str, Callable[[Mapping[str, Any], FrameOf], Input]] = {
    "frame": _read_frame,
    "silence": _read_silence,
    "known_map": _read_map,
    "assumption": _read_assumption,
    "reset": _read_reset,
    "continuation": _read_continuation,
    "beacons": _read_beacons,
}


def _wheels(wheels: WheelMotion | None) -> dict[str, Any] | None:
    if wheels is None:
        return None
    return {"prev_from_curr": wheels.prev_from_curr.tolist(), "cov": wheels.cov.tolist()}


def _read_wheels(body: Mapping[str, Any] | None) -> WheelMotion | None:
    if body is None:
        return None
    return WheelMotion(Displacement(_array(body["prev_from_curr"], (3,))), _array(body["cov"], (3, 3)))


def _heard(heard: Heard) -> dict[str, Any]:
    """Nothing of a robot without such senses, so that its recordings stay as they were."""
    return {} if heard is NOTHING else {"heard": json.loads(value_json(heard))}


def _read_heard(body: Mapping[str, Any]) -> Heard:
    return read_value(json.dumps(body["heard"]).encode("ascii"), Heard) or NOTHING if "heard" in body else NOTHING


def _belief(pose: Array, cov: Array) -> dict[str, Any]:
    return {"pose": pose.tolist(), "cov": cov.tolist()}


def _read_belief(body: Mapping[str, Any]) -> tuple[Pose, Array]:
    return Pose(_array(body["pose"], (3,))), _array(body["cov"], (3, 3))


def _whole(value: Any) -> int:
    number = int(value)
    if not 0 <= number <= MAX_ID:
        raise ValueError(f"found {reprlib.repr(value)}, expected 0 to {MAX_ID}")
    return number


def _array(values: Any, shape: tuple[int, ...]) -> Array:
    return np.array(values, np.float64).reshape(shape)
