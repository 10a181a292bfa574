"""Checks of values that come from a disk: numbers only, finite, of the right shape; each raises Damage."""

from __future__ import annotations

from collections.abc import Set
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ceilvo.crossing_types import CROSSING_TYPES
from ceilvo.json_values import MAX_COORDINATE_M, MAX_ID
from ceilvo.se2 import covariance_problem
from ceilvo.types import Array, Landmarks, frozen


class Damage(Exception):
    """What is wrong with a document; becomes a FileFormatError with the file's name and what to do."""


def keys(value: Any, expected: Set[str], where: str) -> None:
    if not isinstance(value, dict):
        raise Damage(f"{where} is {shown(value)}, expected a mapping")
    missing, unknown = sorted(expected - value.keys()), sorted(value.keys() - expected)
    if missing or unknown:
        raise Damage(f"{where}: missing keys {missing or 'none'}, unknown keys {shown(unknown) if unknown else 'none'}")


def ints(value: Any, where: str, low: int, high: int, n: int | None = None) -> NDArray[np.int64]:
    """Of a list, or of an array that has been read already."""
    if isinstance(value, np.ndarray):
        good = bool(np.all((value >= low) & (value <= high)))
    else:
        good = isinstance(value, list) and all(type(v) is int and low <= v <= high for v in value)
    if not good:
        raise Damage(f"{where} is not a list of whole numbers from {low} to {high}")
    if n is not None and len(value) != n:
        raise Damage(f"{where} has {len(value)} values, expected {n}")
    out = np.array(value, np.int64)
    out.setflags(write=False)
    return out


def floats(value: Any, where: str, shape: tuple[int, ...], limit: float) -> Array:
    """An array of that shape, finite and within the limit; numbers only, so that no text or bool slips in."""
    if not (value.shape == shape if isinstance(value, np.ndarray) else _has_shape(value, shape)):
        raise Damage(f"{where} is not an array of numbers of shape {shape}")
    try:
        out = np.array(value, np.float64).reshape(shape)
    except OverflowError as e:
        raise Damage(f"{where} has a number that is too large") from e
    if not np.all(np.abs(out) <= limit):
        raise Damage(f"{where} has a value that is not finite or beyond {limit:g}")
    return frozen(out)


def _has_shape(value: Any, shape: tuple[int, ...]) -> bool:
    if not shape:
        return type(value) in (int, float)
    return isinstance(value, list) and len(value) == shape[0] and all(_has_shape(v, shape[1:]) for v in value)


def covariance(cov: Array, where: str) -> None:
    """(K, n, n) symmetric and positive semi-definite to rounding."""
    if problem := covariance_problem(cov):
        raise Damage(f"{where} {problem}")


def shown(value: Any) -> str:
    text = repr(value)
    return text if len(text) <= 60 else f"{text[:57]}..."


def landmarks_of(table: dict[str, Any]) -> Landmarks:
    """From columns: `id`, `xy_map_m` (n, 2), `cov_xx_xy_yy_m2` (n, 3), `kind`, `sightings`, `expected`."""
    ids = ints(table["id"], "landmarks.id", 0, MAX_ID)
    n = len(ids)
    if len(np.unique(ids)) != n:
        raise Damage("landmarks.id has duplicates")
    packed = floats(table["cov_xx_xy_yy_m2"], "landmarks.cov_xx_xy_yy_m2", (n, 3), MAX_COORDINATE_M**2)
    cov = packed[:, [0, 1, 1, 2]].reshape(n, 2, 2)
    covariance(cov, "landmarks.cov_xx_xy_yy_m2")
    sightings = ints(table["sightings"], "landmarks.sightings", 0, MAX_ID, n)
    expected = ints(table["expected"], "landmarks.expected", 0, MAX_ID, n)
    if np.any(expected < sightings):
        i = int(np.argmax(expected < sightings))
        raise Damage(f"landmarks.expected[{i}] is {expected[i]}, expected at least its sightings, {sightings[i]}")
    return Landmarks(
        ids=ids,
        xy_map_m=floats(table["xy_map_m"], "landmarks.xy_map_m", (n, 2), MAX_COORDINATE_M),
        cov_m2=frozen(cov),
        crossing_type=ints(table["kind"], "landmarks.kind", 0, CROSSING_TYPES - 1, n),
        sightings=sightings,
        expected=expected,
    )
