"""How likely a wrong place of a map explains as much of a view as a candidate does, measured on the map itself."""

from __future__ import annotations

from math import lgamma

import numpy as np

from ceilvo.daemon.relocalisation.place_index.search import Search
from ceilvo.types import Array, Ints

SMALL = 1e-6
"""No chance and no correlation is taken to be less, or nearer to 1."""
SAMPLE = 1000
"""Wrong places counted; chosen for time."""


def false_alarm_probability(search: Search, explained: Ints) -> Array:
    """(M,) chance that at least one wrong place explains as many features as candidates (M,) with these counts.

    Wrong places are sampled where they are most dangerous: with the rarest feature on a landmark of its type, every
    n-th of those there are. The chance of one place is that of a beta-binomial distribution with the mean and the
    variance of their counts, or the sample's where that is more; features that come together, as a grid's do, make the
    variance large. The map has as many such places as landmarks to lay the feature on. Where another candidate explains
    as many, the chance is 1: it is there. It is 1 for all where nothing was searched.
    """
    if not search.groups or not len(explained):
        return np.ones(len(explained))
    counts, places = _sampled(search)
    chance = np.maximum(_beta_binomial_tail(counts, len(search.order)), _share(counts, len(search.order)))
    out = -np.expm1(-places * chance[explained])
    as_many = np.searchsorted(np.sort(-explained), -explained, side="right")
    return np.where(as_many > 1, 1.0, out)


def _sampled(search: Search) -> tuple[Ints, int]:
    """Features explained at wrong places, and how many such places there are."""
    anchor = search.groups[0][0]
    places = int(search.lengths()[anchor])
    laid = search.laid(anchor, max(places // SAMPLE, 1))
    return np.count_nonzero(search.there(search.order.tolist(), laid)[0], axis=0), places


def _share(counts: Ints, most: int) -> Array:
    """(most + 1,) fraction of the counts that are as high or higher, without the best, which may be the right place."""
    others = np.sort(counts)[:-1]
    return (len(others) - np.searchsorted(others, np.arange(most + 1))) / max(len(others), 1)


def _beta_binomial_tail(counts: Ints, most: int) -> Array:
    """(most + 1,) chance of a count as high or higher, by the method of moments."""
    others = np.sort(counts)[:-1] if len(counts) > 1 else counts
    p = min(max(float(np.mean(others)) / most, SMALL), 1.0 - SMALL)
    excess = float(np.var(others)) / (most * p * (1.0 - p)) - 1.0
    correlation = min(max(excess / max(most - 1, 1), SMALL), 1.0 - SMALL)
    a, b = p * (1.0 / correlation - 1.0), (1.0 - p) * (1.0 / correlation - 1.0)
    log = [
        lgamma(most + 1) - lgamma(c + 1) - lgamma(most - c + 1)
        + lgamma(c + a) + lgamma(most - c + b) - lgamma(most + a + b)
        + lgamma(a + b) - lgamma(a) - lgamma(b)
        for c in range(most + 1)
    ]  # fmt: skip
    return np.asarray(np.minimum(np.cumsum(np.exp(log)[::-1])[::-1], 1.0))
