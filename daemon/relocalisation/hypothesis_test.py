"""Whether a pose that was only assumed is right: it must explain what is seen better than the alternatives do.

A grid of tiles agrees with any pose that is whole tiles off, so that most features fit proves nothing. The alternatives
are tried on the same views: the assumed pose is believed once it has explained clearly more features than the best of
the poses whole tiles away, over views from places a little apart. A bare grid decides nothing, and then nothing is
believed. Where one alternative is clearly better than all others, the robot is there.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from enum import IntEnum

import numpy as np

from ceilvo.daemon.relocalisation.place_search import ReachableRegion
from ceilvo.se2 import compose, inverse
from ceilvo.types import Array

# Counts and fractions were chosen on the laps of python -m ceilvo.bench.faults; docs/faults.md has the figures.
MARGIN, JUMP_MARGIN = 12, 24
"""Features that a pose must explain more than every alternative: to be believed; for an alternative to replace it."""
EXPLAINED_FRACTION, EXPLAINED_FRACTION_LONG, EXPLAINED_FRACTION_AT_ONCE = 0.85, 0.93, 0.97
"""Of the features seen, those that must be explained: near where the robot should be; over FAR_VIEWS; FEWEST_VIEWS."""
CLOSE_FRACTION = 0.6
"""The same for a pose that was given so closely that no tile can be mistaken."""
ELSEWHERE_FRACTION, ELSEWHERE_FRACTION_LONG = 0.03, 0.006
"""Of the features seen, how many more the best other place may explain: over a few views, over FAR_VIEWS."""
FEWEST_VIEWS, FAR_VIEWS = 6, 40
"""Views that it takes: near where the robot should be, and anywhere on the map."""
FEWEST_FEATURES = 5
"""A view of fewer proves nothing."""
NEAR_M = 2.0
"""Alternatives whole tiles away cover poses that are so near."""


class Source(IntEnum):
    """Where a pose came from that landmarks have yet to confirm; the numbers are in recordings."""

    GIVEN_CLOSELY = 0
    """Said by somebody or stored, to within a fraction of a tile: needs no alternatives."""
    GIVEN = 1
    DEAD_RECKONED = 2
    """Carried over a blind path so well that it is usable with care."""
    BLIND = 3
    """After a blind path that may have led to another tile."""
    CONTRADICTED = 4
    """Tracked until what is seen contradicted the map."""
    SEARCHED = 5
    """Found by looking all over the map. Ceilings repeat themselves at many distances and the map may lack the right
    place, so it must be right for a longer path."""


@dataclass(slots=True)
class PoseHypothesis:
    """An assumed pose, and how well views have borne it out.

    Attributes:
        source: where the pose came from.
        reach_m: how far the robot can be from where its path since it was last sure took it.
        blind_m: length of the blind path, for the reason that is given.
        expected_from_assumed: (3,) takes the assumed pose to where that path ended.
        explained: (1 + K,) features explained so far, by the pose and by its K alternatives.
        seen, views: features and views so far.
        elsewhere: sum of how many more the best other place explained in each view where one did.
        lead: sum of how many more than the best other place the pose explained.
    """

    source: Source
    reach_m: float = np.inf
    blind_m: float = 0.0
    expected_from_assumed: Array = field(default_factory=lambda: np.zeros(3))
    explained: Array = field(default_factory=lambda: np.zeros(1))
    seen: int = 0
    views: int = 0
    elsewhere: int = 0
    lead: int = 0

    @property
    def close(self) -> bool:
        return self.source is Source.GIVEN_CLOSELY

    @property
    def usable(self) -> bool:
        """With care, while it is unconfirmed."""
        return self.source is Source.DEAD_RECKONED

    @property
    def reason(self) -> str:
        """Why landmarks have to confirm the pose."""
        if self.source in (Source.DEAD_RECKONED, Source.BLIND):
            return f"{self.blind_m:.2f} m driven blind"
        if self.source is Source.CONTRADICTED:
            return "what is seen contradicts the map"
        return "found elsewhere on the map" if self.source is Source.SEARCHED else "assumed"

    def after_gap(self, usable: bool = True, reach_m: float = 0.0) -> PoseHypothesis:
        """The same hypothesis after a further blind path: what was counted before it says nothing any more."""
        source = Source.GIVEN if self.close else self.source
        if source is Source.DEAD_RECKONED and not usable:
            source = Source.BLIND
        return replace(self._uncounted(), source=source, reach_m=self.reach_m + reach_m)

    def jumped(self, old: Array, new: Array) -> PoseHypothesis:
        """A hypothesis that says the robot is at `new` (3,) instead of at `old`."""
        moved = compose(self.expected_from_assumed, compose(old, inverse(new)))
        return replace(self._uncounted(), source=Source.SEARCHED, expected_from_assumed=moved)

    def _uncounted(self) -> PoseHypothesis:
        return replace(self, explained=np.zeros(1), seen=0, views=0, elsewhere=0, lead=0)

    def region(self, pose: Array) -> ReachableRegion | None:
        """Where the robot is if nobody carried it, for an assumed pose; None where nothing is known of that."""
        if not np.isfinite(self.reach_m):
            return None
        return ReachableRegion(compose(self.expected_from_assumed, pose), self.reach_m)

    def weigh(self, explained: Array, seen: int, elsewhere: int, nis: float, nis_max: float) -> bool:
        """Take in one view from a new place.

        Args:
            explained: (1 + K,) features that the map explains from the assumed pose and from its K alternatives.
            seen: features in the view.
            elsewhere: how many more the best other place of the whole map would explain, negative where none does.

        Returns:
            True once the hypothesis is confirmed.
        """
        if explained.shape != self.explained.shape:
            self.explained = np.zeros(explained.shape)
            self.seen = self.views = self.elsewhere = self.lead = 0
        self.explained = self.explained + explained
        self.seen, self.views = self.seen + seen, self.views + 1
        self.elsewhere += max(elsewhere, 0)
        self.lead -= elsewhere
        fits = explained[0] >= max(FEWEST_FEATURES, CLOSE_FRACTION * seen) and nis <= nis_max
        if self.close or len(explained) == 1:
            return bool(fits and self.close)
        ahead = self.explained[0] - np.max(self.explained[1:])
        return bool(fits and ahead >= MARGIN and self._believed())

    def _believed(self) -> bool:
        """Where the robot should be a few good views do; else it takes many or better ones, and no place like it."""
        searched = self.source is Source.SEARCHED
        if not searched and self.reach_m <= NEAR_M:
            return self.views >= FEWEST_VIEWS and self._holds(EXPLAINED_FRACTION, ELSEWHERE_FRACTION)
        if self.lead < MARGIN:
            return False
        if self.views >= FAR_VIEWS:
            return self._holds(EXPLAINED_FRACTION_LONG, ELSEWHERE_FRACTION_LONG)
        return (
            not searched and self.views >= FEWEST_VIEWS and self._holds(EXPLAINED_FRACTION_AT_ONCE, ELSEWHERE_FRACTION)
        )

    def better(self) -> int | None:
        """Which alternative has explained clearly more than the pose and than every other; None where none has."""
        if len(self.explained) < 3:
            return None
        order = np.argsort(self.explained)
        best, second = int(order[-1]), int(order[-2])
        ahead = self.explained[best] - self.explained[second]
        convinces = self.views >= FEWEST_VIEWS and self.explained[best] >= EXPLAINED_FRACTION * self.seen
        return best - 1 if best > 0 and ahead >= JUMP_MARGIN and convinces else None

    @property
    def hopeless(self) -> bool:
        """Whether enough views were explained too badly, or better elsewhere: the robot is there, or nothing is mapped.

        All views count: were the last one enough, a wrong pose would only have to wait for the one that fits.
        """
        if self.close or self.views < FEWEST_VIEWS:
            return False
        if self.views >= FAR_VIEWS:
            return not self._holds(EXPLAINED_FRACTION_LONG, ELSEWHERE_FRACTION_LONG)
        return not self._holds(EXPLAINED_FRACTION, ELSEWHERE_FRACTION)

    def _holds(self, fraction: float, elsewhere: float) -> bool:
        """Whether the views were explained nearly whole, the best of bad ones being none, and nowhere better."""
        explained = self.explained[0] >= fraction * self.seen
        return bool(explained and self.elsewhere <= elsewhere * self.seen)


def convincing(explained: int, seen: int) -> bool:
    """Whether one view is explained nearly whole."""
    return seen >= FEWEST_FEATURES and explained >= EXPLAINED_FRACTION * seen
