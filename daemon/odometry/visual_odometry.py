"""Stage 4: the robot's motion from frame to frame (section 2.1 of the paper).

Features are predicted from the last motion (or the wheels), matched to the last good frame, cleaned by a homography
and by the residuals of the rigid fit. After a failure the last good frame stays the reference and the prediction
grows with the gap, so one bad frame costs nothing but covariance.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from ceilvo import se2
from ceilvo.config import Odometry
from ceilvo.crossing_types import quarter_turns, turned_type
from ceilvo.daemon.odometry.heading_fusion import HeadingFusion, HeadingState
from ceilvo.daemon.odometry.homography import consistent
from ceilvo.daemon.odometry.matching import mutual_nearest
from ceilvo.daemon.odometry.rigid import RigidFit, median_translation, robust_rigid_motion, with_known_rotation
from ceilvo.robust import median
from ceilvo.types import Crossings, Displacement, Ints, Motion, WheelMotion

Array = NDArray[np.float64]

_MAX_FAILED_FRAMES = 8
"""Frames in a row that fit no reference before the newest becomes it; chosen: 0.27 s at 30 Hz."""
_TWIST_DECAY_S = 1.0
"""Time constant of the twist while vision is out; chosen: a robot that hears that its pose is bad stops in about it."""
_COURSE_SIGMAS = 5.0
"""Of the fit's own error, allowed on top of the acceleration limits; noise alone exceeds 5 in 4 of a million."""
_MIN_AGREEING = 1.0 / 3.0
"""Least fraction of the crossings that move alike; chosen: laps had 0.6 at least, bare plaster with lamps 0.37."""
_NEW_ERROR = 0.6
"""Part of a direction's or tilt's error that is new in a frame; the rest is the same lines' in the next and cancels.
Chosen: the whole makes motions too cautious, which column NEES/3 of `make bench-vision` shows (docs/bench.md)."""
_MIN_VIEW_M = 1e-9
"""Crossings all in one place: not divided by 0."""


@dataclass(slots=True)
class VisualOdometryState:
    """What the next frame is registered to.

    Attributes:
        reference: crossings of the last good frame, None before the first.
        ref_from_prev: (3,) [m, m, rad] predicted motion from it to the previous frame; 0 when that is the reference.
        since_ref_s: time from it to the previous frame.
        failed_frames: in a row that had crossings, but none that fit the reference.
        twist: (3,) [m/s, m/s, rad/s] in base, of the last good step.
        twist_known: whether there was one since odometry last began anew.
        heading: difference between the rotations of lines and points.
    """

    reference: Crossings | None = None
    ref_from_prev: Array = field(default_factory=lambda: np.zeros(3))
    since_ref_s: float = 0.0
    failed_frames: int = 0
    twist: Array = field(default_factory=lambda: np.zeros(3))
    twist_known: bool = False
    heading: HeadingState = field(default_factory=HeadingState)


