"""Wheels that turn otherwise than the robot moves: said which way, and how much.

For windows of .1 to .4 s the difference of wheels and reference (the eye; without it the gyro, for turns) is held
against what both err by.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from ceilvo.types import Array

AXES = ("ahead", "sideways", "turning")
_WINDOWS_S = (0.1, 0.2, 0.4)
"""Chosen: the first sees a wheel that spins, the last one that loses a fifth of a slow way within half a second."""
_SIGMAS = 6.0
"""Of the difference, that is a slip; noise alone is so once in 10^9 windows."""
_LEAST = np.array([0.005, 0.005, 0.008])
"""[m, m, rad] that counts; chosen: play of gears, and lines between the base's telegrams."""
_SHARE = 0.06
"""Of the way by wheels or reference, that counts; chosen: three times the scales' usual error."""
_OVER_S = 0.4
"""Without a difference so long, the slip is over; chosen."""
_TIME, _DIFF, _WAY, _VAR, _SCALE, _LATE = 0, slice(1, 4), slice(4, 7), slice(7, 10), slice(10, 13), slice(13, 16)
_COLUMNS = 16


@dataclass(frozen=True, slots=True)
class Compared:
    """One frame by wheels and by a reference, all (3,) of a twist over it [m, m, rad].

    Attributes:
        counted, moved: by wheels, by the reference.
        known: which axes the reference tells.
        var: noise that is new in every frame.
        scale: standard deviation by what is the same in all frames, such as a scale that is not known well.
        late: by a delay that is not known well: the change of the twist, times its standard deviation.
        ends: variance by what one frame has too much and the next one lacks.
    """

    counted: Array
    moved: Array
    known: Array
    var: Array
    scale: Array
    late: Array
    ends: Array


@dataclass(frozen=True, slots=True)
class Slip:
    """Along an axis of AXES: what the wheels counted and what the robot did since the slip was noticed, m or rad."""

    axis: str
    counted: float
    moved: float


@dataclass(slots=True)
class SlipTestState:
    """
    Attributes:
        rows: (N, 16) of the last frames: time, and (3,) each of difference wheels less reference, way by the
            reference, and `var`, `scale` and `late` of Compared.
        time_s: of the last frame, from the start.
        active_s: (3,) when each axis was last seen slipping; -inf where it is over.
        began: (3,) slips that began, by axis.
    """

    rows: Array = field(default_factory=lambda: np.zeros((0, _COLUMNS)))
    time_s: float = 0.0
    active_s: Array = field(default_factory=lambda: np.full(3, -np.inf))
    began: Array = field(default_factory=lambda: np.zeros(3))


class SlipTest:
    """Feed it every frame with wheels and a reference; miss() the others."""

    def __init__(self) -> None:
        self.state = SlipTestState()

    @property
    def slipping(self) -> tuple[bool, bool, bool]:
        """By axis."""
        a, s, t = np.isfinite(self.state.active_s).tolist()
        return a, s, t

    def miss(self, elapsed_s: float) -> None:
        """A frame without a reference: windows begin anew, and a slip that was on may go on."""
        self.state.time_s += elapsed_s
        self.state.rows = np.zeros((0, _COLUMNS))

    def step(self, c: Compared, elapsed_s: float) -> list[Slip]:
        """Slips that go on now."""
        s = self.state
        s.time_s += elapsed_s
        row = np.zeros(_COLUMNS)
        row[_TIME], row[_DIFF], row[_WAY] = s.time_s, (c.counted - c.moved) * c.known, c.moved * c.known
        row[_VAR], row[_SCALE], row[_LATE] = c.var, c.scale, c.late
        s.rows = np.vstack([s.rows, row])
        s.rows = s.rows[s.rows[:, _TIME] > s.time_s - _WINDOWS_S[-1] - 1e-9]
        off = np.zeros(3, bool)
        for window_s in _WINDOWS_S:
            last = s.rows[s.rows[:, _TIME] > s.time_s - window_s - 1e-9]
            total = last.sum(axis=0)
            diff = np.abs(total[_DIFF])
            var = total[_VAR] + total[_SCALE] ** 2 + total[_LATE] ** 2 + c.ends
            least = np.maximum(_LEAST, _SHARE * np.abs(last[:, _WAY]).sum(axis=0))
            off |= (diff > _SIGMAS * np.sqrt(var)) & (diff > least)
        s.began = s.began + (off & ~np.isfinite(s.active_s))
        s.active_s = np.where(off, s.time_s, s.active_s)
        s.active_s = np.where(s.time_s - s.active_s > _OVER_S, -np.inf, s.active_s)
        total = s.rows.sum(axis=0)
        moved, counted = total[_WAY], total[_WAY] + total[_DIFF]
        return [
            Slip(AXES[k], float(counted[k]), float(moved[k])) for k in np.flatnonzero(np.isfinite(s.active_s)).tolist()
        ]
