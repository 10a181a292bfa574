"""How likely a wrong place of a map explains as much of a view as a candidate does, measured on the map itself."""

from __future__ import annotations

import numpy as np

from ceilvo.daemon.relocalisation.place_index.search import Search
from ceilvo.types import Array, Ints

SAMPLE = 500
"""Wrong places counted, a quarter a turn; chosen for time."""
TAIL = 0.1
"""The upper fraction of the sample that the tail is fitted to."""


def false_alarm_probability(search: Search, explained: Ints) -> Array:
    """(M,) chance that at least one wrong place explains as many features as candidates (M,) with these counts.

    Wrong places are sampled where they are most dangerous: with the rarest feature on a landmark of its type, every
    n-th of those there are. Up to the upper tenth of their counts the chance of one place is the sample's; beyond, it
    falls geometrically with the mean excess of that tenth (peaks over a threshold, exponential). The map has as many
    such places as landmarks to lay that feature on. Where another candidate explains as many, the chance is 1: it is
    there. 1 for all where no group of features was searched.
    """
    if not search.groups or not len(explained):
        return np.ones(len(explained))
    counts, places = _sampled(search)
    order = np.sort(counts)
    threshold = float(order[int((1.0 - TAIL) * (len(order) - 1))])
    above = counts[counts >= threshold]
    mean = float(np.mean(above - threshold))
    share = np.array([np.count_nonzero(counts >= min(c, threshold)) / len(counts) for c in explained])
    ratio = mean / (1.0 + mean)
    one = share * ratio ** np.maximum(explained - threshold, 0.0)
    out = -np.expm1(-places * one)
    rival = np.sort(explained)[::-1]
    other = np.searchsorted(-rival, -explained, side="right") > 1
    return np.where(other, 1.0, out)


def _sampled(search: Search) -> tuple[Ints, int]:
    anchor = search.groups[0][0]
    counts, places = [], 0
    for view in search.views:
        x, y = search.laid(view, anchor)
        every = max(len(x) * len(search.views) // SAMPLE, 1)
        places += len(x)
        x, y = x[::every], y[::every]
        counts.append(sum(search.there(view, k, x, y)[0].astype(np.int64) for k in range(len(view.xy))))
    return np.concatenate(counts), places
