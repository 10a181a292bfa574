"""Which frames of a camera are used when a step takes longer than the time between two of them: every n-th, evenly.

Newest wins leaves frames out as well, but as it comes, and keeps a computer busy that has too much to do. No clock in
here: stamps and durations are told.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass
from typing import Literal

import numpy as np

_WINDOW_S, _INTERVALS = 1.0, 5
"""Frames whose median interval is the camera's period: those of the last second, at least so many; chosen: two stalls
in a row change nothing, a camera of 2 Hz is known after 1.5 s."""
_BLOCK_S, _BLOCKS = 0.5, 6
"""A typical step is the median of so many means, each over so long: 3 s; chosen: one in ten steps takes twice as long
(features.full_every), and a computer that stands still, once or twice for however long, is no reason."""
_ROOM = 0.8
"""Of the time between two used frames, that a step may take at most for the rate to rise; chosen: where it falls at 1,
steps that vary by a tenth keep it where it is."""
_HOLD_S, _MOST_HOLD_S = 5.0, 320.0
"""That a rate is kept before it rises; chosen. Twice as long each time that it had to fall again soon, since a step may
take longer the more there are of them."""
_SOON_S = 60.0
"""Chosen: what made a computer busy, or a room dark, less than a minute ago may do so again."""
_LONGEST_S, _LEAST = 1.0, 2
"""Longest time between two used frames, or so many of the camera's periods if that is longer; chosen: as a camera of
1 Hz. A computer that is slower still takes the newest each time, so it is soon found to be better."""
_OTHER = 1.25
"""Times a period, that is another one; chosen: no camera's rates are closer than 24 and 30 Hz."""
_AS_TOLD, _WORSE = 1.1, 2.0
"""Times the period that the camera told, within which it is not slow; times the one that was said last, from which a
slow camera is told again; chosen: exposure that follows the dusk from 30 to 2 Hz is told four times at most."""
_WHY_SLOW = "automatic exposure in the dark, a slow bus, or a busy computer"
_NS = 1e-9  # s


@dataclass(frozen=True, slots=True)
class RateNews:
    """Said once. slow: the camera gives fewer frames than it said; rate: fewer are used; note: it is better again."""

    kind: Literal["slow", "rate", "note"]
    text: str


class FrameRate:
    """Of one camera; not thread-safe.

    A frame is used once it is due. Whoever is late takes the newest one, and the n-th after that is the next: no frame
    waits for longer than the camera's period.
    """

    def __init__(self, told_hz: float) -> None:
        """told_hz: what the camera says of itself, until frames have come."""
        self._every = 1
        self._step_s = 0.0
        self._hold_s = _HOLD_S
        self._changed_s = self._raised_s = -math.inf
        self._now_s = 0.0
        self._news: deque[RateNews] = deque()
        self.opened(told_hz)

    @property
    def camera_hz(self) -> float:
        """That the camera gives."""
        return 1.0 / self._period_s

    @property
    def every_nth(self) -> int:
        """Of its frames, that are used."""
        return self._every

    @property
    def used_period_s(self) -> float:
        """Between two used frames."""
        return self._every * self._period_s

    def opened(self, told_hz: float) -> None:
        """The camera begins, or begins anew: what it gave before says nothing; how busy the computer is, it does."""
        self._told_s = self._said_s = self._period_s = 1.0 / told_hz
        self._slow_at_s = -math.inf
        self._times_s: deque[float] = deque()
        self._used_s = -math.inf
        self._begin_block()
        self._blocks: deque[float] = deque(maxlen=_BLOCKS)
        self._fit()

    def is_due(self, stamp_ns: int) -> bool:
        """Whether a frame comes late enough after the last one that was used. So do all that come after it."""
        return self._every == 1 or stamp_ns * _NS - self._used_s >= (self._every - 0.5) * self._period_s

    def arrived(self, stamp_ns: int) -> None:
        """A good frame has come, used or not; stamps increase."""
        self._now_s = stamp_ns * _NS
        self._measure()

    def used(self, stamp_ns: int) -> None:
        """A step begins with this frame."""
        self._used_s = stamp_ns * _NS

    def stepped(self, seconds: float) -> None:
        """A used frame kept its reader busy for so long."""
        self._steps += 1
        self._busy_s += seconds
        if self._now_s - self._block_s < _BLOCK_S:
            return
        self._blocks.append(self._busy_s / self._steps)
        self._begin_block()
        if len(self._blocks) == _BLOCKS:
            self._judge(float(np.median(self._blocks)))

    def news(self) -> RateNews | None:
        """What has not been said yet, None for nothing."""
        return self._news.popleft() if self._news else None

    def _begin_block(self) -> None:
        self._block_s, self._steps, self._busy_s = self._now_s, 0, 0.0

    def _measure(self) -> None:
        """The camera's period, from a whole window."""
        times = self._times_s
        times.append(self._now_s)
        whole = False
        while len(times) > _INTERVALS + 1 and times[0] < self._now_s - _WINDOW_S:
            times.popleft()
            whole = True
        if len(times) <= _INTERVALS:
            return
        self._period_s = float(np.median(np.diff(times)))
        if whole:
            self._compare()

    def _compare(self) -> None:
        """Whether the period is news, and whether it is another one than `every` was chosen for."""
        slow = self._said_s > self._told_s
        if self._period_s > _AS_TOLD * self._told_s:
            self._slow_at_s = self._now_s
        gives = f"gives {self.camera_hz:.3g} frames per second"
        if self._period_s > (_WORSE if slow else _OTHER) * self._said_s:
            self._said_s = self._period_s
            self._news.append(RateNews("slow", f"{gives}, it said {1.0 / self._told_s:.3g}: {_WHY_SLOW}"))
        elif slow and self._now_s - self._slow_at_s > _SOON_S:
            self._said_s = self._told_s
            self._news.append(RateNews("note", f"{gives} again"))
        if not 1.0 / _OTHER < self._period_s / self._fitted_s < _OTHER:
            self._fit()

    def _fit(self) -> None:
        """The camera's period is another one: the same steps take another share of its frames, at once."""
        self._fitted_s = self._period_s
        if (every := self._needed(self._step_s)) != self._every:
            self._choose(every)

    def _needed(self, step_s: float) -> int:
        """Smallest n with which steps of this length keep up, as far as that goes."""
        most = max(int(_LONGEST_S / self._period_s), _LEAST)
        return min(max(math.ceil(step_s / self._period_s), 1), most)

    def _judge(self, step_s: float) -> None:
        self._step_s = step_s
        if (every := self._needed(step_s)) > self._every:
            soon = self._now_s - self._raised_s < _SOON_S
            self._hold_s = min(2.0 * self._hold_s, _MOST_HOLD_S) if soon else _HOLD_S
            self._choose(every)
        elif self._now_s - self._changed_s >= self._hold_s and (every := self._needed(step_s / _ROOM)) < self._every:
            self._raised_s = self._now_s
            self._choose(every)

    def _choose(self, every: int) -> None:
        worse, self._every, self._changed_s = every > self._every, every, self._now_s
        self._blocks.clear()
        used = "every frame is used" if every == 1 else f"one frame in {every} is used at most"
        does = f"gives {self.camera_hz:.3g} frames per second, this computer does {1.0 / max(self._step_s, _NS):.3g}"
        self._news.append(RateNews("rate" if worse else "note", f"{does}: {used}"))
