"""Two kinds of wrong places: any, and those that are as like the right one as any."""

from __future__ import annotations

import numpy as np

from ceilvo.types import Array

ALIKE = 0.1
"""Of wrong places, how many are as like this one as any: lamps hang in a pattern, and go on so; chosen."""
ONE_LAMP = 1.4
"""Log-likelihood ratio that a lamp adds to a place against one that is alike; about that, under lamps hung anyhow."""
SAME_LAMP = 0.12
"""Worth of what tells a place from ground that is alike where a ceiling may have been changed: one in eight, for a lamp
is seen from some eight spots by several corners, and a new one that happens to hang there is seen as often; chosen."""


def combined(log_ratio: Array) -> Array:
    """(...,) log-likelihood ratio against all wrong places, of (..., 2) against any and against one that is alike."""
    return np.asarray(-np.logaddexp(np.log(1.0 - ALIKE) - log_ratio[..., 0], np.log(ALIKE) - log_ratio[..., 1]))


def by_single_lamps(seen: Array) -> float:
    """combined() of a place (2,) where each lamp that tells it from those that are alike counts once."""
    return float(combined(seen * [1.0, SAME_LAMP]))


def too_much(seen: Array) -> float:
    """By how much a place (2,) seems likelier against any wrong place than it is against all."""
    return float(seen[0] - combined(seen))


def guessed(log_ratio: Array) -> Array:
    """(2,) log-likelihood ratios where nobody knows how alike the ceiling's places are: by Laplace's rule of succession
    what was alike n times is n + 1 times likelier to be alike than not, in place of 2^n times."""
    alike = float(log_ratio[1])
    return np.array([log_ratio[0], min(alike, np.log1p(max(alike, 0.0) / ONE_LAMP))])
