"""By how much the eye comes later than another sense, to milliseconds, from the shape of speed and turn rate over time.

For every lag on a raster, what the sense gathered over short windows so much earlier is held against what the eye did.
Sums of their products are kept, so the sense's own scale and bias are fitted for every lag and cost nothing (a profile
likelihood). The least of the curve is the delay; its curvature, with the noise that is found there, tells how sure that
is. Two memories, of a minute and of some seconds, tell when it jumps.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ceilvo.types import Array

_STEP_S = 0.01
"""Of the raster; chosen: a third of a frame."""
_EARLIEST_S, _LATEST_S = -0.2, 0.6
"""Lags looked for, as delay.py of the cross-checks."""
LAGS_S = np.arange(round(_EARLIEST_S / _STEP_S), round(_LATEST_S / _STEP_S) + 1) * _STEP_S
_REACH = 3
"""Of the parabola to either side of the least, in steps."""
_WINDOW_S = 0.14
"""Of one comparison; chosen: two frames at 14 Hz, and far shorter than speeding up takes."""
_AROUND_S = 0.3
"""Around a window the eye's rate must change for it to tell a lag."""
_CHANGE, _CHANGE_SHARE = np.array([0.03, 0.06]), 0.4
"""[m/s, rad/s] by which at least, and by which share of the fastest; chosen: while it is steady, noise between the
sense's samples passes for a lag."""
_MEMORY, _RECENT = 300.0, 24.0
"""Windows that the long and the short memory go back; chosen: a minute and some seconds of changing speed."""
_SCALE_SIGMA, _BIAS_SIGMA = 0.05, 0.02
"""Of the sense's scale, and of its bias in its units a second, that the fit allows."""
_FEWEST = 12
"""Windows of a channel that an estimate needs."""
_SURE_S = 0.005
"""A delay that is known better than this is used; chosen: 2.5 mm at .5 m/s."""
_JUMP_S, _JUMP_SIGMAS = 0.01, 3.0
"""Both memories differ by more: the delay has jumped; chosen: 5 mm at .5 m/s. They have much in common, so three
standard deviations are many."""
_KNOWN_RECENTLY_S = 0.01
"""And the short memory must know it so well."""
_NEEDED = 3
"""Times in a row that is found before it is said."""
_LEAST_NOISE = 0.02
"""Variance that is found, over the one that was said, that is believed at least."""
_NANOSECOND_S = 1e-9
CHANNELS = 2
"""Way ahead, m, and turn, rad."""


@dataclass(slots=True)
class LagState:
    """
    Attributes:
        long, short: (L, C, 6) weighted sums of products of eye e, sense s and time t of the windows: ee, es, et, ss,
            st, tt. counts: (2, C) windows in each.
        next_s: where the next window begins.
        delay_s, sigma_s: of the long memory; None before it is known.
        differs: times in a row that the short memory was elsewhere; jumps: of the delay so far; jumped_s: the size of
            the last one; jumped_at_s: when it was noticed; jumped_now: in the last step.
    """

    long: Array = field(default_factory=lambda: np.zeros((len(LAGS_S), CHANNELS, 6)))
    short: Array = field(default_factory=lambda: np.zeros((len(LAGS_S), CHANNELS, 6)))
    counts: Array = field(default_factory=lambda: np.zeros((2, CHANNELS)))
    next_s: float = 0.0
    delay_s: float | None = None
    sigma_s: float = math.inf
    differs: int = 0
    jumps: int = 0
    jumped_s: float = 0.0
    jumped_at_s: float = -math.inf
    jumped_now: bool = False


@dataclass(frozen=True, slots=True)
class Series:
    """The last seconds by eye and by a sense, row by row, oldest first.

    Attributes:
        time_s: (N,) stamps.
        eye, sense: (N, C) way and turn since the first row; a channel that the sense does not tell is 0.
        whole: (N,) whether the eye measured the motion that ends there.
        var_ps: (C,) variance that sense and eye differ by, a second of driving; only ratios of channels count at first.
        var: (C,) the same of one comparison.
    """

    time_s: Array
    eye: Array
    sense: Array
    whole: Array
    var_ps: Array
    var: Array


class Lag:
    """Of one sense."""

    def __init__(self) -> None:
        self.state = LagState()

    @property
    def known_s(self) -> float:
        """By how much the eye is later, 0 while it is not known well enough."""
        s = self.state
        return 0.0 if s.delay_s is None or s.sigma_s > _SURE_S else s.delay_s

    @property
    def sigma_s(self) -> float:
        """Of known_s, where it is known; else inf."""
        return self.state.sigma_s if self.state.sigma_s <= _SURE_S else math.inf

    def restart(self) -> None:
        """Time begins anew; what is known of the delay stays."""
        self.state.next_s, self.state.jumped_at_s = 0.0, -math.inf

    def begin_anew(self, delay_s: float) -> None:
        """The delay is another one now, about so much; how much it is shall be learnt."""
        s = self.state
        s.long, s.short, s.counts, s.differs = 0.0 * s.long, 0.0 * s.short, 0.0 * s.counts, 0
        s.delay_s, s.sigma_s = delay_s, _SURE_S

    def skip(self, now_s: float) -> None:
        """What was gathered until now since the last window tells nothing: wheels slip."""
        self.state.next_s = max(self.state.next_s, now_s)

    def step(self, now: Series) -> None:
        """After a row was added."""
        s, t = self.state, now.time_s
        s.jumped_now = False
        if len(t) < 4:
            return
        last = int(np.searchsorted(t, t[-1] + _EARLIEST_S, side="right")) - 1
        first = int(np.searchsorted(t, max(s.next_s, t[0] + _LATEST_S)))
        if last <= first or t[last] - t[first] < _WINDOW_S - _NANOSECOND_S:
            return
        s.next_s = float(t[last])
        if not np.all(now.whole[first + 1 :] > 0.0):
            return
        telling = _telling(now, float(t[first]), float(t[last]))
        if not np.any(telling):
            return
        products = _products(now, first, last) * telling[:, None]
        for memory, windows in ((s.long, _MEMORY), (s.short, _RECENT)):
            memory *= 1.0 - 1.0 / windows
            memory += products
        s.counts[0] = s.counts[0] * (1.0 - 1.0 / _MEMORY) + telling
        s.counts[1] = s.counts[1] * (1.0 - 1.0 / _RECENT) + telling
        self._judge(float(t[-1]))

    def _judge(self, now_s: float) -> None:
        s = self.state
        found, recent = _least(s.long, s.counts[0]), _least(s.short, s.counts[1])
        if found is not None and recent is not None:
            off = abs(found[0] - recent[0])
            far = recent[1] < _KNOWN_RECENTLY_S and off > _JUMP_S + _JUMP_SIGMAS * math.hypot(recent[1], found[1])
            s.differs = s.differs + 1 if far and s.delay_s is not None else 0
            if s.differs >= _NEEDED:
                s.jumps, s.jumped_s, s.jumped_at_s, s.jumped_now = s.jumps + 1, recent[0] - found[0], now_s, True
                self.begin_anew(recent[0])
                return
        if found is not None:
            s.delay_s, s.sigma_s = found