class VisualOdometry:
    """Frame-to-frame motion."""

    def __init__(self, config: Odometry) -> None:
        self._config = config
        self.state = VisualOdometryState()

    def expected(self, dt_s: float, wheels: WheelMotion | None = None) -> Array | None:
        """(3,) predicted motion since the previous call of step(), None right after a failure or at the start."""
        if self.state.reference is None or self.state.since_ref_s > 0.0:
            return None
        return wheels.prev_from_curr if wheels is not None else self.state.twist * dt_s

    def step(
        self,
        crossings: Crossings | None,
        dt_s: float,
        wheels: WheelMotion | None = None,
        missing: str = "no lines found",
    ) -> Motion:
        """Motion since the previous call.

        Args:
            crossings: of the current frame; None when the frame gave none.
            dt_s: time since the previous call.
            wheels: what the base reports of the same interval, when it does.
            missing: why there are no crossings, for the failure.

        Returns:
            A Motion; where it failed, prev_from_curr is the prediction and cov is the variance of that. A
            good motion after failures corrects their predictions: its cov is that of the whole gap.
        """
        predicted = wheels.prev_from_curr if wheels is not None else self._decayed_twist() * dt_s
        if crossings is None:
            return self._dead_reckon(predicted, dt_s, wheels, missing)
        if len(crossings) < self._config.min_inliers:
            return self._dead_reckon(predicted, dt_s, wheels, f"only {len(crossings)} crossings")
        if self.state.reference is None:
            self._set_reference(crossings)
            still = Displacement(np.zeros(3))
            return Motion(still, self._noise_floor(), len(crossings), 0.0, "first frame", restarted=True)
        fit, failure = self._register(crossings, se2.compose(self.state.ref_from_prev, predicted), dt_s)
        if fit is None:
            return self._after_failure(crossings, self._dead_reckon(predicted, dt_s, wheels, failure))
        motion = se2.between(self.state.ref_from_prev, fit.b_from_a)  # eq. 8, from the previous frame
        cov = fit.cov + self._noise_floor()
        cov[:2, :2] += _NEW_ERROR**2 * (self.state.reference.common_cov_m2 + crossings.common_cov_m2)
        self.state.twist = fit.b_from_a / (self.state.since_ref_s + dt_s)
        self.state.twist_known = True
        self._set_reference(crossings)
        return Motion(Displacement(motion), cov, int(np.count_nonzero(fit.used)), fit.rms_m)

    def _set_reference(self, crossings: Crossings) -> None:
        self.state.reference, self.state.ref_from_prev = crossings, np.zeros(3)
        self.state.since_ref_s, self.state.failed_frames = 0.0, 0

    def _noise_floor(self) -> Array:
        """(3, 3) covariance of a step that no residual shows."""
        xy, theta = self._config.noise_xy_m, self._config.noise_theta_rad
        return np.diag([xy * xy, xy * xy, theta * theta])

    def _register(self, crossings: Crossings, guess: Array, dt_s: float) -> tuple[RigidFit | None, str]:
        """ref_from_curr by matching near the guess, or why there is none."""
        ref, cfg = self.state.reference, self._config
        if ref is None:
            return None, "no reference"
        turn = _direction_change(ref.psi_rad, crossings.psi_rad, float(guess[2]))
        guess = np.array([guess[0], guess[1], turn])
        kinds = turned_type(crossings.crossing_type, quarter_turns(crossings.psi_rad + turn, ref.psi_rad))
        i, j = mutual_nearest(
            se2.transform(guess, crossings.xy_base_m), kinds, ref.xy_base_m, ref.crossing_type, cfg.match_radius_m
        )
        if len(i) < cfg.min_inliers:
            return None, f"{len(i)} of {len(crossings)} crossings matched, {cfg.min_inliers} needed"
        good = consistent(crossings.uv_px[i], ref.uv_px[j], cfg.ransac_px)
        i, j = i[good], j[good]
        if len(i) == 0:
            return None, "no consistent correspondences"
        seen, before = crossings.xy_base_m[i], ref.xy_base_m[j]
        fit = robust_rigid_motion(
            seen,
            before,
            cfg.residual_sigmas,
            cfg.residual_max_m,
            cfg.min_inliers,
            [median_translation(seen, before, turn, ref.psi_rad)],
            _independent_sigma_m(crossings, i) + _independent_sigma_m(ref, j),
        )
        if fit is None:
            return None, "too few consistent correspondences"
        failure = (
            self._implausible(fit.b_from_a, turn, self.state.since_ref_s + dt_s)
            or self._off_course(fit, dt_s)
            or _too_few_agree(fit, crossings, ref)
        )
        if failure:
            return None, failure
        sigma_rad = _NEW_ERROR * math.hypot(ref.psi_sigma_rad, crossings.psi_sigma_rad)
        best = HeadingFusion(self.state.heading).fuse(turn, sigma_rad, float(fit.b_from_a[2]), math.sqrt(fit.cov[2, 2]))
        if best.of_points:
            return fit.with_rotation(best.theta_rad, best.sigma_rad), ""
        return with_known_rotation(fit, seen, before, best.theta_rad, best.sigma_rad), ""

    def _implausible(self, ref_from_curr: Array, turn: float, elapsed_s: float) -> str:
        cfg = self._config
        off = abs(se2.wrap(float(ref_from_curr[2]) - turn))
        travel = float(np.hypot(ref_from_curr[0], ref_from_curr[1]))
        if off > cfg.heading_gate_rad:
            return f"rotation of points and of lines differ by {off:.3f} rad"
        if travel > cfg.max_speed_mps * elapsed_s:
            return f"moved {travel:.3f} m in {elapsed_s:.3f} s"
        if abs(ref_from_curr[2]) > cfg.max_turn_radps * elapsed_s:
            return f"turned {abs(ref_from_curr[2]):.3f} rad in {elapsed_s:.3f} s"
        return ""

    def _after_failure(self, crossings: Crossings, motion: Motion) -> Motion:
        """After several frames that do not fit the reference, go on from here; the covariance grows accordingly."""
        self.state.failed_frames += 1
        if self.state.failed_frames < _MAX_FAILED_FRAMES:
            return motion
        self._set_reference(crossings)
        self.state.twist_known = False
        self.state.heading = HeadingState()
        return replace(motion, restarted=True)

    def _off_course(self, fit: RigidFit, dt_s: float) -> str:
        """Neighbouring lines that change places: a jump that is consistent in itself, but that no robot makes."""
        if not self.state.twist_known:
            return ""
        elapsed_s = self.state.since_ref_s + dt_s
        off = fit.b_from_a - self.state.twist * elapsed_s
        off_m, off_rad = float(np.hypot(off[0], off[1])), abs(se2.wrap(float(off[2])))
        noise_m = _COURSE_SIGMAS * float(np.sqrt(np.linalg.eigvalsh(fit.cov[:2, :2])[-1]))
        noise_rad = _COURSE_SIGMAS * math.sqrt(fit.cov[2, 2])
        if off_m > self._config.max_accel_mps2 * elapsed_s**2 + noise_m:
            return f"jumped {off_m:.3f} m off its course within {elapsed_s:.3f} s"
        if off_rad > self._config.max_turn_accel_radps2 * elapsed_s**2 + noise_rad:
            return f"turned {off_rad:.3f} rad off its course within {elapsed_s:.3f} s"
        return ""

    def _decayed_twist(self) -> Array:
        """The last twist, fading with the gap: a robot that hears that its pose is bad will stop."""
        return np.asarray(self.state.twist * np.exp(-self.state.since_ref_s / _TWIST_DECAY_S))

    def _dead_reckon(self, predicted: Array, dt_s: float, wheels: WheelMotion | None, reason: str) -> Motion:
        start_s = self.state.since_ref_s
        self.state.since_ref_s += dt_s
        self.state.ref_from_prev = se2.compose(self.state.ref_from_prev, predicted)
        if wheels is not None:
            return Motion(wheels.prev_from_curr, wheels.cov, 0, 0.0, reason)
        # an unknown constant acceleration displaces by a t^2 / 2; its variance, split over the steps of the gap
        spread_s4 = 0.25 * (self.state.since_ref_s**4 - start_s**4)
        xy, theta = self._config.coast_accel_mps2**2 * spread_s4, self._config.coast_turn_radps2**2 * spread_s4
        return Motion(
            Displacement(np.asarray(predicted, np.float64)),
            np.diag([xy, xy, theta]) + self._noise_floor(),
            0,
            0.0,
            reason,
        )


