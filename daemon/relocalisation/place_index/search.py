"""Poses that put features on landmarks of their types, each verified by counting all features.

The direction of the ceiling's lines and the scale are known, so one landmark is a whole basis of geometric hashing: a
feature laid on it gives the pose, and the cells of a TypeGrid are the hash table that all other features are looked up
in. A rare feature has few landmarks to be laid on. Where there are many, further features must be there as well, which
makes the basis a pair or a triangle.

Groups of features have none in common. A place that explains all but G - 1 of the features explains one of G groups
whole, so it is found.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from ceilvo.crossing_types import CROSSING_TYPES
from ceilvo.daemon.relocalisation.place_index.blocks import FINE_M, Fine
from ceilvo.daemon.relocalisation.place_index.members import Members
from ceilvo.daemon.relocalisation.place_index.missing import missed
from ceilvo.daemon.relocalisation.place_index.turned_view import TurnedView
from ceilvo.daemon.relocalisation.place_index.type_grid import GROUND, TypeGrid
from ceilvo.types import Array, Ints, Observations

TURNS = 4
"""Headings that the direction of the lines leaves."""
MOST_TRIED = 800_000
"""Poses that a query lays features on landmarks for; chosen for time."""
ENOUGH = 16_384
"""Where a feature has more landmarks to be laid on, a second and a third one have to be there; chosen for time."""
LARGEST_GROUP = 3
"""A triangle."""
MOST_VERIFIED = 32_768
"""Poses of a query that all features are counted for; chosen for time."""
GROUPS_FRACTION = 0.25
"""Of the features seen, how many may at most be without a landmark at a place that is found for certain; chosen: beyond
that the place has changed too much to be known from one view."""
CONTRADICTED_FRACTION = 0.5
"""A place that contradicts more of a view than this is none; chosen."""
EXPLAINED_FRACTION = 0.5
"""A place that explains less than this fraction of what the best one does is none; chosen."""
CONTRADICTED = 2
"""Landmarks not seen that weigh as much as a feature where no landmark is: detection passes over one in ten, one in
twenty is false and then may lie anywhere; chosen."""
FIRST = 32
"""Of a group the best places so far, for which is counted at once what they miss; chosen for time."""
SAME_PLACE_M = 0.2
"""Side of the cells in which poses are one place: nearer than half of it always, never a tile of 0.3 m apart."""
LOOK_EVERY = 4
"""Features counted between two looks for hopeless poses; chosen for time."""


@dataclass(slots=True)
class Found:
    """Verified poses: x, y, turn, explained, contradicted (M,), and missed (M,) once that is counted."""

    x: Fine
    y: Fine
    turn: Ints
    explained: Ints
    contradicted: Ints
    missed: Ints

    @staticmethod
    def all_of(parts: Sequence[Found]) -> Found:
        none = np.empty(0, np.int64)
        parts = [Found(none.astype(np.int32), none.astype(np.int32), none, none, none, none), *parts]
        return Found(*(np.concatenate([getattr(p, name) for p in parts]) for name in Found.__slots__))

    def of(self, which: Ints) -> Found:
        return Found(*(getattr(self, name)[which] for name in self.__slots__))

    def __len__(self) -> int:
        return len(self.x)

    @property
    def cost(self) -> Ints:
        """What speaks against each: two for a feature where no landmark is, one for a landmark that is not seen."""
        return CONTRADICTED * self.contradicted + self.missed

    @property
    def score(self) -> Ints:
        """What speaks for each, less what speaks against it."""
        return CONTRADICTED * self.explained - self.cost


@dataclass(slots=True)
class Search:
    """One query.

    Attributes:
        grid, members: the map.
        views: the view at its four headings.
        margin: cost that a place may have beyond the best one's.
        order: features, those with the fewest landmarks first.
        groups: those whose poses have been verified.
        tried, verified: poses so far.
        found: of each group and turn.
        best: the place with the best score so far, alone; none before one was verified.
    """

    grid: TypeGrid
    members: Members
    views: list[TurnedView]
    margin: int
    order: Ints = field(default_factory=lambda: np.empty(0, np.int64))
    groups: list[list[int]] = field(default_factory=list)
    tried: int = 0
    verified: int = 0
    found: list[Found] = field(default_factory=list)
    best: Found = field(default_factory=lambda: Found.all_of([]))

    @staticmethod
    def of(grid: TypeGrid, members: Members, view: Observations, margin: int) -> Search:
        views = [TurnedView.of(view, turn, grid.reach_m) for turn in range(TURNS)]
        out = Search(grid, members, views, margin)
        out.order = np.lexsort((np.sum(view.var_m2, axis=1), out.lengths()))
        return out

    def lengths(self) -> Ints:
        """(K,) landmarks that each feature can be laid on, over all turns."""
        return np.asarray(sum(self.members.count[v.crossing_type] for v in self.views), np.int64)

    def run(self) -> None:
        """Verify groups until enough features may be wrong, or work ends."""
        length = self.lengths()
        left = [int(k) for k in self.order if length[k]]
        wanted = 1 + int(GROUPS_FRACTION * len(length))
        while left and len(self.groups) < wanted and self.tried + length[left[0]] <= MOST_TRIED:
            if not self._group(left):
                return

    def _group(self, left: list[int]) -> bool:
        """Verify the poses of the next group, which is taken from `left`; False if they are too many."""
        anchor = left.pop(0)
        at = [self.laid(view, anchor) for view in self.views]
        self.tried += sum(len(x) for x, _ in at)
        group = [anchor]
        while sum(len(x) for x, _ in at) > ENOUGH and left and len(group) < LARGEST_GROUP:
            group.append(left.pop(0))
            at = [self._with(view, group[-1], *xy) for view, xy in zip(self.views, at, strict=True)]
        at = [self._new(view, *xy) for view, xy in zip(self.views, at, strict=True)]
        self.verified += sum(len(x) for x, _ in at)
        if self.verified > MOST_VERIFIED:
            return False
        fresh = Found.all_of([self._verified(turn, x, y) for turn, (x, y) in enumerate(at)])
        self._improve(fresh)
        self.found.append(fresh)
        self.groups.append(group)
        return True

    def laid(self, view: TurnedView, k: int) -> tuple[Fine, Fine]:
        """Where the robot is if feature k is one of the landmarks."""
        at = self.grid.blocks.xy[self.members.of(int(view.crossing_type[k]))]
        return at[:, 0] - view.xy[k, 0], at[:, 1] - view.xy[k, 1]

    def there(self, view: TurnedView, k: int, x: Fine, y: Fine) -> tuple[Ints, Ints]:
        """(M,) 1 where feature k has a landmark, and where ground is mapped at it."""
        bits = self.grid.bits(x + view.xy[k, 0], y + view.xy[k, 1])
        return (bits >> int(view.crossing_type[k])) & 1, (bits & GROUND) >> CROSSING_TYPES

    def _with(self, view: TurnedView, k: int, x: Fine, y: Fine) -> tuple[Fine, Fine]:
        on = np.flatnonzero(self.there(view, k, x, y)[0])
        return x[on], y[on]

    def _new(self, view: TurnedView, x: Fine, y: Fine) -> tuple[Fine, Fine]:
        """Without those that an earlier group has found."""
        for group in self.groups:
            old = np.ones(len(x), bool)
            for k in group:
                old &= self.there(view, k, x, y)[0] > 0
            x, y = x[~old], y[~old]
        return x, y

    def _verified(self, turn: int, x: Fine, y: Fine) -> Found:
        """What poses explain and contradict, without those that are found hopeless on the way."""
        view, last = self.views[turn], len(self.order) - 1
        explained, contradicted = np.zeros(len(x), np.int64), np.zeros(len(x), np.int64)
        most, least = self._most_contradicted(), self._least_explained()
        for done, k in enumerate(self.order):
            there, ground = self.there(view, int(k), x, y)
            explained += there
            contradicted += ground & ~there
            if done % LOOK_EVERY == LOOK_EVERY - 1 or done == last:
                on = np.flatnonzero((contradicted <= most) & (explained + (last - done) >= least))
                x, y, explained, contradicted = x[on], y[on], explained[on], contradicted[on]
        return Found(x, y, np.full(len(x), turn), explained, contradicted, np.zeros(len(x), np.int64))

    def _most_contradicted(self) -> float:
        if not len(self.best):
            return CONTRADICTED_FRACTION * len(self.order)
        return float(self.best.cost[0] + self.margin) / CONTRADICTED

    def _least_explained(self) -> float:
        return max(EXPLAINED_FRACTION * float(self.best.explained[0]), 1.0) if len(self.best) else 1.0

    def _improve(self, fresh: Found) -> None:
        """Take the best of what was found for the best, if it is."""
        first = fresh.of(np.argsort(-fresh.score, kind="stable")[:FIRST])
        self._count_missed(first)
        first = Found.all_of([self.best, first])
        self.best = first.of(np.argsort(-first.score, kind="stable")[:1])

    def _count_missed(self, f: Found) -> None:
        f.missed = missed(self.grid, self.views, f.x, f.y, f.turn)

    def kept(self) -> Found:
        """All that is within reach of the best, best first, each place once."""
        f = Found.all_of(self.found)
        possible = (f.contradicted <= self._most_contradicted()) & (f.explained >= self._least_explained())
        f = f.of(np.flatnonzero(possible))
        self._count_missed(f)
        self._improve(f)
        good = (f.cost <= self.best.cost[0] + self.margin) if len(f) else np.zeros(0, bool)
        f = f.of(np.flatnonzero(good))
        f = f.of(np.lexsort((f.turn, f.y, f.x, -f.score)))
        return f.of(_first_of_places(f))

    def poses(self, f: Found) -> Array:
        """(M, 3) map_from_base."""
        heading = np.array([v.heading_rad for v in self.views])
        return np.column_stack([FINE_M * f.x, FINE_M * f.y, heading[f.turn]])


def _first_of_places(f: Found) -> Ints:
    """Of poses of one heading that are in one cell of any of four grids, shifted by half a cell, the first one."""
    keep = np.arange(len(f))
    side = round(SAME_PLACE_M / FINE_M)
    for dx, dy in ((0, 0), (1, 0), (0, 1), (1, 1)):
        column = (f.x[keep].astype(np.int64) + dx * side // 2) // side
        row = (f.y[keep].astype(np.int64) + dy * side // 2) // side
        place = (column * (1 << 24) + row) * TURNS + f.turn[keep]
        keep = keep[np.sort(np.unique(place, return_index=True)[1])]
    return keep
