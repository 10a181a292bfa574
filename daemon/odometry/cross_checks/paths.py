"""The last seconds of the path by eye and by wheels, side by side, from which every comparison takes its windows."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np

from ceilvo import se2
from ceilvo.daemon.odometry.senses.lag import Series
from ceilvo.types import Array, Displacement, Motion, WheelMotion

KEPT_S = 3.0
"""How far back the paths reach; chosen: several times the longest delay that is looked for."""
_MOST_ROWS = 256
"""Of the history, whatever the frame rate; chosen: 3 s at 85 Hz."""
_VAR_PS = np.array([1e-5, 1e-5])
"""[m^2/s, rad^2/s] by which wheels and eye differ in a second of driving, and of one comparison, for the delay: only
the ratio of the two counts; chosen: 3 mm and .2 deg, and 1 mm, .1 deg for lines between the base's telegrams."""
_VAR = np.array([1e-6, 3e-6])
_TIME, _GOOD, _PIECE, _VAR_XY, _VAR_TURN, _WHEELS, _EYE = 0, 1, 2, 3, 4, slice(5, 8), slice(8, 11)
_COLUMNS = 11


@dataclass(slots=True)
class PathsState:
    """Rows of the last frames, oldest first.

    Attributes:
        rows: (N, 11) stamp s, whether vision measured the motion, number of the unbroken piece of vision's path,
            variance m^2 and rad^2 that the wheels' path has gathered, path by wheels (3,), path by eye (3,); headings
            are not wrapped.
        time_s: stamp of the last row, counted from the first frame.
    """

    rows: Array = field(default_factory=lambda: np.zeros((0, _COLUMNS)))
    time_s: float = 0.0


class Paths:
    """Two paths from the same start. Without wheels there is nothing to compare, and the history is dropped."""

    def __init__(self) -> None:
        self.state = PathsState()

    def add(self, motion: Motion, wheels: WheelMotion | None, elapsed_s: float) -> None:
        """A frame's motion (in a gap its prediction, which the next good motion corrects) and what wheels say of it."""
        s = self.state
        s.time_s += elapsed_s
        if wheels is None:
            s.rows = np.zeros((0, _COLUMNS))
            return
        row = np.zeros(_COLUMNS)
        if len(s.rows):
            last = s.rows[-1]
            row[_PIECE] = last[_PIECE] + motion.restarted
            row[_VAR_XY] = last[_VAR_XY] + 0.5 * (wheels.cov[0, 0] + wheels.cov[1, 1])
            row[_VAR_TURN] = last[_VAR_TURN] + wheels.cov[2, 2]
            row[_WHEELS] = _onward(last[_WHEELS], wheels.prev_from_curr)
            row[_EYE] = _onward(last[_EYE], motion.prev_from_curr)
        row[_TIME], row[_GOOD] = s.time_s, motion.ok or motion.restarted
        rows = np.vstack([s.rows, row])
        s.rows = rows[np.searchsorted(rows[:, _TIME], s.time_s - KEPT_S) :][-_MOST_ROWS:]

    # -- columns, oldest first

    @property
    def time_s(self) -> Array:
        """(N,)"""
        return self.state.rows[:, _TIME]

    @property
    def good(self) -> Array:
        """(N,) 1 where vision measured the motion that ends there."""
        return self.state.rows[:, _GOOD]

    @property
    def piece(self) -> Array:
        """(N,) rows of one piece of vision's path have the same number."""
        return self.state.rows[:, _PIECE]

    @property
    def wheels(self) -> Array:
        """(N, 3) path by wheels, heading not wrapped."""
        return self.state.rows[:, _WHEELS]

    @property
    def eye(self) -> Array:
        """(N, 3) path by eye, heading not wrapped."""
        return self.state.rows[:, _EYE]

    def __len__(self) -> int:
        return len(self.state.rows)

    def series(self) -> Series:
        """Way ahead and turn, by eye and by wheels, for the delay between them."""
        wheels, eye = _ahead(self.wheels), _ahead(self.eye)
        whole = self.good * np.append(1.0, np.diff(self.piece) == 0.0)
        return Series(self.time_s, eye, wheels, whole, _VAR_PS, _VAR)

    # -- windows

    def wheels_at(self, time_s: float | Array) -> Array:
        """(..., 3) path by wheels at a time, linear between rows; the ends beyond them."""
        t = self.time_s
        return np.stack([np.interp(time_s, t, column) for column in self.wheels.T], axis=-1)

    def wheel_variance(self, from_s: float, to_s: float) -> tuple[float, float]:
        """m^2 and rad^2 that the wheels' path gathers between two times."""
        t, rows = self.time_s, self.state.rows
        gathered = [np.interp((from_s, to_s), t, rows[:, c]) for c in (_VAR_XY, _VAR_TURN)]
        return float(gathered[0][1] - gathered[0][0]), float(gathered[1][1] - gathered[1][0])

    def wheel_motion(self, from_s: float, to_s: float) -> WheelMotion | None:
        """What the wheels did between two times, None where the history does not cover them."""
        if len(self) < 2 or from_s < self.time_s[0] or to_s > self.time_s[-1]:
            return None
        var_xy, var_turn = self.wheel_variance(from_s, to_s)
        moved = displacement(self.wheels_at(from_s), self.wheels_at(to_s))
        return WheelMotion(moved, np.diag([var_xy, var_xy, var_turn]))


def displacement(start: Array, end: Array) -> Displacement:
    """(3,) from one row of a path to another, in base at the first; the turn is not wrapped."""
    c, s = math.cos(start[2]), math.sin(start[2])
    x, y, turned = (end - start).tolist()
    return Displacement(np.array([c * x + s * y, c * y - s * x, turned]))


def _ahead(path: Array) -> Array:
    """(N, 2) way ahead since the first row, and heading."""
    step, middle = np.diff(path, axis=0), 0.5 * (path[:-1, 2] + path[1:, 2])
    ahead = np.cos(middle) * step[:, 0] + np.sin(middle) * step[:, 1]
    return np.column_stack([np.concatenate([[0.0], np.cumsum(ahead)]), path[:, 2] - path[0, 2]])


def _onward(pose: Array, step: Array) -> Array:
    """A row of a path after a step, heading not wrapped."""
    on = se2.compose(pose, step)
    on[2] = pose[2] + step[2]
    return on
