"""The last seconds of the heading by gyro and by eye, side by side."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from ceilvo.daemon.odometry.senses.lag import CHANNELS, Series
from ceilvo.senses.heard import Turn
from ceilvo.types import Array, Motion

_KEPT_S, _MOST_ROWS = 3.0, 256
"""As the paths of the cross-checks."""
_TIME, _GYRO, _EYE, _WHOLE, _COLUMNS = 0, 1, 2, 3, 4
_VAR_PS = np.array([1.0, 1e-6])
"""[m^2/s, rad^2/s] of gyro and eye; its ratio to the one below counts; chosen: .06 deg after a second."""
_VAR = np.array([1.0, 2e-7])
"""[m^2, rad^2] of one comparison: the eye's direction, and lines between the gyro's samples."""


@dataclass(slots=True)
class GyroPathState:
    """rows: (N, 4) stamp s, heading by gyro with its bias, heading by eye, both not wrapped, whether the eye measured;
    time_s: of the last one."""

    rows: Array = field(default_factory=lambda: np.zeros((0, _COLUMNS)))
    time_s: float = 0.0


class GyroPath:
    """Without a gyro there is nothing to compare, and the history is dropped."""

    def __init__(self) -> None:
        self.state = GyroPathState()

    def __len__(self) -> int:
        return len(self.state.rows)

    def add(self, motion: Motion, turn: Turn | None, seen: bool, elapsed_s: float) -> None:
        """A frame, with the gyro's turn between the stamps."""
        s = self.state
        s.time_s += elapsed_s
        if turn is None:
            s.rows = np.zeros((0, _COLUMNS))
            return
        last = s.rows[-1] if len(s.rows) else np.zeros(_COLUMNS)
        row = np.array(
            [s.time_s, last[_GYRO] + turn.turned_rad, last[_EYE] + float(motion.prev_from_curr[2]), float(seen)]
        )
        rows = np.vstack([s.rows, row])
        s.rows = rows[np.searchsorted(rows[:, _TIME], s.time_s - _KEPT_S) :][-_MOST_ROWS:]

    def earlier(self, turn: Turn, late_s: float, elapsed_s: float) -> Turn:
        """The turn of an interval that ended so much earlier; as it is where the history does not reach."""
        rows, now_s = self.state.rows, self.state.time_s
        if late_s <= 0.0 or elapsed_s <= 0.0 or not len(rows) or now_s - late_s < rows[0, _TIME]:
            return turn
        times = np.append(rows[:, _TIME], now_s + elapsed_s)
        angles = np.append(rows[:, _GYRO], rows[-1, _GYRO] + turn.turned_rad)
        before, after = np.interp([now_s - late_s, now_s + elapsed_s - late_s], times, angles).tolist()
        return replace(turn, turned_rad=after - before)

    def last(self, late_s: float) -> Turn | None:
        """Of the last late_s until the last row, None where the history does not reach."""
        rows, now_s = self.state.rows, self.state.time_s
        if late_s <= 0.0 or not len(rows) or now_s - late_s < rows[0, _TIME]:
            return None
        before = float(np.interp(now_s - late_s, rows[:, _TIME], rows[:, _GYRO]))
        return Turn(float(rows[-1, _GYRO]) - before, float(_VAR[1]), late_s)

    def series(self) -> Series:
        """For the delay; of the two channels the gyro knows one."""
        rows = self.state.rows
        eye, gyro = np.zeros((len(rows), CHANNELS)), np.zeros((len(rows), CHANNELS))
        eye[:, 1], gyro[:, 1] = rows[:, _EYE], rows[:, _GYRO]
        return Series(rows[:, _TIME], eye, gyro, rows[:, _WHOLE], _VAR_PS, _VAR)
