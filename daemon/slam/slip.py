"""Wheels that slip or misreport turns: what that does to the pose, how likely it is, and what was learnt of it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from ceilvo.config import Filter
from ceilvo.se2 import rotation
from ceilvo.types import Array, Displacement, Motion

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
SCALE_SIGMA = 0.1
"""Standard deviation of the share of turns that wheels misreport before any was seen; chosen: a tenth of the track."""
SCALE_SIGMA_LEAST = 0.005
"""The same, however many were seen; chosen: floors and loads change."""


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


@dataclass(slots=True)
class TurnScale:
    """By which share wheels misreport turns, all the time: learnt from how much further updates turn the pose.

    Where the map turns with the pose and no heading is measured, no update tells (`told`).

    Attributes:
        share: the robot turns by 1 + share of what wheels report; with a variance.
        lever: (3,) how the pose moves with the share, on the path since the last update.
        told: the last update would have told a turn.
    """

    share: float = 0.0
    var: float = SCALE_SIGMA**2
    lever: Array = field(default_factory=lambda: np.zeros(3))
    told: bool = False

    def scaled(self, motion: Motion) -> Motion:
        """A motion with the turn as it will have been; what vision measured or foresaw, or is exact, is as it is."""
        if not _wheels_alone(motion):
            return motion
        x, y, turn_rad = motion.prev_from_curr
        way = rotation(0.5 * self.share * turn_rad) @ [x, y]
        return replace(motion, prev_from_curr=Displacement(np.append(way, (1.0 + self.share) * turn_rad)))

    def moved(self, step_m: Array, motion: Motion) -> Array:
        """(3, 3) by how much a motion by (2,) in map makes the pose less certain, as the share is not known."""
        across = np.array([-step_m[1], step_m[0]])
        carried = self.lever + np.append(self.lever[2] * across, 0.0)
        self.lever = carried
        if self.told and _wheels_alone(motion):
            self.lever = carried + motion.prev_from_curr[2] * np.append(0.5 * across, 1.0)
        return np.asarray(self.var * (np.outer(self.lever, self.lever) - np.outer(carried, carried)), np.float64)

    def learn(self, before: Sequence[Array], step: Sequence[Array], after: Sequence[Array], weight: Array) -> None:
        """What an update says of the share by the pose it corrected; a new path begins.

        Args:
            before, after: (3, 3) covariances of the pose, of every hypothesis of weight (B,).
            step: (3,) its correction.
        """
        if np.any(self.lever):
            gain = [np.linalg.solve(cov, self.var * self.lever) for cov in before]
            moved = np.array([g @ s for g, s in zip(gain, step, strict=True)])
            less = np.array([g @ (b - a) @ g for g, b, a in zip(gain, before, after, strict=True)])
            weight = weight / np.sum(weight)
            mean = float(weight @ moved)
            var = self.var + float(weight @ ((moved - mean) ** 2 - less))
            self.share, self.var = self.share + mean, max(var, SCALE_SIGMA_LEAST**2)
        self.rest()

    def rest(self) -> None:
        """A new path begins."""
        self.lever = np.zeros(3)


def _wheels_alone(motion: Motion) -> bool:
    return motion.by_wheels and not motion.seen and bool(motion.cov[2, 2] > 0.0)
