"""Whether the noise model still holds at run time: NIS far above commissioning's means a stale calibration.

Pure: time comes with the evidence. The filter's innovations are not independent from update to update (the same
landmarks are seen again, the robot rocks), and their mean is 1 only where the noise curves say all; so the bound is
a multiple of what the drive of `calib survey` had in its worst stretch (a robot may stay there), on a mean over a long
window, and must be exceeded for a while. How often that is wrong is measured in docs/calibration.md.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

from ceilvo.daemon.integrity.states import LEAVE_RATIO

WINDOW_S = 60.0
"""The mean is taken over this time of driving; chosen: innovations are correlated over seconds."""
HOLD_S = 20.0
"""The mean must be above the bound for so long; chosen: a bad lens is noticed after some 30 s (docs/calibration.md)."""
STRETCH_S = 15.0
"""Part of the survey's drive whose mean NIS is the expected one; chosen: a robot may stay where it was worst."""
HIGH = 1.6
"""Bound over the expected NIS; chosen: 1600 h resampled had 1.12 at most (`make bench-calib`, docs/calibration.md)."""
UNMEASURED_NIS = 4.0
"""Expected where no survey has measured it: as the worst rigs of docs/calibration.md have, so only much is noticed."""
CAP = 4.0
"""Over the expected NIS, what one update counts at most; chosen: a wrong association must not decide."""
MIN_UPDATES = 60
"""Fewest updates that a mean is taken of; chosen: with 2 degrees of freedom each it is known to 0.13."""
_LEAST_EXPECTED = 0.1
"""Least expected NIS, whatever a survey had; chosen: a map can explain its own noise."""
_NS = 1e-9  # s


@dataclass(frozen=True, slots=True)
class Staleness:
    """Verdict: stale with its reason, and the mean NIS per degree of freedom over the window (nan = too little yet)."""

    stale: bool
    reason: str
    mean_nis: float


def worst_stretch(series: Sequence[tuple[float, float]]) -> float | None:
    """Highest mean of NIS over STRETCH_S of a drive (time s, NIS); None when there is too little of it."""
    if len(series) < MIN_UPDATES:
        return None
    highest, total, first = 0.0, 0.0, 0
    for k, (t, nis) in enumerate(series):
        total += nis
        while t - series[first][0] > STRETCH_S:
            total -= series[first][1]
            first += 1
        if t - series[0][0] >= STRETCH_S or k == len(series) - 1:
            highest = max(highest, total / (k + 1 - first))
    return highest


@dataclass(slots=True)
class StalenessState:
    """Updates of the window and what they say.

    Attributes:
        updates: stamp (ns) and NIS per degree of freedom, oldest first.
        total: sum of the latter.
        above_since_ns: since when the mean has been above the bound.
        verdict: the last one.
    """

    updates: list[tuple[int, float]] = field(default_factory=list)
    total: float = 0.0
    above_since_ns: int | None = None
    verdict: Staleness = Staleness(False, "", math.nan)


class StalenessMonitor:
    """Feed it every update of the filter, in order of time.

    Args:
        expected: NIS per degree of freedom while the calibration was good, worst_stretch() of a drive; None = not
            measured.
        high: times that, beyond which the calibration counts as stale.
        window_s: the mean is taken over; hold_s: it must be beyond for as long.
    """

    def __init__(
        self, expected: float | None = None, high: float = HIGH, window_s: float = WINDOW_S, hold_s: float = HOLD_S
    ) -> None:
        self._expected = UNMEASURED_NIS if expected is None else max(expected, _LEAST_EXPECTED)
        self._high, self._window_ns, self._hold_ns = high, round(window_s / _NS), round(hold_s / _NS)
        self.state = StalenessState()

    @property
    def last(self) -> Staleness:
        """The verdict after the last update."""
        return self.state.verdict

    def reset(self) -> None:
        """After a relocalisation or a new map: what was before says nothing about the calibration."""
        self.state = StalenessState()

    def add(self, stamp_ns: int, nis: float, dof: int) -> Staleness:
        """One update: mean NIS per degree of freedom and its degrees of freedom; dof 0 = none, which is skipped.

        One wild update (a wrong association) counts no more than CAP times what is expected.
        """
        s = self.state
        if dof <= 0:
            return s.verdict
        most = CAP * self._expected
        counted = min(nis, most) if math.isfinite(nis) else most
        s.updates.append((stamp_ns, counted))
        s.total += counted
        while stamp_ns - s.updates[0][0] > self._window_ns:
            s.total -= s.updates.pop(0)[1]
        if len(s.updates) < MIN_UPDATES:
            s.verdict = replace(s.verdict, mean_nis=math.nan)
        else:
            s.verdict = self._judge(stamp_ns, s.total / len(s.updates))
        return s.verdict

    def _judge(self, stamp_ns: int, mean: float) -> Staleness:
        s, bound = self.state, self._high * self._expected
        if s.verdict.stale:
            stale = mean >= LEAVE_RATIO * bound
            return Staleness(stale, s.verdict.reason if stale else "", mean)
        if mean <= bound:
            s.above_since_ns = None
            return Staleness(False, "", mean)
        s.above_since_ns = stamp_ns if s.above_since_ns is None else s.above_since_ns
        above_ns = stamp_ns - s.above_since_ns
        if above_ns < self._hold_ns:
            return Staleness(False, "", mean)
        reason = (
            f"calibration stale: NIS is {mean:.1f} for {above_ns * _NS:.0f} s, "
            f"{self._expected:.1f} expected, {bound:.1f} allowed; run 'calib check'"
        )
        return Staleness(True, reason, mean)
