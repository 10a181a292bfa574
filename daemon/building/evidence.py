"""What two maps say of a motion between their frames: lamps and vents that are in both, and that are in one only."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from ceilvo.daemon.relocalisation.place_index.place_index import PlaceIndex
from ceilvo.se2 import inverse
from ceilvo.types import UNLABELLED, Array, Ints, Landmarks, Observations

BESIDE, BESIDE_M = 1.1, (0.35, 1.4)
"""Landmarks that are no plain joints and nearer to each other than so many tiles are one thing, a lamp or a vent; and m
at least and most; chosen: the corners of what is one tile large."""
SQUARE_M = 1.5
"""What is larger is cut into squares; chosen: somewhat more than a lamp."""
FEWEST = 2
"""Landmarks of a thing; chosen: one is often false, and an end of a long lamp has two."""
ON_GROUND, EXPLAINED = 0.6, 0.5
"""Share of a thing's landmarks that must lie on the other map's ground for it to count, and of these, that must lie on
one of their type for it to be there; chosen: some are always missed or taken for another type."""
_AT_ONCE = 1 << 22
"""Landmarks times motions that are looked up together; chosen for memory."""
_SMALL = 1e-6
_RIGHT = 0.03
"""Share of things that contradict at the right place; chosen: a lamp in thirty was moved."""
_BETTER, _RATES = 0.1, (0.2, 0.8)
"""Share of wrong places that are called the better ones, and between what their rate of contradictions is taken to be;
chosen: on a raster of lamps they are those that lay lamps on lamps."""
_TOP, _FEWEST_TOP = 30, 20
"""Best wrong places that say how fast they become fewer, and at least; chosen."""


@dataclass(frozen=True)
class Counts:
    """Of M motions: how many things of both maps can be compared, and how many are in one map only."""

    looked_at: Ints
    contradicted: Ints

    def of(self, which: Ints) -> Counts:
        return Counts(self.looked_at[which], self.contradicted[which])

    def __len__(self) -> int:
        return len(self.looked_at)

    @staticmethod
    def all_of(parts: Sequence[Counts]) -> Counts:
        none = np.empty(0, np.int64)
        return Counts(*(np.concatenate([none, *(getattr(p, k) for p in parts)]) for k in ("looked_at", "contradicted")))


class _Things:
    """What of a map is more than plain tiles: lamps, vents, columns.

    Attributes:
        landmarks: of all of them, thing by thing.
        starts: of each thing in these.
    """

    def __init__(self, m: Landmarks) -> None:
        kinds, count = np.unique(m.crossing_type, return_counts=True)
        plain = m.crossing_type == kinds[np.argmax(count)]
        rare = np.flatnonzero(~plain)
        xy, reach_m = m.xy_map_m[rare], _beside_m(m.xy_map_m[plain])
        pairs = cKDTree(xy).query_pairs(reach_m, output_type="ndarray") if len(rare) else np.empty((0, 2), np.int64)
        graph = coo_array((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), shape=(len(rare),) * 2)
        part = connected_components(graph, directed=False)[1] if len(rare) else np.empty(0, np.int64)
        middle = np.column_stack([np.bincount(part, xy[:, i]) / np.bincount(part) for i in (0, 1)])[part]
        square = np.floor((xy - middle) / SQUARE_M + 0.5).astype(np.int64)
        _, thing, size = np.unique(np.column_stack([part, square]), axis=0, return_inverse=True, return_counts=True)
        order = np.argsort(thing, kind="stable")
        order = order[size[thing[order]] >= FEWEST]
        self.landmarks = m.of(rare[order])
        self.starts = np.flatnonzero(np.diff(thing[order], prepend=-1))

    def __len__(self) -> int:
        return len(self.starts)

    def there(self, there: NDArray[np.bool_], ground: NDArray[np.bool_]) -> tuple[Ints, Ints]:
        """(M,) things that the other map has, and that it lacks, from (M, L) of their landmarks."""
        if not len(self):
            return np.zeros(len(there), np.int64), np.zeros(len(there), np.int64)
        on = np.add.reduceat(ground.astype(np.int32), self.starts, axis=1)
        found = np.add.reduceat((there & ground).astype(np.int32), self.starts, axis=1)
        size = np.diff(np.append(self.starts, len(self.landmarks)))
        told = on >= ON_GROUND * size
        good = told & (found >= EXPLAINED * on)
        return np.count_nonzero(good, axis=1), np.count_nonzero(told & ~good, axis=1)


def _beside_m(plain_m: Array) -> float:
    """From the usual way from one plain joint to the next (N, 2), a tile."""
    if len(plain_m) < FEWEST:
        return BESIDE_M[0]
    return float(np.clip(BESIDE * np.median(cKDTree(plain_m).query(plain_m, 2)[0][:, 1]), *BESIDE_M))


class Evidence:
    """Two maps, each in its place index, and its things as one large view for the other."""

    def __init__(self, a: Landmarks, a_axis_rad: float, b: Landmarks, b_axis_rad: float) -> None:
        self.index = PlaceIndex.of(replace(a, ids=np.arange(len(a))))
        self._other = PlaceIndex.of(replace(b, ids=np.arange(len(b))))
        self._a, self._b = _Things(a), _Things(b)
        self._seen = (
            as_view(self._b.landmarks, a_axis_rad - b_axis_rad),
            as_view(self._a.landmarks, b_axis_rad - a_axis_rad),
        )

    def of(self, a_from_b: Array) -> Counts:
        """Of motions (M, 3)."""
        parts = []
        for some in np.array_split(a_from_b, max(1, len(a_from_b) * len(self._seen[0]) // _AT_ONCE)):
            good, bad = self._b.there(*self.index.grid.hits(some, self._seen[0]))
            parts.append(Counts(good + bad, bad))
        first = Counts.all_of(parts)
        parts = []
        for some in np.array_split(_inverse(a_from_b), max(1, len(a_from_b) * len(self._seen[1]) // _AT_ONCE)):
            _, bad = self._a.there(*self._other.grid.hits(some, self._seen[1]))
            parts.append(Counts(bad, bad))
        second = Counts.all_of(parts)
        return Counts(first.looked_at + second.looked_at, first.contradicted + second.contradicted)


def _inverse(motions: Array) -> Array:
    """(M, 3) the other way."""
    return np.array([inverse(m) for m in motions]).reshape(-1, 3)


def as_view(b: Landmarks, heading_rad: float, centre_m: Array | None = None) -> Observations:
    """Landmarks as if one look from a point (2,) of their map showed them, axis to axis at a heading in the other."""
    xy = b.xy_map_m if centre_m is None else b.xy_map_m - centre_m
    return Observations(
        xy_base_m=xy,
        var_m2=np.full(xy.shape, 1e-4),
        crossing_type=b.crossing_type,
        label=np.full(len(b), UNLABELLED),
        heading_rad=float(heading_rad),
        heading_var_rad2=1e-6,
    )


def wrong_rate(wrong: Counts) -> float:
    """Share of things that contradict at the better ones of wrong places."""
    rate = wrong.contradicted / np.maximum(wrong.looked_at, 1)
    return float(np.clip(np.quantile(rate, _BETTER), *_RATES)) if len(wrong) else _RATES[0]


def scores(some: Counts, rate: float) -> Array:
    """(M,) log-likelihood ratios of the right place, where few things contradict, and a wrong one at that rate."""
    good = some.looked_at - some.contradicted
    return np.asarray(good * np.log((1.0 - _RIGHT) / (1.0 - rate)) + some.contradicted * np.log(_RIGHT / rate))


def false_alarm(score: float, wrong: Array) -> float:
    """Chance that the best of wrong places scores as high, from how fast their best ones become fewer with the score
    (peaks over a threshold, exponential: Pickands 1975). 1 where there are too few of them to say."""
    top = np.sort(wrong)[::-1][: _TOP + 1]
    if len(top) < _FEWEST_TOP:
        return 1.0
    over = top[:-1] - top[-1]
    mean = max(float(np.mean(over)), float(over[0]) / np.log(len(over)), _SMALL)
    return float(-np.expm1(-len(over) * np.exp(-max(score - float(top[-1]), 0.0) / mean)))
