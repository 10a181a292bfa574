"""The state of a pipeline as text, so that a replay can begin in the middle of a run and still be exact.

The state is whatever the pipeline's objects hold: arrays, numbers, containers, the random generator, objects of this
program. What the configuration and the calibration determine is not part of it: a fresh pipeline has that already.
Reading makes objects of ceilvo's own classes only and calls nothing of theirs.
"""

from __future__ import annotations

import base64
import copy
import json
import math
import sys
from collections import deque
from collections.abc import Iterable, Mapping
from enum import Enum
from types import BuiltinFunctionType, FunctionType
from typing import Any, Literal

import numpy as np

from ceilvo.daemon.pipeline import Pipeline
from ceilvo.errors import FileFormatError

_CONSTANT_CLASSES = ("EdgeDetector", "BandDetector")
_CONTAINERS: Mapping[str, type] = {"tuple": tuple, "set": set, "frozenset": frozenset}
_FUNCTIONS = (FunctionType, BuiltinFunctionType)


class SnapshotError(FileFormatError):
    """The state has something in it that cannot be kept, or the text is no state."""


def freeze(pipeline: Pipeline) -> Pipeline:
    """A copy that stays as it is; quick, for it is taken while the pipeline waits. Without the last frame's view."""
    memo: dict[int, Any] = {id(c): c for c in _constants(pipeline).values()}
    memo[id(pipeline.vision.view)] = None
    memo |= {id(o): o for o in _tables(pipeline)}
    return copy.deepcopy(pipeline, memo)


def snapshot_json(frozen: Pipeline) -> Any:
    """The state as JSON values.

    Raises:
        SnapshotError: something in it cannot be kept.
    """
    names = {id(c): name for name, c in _constants(frozen).items()}
    return _Writer(names, {id(o) for o in _tables(frozen)}).tree(frozen)


def restore(pipeline: Pipeline, state: Any) -> None:
    """Continue where the snapshot was taken; the pipeline is a fresh one of the same configuration and calibration.

    Raises:
        SnapshotError: it is no state, or one of another program or configuration.
    """
    try:
        _Reader(_constants(pipeline)).tree(state, pipeline)
    except (KeyError, TypeError, ValueError, AttributeError, IndexError, RecursionError, OverflowError) as e:
        raise SnapshotError(f"pipeline state: {type(e).__name__} {e}; of another version, or damaged") from e


def value_json(value: object) -> bytes:
    """A value of ceilvo.types, such as Crossings, to the last bit."""
    return json.dumps(_Writer({}, set()).tree(value), separators=(",", ":")).encode("ascii")


def read_value(data: bytes, kind: type) -> Any:
    """What value_json() wrote, of that class or None.

    Raises:
        SnapshotError: it is anything else.
    """
    try:
        value = _Reader({}).tree(json.loads(data), None)
    except (KeyError, TypeError, ValueError, AttributeError, IndexError, RecursionError, OverflowError) as e:
        raise SnapshotError(f"{kind.__name__}: {type(e).__name__} {e}; the recording is damaged") from e
    if value is not None and type(value) is not kind:
        raise SnapshotError(f"found {type(value).__name__}, expected {kind.__name__}; the recording is damaged")
    return value


def _constants(pipeline: Pipeline) -> dict[str, Any]:
    """What every pipeline of this configuration and calibration has, by name."""
    config, calibration = pipeline._config, pipeline._calibration
    out: dict[str, Any] = {"config": config, "calibration": calibration, "level_view": calibration.level_view}
    out |= {f"config.{name}": section for name, section in vars(config).items()}
    return out | {"calibration.camera": calibration.camera, "calibration.noise": calibration.noise}


def _tables(pipeline: Pipeline) -> Iterable[object]:
    """Parts that hold nothing but what they were made from."""
    return [v for v in vars(pipeline._lines).values() if type(v).__name__ in _CONSTANT_CLASSES]


def _fields(value: object) -> dict[str, Any]:
    slots = [s for c in type(value).__mro__ for s in getattr(c, "__slots__", ()) if hasattr(value, s)]
    return {**{s: getattr(value, s) for s in slots}, **getattr(value, "__dict__", {})}


