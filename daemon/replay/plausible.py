"""Whether quantities that come from a file can be what they are called: shapes, ranges, covariances."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

import numpy as np
from numpy.typing import NDArray

from ceilvo.crossing_types import CROSSING_TYPES, CeilingLines
from ceilvo.json_values import MAX_COORDINATE_M, MAX_ID
from ceilvo.se2 import covariance_problem
from ceilvo.senses.heard import Turn
from ceilvo.types import Array, Crossings, Landmarks, WheelMotion

_MAX_PX = 1e6
"""Largest place in a view: no camera has as many pixels, and a lens that bends its rim stays far below."""


def belief_problem(pose: Array, cov: Array) -> str:
    """Of a pose or a displacement (3,) with its covariance (3, 3)."""
    problems = _number_problems({"pose": (pose, (3,), MAX_COORDINATE_M), "cov": (cov, (3, 3), MAX_COORDINATE_M**2)})
    problem = next(problems, "") or _named("cov", covariance_problem(cov[None]))
    return problem or ("" if np.all(np.diag(cov) > 0.0) else "cov has a variance of 0")


def wheels_problem(wheels: WheelMotion | None) -> str:
    """Of what the base reported between two frames."""
    return "" if wheels is None else _named("wheels", belief_problem(wheels.prev_from_curr, wheels.cov))


def landmarks_problem(m: Landmarks) -> str:
    """Of a whole map."""
    n = m.ids.size
    numbers = _number_problems(
        {
            "ids": (m.ids, (n,), MAX_ID),
            "xy_map_m": (m.xy_map_m, (n, 2), MAX_COORDINATE_M),
            "cov_m2": (m.cov_m2, (n, 2, 2), MAX_COORDINATE_M**2),
            "kind": (m.crossing_type, (n,), CROSSING_TYPES - 1),
            "sightings": (m.sightings, (n,), MAX_ID),
            "expected": (m.expected, (n,), MAX_ID),
        }
    )
    problem = next(numbers, "") or _types_problem(m.crossing_type) or _named("cov_m2", covariance_problem(m.cov_m2))
    if not problem and len(np.unique(m.ids)) < n:
        problem = "ids has duplicates"
    if not problem and min(m.ids.min(initial=0), m.sightings.min(initial=0)) < 0:
        problem = "ids or sightings are below 0"
    return problem


def turn_problem(turn: Turn | None) -> str:
    """Of what a gyro said."""
    if turn is None:
        return ""
    numbers = np.array([turn.turned_rad, turn.var_rad2, turn.span_s, turn.ends_rad2])
    found = {"turn": (numbers, (4,), MAX_COORDINATE_M)}
    if turn.gained_mps is not None:
        found["gained_mps"] = (turn.gained_mps, (2,), MAX_COORDINATE_M)
    problem = next(_number_problems(found), "")
    below = not problem and min(turn.var_rad2, turn.span_s, turn.ends_rad2) < 0.0
    return "a variance or the span of a turn is below 0" if below else problem


def crossings_problem(c: Crossings) -> str:
    """Of what vision found in one frame."""
    n = c.crossing_type.size
    numbers = _number_problems(
        {
            "uv_px": (c.uv_px, (n, 2), _MAX_PX),
            "xy_base_m": (c.xy_base_m, (n, 2), MAX_COORDINATE_M),
            "cov_base_m2": (c.cov_base_m2, (n, 2, 2), MAX_COORDINATE_M**2),
            "crossing_type": (c.crossing_type, (n,), CROSSING_TYPES - 1),
            "psi_rad": (np.array(c.psi_rad), (), np.pi),
            "psi_sigma_rad": (np.array(c.psi_sigma_rad), (), np.pi),
            "tilt_rad": (c.tilt_rad, (2,), np.pi),
            "tilt_sigma_rad": (c.tilt_sigma_rad, (2,), np.pi),
            "common_cov_m2": (c.common_cov_m2, (2, 2), MAX_COORDINATE_M**2),
        }
        | ({} if c.fixtures_m is None else {"fixtures_m": (c.fixtures_m, (len(c.fixtures_m), 2), MAX_COORDINATE_M)})
    )
    problem = next(numbers, "") or _types_problem(c.crossing_type) or _lines_problem(c.lines)
    problem = problem or _named("cov_base_m2", covariance_problem(c.cov_base_m2))
    problem = problem or _named("common_cov_m2", covariance_problem(c.common_cov_m2[None]))
    if not problem and min(c.psi_sigma_rad, *c.tilt_sigma_rad) < 0.0:
        problem = "a sigma is below 0"
    return problem or ("" if c.sample_gray.ndim == 1 else "sample_gray is not a row of grey levels")


def _lines_problem(lines: CeilingLines | None) -> str:
    if lines is None:
        return ""
    n = lines.axis.size
    numbers = _number_problems(
        {
            "lines.axis": (lines.axis, (n,), 1.0),
            "lines.offset_m": (lines.offset_m, (n,), MAX_COORDINATE_M),
            "lines.sigma_m": (lines.sigma_m, (n,), MAX_COORDINATE_M),
            "lines.kind": (lines.kind, (n,), 1.0),
        }
    )
    below = lines.axis.min(initial=0) < 0 or not lines.sigma_m.min(initial=np.inf) > 0.0
    return next(numbers, "") or ("a line's axis is below 0, or its sigma is not above" if below else "")


def _types_problem(crossing_type: NDArray[np.int64]) -> str:
    return "a crossing's type is below 0" if crossing_type.min(initial=0) < 0 else ""


def _number_problems(expected: Mapping[str, tuple[NDArray[np.generic], tuple[int, ...], float]]) -> Iterator[str]:
    """By name: an array, the shape it must have and the largest number in it."""
    for name, (value, shape, most) in expected.items():
        if value.shape != shape:
            yield f"{name} has the shape {value.shape}, expected {shape}"
        elif not np.all(np.abs(value.astype(np.float64)) <= most):
            yield f"{name} has a number that is not finite or beyond {most:g}"


def _named(name: str, problem: str) -> str:
    return f"{name} {problem}" if problem else ""
