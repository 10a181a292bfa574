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
from numpy.typing import NDArray

from ceilvo.daemon.relocalisation.place_index.blocks import FINE_M, fine
from ceilvo.daemon.relocalisation.place_index.found import CONTRADICTED, EXPLAINED, Found, first_of_places
from ceilvo.daemon.relocalisation.place_index.id_table import Slots
from ceilvo.daemon.relocalisation.place_index.members import Members
from ceilvo.daemon.relocalisation.place_index.missing import missed
from ceilvo.daemon.relocalisation.place_index.turned_views import TURNS, TurnedViews
from ceilvo.daemon.relocalisation.place_index.type_grid import GROUND, TypeGrid
from ceilvo.types import Array, Ints, Observations

MOST_TRIED = 800_000
"""Poses that a query lays features on landmarks for; chosen for time."""
ENOUGH = 16_384
"""Where a feature has more landmarks to be laid on, a second and a third one have to be there; chosen for time."""
LARGEST_GROUP = 3
"""A triangle."""
MOST_VERIFIED = 32_768
"""Poses of a query that all features are counted for; chosen for time."""
MOST_GROUPS = 12
"""Groups that a query tries while it is not complete; chosen for time."""
CONTRADICTED_FRACTION = 0.5
"""A place that contradicts more of a view than this is none; chosen."""
EXPLAINED_FRACTION = 0.5
"""A place that explains less than this fraction of what the best one does is none; chosen."""
INDEPENDENT = 32
"""Features from which on the margin grows with their number: a line that is missed or taken for another kind takes all
its crossings with it, six of 32 in a square grid; chosen."""
SAMPLE = 1024
"""Poses that a group is judged by before all of its are looked at; chosen for time."""
PREVIEW = 16
"""One of so many poses is verified before the others; chosen for time."""
MOST_FEATURES = 64
"""Of a view, those with the fewest landmarks, the surest first; a ceiling of 0.3 m tiles shows hundreds, and time must
not depend on that."""
FIRST = 32
"""Of a group the best places so far, for which is counted at once what they miss; chosen for time."""
RUNS = 2
"""The second with the best place of the first in mind."""
LOOK_EVERY, AT_ONCE = 4, 1 << 14
"""Features counted between two looks for hopeless poses, or so many that this many points are looked up; chosen for
time."""


