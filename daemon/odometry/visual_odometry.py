"""Stage 4: the robot's motion from frame to frame (section 2.1 of the paper).

Features are predicted from the last motion (or the wheels), matched to the last good frame, cleaned by a homography
and by the residuals of the rigid fit. After a failure the last good frame stays the reference and the prediction
grows with the gap, so one bad frame costs nothing but covariance. Where the prediction leaves room for whole tiles,
or a view fits worse than usual, all displacements that fit are weighed (alternatives.py).
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from ceilvo import se2
from ceilvo.config import Odometry
from ceilvo.daemon.odometry.alternatives import Candidates, Prior, by_two_views, find_candidates
from ceilvo.daemon.odometry.coasting import KnownTurn, RecentTwists, twist_prior
from ceilvo.daemon.odometry.course import (
    CARRIED_PS,
    JUMPED,
    NOWHERE,
    Course,
    Failures,
    Found,
    chance_of_hand,
    contradicted,
    foreseen,
    judged,
    measured_twist,
    off_course,
    on_earlier,
    with_parts,
)
from ceilvo.daemon.odometry.heading_fusion import (
    NEW_ERROR,
    HeadingFusion,
    HeadingState,
    as_expected,
    held,
    with_carried,
    with_direction,
)
from ceilvo.daemon.odometry.lines.across import AcrossState, across, slid
from ceilvo.daemon.odometry.odometry_state import EarlierView, VisualOdometryState
from ceilvo.daemon.odometry.points.constellation import LEANS, has_points, laid
from ceilvo.daemon.odometry.prediction import course_of, predicted_motion, steadied, step_alone_cov, turning_of
from ceilvo.daemon.odometry.registration import (
    Registration,
    fewest,
    held_by_one,
    points_of,
    register,
    view_size_m,
)
from ceilvo.daemon.vision.rolling_shutter import TwistPrior
from ceilvo.daemon.vision.thinning import ENOUGH
from ceilvo.types import Array, Crossings, Displacement, Motion, WheelMotion

_MAX_FAILED_FRAMES = 8
"""Frames in a row that fit no reference before the newest becomes it; chosen: 0.27 s at 30 Hz."""
_REFINE_M = 0.05
"""Match radius around a displacement that many crossings voted for; chosen: several bins of the votes."""
_FALSE_RATE = 1e-4
"""Rate at which a displacement may be wrong that is reported without alternatives; the stated one of the daemon."""
_AS_LIKELY = 0.5
"""Doubt from which a displacement is as likely wrong as right."""
_HARDLY = 0.01
"""Chance of a hand up to which a view is laid on an earlier one without a look at what else fits; chosen."""
_MOVED_RAD = np.pi / math.sqrt(3.0)
"""Standard deviation of the heading of a robot that was put somewhere else: all are alike."""
_ALL_LEAN = 0.75
"""Of the points that meet, so many agree at least where a lean moves them by centimetres; chosen: of a car's lamps 10
of 12 and more, at a false displacement by two slats 9 of 14."""
_NOTHING = np.zeros((3, 3))
_NO_FIT = "nothing fits the last good view"


class VisualOdometry:
    """Frame-to-frame motion; `_noise_floor` is the (3, 3) covariance of a step that no residual shows."""

    def __init__(self, config: Odometry) -> None:
        self._config = config
        xy, theta = config.noise_xy_m, config.noise_theta_rad
        self._noise_floor = np.diag([xy * xy, xy * xy, theta * theta])
        self.state = VisualOdometryState()

    def expected(self, dt_s: float, wheels: WheelMotion | None = None, turn: KnownTurn | None = None) -> Array | None:
        """(3,) predicted motion since the previous call of step(), None right after a failure or at the start."""
        if self.state.reference is None or self.state.since_ref_s > 0.0:
            return None
        if wheels is not None:
            return wheels.prev_from_curr
        moved = self.state.twist * dt_s
        return moved if turn is None else np.array([moved[0], moved[1], turn.turned_rad])

    def look_again(self, reference: Crossings | None) -> None:
        """The last good frame's crossings, when they are known better now; None when they are not."""
        if reference is not None and self.state.reference is not None:
            self.state.reference = reference

    def expected_twist(
        self, dt_s: float, wheels: WheelMotion | None = None, turn: KnownTurn | None = None
    ) -> TwistPrior | None:
        """Of the robot at the end of dt_s, by wheels, or as it was last seen; None when nothing is known of it."""
        s = self.state
        if not s.twist_known or s.twist_span_s <= 0.0 or dt_s <= 0.0:
            return None
        last = se2.mean_twist(s.twist * s.twist_span_s, s.twist_span_s)
        return twist_prior(last, s.twist_change, dt_s, wheels, turn)

    def step(
        self,
        crossings: Crossings | None,
        dt_s: float,
        wheels: WheelMotion | None = None,
        missing: str = "no lines found",
        turn: KnownTurn | None = None,
    ) -> Motion:
        """Motion since the previous call.

        Args:
            crossings: of the current frame; None when the frame gave none.
            dt_s: time since the previous call.
            wheels: what the base reports of the same interval, when it does.
            missing: why there are no crossings, for the failure.
            turn: of the same interval, where there are no wheels.

        Returns:
            A Motion; where it failed, prev_from_curr is the prediction and cov is the variance of that. A
            good motion after failures corrects their predictions: its cov is that of the whole gap.
        """
        predicted = predicted_motion(self.state, self._config, self._noise_floor, dt_s, wheels, turn)
        course, told = course_of(self.state, predicted, dt_s), wheels is not None or turn is not None
        s, ref = self.state, self.state.reference
        if crossings is None or len(crossings) < fewest(crossings, self._config):
            if crossings is not None and ref is not None and (one := self._by_one(ref, crossings, course, told)):
                return self._accept(ref, crossings, course, one, predicted)
            s.refused = None
            predicted = self._held(predicted, crossings, course.step_s)
            return self._coast(predicted, dt_s, missing if crossings is None else f"only {len(crossings)} crossings")
        if ref is None:
            self._set_reference(crossings)
            still = Displacement(np.zeros(3))
            return Motion(still, self._noise_floor.copy(), len(crossings), 0.0, "first frame", restarted=True)
        crossings = as_expected(crossings, ref, course, self._config.heading_gate_rad)
        found = self._find(ref, crossings, course)
        if found.place is None and has_points(crossings) and crossings.directed:  # few lines have a wrong one at times
            pointwise = with_direction(crossings, ref.psi_rad - float(course.guess[2]))
            again = self._find(ref, pointwise, course)
            found, crossings = (found, crossings) if again.place is None else (again, pointwise)
        if found.place is None and found.jump is None and s.by_hand < _HARDLY:
            usual = (s.disagreeing, s.special_disagreeing)
            found = on_earlier(s.earlier.views, crossings, usual, course, self._config) or found
            found = found if found.place is not None else self._by_one(ref, crossings, course, told) or found
        if found.place is None:
            s.refused, found = found.jump, with_parts(found, ref, crossings, course)
            coasted = self._coast(self._held(predicted, crossings, course.step_s), dt_s, found.failure)
            failures = Failures(s.failed_frames + 1, s.disagreeing, s.sliding.glossy, ENOUGH)
            hand = s.across.by_chance * chance_of_hand(ref, crossings, found, failures, course, self._config)
            return self._after_failure(crossings, coasted, found.out_of_view, hand)
        return self._accept(ref, crossings, course, found, predicted)

    def directed(self, crossings: Crossings) -> Crossings:
        """Crossings that step() took, with the direction carried on to them where lines tell none."""
        ref, carried = self.state.reference, self.state.heading.carried
        return with_direction(crossings, ref.psi_rad) if ref is not None and carried else crossings

    # -- the view

    def _find(self, ref: Crossings, crossings: Crossings, course: Course) -> Found:
        """The view on the reference: near the prediction where that suffices, else wherever it fits."""
        guess = foreseen(ref, crossings, course.guess)
        turn = float(guess[2])
        carried = max(self.state.by_hand, min(CARRIED_PS * course.elapsed_s, JUMPED))
        usual = (self.state.disagreeing, self.state.special_disagreeing)
        carried_s = math.inf if self.state.failed_frames else course.elapsed_s
        prior = Prior(course.guess, course.cov, carried, carried_s, usual[1])
        narrow = course.is_within(self._config.match_radius_m)
        near, why = register(ref, crossings, guess, self._config.match_radius_m, self._config, narrow)
        if narrow and not self.state.failed_frames and carried < JUMPED and near is not None and near.is_usual(usual):
            found = judged(Found(near), True, course, self._config)
            return found if found.jump is None else self._by_points(ref, crossings, course) or found
        if min(len(ref), len(crossings)) == 1:  # a lamp: where it is expected, or nowhere
            return judged(Found(near if narrow else None, why or _NO_FIT), True, course, self._config)
        alone = self._by_points(ref, crossings, course)
        if alone is not None:
            return alone
        known = None if near is None else near.fit.b_from_a
        candidates, earlier = find_candidates(ref, crossings, turn, prior, known), self.state.earlier
        if len(candidates) > 1 and earlier.crossings is not None and candidates.doubt() > _FALSE_RATE:
            candidates = by_two_views(candidates, earlier.crossings, earlier.at, crossings, prior)
        found = self._chosen(ref, crossings, candidates, near, why, course)
        return judged(found, found.doubt < _FALSE_RATE, course, self._config)

    def _by_points(self, ref: Crossings, crossings: Crossings, course: Course) -> Found | None:
        """The view where its points lay it and nothing else does, however the robot came there; None if none is so."""
        way = laid(points_of(ref), points_of(crossings), course.guess, course.elapsed_s, self._config)
        if way is None or not way.alone:
            return None
        guess = foreseen(ref, crossings, way.ref_from_curr)
        off_m, sigmas = LEANS * self._config.residual_max_m, LEANS * self._config.residual_sigmas
        leaning = replace(self._config, residual_max_m=off_m, residual_sigmas=sigmas)
        place, _ = register(ref, crossings, guess, self._config.match_radius_m, leaning)
        if place is None or contradicted(place, self._config, course):
            return None
        rough = place.fit.rms_m > self._config.residual_max_m and place.agreeing < _ALL_LEAN * len(place.kinds)
        return None if rough and off_course(place.fit, True, course, self._config) else Found(place)

    def _by_one(self, ref: Crossings, crossings: Crossings, course: Course, told: bool) -> Found | None:
        """The view by a single point where it is expected; None where that does not do."""
        s = self.state
        if not has_points(crossings) or s.by_hand >= _HARDLY or not (told or s.twist_known):
            return None
        turning = turning_of(s, self._config, course, told)
        place, then = held_by_one(ref, crossings, turning, course.elapsed_s, self._config) or (None, None)
        return None if place is None else Found(place, by_one=then)

    def _chosen(
        self,
        ref: Crossings,
        crossings: Crossings,
        found: Candidates,
        near: Registration | None,
        why: str,
        course: Course,
    ) -> Found:
        """The likeliest of all displacements that fit, with the others that may be right."""
        place = near if len(found) and near is not None and found.is_first(near.fit.b_from_a) else None
        if place is None and (not len(found) or max(found.log_elsewhere, found.log_carried) > found.log_weight[0]):
            why = why or (near is not None and contradicted(near, self._config, course)) or _NO_FIT
            return Found(None, why, elsewhere=math.exp(found.log_elsewhere))
        if place is None:
            place, why = register(ref, crossings, found.ref_from_curr[0], _REFINE_M, self._config, narrow=True)
        if place is None:
            return Found(None, why)
        doubt = found.doubt()
        if self.state.failed_frames and doubt > _AS_LIKELY:
            return Found(None, "several displacements fit the last good view alike")
        others = found.others(_FALSE_RATE) if doubt >= _FALSE_RATE else np.zeros(0, np.int64)
        ratio = found.log_ratio[others] - found.log_ratio[0]
        by_hand = self.state.by_hand
        left = min(found.carried() / by_hand, 1.0) if by_hand > 0.0 else 1.0
        at, unpredicted = found.ref_from_curr[others], float(found.unpredicted[0])
        return Found(place, "", at, ratio, doubt, unpredicted, doubt_left=left)

    def _accept(self, ref: Crossings, crossings: Crossings, course: Course, found: Found, predicted: Motion) -> Motion:
        s, place = self.state, found.place
        assert place is not None
        fit = place.fit
        if found.by_one is None:
            fit = HeadingFusion(s.heading).fused(ref, crossings, place, course)
            fit = steadied(fit, place, ref.psi_rad, course) if s.twist_known and crossings.directed else fit
        motion = se2.between(s.ref_from_prev, fit.b_from_a)  # eq. 8, from the previous frame
        cov = fit.cov + self._noise_floor
        cov[:2, :2] += NEW_ERROR**2 * (ref.common_cov_m2 + crossings.common_cov_m2)
        alternatives = se2.between(s.ref_from_prev, found.others) if len(found.others) else NOWHERE
        self._set_reference(with_carried(crossings, ref, fit), fit.b_from_a, cov)
        s.heading.carried = not crossings.directed
        if found.by_one is not None:
            s.turned(found.by_one, course.step_s)
        else:
            twist, span_s = measured_twist(fit, course, self._config)
            s.measured(twist, np.diag(cov) / course.elapsed_s**2, span_s, found.doubt < _FALSE_RATE)
            s.agreed(place)
            s.drove(twist, span_s)
        return replace(
            predicted,
            prev_from_curr=Displacement(motion),
            cov=cov,
            inliers=place.agreeing,
            rms_m=fit.rms_m,
            failure=None,
            seen=True,
            alternatives=alternatives,
            log_ratio=found.log_ratio,
            doubt=max(found.doubt, JUMPED * found.unpredicted),
            doubt_left=found.doubt_left,
            apart=place.apart(ref.psi_rad),
        )

    def _set_reference(self, crossings: Crossings, moved: Array | None = None, cov: Array = _NOTHING) -> None:
        s = self.state
        s.reference, s.ref_from_prev, s.ref_cov = crossings, np.zeros(3), np.zeros((3, 3))
        s.earlier = EarlierView() if moved is None else s.earlier.then(moved, cov, crossings)
        s.since_ref_s, s.failed_frames, s.by_hand, s.by_wheels, s.refused, s.held_s = 0.0, 0, 0.0, True, None, 0.0
        s.turning, s.across = None, AcrossState(crossings)

    # -- without a motion

    def _held(self, predicted: Motion, crossings: Crossings | None, step_s: float) -> Motion:
        """The prediction with the rotation that lines tell, where they do, and the motion across them."""
        s, gate_rad = self.state, self._config.heading_gate_rad
        key, motion, step_cov = s.across, predicted, step_alone_cov(s, self._config, predicted, step_s)
        since = (key.key, key.at, key.cov) if s.reference is None else (s.reference, s.ref_from_prev, s.ref_cov)
        if crossings is not None and (view := since[0]) is not None:
            vague_rad2 = step_cov[2, 2] if s.reference is None else predicted.cov[2, 2]
            motion = held(predicted, view, crossings, *since[1:], float(vague_rad2), gate_rad)
        s.held_s = 0.0 if motion is predicted else step_s
        if s.held_s > 0.0:
            s.twist = np.array([*s.twist[:2], motion.prev_from_curr[2] / s.held_s])
            s.recent, step_cov[2, 2] = s.recent.turning(float(s.twist[2])), motion.cov[2, 2]
        motion = across(s.across, motion, step_cov, crossings, gate_rad, step_s)
        s.twist = slid(s.across, s.twist, motion)
        return motion

    def _coast(self, predicted: Motion, dt_s: float, why: str) -> Motion:
        """The prediction in place of a motion."""
        s = self.state
        s.ref_cov = se2.compose_cov(s.ref_from_prev, s.ref_cov, predicted.prev_from_curr, predicted.cov)
        s.ref_from_prev = se2.compose(s.ref_from_prev, predicted.prev_from_curr)
        s.since_ref_s += dt_s
        s.since_twist_s += dt_s
        s.by_wheels &= predicted.by_wheels
        if predicted.by_wheels and dt_s > 0.0:  # they also say how it goes on without them
            s.twist, s.twist_span_s, s.since_twist_s = predicted.prev_from_curr / dt_s, dt_s, 0.0
            s.recent = RecentTwists()
        return replace(predicted, failure=why)

    def _after_failure(self, crossings: Crossings, motion: Motion, out_of_view: bool, by_hand: float) -> Motion:
        """Where the reference is out of view, or several frames did not fit it, go on from here: where these show that
        somebody moved the robot, anywhere."""
        s = self.state
        s.failed_frames, s.by_hand = s.failed_frames + 1, max(s.by_hand, by_hand)
        if s.reference is None or not (out_of_view or s.failed_frames >= _MAX_FAILED_FRAMES):
            return replace(motion, doubt=by_hand)
        cov, goes_on = motion.cov, (s.held_s, s.across.on(crossings))
        if not out_of_view and s.by_hand > _HARDLY:
            away = view_size_m(s.reference)
            cov, goes_on = cov + np.diag([away**2, away**2, _MOVED_RAD**2]), (0.0, AcrossState(crossings))
        self._set_reference(crossings)
        s.held_s, s.across = goes_on
        s.twist_known, s.recent = False, RecentTwists()
        s.heading = HeadingState()
        return replace(motion, cov=cov, prior_cov=cov, restarted=True)
