"""What is known of a motion before its view is looked at, and which motions no robot makes."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

import cv2
import numpy as np

from ceilvo import se2
from ceilvo.config import Odometry
from ceilvo.daemon.odometry.lines.direction import DIRECTION_SIGMAS, knows_quarter
from ceilvo.daemon.odometry.points.constellation import has_points
from ceilvo.daemon.odometry.points.turning import Turning
from ceilvo.daemon.odometry.registration import (
    MIN_AGREEING,
    Registration,
    expected_turn,
    fewest,
    matched,
    register,
    view_size_m,
)
from ceilvo.daemon.odometry.rigid import RigidFit
from ceilvo.daemon.odometry.sight import CROWD_M, FEW, SMALLEST_TILE_M, crowd
from ceilvo.types import Array, Crossings

_REACH_SIGMAS = 4.0
"""How many standard deviations off its prediction the robot may be; a normal error is beyond once in 3000 gaps."""
_COURSE_SIGMAS = 5.0
"""Of a view's own error, allowed on top of the acceleration limits; noise alone exceeds 5 in 4 of a million."""
_WHEELS_CHI2 = 21.1
"""Squared distance within which view and wheels agree: chi squared with 3 degrees of freedom exceeds it once in 1e4."""
JUMPED = 0.5
"""Chance that somebody moved the robot, after a view that does not fit the reference as a robot moves: as likely as
that it was damaged; chosen."""
CARRIED_PS = 1e-4
"""Chance per second that somebody moves the robot, or that wheels say something else altogether; chosen: thrice in an
eight-hour shift. Alternatives beyond all prediction are weighed with it."""
_MISTAKEN, _AGAIN = 1e-3, 0.5
"""Chance that a view of few lines and points gives no motion, or one that no robot makes; chosen: on laps under
lamps, slats and hexagons 0 to 8 of 1,666 frames did (seeds 153 and 154), on poor ones 16 to 132. And that the next one
does as well; chosen."""

_MISSES = 0.01
"""Of the crossings that a view must show, how many it misses; chosen: laps had 0.03 at most in most conditions (make
bench-vision), and a hand that is overlooked is worse than a doubt."""
_COUNTED = 64
"""Crossings of a view that are counted so at most; chosen for time: of more there are enough in both."""
NOWHERE = np.empty((0, 3))
"""No displacements."""


@dataclass(frozen=True, slots=True)
class Course:
    """Prediction of ref_from_curr, from the last good view to the one at hand.

    Attributes:
        guess: (3,) [m, m, rad].
        cov: (3, 3).
        elapsed_s: since the last good view; step_s: since the view before this one.
        twist: (3,) [m/s, m/s, rad/s] at the last good view, the mean over span_s; None where it is not known.
        by_wheels: the prediction is the wheels' all the way.
        refused: (3,) ref_from_prev, when the view before this one was refused as a motion that no robot makes.
        carried_rad: standard deviation of the last good view's direction where that was carried on without lines, or 0.
        tilt_m: the same by which errors of the tilt may put the view off its course.
    """

    guess: Array
    cov: Array
    elapsed_s: float
    step_s: float
    twist: Array | None
    span_s: float
    by_wheels: bool
    refused: Array | None
    carried_rad: float = 0.0
    tilt_m: float = 0.0

    @property
    def reach_m(self) -> float:
        """How far off its prediction the robot can be."""
        return _REACH_SIGMAS * math.sqrt(max(se2.greatest_variance(self.cov[:2, :2]), 0.0))

    def is_within(self, radius_m: float) -> bool:
        """Whether the robot is not further off the prediction, which knows the heading to well within a quarter."""
        return knows_quarter(float(self.cov[2, 2])) and self.reach_m < radius_m


