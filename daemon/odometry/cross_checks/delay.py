"""By how much pictures come later than wheels, from the shape of speed and turn rate over time.

For every lag on a raster: how badly do the wheels' increments, so much earlier, predict the eye's? A lag is known where
that is curved, so only speeding up, braking and turning tell. At a steady speed the wheels' noise is less half a frame
between their samples, which would add up to a lag: such parts tell nothing and are left out. What a stretch tells is
one estimate; two in a row that agree make the delay steady.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np

from ceilvo import se2
from ceilvo.config import Odometry
from ceilvo.daemon.odometry.coasting import LastTwist, coast
from ceilvo.daemon.odometry.cross_checks.paths import Paths
from ceilvo.daemon.odometry.senses.lag import vertex
from ceilvo.types import Array, Displacement, Motion

_STEP_S = 0.02
"""Of the raster; chosen: below a frame period, a parabola through three finds what lies between."""
_EARLIEST_S, _LATEST_S = -0.2, 0.6
"""Lags looked for; chosen: wheels that come late, through a slow line, and pictures through a slow driver."""
LAGS_S = np.arange(round(_EARLIEST_S / _STEP_S), round(_LATEST_S / _STEP_S) + 1) * _STEP_S
_REACH = 5
"""Of the parabola to either side, in steps: 0.1 s. Noise makes small dents, as wide as a frame period; chosen."""
_NOISE_M, _NOISE_RAD = 0.0005, 0.0007
"""Of one frame's increments besides the wheels' covariance; chosen: vision, and lines between the wheels' samples."""
_SHAPE_S = np.arange(_EARLIEST_S, _LATEST_S + _STEP_S, 0.1)
"""Where the eye's increments are compared with each other; chosen: a turn takes longer."""
_STEADY = 0.25
"""Squared difference, over its variance, of the eye's increments at those times, below which they tell no lag; chosen:
vision errs by a tenth of it, and .1 m/s2 makes .4 at 30 Hz."""
_MOST_NIS = 25.0
"""Of one increment; chosen: a slip is no reason for a lag."""
_SIGMA_S = 0.012
"""A stretch ends when the lag is known so well; chosen: 4 mm at 0.35 m/s."""
_FEWEST_TERMS = 60
"""Increments, of way and turn, that an estimate needs; chosen: 1 s at 30 Hz, fewer had errors far above their sigma."""
_LONGEST_STRETCH = 20000
"""Increments after which a stretch that tells nothing is begun anew; chosen: 10 min at 30 Hz."""
_AGREE_S = 0.04
"""Two estimates that agree; chosen: 3 sigma of their difference and a little for wheels that are no straight lines."""
_SMOOTHING = 0.15
"""Weight of a new estimate in a steady delay; chosen."""
NO_DELAY_S = 0.04
"""A shorter delay is none; chosen: four times the error of the mean of two estimates, and 1.4 cm at 0.35 m/s."""


@dataclass(slots=True)
class DelayState:
    """Evidence of the stretch under way, and what earlier ones found.

    Attributes:
        cost: (L,) for every lag the sum of squared normalised differences; terms: how many.
        estimate_s: of the last stretch; None before the first.
        steady_s: the delay that two stretches agreed on; None before.
    """

    cost: Array = field(default_factory=lambda: np.zeros(len(LAGS_S)))
    terms: int = 0
    estimate_s: float | None = None
    steady_s: float | None = None


