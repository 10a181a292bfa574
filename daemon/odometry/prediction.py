"""What odometry remembers says of the next frame, before its view is looked at."""

from __future__ import annotations

from ceilvo import se2
from ceilvo.config import Odometry
from ceilvo.daemon.odometry.coasting import KnownTurn, LastTwist, accelerations, coast, goes_on_turning
from ceilvo.daemon.odometry.course import Course
from ceilvo.daemon.odometry.odometry_state import VisualOdometryState
from ceilvo.daemon.odometry.points.turning import Turning
from ceilvo.types import Array, Motion, WheelMotion


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
    cov = cov + noise_floor
    return Motion(moved, cov, 0, 0.0, "", prior_cov=cov)


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
    )


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
