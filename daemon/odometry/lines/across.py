"""Motion across lines that do not cross: along them nothing is seen, and the covariance says so.

Lines are laid on those of an earlier view, the key, for as long as both show the same, so errors do not add up from
frame to frame. Lines that repeat are told apart by the prediction, or not at all.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from ceilvo import se2
from ceilvo.crossing_types import CeilingLines
from ceilvo.daemon.odometry.lines.direction import turn_by_lines
from ceilvo.daemon.odometry.lines.through import LINE_M, numbered
from ceilvo.robust import MAD_TO_SIGMA, median
from ceilvo.types import Array, Crossings, Displacement, Ints, Motion

_REACH_SIGMAS = 4.0
"""How far from where they are predicted lines are looked for; a normal error is beyond once in 16,000."""
_TOGETHER_M, _TOGETHER_SIGMAS = 0.002, 4.0
"""Lines move alike within this, or so many standard deviations of theirs; chosen: an edge that is seen in place of the
one beside it is off by a centimetre."""
_RIVAL = 0.5
"""A displacement under which so many lines meet, of those that do at the best one, puts that in doubt; chosen, as for
points."""
_RIVAL_CHI2 = 18.4
"""By which a rival's squared distance from the prediction must be the larger one: e^-9.2, once in 10,000."""
_FEWEST = 2
"""Joints that must move alike; edges nearer than LINE_M are of one. A single one may have been taken for another."""
_MEET = 1.0 / 3.0
"""Least part of the lines of the view that shows fewer; chosen, as of crossings."""
_MOST = 64
"""Lines of a view that are laid on the other one's; chosen for time: open cells show more, and cross."""
_BLURRED = 3.0
"""Times their own standard deviation by which the lines of a view lie beside the key's, half of them, where a turn has
doubled them; chosen: noise does not."""
_ARM_M = 1.0
"""Distance at which a turn leaves lines as far apart as blur has them: so vague is their direction; chosen: half
of a view."""
_RENEWED = 0.5
"""The key gives way to a view of which it shows less; chosen: the rest goes out of view next."""


@dataclass(slots=True)
class AcrossState:
    """
    Attributes:
        key: the view that lines are laid on; None before the first with lines.
        at: (3,) key_from_prev; cov: (3, 3) of it, small across lines that both show.
        told: (K, 2) normals, in base in the previous frame, of lines that told the motion over told_s, told_ago_s
            before it.
        by_chance: probability that lines meet so well on the way to another place.
        since_s: time from the key to the previous frame.
    """

    key: Crossings | None = None
    at: Array = field(default_factory=lambda: np.zeros(3))
    cov: Array = field(default_factory=lambda: np.zeros((3, 3)))
    told: Array = field(default_factory=lambda: np.zeros((0, 2)))
    told_s: float = 0.0
    told_ago_s: float = 0.0
    by_chance: float = 1.0
    since_s: float = 0.0

    def on(self, key: Crossings) -> AcrossState:
        """The same motion, with the previous frame as the key."""
        return AcrossState(key, told=self.told, told_s=self.told_s, told_ago_s=self.told_ago_s)

    @property
    def fresh(self) -> bool:
        """Whether lines told the previous frame's motion."""
        return len(self.told) > 0 and self.told_s > 0.0 and self.told_ago_s == 0.0

    def met(self, shifts: list[_Shift], there: Array, cov: Array, dt_s: float) -> None:
        """A view, dt_s after the last one, is there (3,), with a covariance (3, 3)."""
        unbroken = self.fresh or self.since_s == 0.0
        chance = math.prod(shift.by_chance for shift in shifts)
        self.by_chance = chance**2 if unbroken else chance  # a hand takes several frames from one place to another
        if shifts:
            self.told, self.told_s, self.told_ago_s = np.array([shift.normal for shift in shifts]), dt_s, 0.0
            turned_rad = float(there[2])
        else:
            self.told_ago_s += dt_s
            turned_rad = float(there[2] - self.at[2])
        self.told = self.told @ se2.rotation(turned_rad)
        self.at, self.cov, self.since_s = there, cov, self.since_s + dt_s


@dataclass(frozen=True, slots=True)
class _Shift:
    """How far the robot moved along a normal (2,) in the key's axes beyond its prediction, the variance of where that
    leaves it, what lines that blur has doubled add to it, which err together, the part of the view's joints that say
    so, and the probability that they do by chance."""

    normal: Array
    beyond_m: float
    var_m2: float
    blur_m2: float
    share: float
    by_chance: float


