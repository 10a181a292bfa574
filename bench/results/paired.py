"""Paired differences: the same seeds with and without something, so what the seeds have in common cancels."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import stats

from ceilvo.types import Array

CHANCE = 0.0027
"""That noise alone is a clear difference (Student's t, as three standard deviations of many pairs); chosen: less than
once in a table of a hundred cells."""


@dataclass(frozen=True)
class Difference:
    """Mean of paired differences and its standard error; nan with fewer than two pairs.

    Attributes:
        pairs: how many.
    """

    mean: float
    error: float
    pairs: int

    @property
    def clear(self) -> int:
        """1 or -1 where it is one, by its sign; 0 where it may be chance."""
        if self.pairs < 2:
            return 0
        most = float(stats.t.ppf(1.0 - 0.5 * CHANCE, self.pairs - 1)) * self.error
        return int(np.sign(self.mean)) if abs(self.mean) > most else 0

    def __str__(self) -> str:
        return f"{self.mean:+.2f} ± {self.error:.2f}" if self.mean or self.error else "0"


def difference(with_it: Array, without: Array) -> Difference:
    """Of (S,) values with something less those without it, seed by seed.

    Raises:
        ValueError: they are no pairs.
    """
    a, b = np.asarray(with_it, np.float64), np.asarray(without, np.float64)
    if a.shape != b.shape:
        raise ValueError(f"pairs: found {a.shape} and {b.shape} values, expected as many of both")
    if len(a) < 2:
        return Difference(float("nan"), float("nan"), len(a))
    off = a - b
    return Difference(float(np.mean(off)), float(np.std(off, ddof=1) / np.sqrt(len(off))), len(off))
