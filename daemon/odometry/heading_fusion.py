"""Keeps the sum of a drive's rotations at the direction of the ceiling's lines, which does not drift."""

from __future__ import annotations

import math
from dataclasses import dataclass

from ceilvo.se2 import wrap

_AGREE_SIGMAS = 3.0


@dataclass(frozen=True, slots=True)
class Turn:
    """A rotation, its standard deviation, rad, and whether the points' translation holds for it as it stands."""

    theta_rad: float
    sigma_rad: float
    of_points: bool


class HeadingLock:
    """Chooses between the rotation of the lines and that of the points, and remembers what the choice left open.

    The lines' direction errs from frame to frame where few or crooked lines show, but its errors do not add up; those
    of the points do. So the points carry the heading over frames where the two disagree, and the difference is made
    good as soon as they agree again.
    """

    def __init__(self) -> None:
        self._open_rad = 0.0
        self._variance = 0.0

    def forget(self) -> None:
        """The reference was lost: what was left open means nothing to the next one."""
        self._open_rad, self._variance = 0.0, 0.0

    def choose(self, lines_rad: float, lines_sigma_rad: float, points_rad: float, points_sigma_rad: float) -> Turn:
        """The rotation to report for one step."""
        full = lines_rad + self._open_rad
        off = abs(wrap(full - points_rad))
        variance = self._variance + points_sigma_rad**2
        if off > _AGREE_SIGMAS * math.sqrt(lines_sigma_rad**2 + variance):
            self._open_rad = wrap(full - points_rad)
            self._variance = variance
            return Turn(points_rad, points_sigma_rad, True)
        free = self._open_rad == 0.0
        turn = Turn(full, math.sqrt(lines_sigma_rad**2 + self._variance), not free)
        self.forget()
        return turn