class _Writer:
    def __init__(self, constants: dict[int, str], tables: set[int]) -> None:
        self._constants, self._tables = constants, tables
        self._seen: dict[int, int] = {}

    def tree(self, v: Any) -> Any:
        if v is None or type(v) in (bool, int, str):
            return v
        if type(v) is float:
            return v if math.isfinite(v) else {"float": repr(v)}
        if id(v) in self._constants:
            return {"constant": self._constants[id(v)]}
        if id(v) in self._tables or isinstance(v, _FUNCTIONS):
            return {"as_made": True}
        if isinstance(v, Enum):
            return {"enum": [_name(type(v)), self.tree(v.value)]}
        if id(v) in self._seen:
            return {"again": self._seen[id(v)]}
        number = self._seen[id(v)] = len(self._seen)
        return {"number": number, **self._content(v)}

    def _content(self, v: Any) -> dict[str, Any]:
        if isinstance(v, np.generic):
            return {"scalar": [v.dtype.str, _text(v.tobytes())]}
        if isinstance(v, np.ndarray):
            if v.dtype.hasobject:
                raise SnapshotError(f"array of {v.dtype}: cannot be kept")
            order: Literal["C", "F"] = "F" if v.flags.f_contiguous and not v.flags.c_contiguous else "C"
            return {
                "array": [v.dtype.str, list(v.shape), order, _text(v.tobytes(order))],
                "fixed": not v.flags.writeable,
            }
        if isinstance(v, np.random.Generator):
            return {"generator": self.tree(v.bit_generator.state)}
        if isinstance(v, dict):
            return {"dict": [[self.tree(k), self.tree(x)] for k, x in v.items()]}
        if isinstance(v, deque):
            return {"deque": [self.tree(x) for x in v], "maxlen": v.maxlen}
        if isinstance(v, list):
            return {"list": [self.tree(x) for x in v]}
        if type(v) in _CONTAINERS.values():
            return {type(v).__name__: [self.tree(x) for x in v]}
        return {"object": _name(type(v)), "fields": {k: self.tree(x) for k, x in _fields(v).items()}}


class _Reader:
    def __init__(self, constants: dict[str, Any]) -> None:
        self._constants = constants
        self._seen: dict[int, Any] = {}

    def tree(self, node: Any, made: Any) -> Any:
        """The value; `made` is what a fresh pipeline has in its place, which is filled where possible."""
        if not isinstance(node, dict):
            return node
        if "float" in node:
            return float(node["float"])
        if "constant" in node:
            return self._constants[node["constant"]]
        if "as_made" in node:
            if made is None:
                raise ValueError("a part that only the configuration makes is missing")
            return made
        if "enum" in node:
            return _class(node["enum"][0])(node["enum"][1])
        if "again" in node:
            return self._seen[node["again"]]
        return self._new(node, made)

    def _new(self, node: dict[str, Any], made: Any) -> Any:
        number = node["number"]
        if "object" in node:
            kind = _class(node["object"])
            value = made if type(made) is kind else object.__new__(kind)
            self._seen[number] = value
            for name, field in node["fields"].items():
                object.__setattr__(value, name, self.tree(field, getattr(made, name, None)))
            return value
        value = self._seen[number] = self._plain(node)
        if "dict" in node:
            value.update((self.tree(k, None), self.tree(x, None)) for k, x in node["dict"])
        elif "list" in node or "deque" in node:
            value.extend(self.tree(x, None) for x in node["list" if "list" in node else "deque"])
        return value

    def _plain(self, node: dict[str, Any]) -> Any:
        if "scalar" in node:
            return np.frombuffer(_bytes(node["scalar"][1]), np.dtype(node["scalar"][0]))[0]
        if "array" in node:
            kind, shape, order, data = node["array"]
            array = np.frombuffer(bytearray(_bytes(data)), np.dtype(kind)).reshape(shape, order=order)
            array.setflags(write=not node["fixed"])
            return array
        if "generator" in node:
            state = self.tree(node["generator"], None)
            generator = np.random.default_rng(0)
            generator.bit_generator.state = state
            return generator
        if "dict" in node:
            return {}
        if "list" in node:
            return []
        if "deque" in node:
            return deque(maxlen=node["maxlen"])
        for name, make in _CONTAINERS.items():
            if name in node:
                return make(self.tree(x, None) for x in node[name])
        raise ValueError(f"found {sorted(node)}, expected a value")


def _name(kind: type) -> str:
    if not _ours(kind.__module__):
        raise SnapshotError(f"{kind.__module__}.{kind.__name__}: cannot be kept")
    return f"{kind.__module__}.{kind.__qualname__}"


def _class(name: str) -> type:
    module, _, kind = name.rpartition(".")
    found = getattr(sys.modules[module], kind) if _ours(module) else None
    if not isinstance(found, type) or found.__module__ != module:
        raise ValueError(f"{name} is no class that a state has")
    return found


def _ours(module: str) -> bool:
    return module == "ceilvo.types" or (module.startswith("ceilvo.daemon.") and ".app" not in module)


def _text(data: bytes) -> str:
    return base64.b64encode(data).decode("ascii")


def _bytes(text: str) -> bytes:
    return base64.b64decode(text, validate=True)
