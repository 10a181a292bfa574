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
from ceilvo.daemon.relocalisation.place_index.type_grid import TypeGrid
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
_RIGHT = 0.06
"""Share of things that contradict at the right place; chosen: a lamp in twenty was moved, and some were never seen."""
_LIKE = (0.25, 0.9)
"""Share of things that contradict at wrong places that look like the right one, and at any: on a raster of lamps the
former are those that lay lamps on lamps; chosen to tell the two apart."""
_COMMON = 0.5
"""What so many of the places show that look like the right one is common, what fewer show is rare: on a raster of lamps
vents, and the plain tiles where a lamp is missing; chosen."""
_RATES = (0.08, 0.9)
"""Between what the share of things that contradict at wrong places is taken to be; chosen: it is counted on some
hundred of them."""
_LOW = 0.1
"""Share of the places that look like the right one whose common things contradict less often than is taken for wrong
ones: the rivals are the best of them; chosen."""
_TOP, _FEWEST_TOP = 30, 20
"""Best wrong places that say how fast they become fewer, and at least; chosen."""


@dataclass(frozen=True)
class Counts:
    """Of M motions: how many things of both maps can be compared, and how many are in one map only. What both have is
    seen from both sides, and counts half from each."""

    looked_at: Array
    contradicted: Array

    def of(self, which: Ints) -> Counts:
        return Counts(self.looked_at[which], self.contradicted[which])

    def __len__(self) -> int:
        return len(self.looked_at)

    @staticmethod
    def all_of(parts: Sequence[Counts]) -> Counts:
        none = np.empty(0)
        return Counts(*(np.concatenate([none, *(getattr(p, k) for p in parts)]) for k in ("looked_at", "contradicted")))

    @staticmethod
    def sum_of(parts: Sequence[Counts]) -> Counts:
        return Counts(sum(p.looked_at for p in parts), sum(p.contradicted for p in parts))  # type: ignore[arg-type]

    def rate(self) -> float:
        """Share that contradicts, of all together."""
        return float(np.clip(self.contradicted.sum() / max(float(self.looked_at.sum()), 1.0), *_RATES))

    def low_rate(self) -> float:
        """The share that all but a few of them reach."""
        shares = self.contradicted / np.maximum(self.looked_at, 1.0)
        return float(np.clip(np.quantile(shares, _LOW), *_RATES))


