"""The state of a pipeline as JSON, so that a replay can begin in the middle of a run and still be exact.

A state is a tree of dataclasses (pipeline.PipelineState). It is written field by field, without names of classes, and
read back by the types of the fields; what the configuration and the calibration determine is not part of it.
"""

from __future__ import annotations

import base64
import copy
import json
import math
import types
from collections.abc import Mapping
from dataclasses import MISSING, fields, is_dataclass
from enum import Enum
from functools import lru_cache
from typing import Any, Literal, TypeVar, Union, get_args, get_origin, get_type_hints

import numpy as np

from ceilvo.config.schema import OLD_METHODS
from ceilvo.daemon.pipeline import Pipeline, PipelineState
from ceilvo.daemon.replay.snapshot_v1 import is_v1, upgraded
from ceilvo.errors import FileFormatError, one_line

VERSION = 3
"""Version 1 (ceilvo 0.1) named classes and private attributes; snapshot_v1 turns it into version 2, which had one
hypothesis about the place, and a filter that searched by itself."""
_GONE: Mapping[str, frozenset[str]] = {
    "BridgeState": frozenset({"lean_var"}),
    "Doubt": frozenset({"aligned"}),
    "TiltState": frozenset({"faint", "of_faint"}),
}
"""Fields that programs of version 3 wrote and nothing reads any more, by class."""
_LONGEST_NAME = 8
"""Of a type of numbers, as "<f8"; NumPy evaluates a longer one as a program would be read."""
_BAD_TREE = (KeyError, TypeError, ValueError, AttributeError, IndexError, RecursionError, OverflowError)
_T = TypeVar("_T")


class SnapshotError(FileFormatError):
    """The state has something in it that cannot be kept, or the text is no state."""


def freeze(pipeline: Pipeline) -> PipelineState:
    """A copy of the state that stays as it is; quick, for it is taken while the pipeline waits."""
    return copy.deepcopy(pipeline.state)


def snapshot_json(state: PipelineState, method: str) -> Any:
    """The state as JSON values; method is filter.method, whose state it has.

    Raises:
        SnapshotError: something in it cannot be kept.
    """
    return {"version": VERSION, "method": method, "state": _written(state)}


def restore(pipeline: Pipeline, tree: Any) -> None:
    """Continue where the snapshot was taken; the pipeline is one of the same configuration and calibration.

    Raises:
        SnapshotError: it is no state, or one of another program or configuration.
    """
    try:
        method = pipeline.config.filter.method
        if is_v1(tree):
            tree = {"version": 2, "method": method, "state": upgraded(tree)}
        older = tree["version"] == 2
        if older:
            tree = {"version": VERSION, "method": tree["method"], "state": _from_v2(tree["state"])}
        if tree["version"] != VERSION:
            raise SnapshotError(f"pipeline state: version {tree['version']}, expected {VERSION}; use a newer ceilvo")
        if OLD_METHODS.get(tree["method"], tree["method"]) != method:
            raise SnapshotError(
                f"pipeline state: of filter.method {tree['method']}, expected {method}; replay it with that one"
            )
        pipeline.state = _read(tree["state"], PipelineState, pipeline.state)
        if older:
            pipeline.relocaliser.survey_map()
    except _BAD_TREE as e:
        raise SnapshotError(f"pipeline state: {type(e).__name__} {one_line(e)}; of another version, or damaged") from e


def _from_v2(state: Any) -> Any:
    """A hypothesis becomes a place in doubt; what was counted for it is lost."""
    old, filter_ = state["relocaliser"], state["filter"]
    reason = "" if old["hypothesis"] is None else "a hypothesis in an older recording"
    relocaliser = {"map_axis_rad": old["map_axis_rad"], "reason": reason, "schedule": state["schedule"]}
    kept = {name: value for name, value in state.items() if name != "schedule"}
    return {**kept, "relocaliser": relocaliser, "filter": _filter_from_v2(filter_.get("tracker", filter_))}


def _filter_from_v2(filter_: Any) -> Any:
    """The default filter knew one kind of slip; whether wheels were slipping is lost."""
    rule = filter_.get("rule")
    if rule is None:
        return filter_
    path = {name: rule[name] for name in ("displacement_m", "travel_m")}
    return {**filter_, "rule": {"slip": path} | {name: rule[name] for name in ("ess", "fit_residual", "white")}}


def value_json(value: object) -> bytes:
    """A dataclass of ceilvo.types, such as Crossings, or None, to the last bit."""
    return json.dumps(_written(value), separators=(",", ":")).encode("ascii")


def read_value(data: bytes, kind: type[_T]) -> _T | None:
    """What value_json() wrote, of that class or None.

    Raises:
        SnapshotError: it is anything else.
    """
    try:
        tree = json.loads(data)
        if is_v1(tree):
            tree = upgraded(tree)
        value: _T | None = _read(tree, kind | None, None)
        return value
    except _BAD_TREE as e:
        raise SnapshotError(f"{kind.__name__}: {type(e).__name__} {one_line(e)}; the recording is damaged") from e