def _too_few_agree(fit: RigidFit, crossings: Crossings, ref: Crossings) -> str:
    """A motion that few of the crossings share which both frames must show: a part that fits by chance."""
    view_m = 2.0 * float(np.median(np.hypot(*(ref.xy_base_m - ref.xy_base_m.mean(axis=0)).T)))
    overlap = max(1.0 - float(np.hypot(*fit.b_from_a[:2])) / max(view_m, _MIN_VIEW_M), 0.0)
    most, used = min(len(crossings), len(ref)), int(np.count_nonzero(fit.used))
    return f"{used} of {most} crossings moved alike" if used < _MIN_AGREEING * overlap * most else ""


def _independent_sigma_m(crossings: Crossings, which: Ints) -> float:
    """Median standard deviation of the crossings `which`, m, without the part that all of a frame share."""
    cov, common = crossings.cov_base_m2, crossings.common_cov_m2
    own = cov[which, 0, 0] + cov[which, 1, 1] - (common[0, 0] + common[1, 1])
    return math.sqrt(max(0.5 * median(own), 0.0))


def _direction_change(psi_ref: float, psi_curr: float, predicted: float) -> float:
    """ref_from_curr rotation from the change of dominant direction: the branch modulo 90 deg nearest the prediction."""
    change = psi_ref - psi_curr
    branch = np.round((predicted - change) / (0.5 * np.pi))
    return float(change + branch * 0.5 * np.pi)
