"""Wheels that slip: what a slip does to the pose, how likely one is, and how often slips have been seen."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from ceilvo.config import Filter
from ceilvo.se2 import rotation
from ceilvo.types import Array, Motion

NONE, LOSS, OVER_RUN, YAW = -1, 0, 1, 2
"""Kinds: the wheels held; the robot moved less than they say, more, or turned by more or less."""
KINDS = 3
LENGTH_M = 0.3
"""How long a slip lasts, on average; chosen."""
OVER_RUN_SHARE = 2.0
"""How much of the reported way an over-run may add; chosen: a slide after wheels that brake."""
YAW_RAD_PER_M = 0.8
"""Standard deviation of the turn that wheels do not report, per metre of a slip; chosen."""
YAW_SHARE = 0.5
"""The same as a share of the turn that they report; chosen: wheels that turn on the spot slip by that much."""
TURN_M_PER_RAD = 0.3
"""Turning by a radian is a chance to slip as much as driving so far; chosen: half the wheel base of a small robot."""
PRIOR_M = 50.0
"""So much driving the configured rate counts as, beside what is seen; chosen: some laps of a room."""
MEMORY_M = 500.0
"""What was seen longer ago fades; chosen: floors and wheels change."""
RARER, OFTENER = 0.1, 10.0
"""Bounds of a learnt rate, in units of the configured one; chosen."""
MOST_CHANCE = 0.95
"""That wheels go on slipping, at most: there is always a chance that they hold."""
WIDE_RAD = 0.2
"""A wider spread of turns is tried in pieces, for features do not move on straight lines over it; chosen."""
PIECES = 12
"""Of 2.5 standard deviations either way; chosen: 0.3 rad each where the wheels reported half a turn."""


@dataclass(frozen=True, slots=True)
class Slip:
    """What wheels may have done: shift (3,) of the pose, and its covariance, of rank one.

    Attributes:
        direction: (3,) that it varies along, with this variance.
        share: of all slips of the kind; less than 1 for a piece.
    """

    kind: int
    shift: Array
    direction: Array
    var: float
    share: float = 1.0

    @property
    def spread(self) -> Array:
        return np.asarray(self.var * np.outer(self.direction, self.direction), np.float64)


NO_SLIP = Slip(NONE, np.zeros(3), np.zeros(3), 0.0)


@dataclass(slots=True)
class SlipState:
    """The path since the last update, and how often slips were seen.

    Attributes:
        displacement_m: (2,) in map.
        travel_m: length of the path.
        turn_rad: net turn, of motions that may be wrong about it.
        starts: (3,) slips that began, by kind, as a sum of probabilities.
        metres: the driving in which they began.
    """

    displacement_m: Array = field(default_factory=lambda: np.zeros(2))
    travel_m: float = 0.0
    turn_rad: float = 0.0
    starts: Array = field(default_factory=lambda: np.zeros(KINDS))
    metres: float = 0.0

    def moved(self, step_m: Array, motion: Motion) -> None:
        """The pose went by (2,) in map with a motion; where vision measured that, wheels that slip leave no trace."""
        if motion.seen:
            return
        self.displacement_m = self.displacement_m + step_m
        self.travel_m += float(np.hypot(*step_m))
        if motion.cov[2, 2] > 0.0:
            self.turn_rad += float(motion.prev_from_curr[2])

    def rest(self) -> None:
        """A new path begins."""
        self.displacement_m, self.travel_m, self.turn_rad = np.zeros(2), 0.0, 0.0

    @property
    def exposure_m(self) -> float:
        """Driving since the last update, turns included."""
        return self.travel_m + TURN_M_PER_RAD * abs(self.turn_rad)

    def rates(self, settings: Filter) -> Array:
        """(3,) slips that begin per metre, by kind: the mean of a gamma distribution, bounded."""
        expected = settings.slip_per_m
        seen = (PRIOR_M * expected + self.starts) / (PRIOR_M + self.metres)
        return np.clip(seen, RARER * expected, OFTENER * expected)

    def learn(self, starts: Array) -> None:
        """Count (3,) probabilities that a slip began on the path."""
        kept = min(1.0, MEMORY_M / max(self.metres, MEMORY_M))
        self.starts = kept * self.starts + starts
        self.metres = kept * self.metres + self.exposure_m

    def chances(self, slipping: Array, settings: Filter) -> tuple[Array, Array]:
        """(4,) probabilities of each kind and, last, of none; (3,) that it began on this path.

        Args:
            slipping: (3,) probabilities that wheels were slipping at the last update, by kind.
        """
        if settings.slip_per_m <= 0.0 or self.exposure_m <= 0.0:
            return np.array([0.0, 0.0, 0.0, 1.0]), np.zeros(KINDS)
        began = (1.0 - float(np.sum(slipping))) * (1.0 - np.exp(-self.rates(settings) * self.exposure_m))
        p = slipping * float(np.exp(-self.exposure_m / LENGTH_M)) + began
        p = p * (MOST_CHANCE / max(float(np.sum(p)), MOST_CHANCE))
        return np.append(p, 1.0 - np.sum(p)), np.minimum(began, p)

    def along(self, kind: int, settings: Filter) -> Slip:
        """LOSS or OVER_RUN: of the reported way a share, uniform from none to the most."""
        most = settings.slip_share if kind == LOSS else -OVER_RUN_SHARE
        length = min(1.0, 2.0 * LENGTH_M / self.travel_m) if self.travel_m > 0.0 else 0.0
        lost = np.append(most * length * self.displacement_m, 0.0)
        return Slip(kind, -0.5 * lost, lost, 1.0 / 12.0)

    def turned(self) -> list[Slip]:
        """YAW: a Gaussian of turns, in pieces where it is wide; half of the turn comes before the way."""
        way = self.displacement_m
        sigma = float(np.hypot(YAW_RAD_PER_M * min(self.travel_m, 2.0 * LENGTH_M), YAW_SHARE * self.turn_rad))
        count = PIECES if sigma > WIDE_RAD else 1
        edges = np.linspace(-2.5, 2.5, count + 1)
        middle = 0.5 * (edges[1:] + edges[:-1])
        var = sigma**2 if count == 1 else (sigma * (edges[1] - edges[0])) ** 2 / 12.0
        share = np.exp(-0.5 * middle**2)
        return [_turn(way, sigma * float(z), var, float(s)) for z, s in zip(middle, share / np.sum(share), strict=True)]


def _turn(way: Array, turn_rad: float, var: float, share: float) -> Slip:
    half = rotation(0.5 * turn_rad)
    direction = np.append(0.5 * (half @ [-way[1], way[0]]), 1.0)
    return Slip(YAW, np.append(half @ way - way, turn_rad), direction, var, share)
