"""What odometry remembers says of the next frame, before its view is looked at."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from ceilvo import se2
from ceilvo.config import Odometry
from ceilvo.daemon.odometry.coasting import KnownTurn, LastTwist, accelerations, coast, goes_on_turning
from ceilvo.daemon.odometry.course import Course
from ceilvo.daemon.odometry.lines.across import as_told, with_variance
from ceilvo.daemon.odometry.lines.votes import agreed
from ceilvo.daemon.odometry.odometry_state import VisualOdometryState
from ceilvo.daemon.odometry.points.turning import Turning
from ceilvo.daemon.odometry.registration import Registration
from ceilvo.daemon.odometry.rigid import RigidFit, cov_of_turn, with_known_rotation
from ceilvo.types import Array, Crossings, Motion, WheelMotion

_BESIDE_M = 0.05
"""Edges of one thing lie no further apart: of a lamp and its frame, of a groove; chosen."""
_OFF_CHI2 = 9.21
"""Squared distance of a motion from its prediction: chi squared with 2 degrees of freedom exceeds it once in 100. Then
features are asked one by one, which does no harm where all agree."""
_APART = 3.0
"""Times what they are known to, by which features differ that do not move alike; chosen."""
_WITHIN = 3.0
"""Standard deviations within which a feature is where it is foreseen: 99.7 %."""
_FEWEST_WORTH = 4.0 / 3.0
"""Of those that are, as Registration.apart() counts: two points, or two lines' crossings; chosen, for one lies there by
chance."""
_TILT_RAD = np.radians(0.03)
"""Error of the tilt by which a view may seem to jump; chosen: twice what lines of tiles tell it to. Where it is known
worse, few lines tell it, and edges of one lamp are taken for each other."""
_THREE_VIEWS = 1.0 + 4.0 + 1.0
"""Variances of one view in how far it is off its course, which two before it tell."""


def predicted_motion(
    s: VisualOdometryState,
    config: Odometry,
    noise_floor: Array,
    dt_s: float,
    wheels: WheelMotion | None,
    turn: KnownTurn | None,
) -> Motion:
    """The motion of dt_s by wheels or coasting, which has failed until a view confirms it.

    Args:
        noise_floor: (3, 3) covariance of a step that no residual shows.
    """
    if wheels is not None:
        told, cov = wheels.prev_from_curr, wheels.cov
        return Motion(told, cov, 0, 0.0, "", prior_cov=cov, by_wheels=True, watched=wheels.watched)
    if s.twist_known and len(s.recent.twists):
        last = s.recent.median(s.since_twist_s)
    else:
        last = LastTwist(s.twist, s.twist_span_s if s.twist_known else None, s.since_twist_s)
    if turn is None and s.held_s > 0.0:
        turn = goes_on_turning(config, LastTwist(s.twist, s.held_s, 0.0), dt_s)
    moved, cov = coast(config, last, dt_s, turn)
    if len(s.across.told):
        steady = coast(config, LastTwist(s.twist, s.across.told_s, s.across.told_ago_s), dt_s, turn)
        moved, cov = as_told(s.across, moved, cov, *steady)
    cov = cov + noise_floor
    return Motion(moved, cov, 0, 0.0, "", prior_cov=cov)


def step_alone_cov(s: VisualOdometryState, config: Odometry, predicted: Motion, dt_s: float) -> Array:
    """(3, 3) of a step by itself: predicted.cov is what it adds to a gap, in which all steps may err alike."""
    cov: Array = predicted.cov.copy()
    if predicted.by_wheels:
        return cov
    unknown = coast(config, LastTwist(s.twist, None, s.across.since_s), dt_s)[1]
    if np.trace(unknown[:2, :2]) < np.trace(cov[:2, :2]):
        cov[:2, :2] = unknown[:2, :2]
    cov[2, 2] = min(cov[2, 2], unknown[2, 2])
    for n in s.across.told:
        told_m2 = float(n @ predicted.cov[:2, :2] @ n)
        cov = with_variance(cov, n, min(told_m2, float(n @ cov[:2, :2] @ n)))
    return cov


def course_of(s: VisualOdometryState, predicted: Motion, dt_s: float) -> Course:
    """From the last good view to the end of a predicted motion of dt_s."""
    carried = s.heading.carried and s.reference is not None
    return Course(
        guess=se2.compose(s.ref_from_prev, predicted.prev_from_curr),
        cov=predicted.cov
        if not s.ref_cov.any()
        else se2.compose_cov(s.ref_from_prev, s.ref_cov, predicted.prev_from_curr, predicted.cov),
        elapsed_s=s.since_ref_s + dt_s,
        step_s=dt_s,
        twist=s.twist if s.twist_known else None,
        span_s=s.twist_span_s,
        by_wheels=s.by_wheels and predicted.by_wheels,
        refused=s.refused,
        carried_rad=s.reference.psi_sigma_rad if carried and s.reference is not None else 0.0,
        tilt_m=_by_tilt_m(s.reference) if s.reference is not None and s.lean.told else 0.0,
    )


def _by_tilt_m(view: Crossings) -> float:
    """Standard deviation by which errors of the tilt put a view off where two before it do, each no more than one of
    _TILT_RAD does."""
    sigma_rad = float(np.max(view.tilt_sigma_rad))
    if not sigma_rad > 0.0:
        return 0.0
    each_m = math.sqrt(se2.greatest_variance(view.common_cov_m2)) * min(1.0, _TILT_RAD / sigma_rad)
    return float(math.sqrt(_THREE_VIEWS) * each_m)


def turning_of(s: VisualOdometryState, config: Odometry, course: Course, told: bool) -> Turning:
    """At the last good view; told: wheels or a gyro tell what comes after it."""
    turning = s.turning
    if turning is None:
        turning = Turning.nothing()
        if len(s.recent.twists):
            last = s.recent.median(0.0)
            accel = accelerations(config, last.twist)
            turning = Turning.of(last.twist, last.var, last.span_s or 0.0, accel, s.sideways_mps)
    return turning.told(course.guess, course.cov, course.elapsed_s) if told else turning


def steadied(fit: RigidFit, place: Registration, axis_rad: float, course: Course) -> RigidFit:
    """A motion whose features are at odds by what most agree on; one that is off its prediction by those foreseen.

    Where an edge is seen in place of the one beside it, all crossings on it move by a centimetre together, points do
    not, and the motion is in between. No robot jumps so within a frame. Should it have, the next view shows that.

    Args:
        axis_rad: direction of the reference's lines.
    """
    off, spread = course.guess[:2] - fit.b_from_a[:2], course.cov[:2, :2] + fit.cov[:2, :2]
    weight = place.fit.weight
    if weight is None or np.hypot(*off) > _BESIDE_M:
        return fit
    apart = place.fit.rms_m**2 * float(np.mean(weight[place.fit.used])) > _APART**2
    if not apart and off @ np.linalg.solve(spread, off) < _OFF_CHI2:
        return fit
    theta_rad = float(fit.b_from_a[2])
    if apart:
        return _by_votes(fit, place, weight**-0.5, axis_rad, course)
    away = place.before - se2.transform(np.array([*course.guess[:2], theta_rad]), place.seen)
    var = 1.0 / weight[:, None, None] * np.eye(2) + course.cov[:2, :2]
    met = np.einsum("ni,nij,nj->n", away, np.linalg.inv(var), away) < _WITHIN**2
    if place.apart(axis_rad, met) < _FEWEST_WORTH:
        return fit
    by_those = replace(place.fit, used=met, variance_m2=float(np.mean(1.0 / weight[met])))
    return with_known_rotation(by_those, place.seen, place.before, theta_rad, math.sqrt(fit.cov[2, 2]))


def _by_votes(fit: RigidFit, place: Registration, sigma_m: Array, axis_rad: float, course: Course) -> RigidFit:
    """A motion with the translation that most lines and points agree on, and the rotation that it has.

    Args:
        sigma_m: (N,) of the features' displacements.
    """
    theta_rad = float(fit.b_from_a[2])
    turned = place.seen @ se2.rotation(theta_rad).T
    where = (place.before - turned, place.before, place.kinds, sigma_m, axis_rad)
    most = agreed(*where, course.guess[:2], course.cov[:2, :2])
    middle = np.mean(turned[most.used] if np.any(most.used) else turned, axis=0)
    cov = cov_of_turn(middle, float(fit.cov[2, 2]))
    cov[:2, :2] += most.cov
    return replace(fit, b_from_a=np.array([*most.translation, theta_rad]), cov=cov)
