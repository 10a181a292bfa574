"""How a robot tilts: what the last seconds showed is the prior for the next frame.

A robot on a good floor does not tilt at all, and then estimating tilt from every frame alone only adds noise: the
height of the ceiling turns a hundredth of a degree into half a millimetre. A robot that rocks is believed at once.

Where few lines bear the tilt, or faint ones, each frame leaves it open. A tilt that they mistake stays the same for
seconds, that of a robot that rocks does not: so its scatter, over what each frame is known to, tells the two apart,
before frames tell a prior.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from ceilvo.robust import MAD_TO_SIGMA, leave_one_out
from ceilvo.types import Array, Lines

_MEMORY_FRAMES = 45.0
"""Frames that mean and spread are taken over: 1.5 s at 30 Hz; chosen: shorter is noisier, longer lags a new floor."""
_MIN_WEIGHT = 15
"""Sum of weights before there is a prior; chosen: a spread of two unknowns from fewer frames is a guess."""
_SPREAD_FACTOR = 2.0
"""On the variance that the frames showed; chosen: one rocking further than lately is still likely."""
_FAIR_SIGMA_RAD = np.radians(0.1)
"""A frame that knows the tilt to this counts half; chosen: one lamp counts for little (test_line_detection.py)."""
_FLOOR_RAD = np.radians(0.0005)
"""Least standard deviation of a prior; chosen: 0.02 mm on a ceiling 2.2 m high; 0 would be certainty."""
_WEAK_RAD = np.radians(0.014)
"""A tilt known to this has its error doubled, a weaker one more; chosen: with few lines tilt rests on
what no noise model knows, such as bloom of lamps and remains of the lens."""
_WEAK_ROCKING_RAD = 2.0 * _WEAK_RAD
"""The same of faint joints over a robot that rocks, measured: a tilt's squared error is .05 to 1.1 of its variance then
in 15 of 17 conditions. Edges of lamps keep more: what two of them mistake is wrong by more."""
_LONG = 0.5
"""Tangent of the angle over which a line is seen that bears a tilt by its ends; measured, medians: sides of hexagons,
which are off by up to four times as much, .2 and .4, lines of six other ceilings .7 to 1.4."""
_APART_CHI2 = 4.61
"""Squared distance of a tilt by whole lines from that by pieces from which on the former is in doubt: 90 % of
chi-square with 2 degrees of freedom."""
SIDE_BY_SIDE = 0.06
"""Tangent of the angle between lines from which on each is mistaken by itself; edges of a strip lamp are closer (12 cm,
2.2 m up). Measured: .04 to .08 do alike (seeds 217 to 242); without, two edges of one lamp, bent alike, bear each other
out (drawn-4 of seed 217)."""
PIECES_FACTOR = 4.0
"""On the variance of a tilt by lines that end at their gaps: twice the error, as of weak ones; chosen."""
HELD_RAD = np.radians(0.02)
"""Reported for a tilt that is held level; chosen: below what a frame with few lines could tell, above 0."""
TILT_CHI2 = 9.21
"""Frame and prior, or frame and a level robot, disagree beyond this: 99 % of chi-square with 2 degrees of freedom."""
_MANY_LINES, _OF_EACH = 3.0, 2.0
"""Lines that bear a tilt, from which on it is off by so many times what noise and leaving out each of them say, at
most. Measured over 6 to 8 s of 21 conditions (seeds 217 to 242, and draws): where three to nine lines bear it, 90 % of
errors are at most .67 of that, the largest 1.8. Measured of two lines: one frame in ten is off by 6 times as much below
hexagons, by 19 below strip lamps over a robot that rocks."""
_STEADY_RAD = np.radians(0.1)
"""A robot whose prior is narrower than this does not rock; chosen: frames with many lines know the tilt better."""
_NOTHING = 1e-12
"""Not to divide by 0."""
_ANY_TILT_RAD = 1.0
"""No tilt's standard deviation grows beyond that: it is not known at all, and of squares that are larger a prior leaves
rounding errors, which may be negative."""

_LATELY, _FEWEST_LATELY = 20, 5
"""Frames whose tilts' scatter tells a robot that rocks while none of them tells its tilt: 0.7 s at 30 Hz; and from how
many on it says to what a tilt is known that is held; chosen."""
TELLS_RAD = np.radians(17.0)
"""Frames that know the tilt worse do not count there: to 0.15 deg before it is widened; chosen."""
_CAPPED, _BEYOND = 9.0, 2.25
"""Mean square of how far tilts are off their median, over what each is known to, each capped, from which on their
scatter is not noise: that of 20 pairs of normal numbers is less in 99.9 %. Measured, medians of 4 to 12 s: .02 to .9 of
level robots (seeds 221, 240 and 241; 2.4 and 3.0 at most), .3 to 1.5 of one that stands below photographs, of robots
that rock by 2 deg 3.3 to 6.6 where their lines tell it (faint-3 221, faint-2 225, bare 241, drawn-3 and 13 of 233)."""
_ROCKS_RAD = np.radians(0.2)
"""Scatter from which on a robot rocks. Measured (seeds 217 to 224, median of all frames): .35 to .52 deg of robots that
rock by 2 deg; .05 to .07 of level ones below two lamps, plaster, hexagons and strip lamps."""


@dataclass(frozen=True, slots=True)
class TiltPrior:
    """Rotation about base x and y: mean_rad (2,) with standard deviations sigma_rad (2,)."""

    mean_rad: Array
    sigma_rad: Array


@dataclass(frozen=True, slots=True)
class Borne:
    """How lines bear a tilt about the axis about which it is known least: how many do, of as much weight each and none
    beside another; and how far it moves without each of them, over noise."""

    lines: float
    apart: float

    @property
    def by_many(self) -> bool:
        """Whether they are so many that leaving out each tells how far off it is."""
        return self.lines >= _MANY_LINES

    @staticmethod
    def by(model: Array, line: NDArray[np.int32], before: Array, length: Array, part_of: NDArray[np.int64]) -> Borne:
        """Of the points (P,) of lines (N,).

        Args:
            model: (P, 4) what each is off its line by, and what psi and tilt add to that, over its standard deviation.
            line: (P,) of each.
            before: (3, 3) what is known of psi and tilt beforehand, rad^-2.
            length: (N,) how long lines seem, tangents of angles.
            part_of: (N,) number of what each is part of, with others that are mistaken alike.
        """
        n, part = int(part_of.max()) + 1, part_of[line]
        longest = np.zeros(n)
        np.maximum.at(longest, part_of, length)
        products = [np.bincount(part, model[:, i] * model[:, j], n) for i in range(4) for j in range(4)]
        sums: Array = np.stack(products, axis=1).reshape(n, 4, 4).astype(np.float64)
        normal = sums[:, 1:, 1:] + before / n
        cov = np.linalg.inv(np.sum(normal, axis=0))
        variance, axes = np.linalg.eigh(cov[1:, 1:])
        least_known = axes[:, -1]
        by = cov[:, 1:] @ least_known
        share = np.einsum("i,nij,j->n", by, normal, by) / variance[-1]
        lines = float(np.sum(share[longest > _LONG])) ** 2 / max(float(np.sum(share**2)), _NOTHING)
        if lines < _MANY_LINES:
            return Borne(lines, 0.0)
        moved = least_known @ leave_one_out(normal, -sums[:, 1:, 0])[1:, 1:] @ least_known
        return Borne(lines, math.sqrt(float(moved) / float(variance[-1])))


UNKNOWN = Borne(0.0, 0.0)


@dataclass(frozen=True, slots=True)
class Lately:
    """Tilts of the last frames while none of them tells it: scatter, rad, and (2,) what they are about, 0 and None
    where too few are known; and (2,) how a level robot seems to lean, from the first on, None where it may not."""

    scatter_rad: float = 0.0
    about_rad: Array | None = None
    level_rad: Array | None = None

    def usual_rad(self, last_rad: Array) -> Array:
        """(2,) what is no tilt: level; but what lines show all the time where the last frame, of tilt last_rad (2,),
        was held level. Seams that are not parallel lean every frame by as much; believed now and then, it is a step."""
        held = float(np.max(np.abs(last_rad))) < HELD_RAD
        return self.level_rad if held and self.level_rad is not None else np.zeros(2)


NOTHING_LATELY = Lately()


@dataclass(slots=True)
class TiltState:
    """The tilt about base x and y in the frames so far.

    Attributes:
        weight: sum of the frames' weights, each at most 1.
        mean_rad, var_rad2: (2,) of the single-frame estimates.
        noise_var_rad2: (2,) the part of var_rad2 that is the estimates' own error.
        lately, claimed: (N, 2) rad, the last single-frame estimates while there is no prior, and to what each is known;
            forgotten where a state of a version before does not say that.
    """

    weight: float = 0.0
    mean_rad: Array = field(default_factory=lambda: np.zeros(2))
    var_rad2: Array = field(default_factory=lambda: np.zeros(2))
    noise_var_rad2: Array = field(default_factory=lambda: np.zeros(2))
    lately: Array = field(default_factory=lambda: np.zeros((0, 2)))
    claimed: Array = field(default_factory=lambda: np.zeros((0, 2)))

    def __post_init__(self) -> None:
        if len(self.claimed) != len(self.lately):
            self.lately, self.claimed = np.zeros((0, 2)), np.zeros((0, 2))


class TiltTracker:
    """Mean and spread of the tilt over about the last 45 frames, freed of the estimates' own noise."""

    def __init__(self, state: TiltState | None = None) -> None:
        self.state = TiltState() if state is None else state

    def update(self, lines: Lines) -> None:
        """Take in the tilt of one frame alone; an uncertain one counts little."""
        s, noise = self.state, lines.free_tilt_sigma_rad**2
        weight = 1.0 / (1.0 + float(np.max(noise)) / _FAIR_SIGMA_RAD**2)
        if s.weight < _MIN_WEIGHT and float(np.max(lines.free_tilt_sigma_rad)) < TELLS_RAD:
            s.lately = np.vstack([s.lately[1 - _LATELY :], lines.free_tilt_rad])
            s.claimed = np.vstack([s.claimed[1 - _LATELY :], lines.free_tilt_sigma_rad])
        s.weight += weight
        rate = weight * max(1.0 / _MEMORY_FRAMES, 1.0 / max(s.weight, 1.0))
        off = lines.free_tilt_rad - s.mean_rad
        s.mean_rad = s.mean_rad + rate * off
        s.var_rad2 = (1.0 - rate) * (s.var_rad2 + rate * off**2)
        s.noise_var_rad2 = s.noise_var_rad2 + rate * (noise - s.noise_var_rad2)

    def prior(self) -> TiltPrior | None:
        """For the next frame; None until enough was seen."""
        s = self.state
        if s.weight < _MIN_WEIGHT:
            return self._of_rocking()
        own_var_rad2 = np.maximum(s.var_rad2 - s.noise_var_rad2, 0.0)
        mean_var_rad2 = s.noise_var_rad2 / min(s.weight, _MEMORY_FRAMES)
        return TiltPrior(s.mean_rad, np.sqrt(_SPREAD_FACTOR * own_var_rad2 + mean_var_rad2 + _FLOOR_RAD**2))

    def lately(self, beyond_noise: bool) -> Lately:
        """What a tilt that is held level may be; beyond_noise: no scatter where what each frame is known to explains
        it."""
        s = self.state
        if s.weight >= _MIN_WEIGHT or not len(s.lately):
            return NOTHING_LATELY
        scatter_rad = self.scatter_beyond_noise_rad() if beyond_noise else self.scatter_rad()
        about_rad = np.median(s.lately, axis=0)
        level_rad = about_rad if _may_be_level(s.lately, s.claimed) else None
        return Lately(scatter_rad, about_rad if len(s.lately) >= _FEWEST_LATELY else None, level_rad)

    def scatter_rad(self) -> float:
        """Of the tilt in the last frames while none of them tells it: what it may be where it is held; 0 before."""
        lately = self.state.lately
        if self.state.weight >= _MIN_WEIGHT or len(lately) < _FEWEST_LATELY:
            return 0.0
        return float(np.max(_scatter(lately)))

    def scatter_beyond_noise_rad(self) -> float:
        """The same, 0 where what each frame is known to explains it: seams that are not parallel tell a tilt so badly
        that noise of a grey level turns it by .3 deg, below a robot that stands (ceiling_still)."""
        s = self.state
        scatter_rad = self.scatter_rad()
        if not scatter_rad:
            return 0.0
        off2 = ((s.lately - np.median(s.lately, axis=0)) / s.claimed) ** 2
        told = np.mean(np.minimum(off2, _CAPPED), axis=0) >= _BEYOND
        return scatter_rad if np.any(told) else 0.0

    def _of_rocking(self) -> TiltPrior | None:
        """By frames that each leave the tilt open; None where they may be of a level robot."""
        s = self.state
        if len(s.lately) < _LATELY or (scatter_rad := self.scatter_beyond_noise_rad()) < _ROCKS_RAD:
            return None
        middle = np.median(s.lately, axis=0)
        return TiltPrior(np.zeros(2), np.sqrt(_SPREAD_FACTOR * scatter_rad**2 + middle**2))


