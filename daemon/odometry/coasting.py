"""Prediction without vision: the last twist fades, and what is not known of it grows.

A robot that nobody watches may stop, speed up or turn. Its twist is then off by an unknown constant acceleration, until
it is off by as much as twists of such a robot differ at all.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from itertools import pairwise

import numpy as np

from ceilvo import se2
from ceilvo.config import Odometry
from ceilvo.daemon.vision.rolling_shutter import TwistPrior
from ceilvo.types import Array, Displacement, WheelMotion

_DECAY_S = 1.0
"""Time constant of the twist while vision is out; chosen: a robot that hears that its pose is bad stops in about it."""
_SPREAD = 1.0 / 6.0
"""Standard deviation of the twist after a while, over the largest plausible one; chosen: robots drive at half of that,
and what their last twist, fading, does not explain is a third of it."""
_CURVATURE_PM = 1.2
"""Standard deviation of a path's curvature: half of a corner's of 0.4 m radius; chosen."""
_CURVATURE_RATE_PM2 = 4.0
"""The same of its change in a metre: in that corner, eased over 0.4 m, it is 10 at most; chosen. It lets a fast robot
turn more abruptly than a slow one."""
_SPIN_PS = 3.0
"""By which the angular acceleration grows with the turn rate: a robot that turns stops turning within a few tenths of a
second; chosen."""
_ACCEL_PM = 0.5
"""By which the acceleration grows with the square of the speed, for a robot that is seen to be fast can do more:
0.7 m/s^2 at 1.2 m/s; chosen."""
_STEP_S = 0.1
"""Longest step of which the covariance is linear in the heading; chosen."""
_SMALL_S = 1e-6
"""A step is not divided because it is longer by less: stamps are whole nanoseconds."""
_TWIST_SIGMA = np.array([0.005, 0.005, 0.006])
"""[m/s, m/s, rad/s] of the next frame's twist when it did not change lately; chosen: a steady drive differs
by less, and what lamps and lens do to lines looks like 0.007 rad/s (docs/method.md)."""
_TWIST_LATE = 1.5
"""Steps from the middle of the last one to the next frame: its twist goes on changing as in the last, or does not."""
_SMALL_RAD = 1e-9
"""An arc that turns by less is straight."""
_RECENT = 3
"""Twists of which the median goes on: one view that is mistaken makes two of them wrong, to either side."""
_OF_MEDIAN = 0.449
"""Variance of a median of three over that of one of them, where they are normal."""


@dataclass(frozen=True, slots=True)
class LastTwist:
    """A twist (3,) [m/s, m/s, rad/s], the mean over span_s, which ended since_s ago; span_s None: it is not known.

    var: (3,) of its measurement.
    """

    twist: Array
    span_s: float | None
    since_s: float
    var: Array = field(default_factory=lambda: np.zeros(3))


@dataclass(frozen=True, slots=True)
class RecentTwists:
    """What the last views in a row said, K of them at most: twists (K, 3) with variances (K, 3), over spans (K,)."""

    twists: Array = field(default_factory=lambda: np.zeros((0, 3)))
    var: Array = field(default_factory=lambda: np.zeros((0, 3)))
    span_s: Array = field(default_factory=lambda: np.zeros(0))

    def then(self, twist: Array, var: Array, span_s: float) -> RecentTwists:
        """With one more (3,), which was measured with a variance (3,)."""
        keep = slice(1 - _RECENT, None)
        return RecentTwists(
            np.concatenate([self.twists[keep], twist[None]]),
            np.concatenate([self.var[keep], var[None]]),
            np.append(self.span_s[keep], span_s),
        )

    def turning(self, radps: float) -> RecentTwists:
        """With a turn that lines told since."""
        twists, var = self.twists.copy(), self.var.copy()
        twists[:, 2], var[:, 2] = radps, 0.0
        return replace(self, twists=twists, var=var)

    def median(self, since_s: float) -> LastTwist:
        """What goes on since_s after the last of them; there is one at least."""
        if len(self.twists) == _RECENT:
            var = _OF_MEDIAN * np.sort(self.var, axis=0)[_RECENT // 2]
            twist = np.sort(self.twists, axis=0)[_RECENT // 2]
        else:  # where the first two differ, either may be mistaken
            var = np.max(self.var, axis=0) + (self.twists[-1] - self.twists[0]) ** 2
            twist = self.twists[-1]
        return LastTwist(twist, float(np.sum(self.span_s)), since_s, var)


@dataclass(frozen=True, slots=True)
class KnownTurn:
    """What a gyro says of the heading while nothing else is known of the motion."""

    turned_rad: float
    var_rad2: float


def coast(config: Odometry, last: LastTwist, dt_s: float, turn: KnownTurn | None = None) -> tuple[Displacement, Array]:
    """prev_from_curr (3,) over the next dt_s, with its covariance (3, 3); a turn that is known replaces the twist's.

    The covariance is its share of what has been unknown since the twist was measured: those of a gap's steps add up to
    the whole, for the acceleration is the same in all of them.
    """
    steps = max(math.ceil(dt_s / _STEP_S - _SMALL_S), 1)
    ends_s = np.linspace(last.since_s, last.since_s + dt_s, steps + 1).tolist()
    part = None if turn is None else KnownTurn(turn.turned_rad / steps, turn.var_rad2 / steps)
    moved, cov = _arc(last.twist, ends_s[0], ends_s[1], part), _cov(config, last, ends_s[0], ends_s[1], part)
    for start_s, end_s in pairwise(ends_s[1:]):
        step, step_cov = _arc(last.twist, start_s, end_s, part), _cov(config, last, start_s, end_s, part)
        moved, cov = se2.compose(moved, step), se2.compose_cov(moved, cov, step, step_cov)
    return Displacement(moved), cov


def goes_on_turning(config: Odometry, last: LastTwist, dt_s: float) -> KnownTurn:
    """The turn of the next dt_s as it was in the last frame, whose lines told it though no motion was measured."""
    moved, cov = coast(config, last, dt_s)
    return KnownTurn(float(moved[2]), float(cov[2, 2]))


def twist_prior(
    last: Array, change: Array, dt_s: float, wheels: WheelMotion | None, turn: KnownTurn | None
) -> TwistPrior:
    """By wheels, or as the eye last saw it, with the turn that a gyro tells.

    Args:
        last: (3,) [m/s, m/s, rad/s] of the last step, and by how much that differed from the one before: change (3,).
    """
    if wheels is not None:
        mean = se2.mean_twist(wheels.prev_from_curr, dt_s)
        return TwistPrior(mean, _TWIST_SIGMA + np.abs(mean - last))
    late = _TWIST_LATE * change
    if turn is not None:
        last, late = np.append(last[:2], turn.turned_rad / dt_s), np.append(late[:2], 0.0)
    return TwistPrior(last + late, _TWIST_SIGMA + np.abs(late))


def _arc(twist: Array, start_s: float, end_s: float, turn: KnownTurn | None) -> Array:
    """The way of a twist that fades, but for a turn that is known."""
    vx, vy, w = (twist * (_lasts(end_s) - _lasts(start_s))).tolist()
    w = w if turn is None else turn.turned_rad
    if abs(w) < _SMALL_RAD:
        return np.array([vx, vy, w])
    along, across = math.sin(w) / w, (1.0 - math.cos(w)) / w
    return np.array([along * vx - across * vy, across * vx + along * vy, w])


def accelerations(config: Odometry, twist: Array) -> tuple[float, float]:
    """Standard deviations of a robot's acceleration, m/s^2 along each axis, and rad/s^2, at a twist (3,)."""
    vx, vy, w = twist.tolist()
    speed = math.hypot(vx, vy)
    accel = math.hypot(config.coast_accel_mps2, _ACCEL_PM * speed**2)
    return accel, math.hypot(config.coast_turn_radps2, _CURVATURE_RATE_PM2 * speed**2, _SPIN_PS * w)