@dataclass(frozen=True, slots=True)
class Found:
    """A registration to the reference, or why there is none; what else fits, as in Motion but from the reference.

    Attributes:
        unpredicted: probability that somebody moved the robot, or that what predicts its motion is wrong.
        jump: the displacement that no robot makes, where that is why.
        elsewhere: probability that the robot sees another part of the ceiling than the reference shows.
        doubt_left: as in Motion.
        by_one: what is known where a single point laid it.
    """

    place: Registration | None
    failure: str = ""
    others: Array = field(default_factory=lambda: NOWHERE)
    log_ratio: Array = field(default_factory=lambda: np.empty(0))
    doubt: float = 0.0
    unpredicted: float = 0.0
    jump: Array | None = None
    elsewhere: float = 0.0
    doubt_left: float = 1.0
    by_one: Turning | None = None

    @property
    def out_of_view(self) -> bool:
        """Whether that is likelier than not."""
        return self.elsewhere > 0.5


def judged(found: Found, sure: bool, course: Course, config: Odometry) -> Found:
    """The same, refused where the view contradicts it or no robot makes it; sure: nothing else fits."""
    if found.place is None:
        return found
    failure = contradicted(found.place, config, course)
    if failure:
        return Found(None, failure)
    failure = off_course(found.place.fit, sure, course, config)
    return Found(None, failure, jump=found.place.fit.b_from_a) if failure else found


def foreseen(ref: Crossings, crossings: Crossings, predicted: Array) -> Array:
    """(3,) ref_from_curr as it is predicted (3,), turned as the lines of both views say."""
    return np.array([*predicted[:2], expected_turn(ref, crossings, float(predicted[2]))])


def on_earlier(
    views: list[tuple[Crossings, Array, Array]],
    crossings: Crossings,
    usual: tuple[float, float],
    course: Course,
    config: Odometry,
) -> Found | None:
    """The view near its prediction on one before the reference, which shows what that misses; None if on none. Under
    tiles of 1.25 m a reference that misses a line shares two crossings with the next view, and later one.

    Args:
        views: each with earlier_from_ref (3,) and its covariance (3, 3).
        usual: as Registration.is_usual() takes it.
    """
    for view, at, at_cov in views if course.is_within(config.match_radius_m) else []:
        guess = foreseen(view, crossings, se2.compose(at, course.guess))
        place, _ = register(view, crossings, guess, config.match_radius_m, config, narrow=True)
        if place is not None and place.is_usual(usual):
            found = judged(Found(place.seen_from(at, at_cov)), True, course, config)
            if found.place is not None:
                return found
    return None


@dataclass(frozen=True, slots=True)
class Failures:
    """Views in a row that gave no motion, and how usual it is that features disagree.

    Attributes:
        glossy: where features slide, all points in view may have been left out.
        enough: so many do not all come and go at once.
    """

    failed: int
    disagreeing: float
    glossy: bool
    enough: int


def chance_of_hand(
    ref: Crossings, crossings: Crossings, found: Found, failures: Failures, course: Course, config: Odometry
) -> float:
    """Probability that somebody moved the robot, of a view that gave no motion."""
    n, failed = len(crossings), failures.failed
    if not has_points(crossings) and not failures.glossy:
        moved = moved_by_hand(found.jump, course, found.elsewhere)
        few = found.jump is None and min(n, len(ref)) <= FEW
        return min(moved, moved_though_met(*met_as_foreseen(ref, crossings, course))) if few else moved
    if found.jump is not None or n >= failures.enough:
        return moved_or_mistaken(found.jump, failed, course, found.elsewhere)
    needed = max(fewest(crossings, config), math.ceil(MIN_AGREEING * n))
    return moved_or_flickered(n, needed, failures.disagreeing, failed, course.elapsed_s)


def met_as_foreseen(ref: Crossings, crossings: Crossings, course: Course) -> tuple[int, float]:
    """How many crossings of a view are where the prediction has them, to within its reach; and how many would be there
    on the way to another place."""
    met = len(matched(ref, crossings, foreseen(ref, crossings, course.guess), course.reach_m)[0])
    each_m2 = 0.5 * view_size_m(ref) ** 2 / len(ref)  # over pi: half of a disc is within its median radius
    return met, len(crossings) * course.reach_m**2 / max(each_m2, course.reach_m**2)


def with_parts(found: Found, ref: Crossings, crossings: Crossings, course: Course) -> Found:
    """What was not found, perhaps because two views show different parts of the ceiling."""
    missed = _MISSES ** must_be_in_both(ref, crossings, course) if found.jump is None else 0.0
    return replace(found, elsewhere=min(found.elsewhere + missed, 1.0))


