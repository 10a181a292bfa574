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
