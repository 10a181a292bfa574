"""What the loops over matched points are given; the same for both versions."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Bools = NDArray[np.bool_]

MAX_ROUNDS = 10
"""Of rejection and estimation again; chosen; it ends once the kept points stay the same."""
GATE_MEDIANS = 1.2
"""Least gate in median residuals; chosen: above 1, so that the better half is always kept."""
DEGREES_OF_FREEDOM = 3
"""Of a planar motion."""
CORNER_SIGMA_M = 0.0005
"""Least error of a crossing that residuals are measured in; chosen: .14 px (p95, docs/bench.md) and more."""


class Gate(NamedTuple):
    """Residuals kept by refined(): a few sigma of the better half, and never so tight that that would go.

    Attributes:
        max_m: no residual beyond is kept, unless half of them are.
        sigma_m: standard deviation of the points; no residual below a few of it is rejected.
        min_points: fewest that must remain.
    """

    sigmas: float
    max_m: float
    sigma_m: float
    min_points: int


class RatioNoise(NamedTuple):
    """What a line's ratio is known to at best.

    Attributes:
        step_m: way of the camera, rms times the root of the number of measurements, below which nothing is known.
        sigma_m: of a line's distance.
        sigma_ratio: of the ratio, however far a line is followed.
        independent: measurements that err on their own, at most.
    """

    step_m: float
    sigma_m: float
    sigma_ratio: float
    independent: float


class Limits(NamedTuple):
    """Which measurements are of the line that was followed.

    Attributes:
        outlier_sigmas, outlier_m: one further off is of another line that lies over this one.
        fewest: measurements of a line before one of them is judged.
        strange: measurements in a row that are of another line: it is followed from then on.
    """

    outlier_sigmas: float
    outlier_m: float
    fewest: int
    strange: int


def check_length(name: str, found: int, expected: int) -> None:
    if found != expected:
        raise ValueError(f"{name} has {found} items, expected {expected}")


def check_pairs(a: tuple[int, ...], b: tuple[int, ...]) -> None:
    """ValueError unless both are as many points of two numbers."""
    if a != b or len(a) != 2 or a[1] != 2:
        raise ValueError(f"points of shape {a} and {b}, expected (N, 2) twice")
