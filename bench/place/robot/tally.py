"""What a daemon said of the pose against where the robot was, from the beginning of a fault on."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from ceilvo.types import State

WRONG_M, WRONG_RAD = 0.3, float(np.radians(5.0))
"""A pose further off is wrong, issue's."""
CLAIMED = (State.TRACKING, State.DEGRADED)
"""States that call a pose usable."""
MOVED_M, MOVED_RAD = 0.02, 0.05
"""By which a robot has moved after a fault; chosen: what an eye can tell from standing."""
_REASONS = 40
"""Changes of state that are kept for a report; chosen."""
_KEPT_S = 1.0
"""A right pose in TRACKING for so long is a recovery; chosen."""


@dataclass
class Tally:
    """Figures of a stretch.

    Attributes:
        state_s, wrong_s, worst_m, worst_rad: by state; wrong ones by CLAIMED states alone.
        false_alarms: entries into LOST or RELOCALISING.
        effect_s: moment from which on the daemon could have known; say_s: from there until a wrong pose was claimed for
            the last time, 0 where it never was; wrong_now: it is still claimed.
        over_s: end of the fault; recovered_s, recovered_m: from there until TRACKING with a right pose, and what was
            driven; None while not. told_s, told_m: from there until the place could be told, see Twins.
    """

    seconds: float = 0.0
    state_s: dict[str, float] = field(default_factory=dict)
    wrong_s: dict[str, float] = field(default_factory=dict)
    worst_m: dict[str, float] = field(default_factory=dict)
    worst_rad: dict[str, float] = field(default_factory=dict)
    false_alarms: int = 0
    effect_s: float | None = None
    say_s: float = 0.0
    wrong_now: bool = False
    metres: float = 0.0
    over_s: float | None = None
    recovered_s: float | None = None
    recovered_m: float | None = None
    told_s: float | None = None
    told_m: float | None = None
    reasons: list[str] = field(default_factory=list)
    marked: bool = False
    _state: State | None = None
    _right_since: tuple[float, float] | None = None
    _over_m: float = 0.0
    _moved: tuple[float, float] = (0.0, 0.0)
    _waits: bool = False

    def effect(self) -> None:
        """From the next motion on it can be known."""
        self.effect_s, self.say_s, self._moved = None, 0.0, (0.0, 0.0)
        self._waits = self.marked = True

    def over(self) -> None:
        """The fault is over."""
        self.over_s, self._over_m, self._right_since = self.seconds, self.metres, None

    def told(self) -> None:
        """From now on the place can be told."""
        assert self.over_s is not None
        self.told_s, self.told_m = self.seconds - self.over_s, self.metres - self._over_m

    def add(self, dt_s: float, state: State, off: tuple[float, float], moved: tuple[float, float], reason: str) -> None:
        """An estimate that held for dt_s, off by (m, rad), while the robot moved by (m, rad)."""
        self.seconds += dt_s
        self.metres += moved[0]
        name = state.name
        self.state_s[name] = self.state_s.get(name, 0.0) + dt_s
        claimed = state in CLAIMED
        wrong = off[0] > WRONG_M or off[1] > WRONG_RAD
        if claimed:
            self.worst_m[name] = max(self.worst_m.get(name, 0.0), off[0])
            self.worst_rad[name] = max(self.worst_rad.get(name, 0.0), off[1])
            if wrong:
                self.wrong_s[name] = self.wrong_s.get(name, 0.0) + dt_s
        if state is not self._state:
            if state in (State.LOST, State.RELOCALISING) and self._state not in (State.LOST, State.RELOCALISING, None):
                self.false_alarms += 1
            self.reasons.append(f"{self.seconds:.1f} {name} {off[0]:.2f} m {np.degrees(off[1]):.0f} deg ({reason})")
        self._state = state
        self._say(claimed and wrong, moved)
        self._recover(state is State.TRACKING and not wrong)

    def _say(self, claimed_wrong: bool, moved: tuple[float, float]) -> None:
        if self._waits:
            self._moved = (self._moved[0] + moved[0], self._moved[1] + moved[1])
            if self._moved[0] > MOVED_M or self._moved[1] > MOVED_RAD:
                self._waits, self.effect_s = False, self.seconds
        self.wrong_now = claimed_wrong
        if self.effect_s is not None and claimed_wrong:
            self.say_s = self.seconds - self.effect_s

    def _recover(self, right: bool) -> None:
        if self.over_s is None or self.recovered_s is not None:
            return
        if not right:
            self._right_since = None
        elif self._right_since is None:
            self._right_since = (self.seconds, self.metres)
        elif self.seconds - self._right_since[0] >= _KEPT_S:
            since = self._right_since
            self.recovered_s, self.recovered_m = since[0] - self.over_s, since[1] - self._over_m


def figures(t: Tally) -> dict[str, Any]:
    """As JSON can hold them."""
    return {
        "seconds": round(t.seconds, 3),
        "state_s": _rounded(t.state_s),
        "wrong_s": _rounded(t.wrong_s),
        "worst_m": _rounded(t.worst_m),
        "worst_rad": _rounded(t.worst_rad),
        "alarms": t.false_alarms,
        "say_s": t.say_s,
        "wrong_now": t.wrong_now,
        "recovered_s": t.recovered_s,
        "recovered_m": t.recovered_m,
        "told_s": t.told_s,
        "told_m": t.told_m,
        "reasons": t.reasons[-_REASONS:],
    }


def _rounded(values: dict[str, float]) -> dict[str, float]:
    return {k: round(v, 4) for k, v in values.items()}


def times(ms: list[float]) -> dict[str, float]:
    """Of steps, processor time of this thread, ms; all 0 where there were none."""
    ms = ms or [0.0]
    return {
        "median": float(np.median(ms)),
        "p99": float(np.quantile(ms, 0.99)),
        "max": float(np.max(ms)),
        "sum_s": 1e-3 * sum(ms),
    }