@dataclass(slots=True)
class Search:
    """One query.

    Attributes:
        grid, members: the map.
        views: the view at its four headings.
        margin: cost that a place may have beyond the best one's, in proportion more in a view of many features.
        order: features, those with the fewest landmarks first.
        groups: those whose poses have been verified.
        tried, verified: poses so far.
        found: of each group.
        best: the place with the best score so far, alone; none before one was verified.
        directed: the view has a heading.
        strictest: least cost beyond which a place was left out, unless it promised to be the best.
    """

    grid: TypeGrid
    members: Members
    views: TurnedViews
    margin: float
    order: Ints = field(default_factory=lambda: np.empty(0, np.int64))
    groups: list[list[int]] = field(default_factory=list)
    tried: int = 0
    verified: int = 0
    found: list[Found] = field(default_factory=list)
    best: Found = field(default_factory=lambda: Found.all_of([]))
    strictest: float = np.inf
    directed: bool = True

    @staticmethod
    def of(grid: TypeGrid, members: Members, view: Observations, margin: float) -> Search:
        out = Search(grid, members, TurnedViews.of(view, grid.reach_m), margin)
        out.order = np.lexsort((np.sum(view.var_m2, axis=1), out.lengths()))[:MOST_FEATURES]
        out.directed = bool(np.isfinite(view.heading_var_rad2))
        out.margin = margin * max(1.0, len(out.order) / INDEPENDENT)
        return out

    def lengths(self) -> Ints:
        """(K,) landmarks that each feature can be laid on, over all turns."""
        return np.asarray(np.sum(self.members.count[self.views.kind], axis=0), np.int64)

    def run(self) -> None:
        """Verify groups until it is complete, or work ends; once more where the limit was too strict."""
        for _ in range(RUNS):
            self.groups, self.found, self.tried, self.verified, self.strictest = [], [], 0, 0, np.inf
            self._run_once()
            if self.lenient:
                return

    def _run_once(self) -> None:
        length = self.lengths()
        left = [int(k) for k in self.order if length[k]] if self.directed else []
        while left and len(self.groups) < MOST_GROUPS and self.tried + length[left[0]] <= MOST_TRIED:
            if self.complete or not self._group(left):
                return

    @property
    def lenient(self) -> bool:
        """Whether nothing was left out that is within reach of what is now the best."""
        return self.strictest >= self.limit

    @property
    def floor(self) -> int:
        """Every place that explains so many features was looked at: each that it lacks spoils one group only."""
        impossible = int(np.count_nonzero(self.lengths()[self.order] == 0))
        return len(self.order) - impossible - len(self.groups) + 1

    @property
    def complete(self) -> bool:
        """Whether what was not looked at contradicts too much to be within reach of the best, or to be the best."""
        if not len(self.best) or not self.lenient:
            return False
        most, lacking = self.floor - 1, len(self.order) - self.floor + 1
        better = EXPLAINED * most - CONTRADICTED * lacking > self.best.score[0]
        return bool(CONTRADICTED * lacking > self.limit and not better)

    def _group(self, left: list[int]) -> bool:
        """Verify the poses of the next group, which is taken from `left`; False if they are too many."""
        group = self._chosen(left)
        if group is None:
            return False
        laid = self._new(self._laid_whole(group))
        self.tried += int(self.lengths()[group[0]])
        self.verified += len(laid)
        if self.verified > MOST_VERIFIED:
            return False
        some = np.arange(len(laid)) % PREVIEW == 0  # one good place makes the others' hopelessness show early
        for part in (laid.of(np.flatnonzero(some)), laid.of(np.flatnonzero(~some))):
            fresh = self._verified(part)
            self._improve(fresh)
            self.found.append(fresh)
        self.groups.append(group)
        return True

    def _chosen(self, left: list[int]) -> list[int] | None:
        """The next group, taken from `left`, judged on a sample of its poses; None if there are too many."""
        group = [left.pop(0)]
        every = max(int(self.lengths()[group[0]]) // SAMPLE, 1)
        sample = self.laid(group[0], every)
        while len(sample) * every > ENOUGH and left and len(group) < LARGEST_GROUP:
            group.append(left.pop(0))
            sample = self._with(group[-1], sample)
        return group if len(sample) * every <= MOST_VERIFIED - self.verified else None

    def _laid_whole(self, group: list[int]) -> Found:
        """Where the robot is if the whole group is on landmarks."""
        kept = []
        for turn, kind in enumerate(self.views.kind[:, group[0]].tolist()):
            slots = self.members.of(kind)
            for begin in range(0, len(slots), AT_ONCE):
                laid = self._on(slots[begin : begin + AT_ONCE], group[0], turn)
                for k in group[1:]:
                    laid = self._with(k, laid)
                kept.append(laid)
        return Found.all_of(kept)

    def _with(self, k: int, f: Found) -> Found:
        """Those at which feature k has a landmark."""
        return f.of(np.flatnonzero(self.there([k], f)[0][0]))

    def laid(self, k: int, every: int = 1) -> Found:
        """Where the robot is if feature k is one of the landmarks of its type, or one of every so many."""
        kinds = enumerate(self.views.kind[:, k].tolist())
        return Found.all_of([self._on(self.members.of(kind)[::every], k, turn) for turn, kind in kinds])

    def _on(self, slots: Slots, k: int, turn: int) -> Found:
        at = self.grid.blocks.xy.take(slots, axis=0) - self.views.xy[turn, k]
        return Found.at(at[:, 0].copy(), at[:, 1].copy(), np.full(len(slots), turn))

    def there(self, ks: Sequence[int], f: Found) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
        """(F, M) whether features ks have a landmark, and whether ground is mapped there; f in the order of turns."""
        count = np.bincount(f.turn, minlength=TURNS)
        dx, dy = (np.repeat(self.views.xy[:, ks, i].T, count, axis=1) for i in (0, 1))
        own = np.repeat(np.left_shift(1, self.views.kind[:, ks].T).astype(np.uint16), count, axis=1)
        bits = self.grid.bits(dx + f.x, dy + f.y)
        return (bits & own) > 0, (bits & GROUND) > 0

    def _new(self, f: Found) -> Found:
        """Without those that an earlier group has found."""
        singles = [g[0] for g in self.groups if len(g) == 1]
        for part in (singles[i : i + LOOK_EVERY] for i in range(0, len(singles), LOOK_EVERY)):
            f = f.of(np.flatnonzero(~np.any(self.there(part, f)[0], axis=0)))
        for group in (g for g in self.groups if len(g) > 1):
            f = f.of(np.flatnonzero(~np.all(self.there(group, f)[0], axis=0)))
        return f

    def _verified(self, f: Found) -> Found:
        """Poses with what they explain and contradict, without those that are found hopeless on the way."""
        order, done = self.order.tolist(), 0
        self.strictest = min(self.strictest, self.limit)
        while done < len(order) and len(f):
            ks = order[done : done + max(LOOK_EVERY, AT_ONCE // len(f))]
            there, ground = self.there(ks, f)
            f.explained += np.count_nonzero(there, axis=0)
            f.contradicted += np.count_nonzero(ground & ~there, axis=0)
            done += len(ks)
            f = f.of(np.flatnonzero(self._hopeful(f, len(order) - done)))
        return f

    def _hopeful(self, f: Found, left: int) -> NDArray[np.bool_]:
        """Which can be within reach of the best, or be the best, if all features that are left are explained."""
        if not len(self.best):
            return f.cost <= self.limit
        within = (f.cost <= self.limit) & (f.explained + left >= EXPLAINED_FRACTION * self.best.explained[0])
        return np.asarray(within | (f.score + EXPLAINED * left >= self.best.score[0]))

    @property
    def limit(self) -> float:
        """Cost of places that are listed, at most."""
        if not len(self.best):
            return CONTRADICTED * CONTRADICTED_FRACTION * len(self.order)
        return float(self.best.cost[0] + self.margin)

    def _improve(self, fresh: Found) -> None:
        """Take the best of what was found for the best, if it is."""
        better = np.flatnonzero(fresh.score > self.best.score[0]) if len(self.best) else np.arange(len(fresh))
        first = fresh.of(better[np.argsort(-fresh.score[better], kind="stable")[:FIRST]])
        self._count_missed(first)
        first = Found.all_of([self.best, first])
        self.best = first.of(np.lexsort((-first.cost, -first.score))[:1])

    def _count_missed(self, f: Found) -> None:
        f.missed = missed(self.grid.blocks, self.views, f.x, f.y, f.turn)

    def kept(self) -> Found:
        """All that is within reach of the best, best first, each place once."""
        f = Found.all_of(self.found)
        f = f.of(np.flatnonzero(self._hopeful(f, 0)))
        self._count_missed(f)
        self.best = f.of(np.lexsort((-f.cost, -f.score))[:1])
        f = f.of(np.flatnonzero(self._hopeful(f, 0)))
        f = f.of(np.lexsort((f.turn, f.y, f.x, -f.score)))
        return f.of(first_of_places(f))

    def counted(self, poses: Array) -> Found:
        """Poses (M, 3), at the nearest of the view's headings, with their counts and in their order."""
        turn = np.round((self.views.heading_rad[0] - poses[:, 2]) / (0.5 * np.pi)).astype(np.int64) % TURNS
        order = np.argsort(turn, kind="stable")
        x, y = fine(poses[order, :2]).T.copy()
        f = Found.at(x, y, turn[order])
        there, ground = self.there(self.order.tolist(), f)
        f.explained = np.count_nonzero(there, axis=0)
        f.contradicted = np.count_nonzero(ground & ~there, axis=0)
        self._count_missed(f)
        return f.of(np.argsort(order))

    def poses(self, f: Found) -> Array:
        """(M, 3) map_from_base."""
        return np.column_stack([FINE_M * f.x, FINE_M * f.y, self.views.heading_rad[f.turn]])
