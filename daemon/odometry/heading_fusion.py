"""Keeps the sum of a drive's rotations at the direction of the ceiling's lines, which does not drift."""

from __future__ import annotations

import math
from dataclasses import dataclass

from ceilvo.se2 import wrap

_AGREE_SIGMAS = 3.0
"""Lines and points agree within this, in standard deviations of their difference: 99.7 %."""


@dataclass(frozen=True, slots=True)
class Turn:
    """A rotation, its standard deviation, rad, and whether the points' translation holds for it as it stands."""

    theta_rad: float
    sigma_rad: float
    of_points: bool


@dataclass(slots=True)
class HeadingState:
    """By how much the lines' heading is ahead of the sum of reported rotations, and the variance of that sum."""

    deferred_rad: float = 0.0
    deferred_var_rad2: float = 0.0


class HeadingFusion:
    """Chooses between the rotation of the lines and that of the points, and remembers what the choice left open.

    The lines' direction errs from frame to frame where few or crooked lines show, but its errors do not add up; those
    of the points do. So the points carry the heading over frames where the two disagree, and the difference is made
    good as soon as they agree again.
    """

    def __init__(self, state: HeadingState | None = None) -> None:
        self.state = HeadingState() if state is None else state

    def fuse(self, lines_rad: float, lines_sigma_rad: float, points_rad: float, points_sigma_rad: float) -> Turn:
        """The rotation to report for one step."""
        s = self.state
        full = lines_rad + s.deferred_rad
        off = abs(wrap(full - points_rad))
        variance = s.deferred_var_rad2 + points_sigma_rad**2
        if off > _AGREE_SIGMAS * math.sqrt(lines_sigma_rad**2 + variance):
            s.deferred_rad, s.deferred_var_rad2 = wrap(full - points_rad), variance
            return Turn(points_rad, points_sigma_rad, True)
        turn = Turn(full, math.sqrt(lines_sigma_rad**2 + s.deferred_var_rad2), s.deferred_rad != 0.0)
        s.deferred_rad, s.deferred_var_rad2 = 0.0, 0.0
        return turn
