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

from ceilvo.daemon.odometry.cross_checks.paths import Paths
from ceilvo.daemon.odometry.senses.lag import vertex
from ceilvo.types import Array

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