# -- writing


def _written(v: Any) -> Any:
    if v is None or isinstance(v, bool | str):
        return v
    if isinstance(v, Enum):
        return v.value
    if isinstance(v, np.ndarray):
        return _array_json(v)
    if isinstance(v, int | np.integer | np.bool_):
        return v.item() if isinstance(v, np.generic) else v
    if isinstance(v, float | np.floating):
        return float(v) if math.isfinite(v) else {"float": repr(float(v))}
    if is_dataclass(v):
        return {f.name: _written(getattr(v, f.name)) for f in fields(v) if f.init}
    if isinstance(v, np.random.Generator):
        return v.bit_generator.state
    if isinstance(v, list | tuple):
        return [_written(x) for x in v]
    if isinstance(v, Mapping) and all(isinstance(k, str) for k in v):
        return {k: _written(x) for k, x in v.items()}
    raise SnapshotError(f"{type(v).__module__}.{type(v).__name__}: cannot be kept")


def _array_json(v: np.ndarray[Any, Any]) -> dict[str, Any]:
    if v.dtype.hasobject:
        raise SnapshotError(f"array of {v.dtype}: cannot be kept")
    order: Literal["C", "F"] = "F" if v.flags.f_contiguous and not v.flags.c_contiguous else "C"
    return {"array": [v.dtype.str, list(v.shape), order, base64.b64encode(v.tobytes(order)).decode("ascii")]}


# -- reading


def _read(node: Any, hint: Any, like: Any) -> Any:
    """A value of a type; where that says nothing, of the type of `like`, which is what a fresh pipeline has there."""
    hint = getattr(hint, "__supertype__", hint)
    if hint is Any:
        if like is None or node is None:
            _expect(node, node is None and like is None, "nothing")
            return None
        hint = type(like)
    origin = get_origin(hint)
    if origin in (Union, types.UnionType):
        if node is None:
            return None
        (hint,) = (h for h in get_args(hint) if h is not type(None))
        return _read(node, hint, like)
    if origin is np.ndarray:
        return _array(node, get_args(hint))
    if is_dataclass(hint):
        return _read_dataclass(node, hint, like)
    if origin in (list, tuple):
        inner = get_args(hint)
        each = inner[:1] * len(node) if origin is list or inner[1:] == (...,) else inner
        return origin(_read(n, h, None) for n, h in zip(node, each, strict=True))
    if origin is dict:
        return {str(k): _read(n, get_args(hint)[1], None) for k, n in node.items()}
    return _scalar(node, hint)


def _read_dataclass(node: Any, hint: Any, like: Any) -> Any:
    """A field that came after the state was written has its default; one that has gone is passed over."""
    hints, gone = _hints(hint), _GONE.get(hint.__name__, frozenset())
    node = {name: value for name, value in node.items() if name not in gone}
    known = [f for f in fields(hint) if f.init]
    needed = {f.name for f in known if f.default is MISSING and f.default_factory is MISSING}
    names = {f.name for f in known}
    _expect(sorted(node), needed <= set(node) <= names, sorted(names))
    return hint(**{name: _read(node[name], hints[name], getattr(like, name, None)) for name in sorted(node)})


@lru_cache(maxsize=64)
def _hints(hint: type) -> dict[str, Any]:
    return get_type_hints(hint)


def _scalar(node: Any, hint: Any) -> Any:
    if hint is np.random.Generator:
        generator = np.random.default_rng(0)
        generator.bit_generator.state = node
        return generator
    if isinstance(hint, type) and issubclass(hint, Enum):
        return hint(node)
    if hint is float:
        node = float(node["float"]) if isinstance(node, dict) else node
        _expect(node, isinstance(node, int | float) and not isinstance(node, bool), "a number")
        return float(node)
    _expect(node, type(node) is hint, getattr(hint, "__name__", hint))
    return node


def _array(node: Any, args: tuple[Any, ...]) -> np.ndarray[Any, Any]:
    name, shape, order, data = node["array"]
    _expect(name, isinstance(name, str) and len(name) <= _LONGEST_NAME, "the name of a type of numbers")
    dtype = np.dtype(name)
    wanted = np.dtype(get_args(args[1])[0])
    wider = dtype.kind in "if" and dtype.kind == wanted.kind and dtype.itemsize > wanted.itemsize
    _expect(name, wider or np.issubdtype(dtype, wanted), wanted.str)
    flat: np.ndarray[Any, Any] = np.frombuffer(bytearray(base64.b64decode(data, validate=True)), dtype)
    if wider:  # columns that were wider in earlier versions
        kept, flat = flat, flat.astype(wanted)
        _expect(name, dtype.kind == "f" or np.array_equal(flat, kept), f"numbers that fit {wanted.str}")
    out: np.ndarray[Any, Any] = flat.reshape(shape, order=order)
    return out


def _expect(found: Any, holds: bool, expected: Any) -> None:
    if not holds:
        raise ValueError(f"found {str(found)[:80]}, expected {expected}")