def _cov(config: Odometry, last: LastTwist, start_s: float, end_s: float, known: KnownTurn | None) -> Array:
    speed, (accel, turn_accel) = math.hypot(*last.twist[:2].tolist()), accelerations(config, last.twist)
    turn = math.hypot(_SPREAD * config.max_turn_radps, _CURVATURE_PM * speed)
    xy, theta = (accel, _SPREAD * config.max_speed_mps, last.span_s), (turn_accel, turn, last.span_s)
    var_xy, var_theta = (_off(*a, end_s) ** 2 - _off(*a, start_s) ** 2 for a in (xy, theta))
    measured = last.var * (_lasts(end_s) ** 2 - _lasts(start_s) ** 2)
    var_theta += measured[2]
    return np.diag([var_xy + measured[0], var_xy + measured[1], var_theta if known is None else known.var_rad2])


def _lasts(t_s: float) -> float:
    """For how long, at its first value, a twist that fades has lasted after t_s."""
    return _DECAY_S * (1.0 - math.exp(-t_s / _DECAY_S))


def _off(accel: float, most: float, span_s: float | None, t_s: float) -> float:
    """Standard deviation of the way after t_s: the integral of a twist's error that grows from accel * span / 2 on."""
    if span_s is None:
        return most * t_s
    growing_s = min(max(most / accel - 0.5 * span_s, 0.0), t_s)
    return 0.5 * accel * growing_s * (growing_s + span_s) + most * (t_s - growing_s)
