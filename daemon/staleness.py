"""Whether the noise model still holds at run time: NIS out of its bounds for long means a stale calibration.

Pure: time comes with the evidence. The filter's innovations are not independent from update to update (the same
landmarks are seen again), so a chi-square bound for independent ones would cry wolf; the bound is on a mean over a long
window, and must be exceeded for a while. What that gives is measured in docs/calibration.md.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass

WINDOW_S = 60.0
HOLD_S = 20.0
HIGH = 3.0
LEAVE_RATIO = 0.8
CAP = 8.0
MIN_UPDATES = 60
_NS = 1e-9


@dataclass(frozen=True, slots=True)
class Staleness:
    """Verdict: stale with its reason, and the mean NIS per degree of freedom over the window (nan = too little yet)."""

    stale: bool
    reason: str
    mean_nis: float


class StalenessMonitor:
    """Feed it every update of the filter, in order of time.

    Args:
        high: mean NIS per degree of freedom beyond which the calibration counts as stale.
        window_s: the mean is taken over; hold_s: it must be beyond for as long.
    """

    def __init__(self, high: float = HIGH, window_s: float = WINDOW_S, hold_s: float = HOLD_S) -> None:
        self._high, self._window_ns, self._hold_ns = high, round(window_s / _NS), round(hold_s / _NS)
        self._updates: deque[tuple[int, float]] = deque()
        self._since_ns: int | None = None
        self._last = Staleness(False, "", math.nan)

    @property
    def last(self) -> Staleness:
        return self._last

    def reset(self) -> None:
        """After a relocalisation or a new map: what was before says nothing about the calibration."""
        self._updates.clear()
        self._since_ns = None
        self._last = Staleness(False, "", math.nan)

    def add(self, stamp_ns: int, nis: float, dof: int) -> Staleness:
        """One update: mean NIS per degree of freedom and its degrees of freedom; dof 0 = none, which is skipped.

        One wild update (a wrong association) counts no more than CAP.
        """
        if dof <= 0:
            return self._last
        self._updates.append((stamp_ns, min(nis, CAP) if math.isfinite(nis) else CAP))
        while stamp_ns - self._updates[0][0] > self._window_ns:
            self._updates.popleft()
        if len(self._updates) < MIN_UPDATES:
            self._last = Staleness(self._last.stale, self._last.reason, math.nan)
            return self._last
        mean = sum(n for _, n in self._updates) / len(self._updates)
        self._last = self._judge(stamp_ns, mean)
        return self._last

    def _judge(self, stamp_ns: int, mean: float) -> Staleness:
        if self._last.stale:
            stale = mean >= LEAVE_RATIO * self._high
            return Staleness(stale, self._last.reason if stale else "", mean)
        if mean <= self._high:
            self._since_ns = None
            return Staleness(False, "", mean)
        self._since_ns = stamp_ns if self._since_ns is None else self._since_ns
        if stamp_ns - self._since_ns < self._hold_ns:
            return Staleness(False, "", mean)
        reason = (
            f"calibration stale: innovations are {math.sqrt(mean):.1f} times what the noise curves say for "
            f"{(stamp_ns - self._since_ns) * _NS:.0f} s; run 'calib check'"
        )
        return Staleness(True, reason, mean)
