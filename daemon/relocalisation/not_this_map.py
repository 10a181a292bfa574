"""Is the robot anywhere on the map? All places at once, by views that share no ground, against ground it does not know.

The belief cannot say: places that are alike by chance come up with every view, and each is new there. Here every place
must explain all views that are kept, so what was alike once is not for long. What a map has of a ceiling may have
changed, a part of it as large as a view at once. So each view is that of changed ground, or not.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from ceilvo.daemon.relocalisation.doubts import PLACES_PER_M2, Doubt
from ceilvo.daemon.relocalisation.evidence.coverage import Coverage
from ceilvo.daemon.relocalisation.evidence.view_evidence import CHANGED, CHANGED_CHANCE
from ceilvo.daemon.relocalisation.evidence.wrong_places import combined
from ceilvo.daemon.relocalisation.lattice import (
    FEWEST_PAIRS,
    Lattice,
    cells,
    offset,
    rival_from_tracked,
    rival_poses,
    same_places,
)
from ceilvo.se2 import compose, inverse, transform
from ceilvo.types import Array, Observations, Pose

MAP_RIGHT = 0.05
"""Chance at most that the map is right when it is said that it is not; chosen: saying so changes nothing, so it is not
states.false_place_rate. It takes two to three views without a feature in common."""
NEW_GROUND = 0.5
"""Share of a view that must show ground which no view that is kept shows; chosen: a metre of the way."""
MOST_VIEWS = 8
"""Kept, the last; chosen for time."""
MOST_PLACES = 512
"""Places kept, the likeliest; chosen for time."""
UNLISTED, UNLISTED_INCOMPLETE = 0.01, 0.5
"""Chance that the index does not list the right place of a view: where it says that it lists all (measured: none of
some hundred, docs/place-index.md), and where it does not (measured: 0.1 to 0.53)."""
LEAVES, STAYS_OFF = 0.05, 0.5
"""Chance that a robot on the map comes to ground that nobody has mapped, and that it stays there for another view;
chosen."""
SPOILT = 0.001
"""Chance that a view which is kept shows something else than the ceiling, whatever has changed: people, a damaged
picture; chosen."""
SCALED, MOST_SCALED = 0.025, 0.3
"""By how much, as a logarithm, tiles along both axes must be larger or smaller than the map's, all alike, to be of
another height, a period in a view being known to 0.005; and beyond which it is another number of tiles; chosen."""
RESCALED = 0.001
"""Chance that the right map shows such tiles: a step of the ceiling that is not told, or another grid; chosen."""
HALF = 0.5
"""A view of which the map knows less of the ground is from there."""
_NEVER = -np.inf
_CELL_M = 0.02
"""Places nearer than that are one; chosen: a feature may be 5 cm off. A place that was put right by more explains
other views."""
_LEAST_M2 = 1e-3
"""In place of an area that is none."""

Weigh = Callable[[Observations, float, Array], tuple[Array, Array]]
"""(N, 2) log-likelihood ratios of a view, whose features are worth so much, at poses (N, 3), and (N,) the share of it
on ground that the map knows."""


@dataclass(slots=True)
class NotThisMapState:
    """What is remembered since the doubt.

    Attributes:
        area_m2: that the map knows.
        unknown: log-odds of ground that the map does not know against the tracked place, before any view; -inf: nobody
            asks.
        beyond: the same of places of the map that are not listed one by one; each: of one place.
        views: kept, each with the tracked pose (3,) it was seen from, its share of new ground, and the logarithm of the
            chance that the right place is not listed.
        ground: that they show; view_m2: of one view.
        places: (G, 3) place_from_tracked; the first is the tracked one, zero. prior: (G,) of each against that.
        ratio: (G, K, 2) of every view there; on: (G, K) whether its ground is known there.
        odds: log-odds of the map against ground that it does not know; said: that it is not this map; times: that it
            was said.
        lattice: of the map where the doubt began; scales: of every view, see Lattice.log_scales.
    """

    area_m2: float = 0.0
    unknown: float = _NEVER
    beyond: float = 0.0
    each: float = 0.0
    views: list[tuple[Observations, Array, float, float]] = field(default_factory=list)
    ground: Coverage = field(default_factory=Coverage)
    view_m2: float = 0.0
    places: Array = field(default_factory=lambda: np.zeros((1, 3)))
    prior: Array = field(default_factory=lambda: np.zeros(1))
    ratio: Array = field(default_factory=lambda: np.zeros((1, 0, 2)))
    on: NDArray[np.bool_] = field(default_factory=lambda: np.zeros((1, 0), bool))
    odds: float = np.inf
    said: bool = False
    times: int = 0
    lattice: Lattice | None = None
    scales: list[tuple[Array, Array]] = field(default_factory=list)

    def __post_init__(self) -> None:
        """States of older recordings knew the tracked place only."""
        if len(self.prior) != len(self.places):
            self.prior = np.append(0.0, np.full(len(self.places) - 1, self.each))

    @property
    def scale(self) -> float:
        """See other_scale."""
        return other_scale(self.scales)


class NotThisMap:
    """Begin it with a doubt, show it views; end it when the place is sure."""

    def __init__(self) -> None:
        self.state = NotThisMapState()

    @property
    def said(self) -> bool:
        return self.state.said

    @property
    def refuses(self) -> bool:
        """Whether no place of the map may be called sure: it is not this map, or not at this height."""
        return self.state.said or self.state.scale != 0.0

    @property
    def asks(self) -> bool:
        return self.state.unknown > _NEVER

    def doubt(
        self,
        doubt: Doubt,
        pose: Array,
        view: Observations,
        lattice: Lattice | None,
        ground: Coverage,
        known: float,
        listed_m: float,
        stood: Array,
    ) -> None:
        """Begin to ask, unless the robot was where the map does not know anyhow.

        Args:
            pose: (3,) where it should be; view: from there, known: of which the map knows so much of the ground.
            lattice: of the ceiling there; ground: that the map knows; listed_m: how far rivals are listed one by one.
            stood: (N, 3) place_from_tracked, where the robot is as likely as at the tracked place.
        """
        if known < HALF:
            self.end()
            return
        unknown, reach_m = doubt.unknown, 0.0
        if lattice is not None:
            reach_m = lattice.reach_m(listed_m)
            off = offset(lattice.aligned(pose, view), pose)
            fits = doubt.alignment(off, lattice.tile_m, turned=False) if doubt.unmeasured else 0.0
            unknown -= max(fits, 0.0)  # tiles that do not lie so are features without landmarks, and count as those
        beyond = ground.share_beyond(pose[:2], reach_m) if doubt.anywhere else 0.0
        before = self.state
        self.begin(unknown, ground.area_m2, beyond)
        self._list(stood, np.zeros(len(stood)), [])
        # the calibration of a daemon that runs does not change: what it sees larger then is a step of the ceiling
        self.state.lattice, self.state.scales = (lattice, []) if doubt.stored > 0.0 else (before.lattice, before.scales)

    def begin(self, unknown: float, area_m2: float, beyond: float) -> None:
        """With a doubt: log-odds of unknown ground against the tracked place, ground that the map knows, and the share
        of it that lies further off than rivals are listed one by one."""
        before = self.state
        each = unknown - float(np.log(max(area_m2, 1.0) * PLACES_PER_M2))
        beyond = unknown + float(np.log(beyond)) if beyond > 0.0 else _NEVER
        if before.said:  # another doubt does not take it back
            unknown = float(np.logaddexp(unknown, -before.odds))
        self.state = NotThisMapState(area_m2, unknown, beyond, each, said=before.said, times=before.times)

    def end(self) -> None:
        """The place is known, or nobody asks any more."""
        self.state = NotThisMapState(times=self.state.times)

    def new_ground(self, pose: Array, visible_m: Array) -> float:
        """Share of a view's polygon (V, 2) in base, from a pose (3,), that no view has shown."""
        shown = Coverage()
        shown.show(transform(Pose(pose), visible_m))
        cells = shown.cells_m
        return float(np.mean(self.state.ground.views(cells) == 0)) if len(cells) else 0.0

    def put_right(self, before: Array, after: Array, weigh: Weigh) -> None:
        """The tracked pose (3,) was found to lie centimetres elsewhere, (3,): so did those that views were seen from.

        The other places stay where they are.
        """
        s = self.state
        moved = compose(after, inverse(before))
        s.views = [(view, np.asarray(compose(moved, at)), new, missed) for view, at, new, missed in s.views]
        s.places[1:] = rival_from_tracked(rival_poses(s.places[1:], before), after)
        for k, (view, at, new, _) in enumerate(s.views):
            ratio, known = weigh(view, new, at[None])
            s.ratio[0, k], s.on[0, k] = ratio[0], known[0] >= HALF

    def take(
        self, view: Observations, pose: Array, places: Array, complete: bool, weigh: Weigh, likeliest: int = 0
    ) -> bool:
        """Keep a view from the tracked pose (3,) if it shows new ground; True when that was what made it say so.

        Args:
            places: (P, 3) place_from_tracked that are likely now, `likeliest` more than the others.
            complete: no other place of the map is.
        """
        s = self.state
        self._scale(view)
        new = self.new_ground(pose, view.visible_m)
        if new < NEW_GROUND or not len(view):
            if s.views:
                self._add(places[likeliest : likeliest + 1], weigh)
            return self._says()
        before_m2 = s.ground.shown_m2
        s.ground.show(transform(Pose(pose), view.visible_m))
        s.view_m2 = (s.ground.shown_m2 - before_m2) / new
        s.views.append((view, np.array(pose), new, float(np.log(UNLISTED if complete else UNLISTED_INCOMPLETE))))
        self._weigh_new_view(weigh)
        self._add(places, weigh)
        if len(s.views) > MOST_VIEWS:
            s.views, s.ratio, s.on = s.views[1:], s.ratio[:, 1:], s.on[:, 1:]
        return self._says()

    def _scale(self, view: Observations) -> None:
        """Of the last views, also of old ground; once the height is right again those that were kept say nothing."""
        s = self.state
        before = s.scale
        s.scales = [*s.scales, *([] if s.lattice is None else [s.lattice.log_scales(view)])][-MOST_VIEWS:]
        if before != 0.0 and s.scale == 0.0:
            s.views, s.ground, s.said, s.odds = [], Coverage(), False, np.inf
            s.ratio, s.on = np.zeros((len(s.places), 0, 2)), np.zeros((len(s.places), 0), bool)

    def _says(self) -> bool:
        """Weigh the map anew; True when that was what made it say so."""
        s = self.state
        if not s.views:
            return False
        s.odds = float(self._odds())
        before, scaled = s.said, len(s.views) > 1 and s.scale != 0.0
        s.said = bool(s.odds < np.log(MAP_RIGHT) or (s.said and s.odds < 0.0) or scaled)
        s.times += s.said and not before
        return s.said and not before

    def _weigh_new_view(self, weigh: Weigh) -> None:
        s = self.state
        view, pose, new, _ = s.views[-1]
        ratio, known = weigh(view, new, rival_poses(s.places, pose))
        s.ratio = np.concatenate([s.ratio, ratio[:, None]], axis=1)
        s.on = np.concatenate([s.on, (known >= HALF)[:, None]], axis=1)

    def _add(self, places: Array, weigh: Weigh) -> None:
        """Weigh places that are not known yet at all views, those first that the last view speaks for."""
        s = self.state
        fresh = places[~_same(places, s.places)]
        if not len(fresh):
            return
        view, pose, new, _ = s.views[-1]
        best = np.argsort(-combined(weigh(view, new, rival_poses(fresh, pose))[0]), kind="stable")[:MOST_PLACES]
        fresh = fresh[best]
        stood = s.places[1:][s.prior[1:] > s.each]  # may be put right by some centimetres
        prior = np.where(np.any(same_places(fresh, stood), axis=1), 0.0, s.each)
        self._list(fresh, prior, [weigh(v, worth, rival_poses(fresh, at)) for v, at, worth, _ in s.views])
        keep = np.append(0, 1 + np.argsort(-self._weights()[1:], kind="stable")[: MOST_PLACES - 1])
        s.places, s.prior, s.ratio, s.on = s.places[keep], s.prior[keep], s.ratio[keep], s.on[keep]

    def _list(self, places: Array, prior: Array, told: list[tuple[Array, Array]]) -> None:
        """Places (N, 3) with (N,) log-odds before any view, and what every view that is kept tells of them."""
        s = self.state
        shape = len(places), 0
        s.places, s.prior = np.concatenate([s.places, places]), np.append(s.prior, prior)
        ratio = np.stack([r for r, _ in told], axis=1) if told else np.zeros((*shape, 2))
        on = np.stack([k >= HALF for _, k in told], axis=1) if told else np.zeros(shape, bool)
        s.ratio, s.on = np.concatenate([s.ratio, ratio]), np.concatenate([s.on, on])

    def _weights(self) -> Array:
        """(G,) log-odds of the places against the tracked one before any view; where none shows the map, -inf."""
        s = self.state
        both = np.stack([self._with_changes(s.ratio[..., c]) for c in range(2)], axis=-1)
        off = ~s.on
        left = off & np.column_stack([np.ones(len(off), bool), s.on[:, :-1]])
        way = np.sum(np.where(left, np.log(LEAVES), np.where(off, np.log(STAYS_OFF), 0.0)), axis=1)
        out = s.prior + combined(both) + way
        out[1:][~np.any(s.on[1:], axis=1)] = _NEVER
        return np.asarray(out)

    def _odds(self) -> float:
        s = self.state
        missed = np.array([[v[3] for v in s.views]])
        unlisted = s.beyond + float(self._with_changes(missed)[0])
        scaled = float(np.log(RESCALED)) if s.scale != 0.0 else 0.0  # of all views together: it is one ceiling
        return float(np.logaddexp(np.logaddexp.reduce(self._weights()), unlisted)) + scaled - s.unknown

    def _with_changes(self, ratio: Array) -> Array:
        """(G,) log-likelihood ratios of views (G, K), each of changed ground or not.

        What has changed is a fraction of the whole map: where the views have shown more than that, the rest has not.
        """
        s = self.state
        new = np.array([v[2] for v in s.views])
        cells = s.area_m2 / max(s.view_m2, _LEAST_M2)
        before = np.cumsum(new) - new
        left = np.maximum(cells - before, _LEAST_M2)
        changed = np.clip((CHANGED[:, None] * cells - before) / left, SPOILT, CHANGED[-1])  # (R, K)
        same = ratio[:, None] + new * np.log1p(-changed)
        each = np.logaddexp(new * np.log(changed), same)
        return np.asarray(np.logaddexp.reduce(np.log(CHANGED_CHANCE) + np.sum(each, axis=-1), axis=-1))


def other_scale(scales: list[tuple[Array, Array]]) -> float:
    """By how much tiles in views, see Lattice.log_scales, are larger than the map's along both axes, as a share.

    0 where they are as large, are not alike along both, or show too little.
    """
    steps = [np.concatenate([view[axis] for view in scales]) if scales else np.zeros(0) for axis in range(2)]
    if min(len(s) for s in steps) < FEWEST_PAIRS:
        return 0.0
    middle = [float(np.median(s)) for s in steps]
    off = float(np.mean(middle))
    alike = abs(middle[0] - middle[1]) < SCALED
    return float(np.expm1(off)) if alike and SCALED < abs(off) < MOST_SCALED else 0.0


def _same(places: Array, known: Array) -> NDArray[np.bool_]:
    """(N,) whether places (N, 3) are among known ones (M, 3)."""
    rows = {tuple(row) for row in cells(known, _CELL_M).tolist()}
    return np.array([tuple(row) in rows for row in cells(places, _CELL_M).tolist()], np.bool_)