@dataclass(frozen=True, slots=True)
class _Parallels:
    """Lines along one axis: (L,) offsets and their standard deviations, m, kinds, and which of them are one joint's."""

    offset_m: Array
    sigma_m: Array
    kind: Ints
    joint: Ints

    @staticmethod
    def of(lines: CeilingLines, axis: int, quarters: int = 0) -> _Parallels:
        """Of a view whose axes are named so many quarter turns further."""
        which = np.flatnonzero((lines.axis + quarters) % 2 == axis)[:_MOST]
        sign = np.where((lines.axis[which] + quarters) % 4 > 1, -1, 1)
        which, sign = (a[np.argsort(sign * lines.offset_m[which], kind="stable")] for a in (which, sign))
        offset_m = sign * lines.offset_m[which]
        return _Parallels(offset_m, lines.sigma_m[which], sign * lines.kind[which], numbered(offset_m) - 1)

    @property
    def joints(self) -> int:
        return int(self.joint[-1]) + 1 if len(self.joint) else 0


def across(
    s: AcrossState, predicted: Motion, step_cov: Array, crossings: Crossings | None, gate_rad: float, dt_s: float
) -> Motion:
    """A prediction with the motion across lines, where the view's tell it; the state moves on to this view.

    Args:
        predicted: since the previous frame, turned as lines say; step_cov: (3, 3) of that step by itself.
        crossings: None: nothing is seen.
        gate_rad: by which the direction of the lines may be off the prediction, beside its error.
    """
    moved, cov = predicted.prev_from_curr, predicted.cov
    there, there_cov = se2.compose(s.at, moved), se2.compose_cov(s.at, s.cov, moved, step_cov)
    shifts = _shifts(s.key, crossings, there, there_cov, gate_rad)
    to_prev = se2.rotation(-float(s.at[2]))
    for shift in shifts:
        n, before_m2 = to_prev @ shift.normal, float(shift.normal @ s.cov[:2, :2] @ shift.normal)
        moved = moved + np.append(shift.beyond_m * n, 0.0)
        # of the key's lines, not of every step's
        cov = with_variance(cov, n, max(shift.var_m2 - before_m2, 0.0) + shift.blur_m2)
        cov[2, 2] += shift.blur_m2 / _ARM_M**2
        there = there + np.append(shift.beyond_m * shift.normal, 0.0)
        there_cov = with_variance(there_cov, shift.normal, shift.var_m2)
    s.met(shifts, there, there_cov, dt_s)
    if max((shift.share for shift in shifts), default=0.0) < _RENEWED and _lines_of(crossings) is not None:
        s.key, s.at, s.cov, s.since_s = crossings, np.zeros(3), np.zeros((3, 3)), 0.0
    return replace(predicted, prev_from_curr=Displacement(moved), cov=cov)


def _lines_of(view: Crossings | None) -> CeilingLines | None:
    """Those that tell a direction, to lay others on or on others."""
    lines = None if view is None or not view.directed else view.lines
    return None if lines is None or not len(lines.axis) else lines


def slid(s: AcrossState, twist: Array, motion: Motion) -> Array:
    """A twist (3,) with its part across lines as they told it in this motion."""
    if not s.fresh:
        return twist
    off = se2.rotation(-float(motion.prev_from_curr[2])) @ motion.prev_from_curr[:2] / s.told_s - twist[:2]
    return np.append(twist[:2] + s.told.T @ (s.told @ off), twist[2])


def as_told(
    s: AcrossState, moved: Displacement, cov: Array, steady: Displacement, steady_cov: Array
) -> tuple[Displacement, Array]:
    """A prediction (3,) with its covariance (3, 3); across lines that told the motion, where that goes on (3,) with
    covariance (3, 3)."""
    for n in s.told:
        moved = Displacement(moved + np.append(n * (n @ (steady - moved)[:2]), 0.0))
        cov = with_variance(cov, n, float(n @ steady_cov[:2, :2] @ n))
    return moved, cov


def with_variance(cov: Array, normal: Array, var_m2: float) -> Array:
    """A covariance (3, 3) with what is known along a normal (2,) in place of what it says there."""
    rest = np.eye(3)
    rest[:2, :2] -= np.outer(normal, normal)
    out = rest @ cov @ rest
    out[:2, :2] += var_m2 * np.outer(normal, normal)
    return np.asarray(out)


