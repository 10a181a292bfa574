"""How much oftener than usual the map lacks what a view shows on ground that it knows: of this camera and ceiling.

Where small pictures or a grille make lines that come and go, a fifth of the features is new at every look; while the
place is sure that is counted, so that it does not speak against the place later.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

_BEFORE = 3.0
"""Features that are expected to be new, by which what is usual counts as well; chosen: a dozen spots of a plain
ceiling. With 5 the path-traced office, a ceiling of twice as many, was in doubt before it was known (docs/place.md)."""
_KEPT = 0.97
"""Of what was counted, at every spot; chosen: a ceiling's other part is another after thirty spots, 8 m."""
_STEPS = (8.0, 4.0, 2.0)
"""What is told apart; chosen: tables are made for each."""


@dataclass(slots=True)
class Unmapped:
    """Sums over spots: features that the map lacked, and how many it should have lacked."""

    lacked: float = 0.0
    expected: float = 0.0

    def learn(self, lacked: float, expected: float) -> None:
        """From one view of a place that is sure."""
        self.lacked = _KEPT * self.lacked + lacked
        self.expected = _KEPT * self.expected + expected

    @property
    def scale(self) -> float:
        """How many times as often as usual the map lacks something, the nearest step."""
        ratio = (self.lacked + _BEFORE) / (self.expected + _BEFORE)
        return next((step for step in _STEPS if ratio >= math.sqrt(0.5) * step), 1.0)
