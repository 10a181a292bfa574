"""What a recording says to the pipeline, message by message: inputs, states of the middle of a run, crossings."""

from __future__ import annotations

import base64
import json
from functools import lru_cache
from random import Random
from typing import Any

import numpy as np

from ceilvo.bench.fuzz.engine.mutations import mutated_json, mutated_tree
from ceilvo.bench.fuzz.engine.target import PERIOD_NS, Target, crossings, frame, json_of, pipeline, rig, wheels
from ceilvo.daemon.pipeline import Pipeline
from ceilvo.daemon.replay.inputs import (
    Continuation,
    FrameInput,
    Input,
    LoadMap,
    Reset,
    SetPose,
    Sighting,
    Silence,
    apply,
    check_plausible,
    input_json,
    read_input,
)
from ceilvo.daemon.replay.replay import Outputs, replay
from ceilvo.daemon.replay.snapshot import read_value, snapshot_json, value_json
from ceilvo.types import Crossings, Frame, Pose

METHODS = ("joint", "pfcf_paper", "pf", "ukf")
_VIEWS = 6
"""Before the state is taken: there is a map by then."""


def driven(method: str = "joint") -> Pipeline:
    """A pipeline after some views."""
    out = pipeline(method)
    for k in range(_VIEWS):
        apply(out, Sighting((k + 1) * PERIOD_NS, crossings(k), wheels()))
    return out


def _replayed(*given: Input, method: str = "joint") -> None:
    """As `ceilvod replay` does it: inputs from a file, then two views that are as they should be."""
    more = (Sighting((k + 1) * PERIOD_NS, crossings(k), wheels()) for k in (_VIEWS, _VIEWS + 1))
    plausible = (given_or_refused(one) for one in (*given, *more))
    replay(plausible, pipeline(method), rig(), Outputs())


def given_or_refused(given: Input) -> Input:
    check_plausible(given)
    return given


def _features(data: bytes) -> None:
    """The crossings of one frame between others."""
    found = Sighting(2 * PERIOD_NS, read_value(data, Crossings), wheels())
    _replayed(Sighting(PERIOD_NS, crossings(0), wheels()), found)


def _snapshot(data: bytes) -> None:
    """First byte: which filter."""
    method = METHODS[data[0] % len(METHODS)] if data else METHODS[0]
    _replayed(Continuation(json_of(data[1:])), method=method)


def _inputs(data: bytes) -> None:
    """One input a line."""
    given = [
        read_input(line, lambda seq, stamp_ns: Frame(seq, stamp_ns, frame(0).gray))[1] for line in data.split(b"\n")[:6]
    ]
    _replayed(Sighting(PERIOD_NS // 2, crossings(0), wheels()), *given)


@lru_cache
def _snapshot_seeds() -> tuple[bytes, ...]:
    return tuple(
        bytes([i]) + json.dumps(snapshot_json(driven(method).state, method)).encode()
        for i, method in enumerate(METHODS)
    )


@lru_cache
def _input_seeds() -> tuple[bytes, ...]:
    landmarks = driven().filter.landmarks()
    pose, cov = Pose(np.array([0.1, 0.2, 0.03])), 0.01 * np.eye(3)
    given: tuple[Input, ...] = (
        FrameInput(frame(0), wheels()),
        Silence(3 * PERIOD_NS, "the camera gives no frames", wheels()),
        LoadMap(landmarks, 0.1, pose, cov, True),
        SetPose(pose, cov, "said"),
        Reset(True),
        Reset(False),
    )
    lines = [input_json(g, n) for n, g in enumerate(given)]
    return (lines[1], lines[2], b"\n".join(lines[3:]), b"\n".join(lines[:3]))


def shape_changed(tree: Any, rng: Random) -> Any:
    """An array of a state given another shape, with as many numbers as that has."""
    arrays = [node for node in _nodes(tree) if isinstance(node.get("array"), list) and len(node["array"]) == 4]
    if not arrays:
        return mutated_tree(tree, rng)
    node = arrays[rng.randrange(len(arrays))]
    name, shape, order, packed = node["array"]
    try:
        dtype = np.dtype(name)
        flat = np.frombuffer(base64.b64decode(packed), dtype)
        sizes = [max(0, n + rng.choice((-1, 0, 1, 2, -n))) for n in shape]
        if rng.random() < 0.2:
            sizes = rng.choice(([], [*sizes, 1], sizes[1:], [1, *sizes]))
        count = int(np.prod(sizes))
        if count > 10**6:
            return tree
        more = np.resize(flat if flat.size else np.zeros(1, dtype), count).astype(dtype)
        node["array"] = [name, sizes, order, base64.b64encode(more.tobytes()).decode()]
    except (TypeError, ValueError, SyntaxError):
        return mutated_tree(tree, rng)
    return tree


def _nodes(tree: Any) -> list[dict[str, Any]]:
    out: list[dict[str, Any]] = []
    todo = [tree]
    while todo:
        node = todo.pop()
        if isinstance(node, dict):
            out.append(node)
        if isinstance(node, dict | list):
            todo.extend(node.values() if isinstance(node, dict) else node)
    return out


def mutated_state(data: bytes, rng: Random) -> bytes:
    """JSON with arrays in it, whose shapes may come to lie."""
    if rng.random() < 0.4:
        return mutated_json(data, rng)
    tree = json_of(data)
    return json.dumps(shape_changed(tree, rng)).encode("utf-8", "surrogatepass")


def _mutated_snapshot(data: bytes, rng: Random) -> bytes:
    first = bytes([rng.randrange(256)]) if rng.random() < 0.02 else data[:1]
    return first + mutated_state(data[1:], rng)


def _mutated_lines(data: bytes, rng: Random) -> bytes:
    lines = data.split(b"\n")
    at = rng.randrange(len(lines))
    return b"\n".join([*lines[:at], mutated_json(lines[at], rng), *lines[at + 1 :]])


TARGETS = {
    "features": Target(_features, lambda: tuple(value_json(crossings(k)) for k in (1, 5)), mutated_state),
    "snapshot": Target(_snapshot, _snapshot_seeds, _mutated_snapshot),
    "inputs": Target(_inputs, _input_seeds, _mutated_lines),
}
