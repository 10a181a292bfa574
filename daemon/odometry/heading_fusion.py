"""Keeps the sum of a drive's rotations at the direction of the ceiling's lines, which does not drift.

Where a view has no lines their direction is carried on by the rotation of the points, so it is there when lines are in
view again.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

from ceilvo.daemon.odometry.course import Course
from ceilvo.daemon.odometry.lines.direction import DIRECTION_SIGMAS, turn_by_lines
from ceilvo.daemon.odometry.points.constellation import has_points
from ceilvo.daemon.odometry.registration import Registration
from ceilvo.daemon.odometry.rigid import RigidFit, with_known_rotation
from ceilvo.daemon.vision.line_pairing import fold_direction
from ceilvo.se2 import wrap
from ceilvo.types import NO_DIRECTION_RAD, Array, Crossings, Displacement, Motion

NEW_ERROR = 0.6
"""Part of a direction's or tilt's error that is new in a frame; the rest is the same lines' in the next and cancels.
Chosen: the whole makes motions too cautious, which column NEES/3 of `make bench-vision` shows (docs/bench.md)."""
_VAGUE_RAD = math.radians(0.3)
"""Lines whose direction is known worse hold no heading; chosen: outlines of stains tell theirs to a degree."""
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
    """By how much the lines' heading is ahead of the sum of reported rotations, and the variance of that sum.

    Attributes:
        carried: the direction of the last good view was carried on, not seen.
    """

    deferred_rad: float = 0.0
    deferred_var_rad2: float = 0.0
    carried: bool = False


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

    def fused(self, ref: Crossings, crossings: Crossings, place: Registration, course: Course) -> RigidFit:
        """The fit with the rotation to report: by lines or points, and by the prediction where there are no lines."""
        fit = place.fit
        points_rad, points_var_rad2 = float(fit.b_from_a[2]), float(fit.cov[2, 2])
        if not place.by_lines:
            share = points_var_rad2 / (points_var_rad2 + float(course.cov[2, 2]))
            theta = points_rad + share * wrap(float(course.guess[2]) - points_rad)
            sigma = math.sqrt(points_var_rad2 * (1.0 - share))
            return with_known_rotation(fit, place.seen, place.before, theta, sigma)
        sigma = NEW_ERROR * math.hypot(ref.psi_sigma_rad, crossings.psi_sigma_rad)
        best = self.fuse(place.turn_rad, sigma, points_rad, math.sqrt(points_var_rad2))
        if best.of_points or self.state.carried:  # what lines make good was not turned in this step
            return fit.with_rotation(best.theta_rad, best.sigma_rad)
        return with_known_rotation(fit, place.seen, place.before, best.theta_rad, best.sigma_rad)


def oriented(crossings: Crossings, psi_rad: float) -> Crossings:
    """The crossings with that direction, unless lines tell them one."""
    return crossings if crossings.directed else with_direction(crossings, psi_rad)


def with_direction(crossings: Crossings, psi_rad: float) -> Crossings:
    """The crossings with a direction that none of their lines tells."""
    return replace(crossings, psi_rad=fold_direction(psi_rad)[0], psi_sigma_rad=NO_DIRECTION_RAD)


def as_expected(crossings: Crossings, ref: Crossings, course: Course, gate_rad: float) -> Crossings:
    """The crossings with the direction that is predicted where lines tell none, or one that is not the ceiling's.

    Where few lines cross, their direction may be that of other lines than before: hexagons have three. So it may when
    lines suffice again after the direction was carried on over points.
    """
    predicted = ref.psi_rad - float(course.guess[2])
    vague = math.hypot(course.carried_rad, math.sqrt(course.cov[2, 2]))
    off = abs(fold_direction(crossings.psi_rad - predicted)[0])
    other = off > gate_rad + DIRECTION_SIGMAS * vague
    few = has_points(crossings) or course.carried_rad > 0.0
    return with_direction(crossings, predicted) if few and ref.directed and other else oriented(crossings, predicted)


def held(
    predicted: Motion,
    view: Crossings,
    crossings: Crossings,
    before: Array,
    before_cov: Array,
    step_var_rad2: float,
    gate_rad: float,
) -> Motion:
    """A prediction with the rotation that lines show, where they are too few for a motion: one lamp holds the heading.

    Args:
        view: an earlier one.
        before: (3,) predicted from that view to the previous frame, with covariance (3, 3).
        step_var_rad2: of the predicted rotation.
        gate_rad: lines that are off the prediction by more, beside its error, are others.
    """
    sigma = math.hypot(view.psi_sigma_rad, crossings.psi_sigma_rad)
    guess = float(before[2] + predicted.prev_from_curr[2])
    turn = turn_by_lines(view.psi_rad, crossings.psi_rad, guess, float(before_cov[2, 2]) + step_var_rad2, gate_rad)
    if sigma > _VAGUE_RAD or turn is None:
        return predicted
    moved, cov = predicted.prev_from_curr.copy(), predicted.cov.copy()
    moved[2], cov[2, :2], cov[:2, 2] = wrap(turn - float(before[2])), 0.0, 0.0
    cov[2, 2] = max(sigma**2 - float(before_cov[2, 2]), (NEW_ERROR * sigma) ** 2)  # together they err as the lines do
    return replace(predicted, prev_from_curr=Displacement(moved), cov=cov)


def with_carried(crossings: Crossings, ref: Crossings, fit: RigidFit) -> Crossings:
    """The crossings with the direction of the view that they were registered to, unless lines tell them one."""
    if crossings.directed:
        return crossings
    sigma = min(math.hypot(ref.psi_sigma_rad, math.sqrt(float(fit.cov[2, 2]))), NO_DIRECTION_RAD)
    return replace(with_direction(crossings, ref.psi_rad - float(fit.b_from_a[2])), psi_sigma_rad=sigma)
