"""Whether the camera's stamps run as fast as the computer's clock; where not, the time of arrival serves instead.

Frames arrive late by the exposure, the transfer and a wait that varies, but never early: the least age of some frames
in a row is steady to milliseconds. When it keeps growing, or shrinking, the stamps run at another rate.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from itertools import pairwise

_WINDOW_S, _WINDOW_FRAMES = 0.5, 5
"""Frames of which the least age counts; chosen: some come at once even on a busy computer."""
_FEWEST, _MOST = 4, 20
"""Windows in a row that must agree, and that are kept: 2 s to 10 s; chosen."""
_LEAST_RATE = 0.02
"""A stamp's clock that is off by less is none; chosen: crystals are off by 1e-4."""
_LEAST_DRIFT_S = 0.15
"""Least change of the age; chosen: 1.5 frame periods at 10 Hz, within which the wait for the estimator varies."""
_EVEN_SHARE = 0.5
"""Of the mean change from window to window that each must have: a clock drifts evenly, a computer gets busy
at once; chosen."""
_EARLIEST_S, _LATEST_S = -0.05, 1.0
"""Age of a first frame whose stamp is of this clock (as V4L2 stamps are checked); others are of a recording."""
_BACK_S = 0.05
"""Stamps are believed again when their age is again within this of what it was; chosen."""
_NS = 1e-9  # s


@dataclass(slots=True)
class StampRateState:
    """What the last frames left.

    Attributes:
        same_clock: whether the first frame's stamp was of the computer's clock; None before it.
        begin_s, frames, least_s: window under way: time of arrival of its first frame, frames, their least age.
        times_s, ages_s: of the last windows: time of arrival and least age.
        arrival_age_s: what is taken off the time of arrival while that serves as the stamp; None while it does not.
        faults: times that stamps ran at another rate.
        reason: why the time of arrival serves, "" while it does not.
    """

    same_clock: bool | None = None
    begin_s: float | None = None
    frames: int = 0
    least_s: float = 0.0
    times_s: list[float] = field(default_factory=list)
    ages_s: list[float] = field(default_factory=list)
    arrival_age_s: float | None = None
    faults: int = 0
    reason: str = ""


class StampRate:
    """Feed it every live frame in order of arrival."""

    def __init__(self) -> None:
        self.state = StampRateState()

    def usable(self, stamp_ns: int, arrival_ns: int) -> int:
        """The stamp to use of a frame that has stamp_ns and arrived at arrival_ns of the computer's clock."""
        s, age_s = self.state, (arrival_ns - stamp_ns) * _NS
        if s.same_clock is None:
            s.same_clock = _EARLIEST_S <= age_s <= _LATEST_S
        if not s.same_clock:
            return stamp_ns
        now_s = arrival_ns * _NS
        if s.begin_s is None:
            s.begin_s, s.frames, s.least_s = now_s, 0, age_s
        s.frames, s.least_s = s.frames + 1, min(s.least_s, age_s)
        if now_s - s.begin_s >= _WINDOW_S and s.frames >= _WINDOW_FRAMES:
            s.times_s, s.ages_s = [*s.times_s[1 - _MOST :], now_s], [*s.ages_s[1 - _MOST :], s.least_s]
            s.begin_s = None
            self._judge()
        return stamp_ns if s.arrival_age_s is None else arrival_ns - round(s.arrival_age_s / _NS)

    def _judge(self) -> None:
        s = self.state
        if s.arrival_age_s is not None:
            if abs(s.ages_s[-1] - s.arrival_age_s) < _BACK_S and abs(s.ages_s[-2] - s.arrival_age_s) < _BACK_S:
                s.arrival_age_s, s.reason = None, ""
            return
        for count in range(_FEWEST, len(s.ages_s) + 1):
            rate = _even_rate(s.times_s[-count:], s.ages_s[-count:])
            if rate:
                s.arrival_age_s = min(max(s.ages_s[-count], 0.0), _LEAST_DRIFT_S)
                s.faults += 1
                s.reason = (
                    f"the camera's stamps run at {1.0 - rate:.2f} times the computer's clock; the time of arrival "
                    "serves instead, check the camera's driver"
                )
                return


def _even_rate(times_s: list[float], ages_s: list[float]) -> float:
    """By how much the age grows in a second; 0 where it does not, or not evenly."""
    drift_s, elapsed_s = ages_s[-1] - ages_s[0], times_s[-1] - times_s[0]
    each = drift_s / (len(ages_s) - 1)
    even = all((b - a) / each >= _EVEN_SHARE for a, b in pairwise(ages_s)) if each else False
    rate = drift_s / elapsed_s
    return rate if even and abs(drift_s) > _LEAST_DRIFT_S and abs(rate) > _LEAST_RATE else 0.0