def _may_be_level(tilts_rad: Array, claimed_rad: Array) -> bool:
    """Of tilts (N, 2): their mean, weighed by what each is known to, which is known no better than one of them: what
    lines mistake is the same in all."""
    information = np.mean(claimed_rad**-2.0, axis=0)
    mean_rad = np.mean(tilts_rad * claimed_rad**-2.0, axis=0) / information
    return float(np.sum(mean_rad**2 * information)) <= TILT_CHI2


def _scatter(tilts_rad: Array) -> Array:
    """(2,) of tilts (N, 2) about their median."""
    off = np.abs(tilts_rad - np.median(tilts_rad, axis=0))
    return np.asarray(MAD_TO_SIGMA * np.median(off, axis=0))


def rocks(prior: TiltPrior | None) -> bool:
    """Whether the robot has tilted lately."""
    return prior is not None and float(np.max(prior.sigma_rad)) >= _STEADY_RAD


def is_weak(covariance: Array) -> bool:
    """Whether so much more than noise may be in a tilt's error that it is worth while to look at each line."""
    return bool(np.max(covariance[[1, 2], [1, 2]]) > _WEAK_RAD**2)


def widened(covariance: Array, rocking: bool = False, borne: Borne = UNKNOWN) -> Array:
    """(3, 3) of psi and tilt, with what few lines do not show of the tilt's error; rocking: of a robot that does."""
    weak_rad = _WEAK_ROCKING_RAD if rocking else _WEAK_RAD
    own = covariance[[1, 2], [1, 2]]
    most = np.maximum(_ANY_TILT_RAD / np.sqrt(own), 1.0)
    grow = np.append(1.0, np.minimum(1.0 + own / weak_rad**2, most))
    if borne.by_many:
        grow = np.minimum(grow, _OF_EACH * math.hypot(1.0, borne.apart))
    return np.asarray(covariance * grow * grow[:, None])


def is_tilt(tilt_rad: Array, covariance: Array) -> bool:
    """Whether a robot as level as floors are would hardly show that; covariance: (3, 3) of psi and tilt."""
    level = covariance[1:, 1:] + HELD_RAD**2 * np.eye(2)
    return float(tilt_rad @ np.linalg.solve(level, tilt_rad)) > TILT_CHI2


def are_apart(off_rad: Array, covariance: Array) -> bool:
    """Whether a tilt by whole lines, from which one by pieces is off by (2,), is in doubt; covariance: (3, 3) of
    the latter, with psi."""
    return float(off_rad @ np.linalg.solve(covariance[1:, 1:], off_rad)) > _APART_CHI2
