"""By how much the eye comes later than another sense, to milliseconds, from the shape of speed and turn rate over time.

For every lag on a raster, what the sense gathered over short windows so much earlier is held against what the eye did.
Sums of their products are kept, so the sense's own scale and bias are fitted for every lag and cost nothing (a profile
likelihood). The least of the curve is the delay; its curvature, with the noise that is found there, tells how sure that
is.

That it jumps is told by a sequential test (Page's cumulative sums, one for every lag): by how much better a window fits
another lag than the one that is known, added up from the moment on at which it began to.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ceilvo.types import Array

_STEP_S = 0.01
"""Of the raster; chosen: a third of a frame."""
_EARLIEST_S, _LATEST_S = -0.2, 0.6
"""Lags looked for, as delay.py of the cross-checks."""
LAGS_S: Array = np.asarray(np.arange(round(_EARLIEST_S / _STEP_S), round(_LATEST_S / _STEP_S) + 1) * _STEP_S)
_REACH = 3
"""Of the parabola to either side of the least, in steps."""
_WINDOW_S = 0.14
"""Of one comparison; chosen: two frames at 14 Hz, and far shorter than speeding up takes."""
_AROUND_S = 0.3
"""Around a window the eye's rate must change for it to tell a lag."""
_CHANGE, _CHANGE_SHARE = np.array([0.03, 0.06]), 0.4
"""[m/s, rad/s] by which at least, and by which share of the fastest; chosen: while it is steady, noise between the
sense's samples passes for a lag."""
_MEMORY = 300.0
"""Windows that the memory goes back; chosen: some minutes, of which a part tells."""
_SCALE_SIGMA, _BIAS_SIGMA = 0.05, 0.02
"""Of the sense's scale, and of its bias in its units a second, that the fit allows."""
_FEWEST = 12
"""Windows of a channel that an estimate needs."""
_ENOUGH = 36
"""And so many before a jump is looked for: how much windows err must be known; chosen."""
_SURE_S = 0.005
"""A delay that is known better than this is used; chosen: 2.5 mm at .5 m/s."""
_JUMP_S, _JUMP_SIGMAS = 0.01, 3.0
"""Lags that are further from the known one are jumps; chosen: 5 mm at .5 m/s."""
_WINDOWS_BETWEEN = 2.6e7
"""Mean number of windows to a false jump at least: 1000 h in which speed changes all the time."""
_SAID = math.log(_WINDOWS_BETWEEN * len(LAGS_S))
"""Log-likelihood ratio at which a jump is said. Without one, a sum is e^x only once in e^x windows (Lorden 1971)."""
_MOST = _SAID / 4.0
"""That a window says at most: four must; chosen: a slip, or a wheel over a sill, is one or two."""
_LOUDER = 2.0
"""Variance of a window over what the memory found; chosen: harder braking errs more than the mean."""
_WILD = 9.0
"""Squared error over its variance, beyond which a window weighs less in the memory; chosen: one
picture of it was late by itself."""
_TINY = 1e-30
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
            st, tt; of all, and of those since another lag began to fit better, which join them when that is over.
            counts: (2, C) windows in each.
        next_s: where the next window begins.
        delay_s, sigma_s: of the long memory; None before it is known.
        evidence: (L,) log-likelihood ratios of the delay being another one since it began to fit better.
        differs: windows since any did; jumps: of the delay so far; jumped_s: the size of the last one; jumped_at_s:
            when it was noticed; jumped_now: in the last step.
    """

    long: Array = field(default_factory=lambda: np.zeros((len(LAGS_S), CHANNELS, 6)))
    short: Array = field(default_factory=lambda: np.zeros((len(LAGS_S), CHANNELS, 6)))
    counts: Array = field(default_factory=lambda: np.zeros((2, CHANNELS)))
    next_s: float = 0.0
    delay_s: float | None = None
    sigma_s: float = math.inf
    evidence: Array = field(default_factory=lambda: np.zeros(len(LAGS_S)))
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
        s.long, s.counts = 0.0 * s.long, 0.0 * s.counts
        s.delay_s, s.sigma_s = delay_s, _SURE_S
        self._no_evidence()

    def _no_evidence(self) -> None:
        s = self.state
        s.short, s.counts[1], s.evidence, s.differs = 0.0 * s.short, 0.0, 0.0 * s.evidence, 0

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
        window = _window(now, first, last)
        if s.delay_s is not None and s.sigma_s <= _SURE_S and np.max(s.counts[0]) >= _ENOUGH:
            self._test(s.delay_s, window, telling, float(t[-1]))
        else:
            self._remember(window.products() * telling[:, None], telling, 1)

    def _test(self, delay_s: float, window: Window, telling: Array, now_s: float) -> None:
        """A window against what is known; it is remembered when nothing speaks for another delay."""
        s = self.state
        known = _fitted(s.long[int(np.argmin(np.abs(LAGS_S - delay_s)))], s.counts[0])
        far = np.abs(LAGS_S - delay_s) > _JUMP_S + _JUMP_SIGMAS * s.sigma_s
        new = np.where(far, window.better(delay_s, known) @ telling, 0.0)
        s.evidence = np.maximum(s.evidence + new * min(1.0, _MOST / max(float(np.max(new)), _TINY)), 0.0) * far
        weight = telling * window.belongs(delay_s, known)
        s.short, s.counts[1] = s.short + window.products() * weight[:, None], s.counts[1] + weight
        s.differs += 1
        if np.max(s.evidence) > _SAID:
            best = vertex(-s.evidence, LAGS_S, _STEP_S, 1)
            now_late_s = float(LAGS_S[int(np.argmax(s.evidence))]) if best is None else best[0]
            self.begin_anew(now_late_s)
            s.jumps, s.jumped_s, s.jumped_at_s, s.jumped_now = s.jumps + 1, now_late_s - delay_s, now_s, True
        elif not np.any(s.evidence):
            self._remember(s.short, s.counts[1], s.differs)
            self._no_evidence()

    def _remember(self, products: Array, telling: Array, windows: int) -> None:
        s, keep = self.state, (1.0 - 1.0 / _MEMORY) ** windows
        s.long, s.counts[0] = s.long * keep + products, s.counts[0] * keep + telling
        found = _least(s.long, s.counts[0])
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


@dataclass(frozen=True, slots=True)
class Window:
    """One comparison: ways (C,) by eye and (L, C) by the sense at every lag, its length, and (C,) variances.

    Attributes:
        at: ways (C,) by the sense at any lag.
    """

    eye: Array
    sense: Array
    span_s: float
    var: Array
    at: Callable[[float], Array]

    def products(self) -> Array:
        """(L, C, 6) over the variance."""
        s, d = self.sense, np.full(self.sense.shape, self.span_s)
        e = np.broadcast_to(self.eye, s.shape)
        return np.asarray(np.stack([e * e, e * s, e * d, s * s, s * d, d * d], axis=-1) / self.var[:, None])

    def belongs(self, lag_s: float, known: Fitted) -> Array:
        """(C,) how much it weighs if the lag is right: less where it errs too much."""
        off = self.eye - known.bias * self.span_s - known.scale * self.at(lag_s)
        return np.asarray(np.minimum(1.0, _WILD * known.noise * self.var / np.maximum(off**2, _TINY)) ** 2)

    def better(self, lag_s: float, known: Fitted) -> Array:
        """(L, C) log-likelihood ratios of every lag to one."""
        off = self.eye - known.bias * self.span_s
        squares = (off - known.scale * self.at(lag_s)) ** 2 - (off - known.scale * self.sense) ** 2
        return np.asarray(0.5 * squares / (_LOUDER * known.noise * self.var))


@dataclass(frozen=True, slots=True)
class Fitted:
    """(C,) each: scale and bias of the sense, and its variance over what was said."""

    scale: Array
    bias: Array
    noise: Array


def _window(now: Series, first: int, last: int) -> Window:
    t = now.time_s
    span_s, ends = float(t[last] - t[first]), np.array([t[first], t[last]])

    def way(lags_s: Array) -> Array:
        before, after = _cubic(t, now.sense, ends[:, None] - lags_s)
        return np.asarray(after - before)

    var = now.var_ps * span_s + now.var
    return Window(now.eye[last] - now.eye[first], way(LAGS_S), span_s, var, lambda lag_s: way(np.array([lag_s]))[0])


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
    cost = _cost(sums)
    enough = counts >= _FEWEST
    if not np.any(enough):
        return None
    noise = np.maximum(cost.min(axis=0) / np.maximum(counts, 1.0), _LEAST_NOISE)
    total = (cost / noise)[:, enough].sum(axis=1)
    least = vertex(total, LAGS_S, _STEP_S, _REACH)
    return None if least is None else (least[0], math.sqrt(1.0 / least[1]))


def _cost(sums: Array) -> Array:
    """(..., C) of sums (..., C, 6), at the best scale and bias."""
    ee, es, et, ss, st, tt = np.moveaxis(sums, -1, 0)
    ps, pb = _SCALE_SIGMA**-2, _BIAS_SIGMA**-2
    a, b, c, x, y = ss + ps, st, tt + pb, es + ps, et
    return np.asarray(ee + ps - (c * x * x - 2.0 * b * x * y + a * y * y) / (a * c - b * b))


def _fitted(sums: Array, counts: Array) -> Fitted:
    """Of sums (C, 6) at the lag that is known."""
    _, es, et, ss, st, tt = np.moveaxis(sums, -1, 0)
    a, b, c, x, y = ss + _SCALE_SIGMA**-2, st, tt + _BIAS_SIGMA**-2, es + _SCALE_SIGMA**-2, et
    least = a * c - b * b
    noise = np.where(counts >= _FEWEST, _cost(sums) / np.maximum(counts, 1.0), np.inf)
    return Fitted((c * x - b * y) / least, (a * y - b * x) / least, np.maximum(noise, _LEAST_NOISE))


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