class Delay:
    """Feed it every frame; it takes increments from the paths."""

    def __init__(self) -> None:
        self.state = DelayState()

    @property
    def known_s(self) -> float:
        """The steady delay of pictures, 0 where it is none or not known; negative where the wheels come late."""
        steady_s = self.state.steady_s
        return 0.0 if steady_s is None or abs(steady_s) < NO_DELAY_S else steady_s

    def told(self, delay_s: float | None) -> None:
        """Something else says what the delay is now; None: that it is not known."""
        self.state = DelayState(estimate_s=delay_s, steady_s=delay_s)

    def step(self, paths: Paths) -> None:
        """After a frame was added to the paths."""
        window = self._window(paths)
        if window is None:
            return
        s = self.state
        if _steady(paths, *window):
            return
        s.cost += _cost(paths, *window)
        s.terms += 2
        found = _minimum(s.cost, s.terms)
        if found is not None and found[1] < _SIGMA_S and s.terms >= _FEWEST_TERMS:
            self._ends(found[0])
        elif s.terms > _LONGEST_STRETCH:
            s.cost, s.terms = np.zeros(len(LAGS_S)), 0

    def _window(self, paths: Paths) -> tuple[float, float] | None:
        """The two times between which a frame's increment is compared: before it, so that early wheels are there."""
        t = paths.time_s
        if len(t) < 2:
            return None
        to_s, from_s = float(t[-1]) + _EARLIEST_S, float(t[-2]) + _EARLIEST_S
        first = int(np.searchsorted(t, from_s, side="right")) - 1
        if from_s - _LATEST_S < t[0] or first < 0:
            return None
        whole = np.all(paths.good[first:] > 0.0) and paths.piece[first] == paths.piece[-1]
        return (from_s, to_s) if whole else None

    def _ends(self, estimate_s: float) -> None:
        """A stretch's estimate: alone it counts for nothing."""
        s = self.state
        if s.estimate_s is not None and abs(estimate_s - s.estimate_s) < _AGREE_S:
            near = s.steady_s is not None and abs(estimate_s - s.steady_s) < _AGREE_S
            middle = 0.5 * (estimate_s + s.estimate_s)
            s.steady_s = (
                s.steady_s + _SMOOTHING * (estimate_s - s.steady_s) if near and s.steady_s is not None else middle
            )
        s.estimate_s, s.cost, s.terms = estimate_s, np.zeros(len(LAGS_S)), 0


def _steady(paths: Paths, from_s: float, to_s: float) -> bool:
    """Whether the eye moved alike all around one of its increments."""
    at_s = np.array([from_s, to_s])[:, None] - _SHAPE_S
    start, end = np.stack([np.interp(at_s, paths.time_s, column) for column in paths.eye.T], axis=-1)
    var_xy, var_turn = paths.wheel_variance(from_s, to_s)
    ahead, turned = _forward(start, end), (end - start)[:, 2]
    return bool(
        np.ptp(ahead) ** 2 < _STEADY * (var_xy + _NOISE_M**2)
        and np.ptp(turned) ** 2 < _STEADY * (var_turn + _NOISE_RAD**2)
    )


def _cost(paths: Paths, from_s: float, to_s: float) -> Array:
    """(L,) squared differences, over their variances, of one increment of the eye and the wheels' at every lag."""
    t, eye, wheels = paths.time_s, paths.eye, paths.wheels
    ends = np.array([from_s, to_s])
    seen = np.stack([np.interp(ends, t, column) for column in eye.T], axis=-1)
    told = np.stack([np.interp(ends[:, None] - LAGS_S, t, column) for column in wheels.T], axis=-1)  # (2, L, 3)
    var_xy, var_turn = paths.wheel_variance(from_s, to_s)
    forward = _forward(told[0], told[1]) - _forward(seen[0], seen[1])
    turned = (told[1] - told[0])[..., 2] - (seen[1] - seen[0])[2]
    nis_m, nis_rad = forward**2 / (var_xy + _NOISE_M**2), turned**2 / (var_turn + _NOISE_RAD**2)
    return np.asarray(np.minimum(nis_m, _MOST_NIS) + np.minimum(nis_rad, _MOST_NIS))


def _forward(start: Array, end: Array) -> Array:
    """(...) way ahead between rows (..., 3) of a path."""
    step = end - start
    return np.asarray(np.cos(start[..., 2]) * step[..., 0] + np.sin(start[..., 2]) * step[..., 1])


def _minimum(cost: Array, terms: int) -> tuple[float, float] | None:
    """Lag of the least cost and its standard deviation, s; None where it is at an end or flat.

    Differences that are larger than their variances say make it less certain; terms: how many there were.
    """
    least = vertex(cost, LAGS_S, _STEP_S, _REACH)
    return None if least is None else (least[0], math.sqrt(max(float(np.min(cost)) / terms, 1.0) / least[1]))


_ENDS_S = 600.0
"""Mean time until a delay that began with old pictures ends; chosen: a driver's queue stays as it is until it is
flushed."""
_STOPS = 1.0 / 8.0
"""Chance that a ring of old buffers stops after one round; chosen: it may stop after any of eight."""
_MOST_ODDS = 12.0
"""Log-odds of a delay are believed up to here; chosen."""
_LEAST_S = 1e-3
"""In place of a time that is none."""
_FEWEST_OLD = 2
"""Old pictures in their order that tell a delay; chosen: one alone is a picture that came twice."""


