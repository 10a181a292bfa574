"""Two kinds of wrong places: any, and those that are as like the right one as any."""

from __future__ import annotations

import numpy as np

from ceilvo.types import Array

ALIKE = 0.1
"""Of wrong places, how many are as like this one as any: lamps hang in a pattern, and go on so; chosen."""
ONE_LAMP = 1.4
"""Log-likelihood ratio that a lamp adds to a place against one that is alike; about that, under lamps hung anyhow."""


def combined(log_ratio: Array) -> Array:
    """(...,) log-likelihood ratio against all wrong places, of (..., 2) against any and against one that is alike."""
    return np.asarray(-np.logaddexp(np.log(1.0 - ALIKE) - log_ratio[..., 0], np.log(ALIKE) - log_ratio[..., 1]))


def too_much(seen: Array) -> float:
    """By how much a place (2,) seems likelier against any wrong place than it is against all."""
    return float(seen[0] - combined(seen))


def guessed(log_ratio: Array) -> Array:
    """(2,) log-likelihood ratios where nobody knows how alike the ceiling's places are: by Laplace's rule of succession
    what was alike n times is n + 1 times likelier to be alike than not, in place of 2^n times."""
    alike = float(log_ratio[1])
    return np.array([log_ratio[0], min(alike, np.log1p(max(alike, 0.0) / ONE_LAMP))])