def must_be_in_both(ref: Crossings, crossings: Crossings, course: Course) -> float:
    """How many crossings, those close together as one, one of two views shows and the other must have shown, had the
    robot moved as predicted, for they lie among those that it shows; where none of them meet."""
    now, before = (view.xy_base_m[:: -(-len(view) // _COUNTED)] for view in (crossings, ref))
    there = se2.transform(foreseen(ref, crossings, course.guess), now)
    return _among(there, before) + _among(before, there)


def _among(xy: Array, shown: Array) -> float:
    """How many points (N, 2) lie among those (M, 2) that a view shows, or half as far from them as they are apart."""
    apart = np.hypot(*(shown[:, None] - shown[None]).transpose(2, 0, 1))
    np.fill_diagonal(apart, np.inf)
    half_m = 0.5 * float(np.median(np.min(apart, axis=1))) if len(shown) > 1 else 0.0
    hull = cv2.convexHull(shown.astype(np.float32))
    near = [cv2.pointPolygonTest(hull, (x, y), True) >= -half_m for x, y in xy.tolist()]
    return float((1.0 / crowd(xy, CROWD_M)) @ np.array(near, float))


def moved_by_hand(jump: Array | None, course: Course, elsewhere: float) -> float:
    """Probability that somebody moved the robot, of a view that fits nothing, or a displacement (3,) no robot makes.

    On the way to the next tile a robot may be seen anywhere in one; lines that were mistaken put a view a little off.
    A robot that sees another part of the ceiling, as likely as `elsewhere`, fits nothing without a hand.
    """
    if jump is None:
        moved = CARRIED_PS * course.elapsed_s
        return JUMPED * moved / (moved + JUMPED * elsewhere) if elsewhere > 0.0 else JUMPED
    off = jump - course.guess
    shift = math.pi * float(off[0] ** 2 + off[1] ** 2) / SMALLEST_TILE_M**2
    turn = abs(se2.wrap(float(off[2]))) / (0.25 * math.pi)
    return JUMPED * min(max(shift, turn), 1.0)


def moved_or_mistaken(jump: Array | None, failed: int, course: Course, elsewhere: float) -> float:
    """moved_by_hand() of the last of `failed` views in a row where points help out: there views are mistaken so often
    that one of them tells little of a hand."""
    mistaken = _MISTAKEN * _AGAIN ** (failed - 1)
    return moved_by_hand(jump, course, elsewhere) * min(CARRIED_PS * course.elapsed_s / mistaken, 1.0)


def moved_though_met(met: int, by_chance: float) -> float:
    """moved_by_hand() of a view of which so many crossings are where they were foreseen, as `by_chance` of them would
    be on the way to another place, each by itself.

    Those of one lattice would be together, or none; but that lines are missed where few are seen is far likelier than
    JUMPED has it (1 to 41 of 4,800 views under tiles of 1.25 m fit nothing, all but 2 of them with some that are met).
    """
    return JUMPED * min(by_chance**met / math.factorial(met), 1.0)


def moved_or_flickered(points: int, needed: int, disagreeing: float, failed: int, elapsed_s: float) -> float:
    """Probability that somebody moved the robot, of `failed` views in a row that show few points and fit nothing: each
    point comes and goes by itself, so a few of them do all at once.

    Args:
        points: of the last view.
        needed: that must agree.
        disagreeing: fraction of the points that usually do not.
        elapsed_s: since the last good view.
    """
    stays = 1.0 - disagreeing
    too_few = sum(math.comb(points, k) * stays**k * disagreeing ** (points - k) for k in range(min(needed, points + 1)))
    moved = CARRIED_PS * elapsed_s
    return min(JUMPED, moved / (moved + too_few**failed)) if moved > 0.0 else 0.0


def contradicted(found: Registration, config: Odometry, course: Course) -> str:
    """Why the view itself does not bear out the motion, "" when it does."""
    off = abs(se2.wrap(float(found.fit.b_from_a[2]) - found.turn_rad))
    vague_rad = course.carried_rad if found.by_lines else math.sqrt(course.cov[2, 2])
    if off > config.heading_gate_rad + DIRECTION_SIGMAS * vague_rad:
        return f"rotation of points and of lines differ by {off:.3f} rad"
    if found.agreeing < MIN_AGREEING * found.expected:
        return f"{found.agreeing} of {found.shown} crossings moved alike"
    return ""


def off_course(fit: RigidFit, sure: bool, course: Course, config: Odometry) -> str:
    """A jump that is consistent in itself, but that no robot makes: neighbouring lines that change places, an old
    picture, a tile too many. Why it is one, "" when it is none.

    What the wheels say is no jump, nor is it one when a second view in a row says the same and nothing else fits.

    Args:
        sure: nothing else fits.
    """
    if course.by_wheels and _within(fit, course):
        return ""
    jump = _jumped(fit, course, config)
    return "" if jump and sure and _repeated(fit, course, config) else jump


def measured_twist(fit: RigidFit, course: Course, config: Odometry) -> tuple[Array, float]:
    """(3,) [m/s, m/s, rad/s] of a motion that is taken, and the time that it is the mean over.

    After a view that was refused it is that since then where this view, too, is off course: the way up to it was no
    motion of a robot. Where this view is on course the other one was mistaken, and tells no twist.
    """
    if course.refused is None or not _jumped(fit, course, config):
        return fit.b_from_a / course.elapsed_s, course.elapsed_s
    return se2.between(course.refused, fit.b_from_a) / course.step_s, course.step_s


def _within(fit: RigidFit, course: Course) -> bool:
    off = fit.b_from_a - course.guess
    off[2] = se2.wrap(float(off[2]))
    return float(off @ np.linalg.solve(course.cov + fit.cov, off)) < _WHEELS_CHI2


def _jumped(fit: RigidFit, course: Course, config: Odometry) -> str:
    moved, t = fit.b_from_a, course.elapsed_s
    twist = np.zeros(3) if course.twist is None else course.twist
    if course.twist is not None:
        off = moved - twist * t
        slack_s2 = 0.5 * t * (t + course.span_s)  # the twist is the mean over span_s
        off_m, off_rad = float(np.hypot(off[0], off[1])), abs(se2.wrap(float(off[2])))
        if off_m > config.max_accel_mps2 * slack_s2 + _noise_m(fit, course):
            return f"jumped {off_m:.3f} m off its course within {t:.3f} s"
        if off_rad > config.max_turn_accel_radps2 * slack_s2 + _noise_rad(fit):
            return f"turned {off_rad:.3f} rad off its course within {t:.3f} s"
    # a robot that is that fast already was believed to be
    travel, turn = float(np.hypot(moved[0], moved[1])), abs(float(moved[2]))
    if float(np.hypot(twist[0], twist[1])) <= config.max_speed_mps < (travel - _noise_m(fit, course)) / t:
        return f"moved {travel:.3f} m in {t:.3f} s"
    if abs(float(twist[2])) <= config.max_turn_radps < (turn - _noise_rad(fit)) / t:
        return f"turned {turn:.3f} rad in {t:.3f} s"
    return ""


def _repeated(fit: RigidFit, course: Course, config: Odometry) -> bool:
    """Whether the robot stands or drives on from where the view before saw it: at a plausible twist or the same."""
    if course.refused is None:
        return False
    step, t = se2.between(course.refused, fit.b_from_a), course.step_s
    on = step - course.refused * (t / max(course.elapsed_s - t, t))
    slow = np.hypot(step[0], step[1]) <= config.max_speed_mps * t and abs(step[2]) <= config.max_turn_radps * t
    steady_m = np.hypot(on[0], on[1]) <= config.max_accel_mps2 * t**2 + _noise_m(fit, course)
    return bool(slow or (steady_m and abs(on[2]) <= config.max_turn_accel_radps2 * t**2 + _noise_rad(fit)))


def _noise_m(fit: RigidFit, course: Course) -> float:
    return _COURSE_SIGMAS * math.sqrt(max(se2.greatest_variance(fit.cov[:2, :2]), 0.0) + course.tilt_m**2)


def _noise_rad(fit: RigidFit) -> float:
    return _COURSE_SIGMAS * math.sqrt(fit.cov[2, 2])
