"""Robust statistics that several rooms use."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

MAD_TO_SIGMA = 1.4826
"""Standard deviation of normal noise over its median absolute deviation: 1 / Phi^-1(3/4)."""
LOWER_QUARTILE_TO_SIGMA = 3.1383
"""The same over the lower quartile of absolute deviations: 1 / Phi^-1(5/8)."""


def median(values: NDArray[Any]) -> float:
    """Upper median of a 1-D array, 0 without values; numpy.median takes several times as long on so few."""
    middle = len(values) // 2
    return float(np.partition(values, middle)[middle]) if len(values) else 0.0


def leave_one_out(normal: NDArray[np.float64], right: NDArray[np.float64]) -> NDArray[np.float64]:
    """(K, K) covariance of a least-squares solution, by how far it moves without each of N parts: the jackknife of
    Tukey (1958), without its factor (N - 1) / N.

    Args:
        normal: (N, K, K) matrix of each part's normal equations; what was known beforehand may be shared out.
        right: (N, K) their right sides, at the solution: their sum is 0.
    """
    moved = np.linalg.solve(np.sum(normal, axis=0) - normal, -right[..., None])[..., 0]
    return np.asarray(moved.T @ moved, np.float64)
