"""Paired comparisons: the same seeds through both filters, confidence by resampling the seeds."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ceilvo.types import Array, Ints

RESAMPLES = 4000  # draws of the bootstrap (docs/experiments.md); chosen: 100 lie beyond either end of 95 %
LEVEL = 0.95  # of the confidence interval, the usual one; docs/experiments.md
_SEED = 20260101  # chosen; fixed, so that a table comes out the same twice


@dataclass(frozen=True)
class Interval:
    """A figure with its confidence interval (95 %)."""

    value: float
    low: float
    high: float

    def __str__(self) -> str:
        return f"{self.value:.3f} [{self.low:.3f}, {self.high:.3f}]"


def mean_interval(values: Array) -> Interval:
    """Mean of (S,) values and its bootstrap interval over them; nan without any."""
    values = np.asarray(values, np.float64)
    if not len(values):
        return Interval(float("nan"), float("nan"), float("nan"))
    means = np.mean(values[_draws(len(values))], axis=1)
    return Interval(float(np.mean(values)), *_ends(means))


def ratio_interval(numerator: Array, denominator: Array) -> Interval:
    """Ratio of the means of (S,) paired values: seeds are drawn together, so what they share cancels."""
    a, b = np.asarray(numerator, np.float64), np.asarray(denominator, np.float64)
    if a.shape != b.shape:
        raise ValueError(f"pairs: found {a.shape} and {b.shape} values, expected as many of both")
    if not len(a):
        return Interval(float("nan"), float("nan"), float("nan"))
    draws = _draws(len(a))
    return Interval(float(np.mean(a) / np.mean(b)), *_ends(np.mean(a[draws], axis=1) / np.mean(b[draws], axis=1)))


def _draws(count: int) -> Ints:
    return np.random.default_rng(_SEED).integers(count, size=(RESAMPLES, count))


def _ends(values: Array) -> tuple[float, float]:
    low, high = np.quantile(values, [0.5 - 0.5 * LEVEL, 0.5 + 0.5 * LEVEL])
    return float(low), float(high)
