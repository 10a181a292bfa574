"""What JSON can say of our values; a number that is not finite becomes null here and nowhere else. Limits of them."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from enum import Enum
from typing import Any

import numpy as np
from numpy.typing import NDArray

MAX_COORDINATE_M = 1e6
"""Coordinates beyond it are damage: no building is so large."""
MAX_ANGLE_RAD = 10.0
"""Directions beyond it are damage: a direction, with room for a turn too many."""
MAX_ID = 2**62
"""Largest id, count or stamp: JSON readers elsewhere may lose larger ones."""


def json_value(value: object) -> Any:
    """A copy in JSON's types; an enumeration becomes its name, anything unknown its text."""
    if value is None or (isinstance(value, bool | str) and not isinstance(value, Enum)):
        return value
    if isinstance(value, Enum):
        return value.name
    if isinstance(value, int | np.integer):
        return int(value)
    if isinstance(value, float | np.floating):
        return float(value) if math.isfinite(value) else None
    if isinstance(value, np.bool_):
        return bool(value)
    if isinstance(value, np.ndarray):
        return _array(value)
    if isinstance(value, Mapping):
        return {str(k): json_value(v) for k, v in value.items()}
    if isinstance(value, Sequence) and not isinstance(value, bytes | bytearray):
        return [json_value(v) for v in value]
    return str(value)


def _array(a: NDArray[Any]) -> Any:
    if a.dtype.kind in "iub" or (a.dtype.kind == "f" and bool(np.isfinite(a).all())):
        return a.tolist()  # the usual case, and much faster
    return json_value(a.tolist())