def _shifts(
    key: Crossings | None, crossings: Crossings | None, there: Array, cov: Array, gate_rad: float
) -> list[_Shift]:
    """Along each axis of the key of which lines tell; there: (3,) key_from_curr as predicted, with cov (3, 3)."""
    before, seen = _lines_of(key), _lines_of(crossings)
    if key is None or crossings is None or before is None or seen is None:
        return []
    turn = turn_by_lines(key.psi_rad, crossings.psi_rad, float(there[2]), float(cov[2, 2]), gate_rad)
    if turn is None:
        return []
    quarters = round((crossings.psi_rad + turn - key.psi_rad) / (0.5 * math.pi))
    back = se2.rotation(turn)
    common = key.common_cov_m2 + back @ crossings.common_cov_m2 @ back.T
    found = []
    for axis in (0, 1):
        normal = se2.rotation(key.psi_rad + axis * 0.5 * math.pi)[:, 0]
        then, now = _Parallels.of(before, axis), _Parallels.of(seen, axis, quarters)
        sigma_m = math.sqrt(max(float(normal @ cov[:2, :2] @ normal), 0.0))
        common_m2 = float(normal @ common @ normal)
        if (met := _met(then, now, normal, float(normal @ there[:2]), sigma_m)) is not None:
            found.append(replace(met, var_m2=met.var_m2 + common_m2))
    return found


def _met(then: _Parallels, now: _Parallels, normal: Array, predicted_m: float, sigma_m: float) -> _Shift | None:
    """How far lines moved along a normal that were predicted to move so far, to sigma_m; None where too few did, or
    they may have moved otherwise. The variance is without what an error of the tilt adds."""
    fewest = max(_FEWEST, _MEET * min(then.joints, now.joints))
    if min(then.joints, now.joints) < _FEWEST:
        return None
    beyond = then.offset_m[:, None] - now.offset_m - predicted_m
    var = then.sigma_m[:, None] ** 2 + now.sigma_m**2
    within_m = np.maximum(_TOGETHER_M, _TOGETHER_SIGMAS * np.sqrt(var))
    beyond[then.kind[:, None] != now.kind] = np.inf
    ways = beyond[np.abs(beyond) < _REACH_SIGMAS * sigma_m + within_m]
    if not len(ways):
        return None
    agree = np.any(np.abs(beyond - ways[:, None, None]) < within_m, axis=1)  # (K, L) of the view
    joints = np.count_nonzero(agree @ np.eye(now.joints)[now.joint] > 0.0, axis=1)
    chi2 = (ways / max(sigma_m, _TOGETHER_M)) ** 2
    best = int(np.argmax(joints - chi2 / _RIVAL_CHI2))
    rival = (joints >= _RIVAL * joints[best]) & (np.abs(ways - ways[best]) > 2.0 * np.max(within_m))
    if joints[best] < fewest or np.any(chi2[rival] - chi2[best] < _RIVAL_CHI2):
        return None
    apart_m = (now.offset_m[-1] - now.offset_m[0]) / (now.joints - 1)
    reach_m = _REACH_SIGMAS * sigma_m + float(np.median(within_m))
    chance, share = min(2.0 * reach_m / apart_m, 1.0), float(joints[best]) / now.joints
    return _Shift(normal, *_measured(beyond, var, agree[best], ways[best]), share, chance)


def _measured(beyond: Array, var: Array, met: NDArray[np.bool_], way_m: float) -> tuple[float, float, float]:
    """The mean of what lines (L,) that met say, its variance, and what blur adds to that.

    Args:
        beyond, var: (K, L) shift of each line of the view from each of the key's, and its variance.
        way_m: the shift at which most meet.
    """
    which = np.arange(beyond.shape[1])
    nearest = np.argmin(np.abs(beyond - way_m), axis=0)
    off, var = beyond[nearest, which], var[nearest, which]
    beside, weight = np.abs(off - way_m) < LINE_M, 1.0 / var[met]
    mean = float(np.average(off[met], weights=weight))
    spread = float(np.sum(weight * (off[met] - mean) ** 2)) / max(len(weight) - 1, 1)
    scatter_m2 = (MAD_TO_SIGMA * median(np.abs(off[beside] - mean))) ** 2
    blur_m2 = scatter_m2 if scatter_m2 > _BLURRED**2 * median(var[beside]) else 0.0
    return mean, max(spread, 1.0) / float(np.sum(weight)), blur_m2