@dataclass(slots=True)
class RewoundState:
    """What the last frames left.

    Attributes:
        period, run: how many frames before each of the last pictures came, and how many of them were old.
        in_order: they came as they had come before.
        old_s, span_s: time of those, and since the last picture that was new.
        moved: (3,) since then.
        twist: (3,) of the last measured motion, the mean over twist_s; 0 where none was measured.
        odds: log-odds of pictures that come late by late_s against none.
    """

    period: int = 0
    run: int = 0
    in_order: bool = False
    old_s: float = 0.0
    span_s: float = 0.0
    moved: Array = field(default_factory=lambda: np.zeros(3))
    twist: Array = field(default_factory=lambda: np.zeros(3))
    twist_s: float = 0.0
    odds: float = -math.inf
    late_s: float = 0.0


class Rewound:
    """Pictures that come once more in their order, and then go on, come late from then on by the time that they took.

    A ring of old buffers that ends shows a robot that has moved on meanwhile; pictures that are late do not. So the
    motion since the last new picture is compared with what the robot's twist makes of either time.
    """

    def __init__(self, config: Odometry) -> None:
        self._config = config
        self.state = RewoundState()

    @property
    def late_s(self) -> float:
        """By which pictures come late; 0 while that is not the likelier."""
        return self.state.late_s if self.state.odds > 0.0 else 0.0

    @property
    def since(self) -> tuple[Displacement, Array] | None:
        """What the robot has done since the picture, (3,) with covariance (3, 3), by its twist; None if it is not
        late."""
        s = self.state
        late_s = self.late_s
        return coast(self._config, LastTwist(s.twist, s.twist_s or None, 0.0), late_s) if late_s > 0.0 else None

    def step(self, period: int, motion: Motion, elapsed_s: float) -> bool:
        """After a frame, of which the picture came `period` frames before, 0 for a new one; True where the delay has
        begun or ended."""
        s, before_s = self.state, self.late_s
        s.moved = np.asarray(se2.compose(s.moved, motion.prev_from_curr))
        s.span_s += elapsed_s
        if period:
            s.in_order = period >= _FEWEST_OLD and (s.run == 0 or (s.in_order and period == s.period))
            s.period, s.run, s.old_s = period, s.run + 1, s.old_s + elapsed_s
        elif motion.ok and s.span_s > 0.0:
            self._measured(motion)
        return self.late_s != before_s

    def _measured(self, motion: Motion) -> None:
        s = self.state
        took_s = s.span_s
        if s.run and s.in_order and s.run == s.period and s.twist_s:
            late, none = (self._log_likelihood(motion, t) for t in (s.span_s - s.old_s, s.span_s))
            odds = late - none - math.log(_STOPS)
            if odds > 0.0:
                took_s -= s.old_s
                s.odds, s.late_s = odds, self.late_s + s.old_s
        elif self.late_s > 0.0:
            took_s = self._goes_on(motion)
        s.twist, s.twist_s = se2.mean_twist(s.moved, took_s), took_s
        s.moved, s.span_s, s.old_s, s.run, s.period = np.zeros(3), 0.0, 0.0, 0, 0

    def _goes_on(self, motion: Motion) -> float:
        """Weigh whether the pictures have caught up, which shows in a jump ahead; returns the time that passed between
        the two pictures."""
        s = self.state
        stays, caught = (self._log_likelihood(motion, t) for t in (s.span_s, s.span_s + s.late_s))
        ends = 1.0 - math.exp(-s.span_s / _ENDS_S)
        late = -math.log1p(math.exp(-s.odds))
        none = np.logaddexp(late + math.log(ends) + caught, -math.log1p(math.exp(min(s.odds, _MOST_ODDS))) + stays)
        s.odds = min(late + math.log1p(-ends) + stays - float(none), _MOST_ODDS)
        return s.span_s if s.odds > 0.0 or caught < stays else s.span_s + s.late_s

    def _log_likelihood(self, motion: Motion, span_s: float) -> float:
        """Of the motion since the last new picture, if so much time lies between the two."""
        s = self.state
        mean, cov = coast(self._config, LastTwist(s.twist, s.twist_s, 0.0), max(span_s, _LEAST_S))
        cov = cov + motion.cov + np.diag([_NOISE_M, _NOISE_M, _NOISE_RAD]) ** 2
        off = s.moved - mean
        off[2] = se2.wrap(float(off[2]))
        return float(-0.5 * off @ np.linalg.solve(cov, off) - 0.5 * np.linalg.slogdet(cov)[1])