def _telling(now: Series, from_s: float, to_s: float) -> Array:
    """(C,) 1 where the eye's rate changes around a window."""
    ends_s = max(from_s - _AROUND_S, float(now.time_s[0])), min(to_s + _AROUND_S, float(now.time_s[-1]))
    at_s = np.arange(*ends_s, 0.5 * _WINDOW_S)
    path = np.stack([np.interp(at_s, now.time_s, channel) for channel in now.eye.T], axis=-1)
    rates = np.diff(path, axis=0) / (0.5 * _WINDOW_S)
    changes = np.ptp(rates, axis=0) > np.maximum(_CHANGE, _CHANGE_SHARE * np.abs(rates).max(axis=0))
    return np.asarray(changes & np.any(now.sense != 0.0, axis=0), np.float64)


def _products(now: Series, first: int, last: int) -> Array:
    """(L, C, 6) of one window, over its variance."""
    t = now.time_s
    span_s = float(t[last] - t[first])
    eye = now.eye[last] - now.eye[first]
    ends = np.array([t[first], t[last]])[:, None] - LAGS_S
    at = _cubic(t, now.sense, ends)
    sense = at[1] - at[0]
    e, d = np.broadcast_to(eye, sense.shape), np.full(sense.shape, span_s)
    products = np.stack([e * e, e * sense, e * d, sense * sense, sense * d, d * d], axis=-1)
    return np.asarray(products / (now.var_ps * span_s + now.var)[:, None])


def _cubic(t: Array, path: Array, at_s: Array) -> Array:
    """(..., C) a path (N, C) at times (...), smooth between rows (Catmull and Rom); the ends beyond them."""
    k = np.clip(np.searchsorted(t, at_s) - 1, 0, len(t) - 2)
    before, after = np.maximum(k - 1, 0), np.minimum(k + 2, len(t) - 1)
    h = t[k + 1] - t[k]
    u = np.clip((at_s - t[k]) / h, 0.0, 1.0)[..., None]
    p0, p1 = path[k], path[k + 1]
    m0 = (p1 - path[before]) / (t[k + 1] - t[before])[..., None] * h[..., None]
    m1 = (path[after] - p0) / (t[after] - t[k])[..., None] * h[..., None]
    u2, u3 = u * u, u * u * u
    return np.asarray((2 * u3 - 3 * u2 + 1) * p0 + (u3 - 2 * u2 + u) * m0 + (3 * u2 - 2 * u3) * p1 + (u3 - u2) * m1)


def _least(sums: Array, counts: Array) -> tuple[float, float] | None:
    """Lag of the least cost and its standard deviation; None where it is at an end, or too little is known."""
    ee, es, et, ss, st, tt = np.moveaxis(sums, -1, 0)
    ps, pb = _SCALE_SIGMA**-2, _BIAS_SIGMA**-2
    a, b, c, x, y = ss + ps, st, tt + pb, es + ps, et
    determinant = a * c - b * b
    cost = ee + ps - (c * x * x - 2.0 * b * x * y + a * y * y) / determinant  # (L, C) at the best scale and bias
    enough = counts >= _FEWEST
    if not np.any(enough):
        return None
    noise = np.maximum(cost.min(axis=0) / np.maximum(counts, 1.0), _LEAST_NOISE)
    total = (cost / noise)[:, enough].sum(axis=1)
    least = vertex(total, LAGS_S, _STEP_S, _REACH)
    return None if least is None else (least[0], math.sqrt(1.0 / least[1]))


def vertex(cost: Array, lags_s: NDArray[np.floating[Any]], step_s: float, reach: int) -> tuple[float, float] | None:
    """Of the parabola through the least of costs (L,) and `reach` on either side of it: its lag, s, and half of its
    curvature, s^-2; None where the least is at an end, or flat.

    Args:
        lags_s: (L,) of the costs, step_s apart.
    """
    k = int(np.argmin(cost))
    if not reach <= k < len(cost) - reach:
        return None
    at_s = np.arange(-reach, reach + 1) * step_s
    half_curvature, slope, _ = np.polyfit(at_s, cost[k - reach : k + reach + 1], 2).tolist()
    return (float(lags_s[k]) - 0.5 * slope / half_curvature, half_curvature) if half_curvature > 0.0 else None