class _Things:
    """Landmarks of a map that are told apart from plain tiles, grouped: lamps, vents, columns.

    Attributes:
        landmarks: of all of them, thing by thing.
        starts: of each thing in these.
        view: the landmarks as one look.
    """

    def __init__(self, m: Landmarks, which: Ints, reach_m: float, heading_rad: float) -> None:
        xy = m.xy_map_m[which]
        pairs = cKDTree(xy).query_pairs(reach_m, output_type="ndarray") if len(xy) else np.empty((0, 2), np.int64)
        graph = coo_array((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), shape=(len(xy),) * 2)
        part = connected_components(graph, directed=False)[1] if len(xy) else np.empty(0, np.int64)
        middle = np.column_stack([np.bincount(part, xy[:, i]) / np.bincount(part) for i in (0, 1)])[part]
        square = np.floor((xy - middle) / SQUARE_M + 0.5).astype(np.int64)
        _, thing, size = np.unique(np.column_stack([part, square]), axis=0, return_inverse=True, return_counts=True)
        order = np.argsort(thing, kind="stable")
        order = order[size[thing[order]] >= FEWEST]
        self.landmarks = m.of(which[order])
        self.starts = np.flatnonzero(np.diff(thing[order], prepend=-1))
        self.view = as_view(self.landmarks, heading_rad)

    def __len__(self) -> int:
        return len(self.starts)

    def there(self, grid: TypeGrid, motions: Array) -> Shown:
        """Whether the other map shows them, which lies in `grid`, for motions (M, 3) into it."""
        if not len(self):
            none = np.zeros((len(motions), 0), bool)
            return Shown(none, none)
        size, parts = np.diff(np.append(self.starts, len(self.landmarks))), []
        for some in np.array_split(motions, max(1, len(motions) * len(self.view) // _AT_ONCE)):
            there, ground = grid.hits(some, self.view)
            on = np.add.reduceat(ground.astype(np.int32), self.starts, axis=1)
            found = np.add.reduceat((there & ground).astype(np.int32), self.starts, axis=1)
            told = on >= ON_GROUND * size
            parts.append((told, told & (found >= EXPLAINED * on)))
        return Shown(*(np.concatenate([part[k] for part in parts]) for k in (0, 1)))


@dataclass(frozen=True)
class Shown:
    """(M, T) which of T things lie on the other map's ground by each of M motions, and which of those are there."""

    told: NDArray[np.bool_]
    good: NDArray[np.bool_]

    def common(self) -> NDArray[np.bool_]:
        """(T,) which are there by most of the motions."""
        told, good = (np.count_nonzero(v, axis=0) for v in (self.told, self.good))
        return np.asarray(good >= _COMMON * told)

    def counts(self, which: NDArray[np.bool_]) -> Counts:
        """Of some of the things (T,)."""
        good = np.count_nonzero(self.good & which, axis=1)
        bad = np.count_nonzero(self.told & which, axis=1) - good
        return Counts(0.5 * good + bad, bad.astype(np.float64))


def _beside_m(plain_m: Array) -> float:
    """From the usual way from one plain joint to the next (N, 2), a tile."""
    if len(plain_m) < FEWEST:
        return BESIDE_M[0]
    return float(np.clip(BESIDE * np.median(cKDTree(plain_m).query(plain_m, 2)[0][:, 1]), *BESIDE_M))


class _Side:
    """A map, and how it is looked up in the other one."""

    def __init__(self, m: Landmarks, heading_rad: float) -> None:
        kinds, count = np.unique(m.crossing_type, return_counts=True)
        plain = m.crossing_type == kinds[np.argmax(count)]
        self.plain = m.of(np.flatnonzero(plain))
        self.heading_rad, self.reach_m = heading_rad, _beside_m(self.plain.xy_map_m)
        self.things = _Things(m, np.flatnonzero(~plain), self.reach_m, heading_rad)

    def holes(self, grid: TypeGrid, motions: Array) -> _Things:
        """Plain joints that few of the motions (M, 3) into the other map's grid show: gaps in a raster."""
        view = as_view(self.plain, self.heading_rad)
        told, good = np.zeros(len(view), np.int64), np.zeros(len(view), np.int64)
        for some in np.array_split(motions, max(1, len(motions) * len(view) // _AT_ONCE)):
            there, ground = grid.hits(some, view)
            told += np.count_nonzero(ground, axis=0)
            good += np.count_nonzero(there & ground, axis=0)
        which = np.flatnonzero((told >= _FEWEST_TOP) & (good < _COMMON * told))
        return _Things(self.plain, which, self.reach_m, self.heading_rad)


class Evidence:
    """Two maps, each in its place index, and the things of each as one large view for the other."""

    def __init__(self, a: Landmarks, a_axis_rad: float, b: Landmarks, b_axis_rad: float) -> None:
        self.index = PlaceIndex.of(replace(a, ids=np.arange(len(a))))
        self._other = PlaceIndex.of(replace(b, ids=np.arange(len(b))))
        self._a, self._b = _Side(a, b_axis_rad - a_axis_rad), _Side(b, a_axis_rad - b_axis_rad)

    def of(self, a_from_b: Array) -> Counts:
        """Of motions (M, 3)."""
        shown = (
            self._b.things.there(self.index.grid, a_from_b),
            self._a.things.there(self._other.grid, _inverse(a_from_b)),
        )
        return Counts.sum_of([s.counts(np.ones(s.told.shape[1], bool)) for s in shown])

    def weighed(self, a_from_b: Array) -> Weighed:
        """By what wrong places show that look like the right one, as nearly all of the motions (M, 3) are."""
        back, parts = _inverse(a_from_b), []
        for side, grid, motions in ((self._b, self.index.grid, a_from_b), (self._a, self._other.grid, back)):
            both = side.things, side.holes(grid, motions)
            parts.append((grid, [(t, t.there(grid, motions).common()) for t in both]))
        done = Weighed(parts, (0.0, 0.0))
        common, rare = done.counts(a_from_b)
        return replace(done, rates=(common.low_rate(), rare.rate()))


@dataclass(frozen=True)
class Weighed:
    """What is common at wrong places, and what is rare, is weighed each by its own rate of contradictions there.

    Attributes:
        sides: of the second map, then of the first: the grid that it is looked up in, and its things and gaps with
            which of them are common (T,).
        rates: of the common and of the rare.
    """

    sides: Sequence[tuple[TypeGrid, Sequence[tuple[_Things, NDArray[np.bool_]]]]]
    rates: tuple[float, ...]

    def counts(self, a_from_b: Array) -> tuple[Counts, Counts]:
        """Common and rare ones by motions (M, 3)."""
        out: list[list[Counts]] = [[], []]
        for (grid, both), motions in zip(self.sides, (a_from_b, _inverse(a_from_b)), strict=True):
            for things, common in both:
                shown = things.there(grid, motions)
                for k, which in enumerate((common, ~common)):
                    out[k].append(shown.counts(which))
        return Counts.sum_of(out[0]), Counts.sum_of(out[1])

    def scores(self, a_from_b: Array) -> Array:
        """(M,) log-likelihood ratios of motions (M, 3), see `scores`."""
        common, rare = self.counts(a_from_b)
        return scores(common, self.rates[0]) + scores(rare, self.rates[1])


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


def likeness(some: Counts) -> Array:
    """(M,) how much each looks like the right place, or like one that passes for it."""
    good = some.looked_at - some.contradicted
    like, any_place = _LIKE
    return np.asarray(good * np.log((1.0 - like) / (1.0 - any_place)) + some.contradicted * np.log(like / any_place))


def scores(some: Counts, rate: float) -> Array:
    """(M,) log-likelihood ratios of the right place, where few things contradict, and of a wrong one, where as many do
    as at the rate or as were seen, whatever is more (generalised likelihood ratio)."""
    good = some.looked_at - some.contradicted
    wrong = np.clip(some.contradicted / np.maximum(some.looked_at, 1), rate, 1.0 - _SMALL)
    return np.asarray(good * np.log((1.0 - _RIGHT) / (1.0 - wrong)) + some.contradicted * np.log(_RIGHT / wrong))


def false_alarm(score: float, wrong: Array) -> float:
    """Chance that the best of wrong places scores as high, from how fast their best ones become fewer with the score
    (peaks over a threshold, exponential: Pickands 1975). 1 where there are too few of them to say."""
    top = np.sort(wrong)[::-1][: _TOP + 1]
    if len(top) < _FEWEST_TOP:
        return 1.0
    over = top[:-1] - top[-1]
    mean = max(float(np.mean(over)), float(over[0]) / np.log(len(over)), _SMALL)
    return float(-np.expm1(-len(over) * np.exp(-max(score - float(top[-1]), 0.0) / mean)))
