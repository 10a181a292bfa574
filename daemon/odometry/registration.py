"""Two views laid on each other near a guess: matched, cleaned by a homography and by the residuals of the rigid fit."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from ceilvo import se2
from ceilvo.config import Odometry
from ceilvo.crossing_types import LAMP, LINE_CROSSINGS, commonest, quarter_turns, turned_type
from ceilvo.daemon.odometry import kernel
from ceilvo.daemon.odometry.kernel.arguments import CORNER_SIGMA_M
from ceilvo.daemon.odometry.lines.direction import DIRECTION_SIGMAS, direction_change
from ceilvo.daemon.odometry.lines.through import LINE_M, lines_through
from ceilvo.daemon.odometry.matching import Bools, consistent, mutual_nearest
from ceilvo.daemon.odometry.points.constellation import Points, has_points
from ceilvo.daemon.odometry.points.turning import TURNED, Turning
from ceilvo.daemon.odometry.rigid import RigidFit, median_translation, robust_rigid_motion, with_known_rotation
from ceilvo.robust import median
from ceilvo.types import Array, Crossings, Ints

MIN_AGREEING = 1.0 / 3.0
"""Least fraction of the crossings that move alike; chosen: laps had 0.6 at least, bare plaster with lamps 0.37."""
_UNUSUAL_SIGMAS = 3.0
"""Crossings beyond the usual number that do not agree, in standard deviations of that number, from which alternatives
are looked at; chosen: half a per cent of a lap's frames cost the look."""
_SPECIAL_SIGMAS, _HALF = 2.0, 0.5
"""The same of crossings that are no joints of tiles, and their part at least: whole tiles off none of them agrees, but
there are few; chosen."""
_FEWEST_POINTS = 2
"""They determine a motion, and their distance tells whether they are the same two."""
_MOST = 300
"""Crossings of a view that are laid on the other one, which may have more; chosen for time: open cells show 1,100."""
_MANY = 32
"""So many correspondences are never all of the same few lines; chosen."""
_POINT_WORTH = 2.0 / 3.0
"""Of a point, where a crossing of two lines is worth one: six points are as much as four crossings; chosen."""
_POINT_SIGMAS = 4.0
"""How far off its prediction a single point is looked for; a normal error is beyond once in 16,000."""
_VAGUE_RAD = 0.5
"""Standard deviation of the heading up to which a pose is still about a Gaussian one; chosen."""
_MIN_VIEW_M = 1e-9
"""Crossings all in one place: not divided by 0."""


@dataclass(frozen=True, slots=True)
class _Turn:
    """A rotation that lines tell, its standard deviation, and their direction."""

    rad: float
    sigma_rad: float
    axis_rad: float


@dataclass(frozen=True, slots=True)
class Registration:
    """One view on another.

    Attributes:
        fit: ref_from_curr by the points.
        seen, before: (N, 2) m, the matched points in both views; fit.used says which of them count.
        turn_rad: ref_from_curr rotation by the lines; by the prediction where not both views have a direction.
        by_lines: it is by the lines.
        kinds: (N,) types of the matched points.
        shown: crossings of the view that has fewer.
        expected: how many of them both views must show, by their overlap.
        special, special_expected: those that move alike, and those that both must show, of all types but the commonest:
            whole tiles off, only they disagree.
    """

    fit: RigidFit
    seen: Array
    before: Array
    turn_rad: float
    shown: int
    expected: float
    special: int
    special_expected: float
    kinds: Ints
    by_lines: bool = True

    @property
    def agreeing(self) -> int:
        """Crossings that move alike."""
        return int(np.count_nonzero(self.fit.used))

    def apart(self, axis_rad: float, which: Bools | None = None) -> float:
        """How many of the crossings that move alike, or of others (N,), err by themselves, along axes at axis_rad.

        Those where the same two lines meet are one, for edges of lamps are double; those of one line in all are two,
        for if it was mistaken they all were. A point is worth two thirds, for its place is not that of lines.
        """
        which = self.fit.used if which is None else which
        kinds = self.kinds[which]
        if len(kinds) > _MANY:
            return float(len(kinds))
        at, points = self.before[which], kinds >= LINE_CROSSINGS
        lines = np.unique(lines_through(at, kinds, axis_rad)[~points], axis=0)
        on_one = len(lines) > 2 and min(len(np.unique(lines[:, axis])) for axis in (0, 1)) == 1
        return _POINT_WORTH * np.count_nonzero(points) + (2.0 if on_one else float(len(lines)))

    def seen_from(self, at: Array, at_cov: Array) -> Registration:
        """The same on another view, at (3,) with covariance (3, 3) as seen from the one it is on."""
        fit, turn, g = self.fit, se2.rotation(float(at[2])), np.eye(3)
        g[:2, :2] = turn.T
        on = se2.lever(at, fit.b_from_a)
        cov = g @ (fit.cov + on @ at_cov @ on.T) @ g.T
        there = replace(fit, b_from_a=se2.between(at, fit.b_from_a), cov=cov)
        before = se2.transform(se2.inverse(at), self.before)
        return replace(self, fit=there, before=before, turn_rad=se2.wrap(self.turn_rad - float(at[2])))

    def is_usual(self, disagreeing: tuple[float, float]) -> bool:
        """Whether no more crossings disagree than chance and passing things explain.

        Args:
            disagreeing: usual fraction of those that both views must show, and of those of all types but the commonest.
        """
        usual, special = disagreeing[0] * self.expected, disagreeing[1] * self.special_expected
        if self.expected - self.agreeing > usual + _UNUSUAL_SIGMAS * math.sqrt(usual + 1.0):
            return False
        missing = self.special_expected - self.special
        return missing <= max(special + _SPECIAL_SIGMAS * math.sqrt(special + 1.0), _HALF * self.special_expected)


def register(
    ref: Crossings, crossings: Crossings, guess: Array, radius_m: float, config: Odometry, narrow: bool = False
) -> tuple[Registration | None, str]:
    """ref_from_curr by matching near the guess (3,), whose rotation is the lines'; or None, and why.

    Args:
        narrow: the guess is right to within the radius, so that two crossings do where lines tell the rotation: tiles
            of 1.25 m show three now and then, of which the next view has two.
    """
    crossings = _some(crossings)
    turn = float(guess[2])
    i, j, kinds = matched(ref, crossings, guess, radius_m)
    need, by_lines = fewest(crossings, config), crossings.directed and ref.directed
    if need < _FEWEST_POINTS and not by_lines:
        need = _FEWEST_POINTS
    if narrow and by_lines:
        need = min(need, _FEWEST_POINTS)
    if len(i) < need:
        return None, f"{len(i)} of {len(crossings)} crossings matched, {need} needed"
    by_points = has_points(crossings)
    # of points their own sigma decides, of which the level view's pixels know nothing
    if not by_points and _are_spread(ref.xy_base_m[j], ref.psi_rad):
        good = consistent(crossings.uv_px[i], ref.uv_px[j], config.ransac_px)
        i, j = i[good], j[good]
    seen, before = crossings.xy_base_m[i], ref.xy_base_m[j]
    fit = None
    if len(i):
        fit = robust_rigid_motion(
            seen,
            before,
            config.residual_sigmas,
            config.residual_max_m,
            max(need, _FEWEST_POINTS),
            [median_translation(seen, before, turn, ref.psi_rad)],
            _independent_sigma_m(crossings, i) + _independent_sigma_m(ref, j),
            np.hypot(_own_sigma_m(crossings, i), _own_sigma_m(ref, j)) if by_points else None,
        )
    told = _Turn(turn, math.hypot(ref.psi_sigma_rad, crossings.psi_sigma_rad), ref.psi_rad)
    most_rad = config.heading_gate_rad + DIRECTION_SIGMAS * told.sigma_rad
    if by_points and by_lines and (fit is None or abs(se2.wrap(fit.b_from_a[2] - turn)) > most_rad):
        own_m = np.hypot(_own_sigma_m(crossings, i), _own_sigma_m(ref, j))
        fit = _turned_as_lines(seen, before, own_m, kinds[i] == LAMP, told, config) or fit
    if fit is None:
        return None, "too few consistent correspondences"
    shown, overlap = min(len(crossings), len(ref)), _overlap(fit, ref)
    common = commonest(ref.crossing_type)
    here, then = kinds != common, ref.crossing_type != common
    special = int(np.count_nonzero(here[i[fit.used]]))
    special_shown = min(np.count_nonzero(here), np.count_nonzero(then))
    return (
        Registration(
            fit, seen, before, turn, shown, shown * overlap, special, special_shown * overlap, kinds[i], by_lines
        ),
        "",
    )


def _are_spread(at: Array, axis_rad: float) -> bool:
    """Whether crossings (N, 2) determine a homography: two at least lie beside any one line. Where a corridor's joints
    meet a single one RANSAC keeps any few of them. A single one beside them stands at either end."""
    across = np.sort(at @ se2.rotation(axis_rad), axis=0)
    begins = across[1:] - across[:-1] > LINE_M
    beside = begins[1:-1].any(axis=0) | (begins[:1] & begins[-1:]).any(axis=0)
    return len(at) > 2 and bool(beside.all())


def matched(ref: Crossings, crossings: Crossings, guess: Array, radius_m: float) -> tuple[Ints, Ints, Ints]:
    """Crossings (M,) of a view and those (M,) of the reference, of one type, that meet within the radius where a guess
    (3,) of ref_from_curr has them; and the types (N,) that the reference would call the view's."""
    turn = quarter_turns(crossings.psi_rad + float(guess[2]), ref.psi_rad)
    kinds = turned_type(crossings.crossing_type, turn)
    at = se2.transform(guess, crossings.xy_base_m)
    return *mutual_nearest(at, kinds, ref.xy_base_m, ref.crossing_type, radius_m), kinds


def held_by_one(
    ref: Crossings, crossings: Crossings, turning: Turning, elapsed_s: float, config: Odometry
) -> tuple[Registration, Turning] | None:
    """A view on the reference by the one point that meets where it is predicted, and what is known then; None where
    that tells nothing.

    Args:
        turning: at the reference, elapsed_s before the view.
    """
    before = turning
    turning = turning.after(elapsed_s)
    moved, by = turning.moved(elapsed_s)
    reach_m = _reach_m(moved, by, turning, crossings)
    if reach_m > config.match_radius_m:
        return None
    i, j, kinds = matched(ref, crossings, moved, config.match_radius_m)
    shown = min(len(ref), len(crossings))
    if len(i) != 1 or kinds[i[0]] < LINE_CROSSINGS or MIN_AGREEING * shown > 1.0:
        return None
    seen, there = crossings.xy_base_m[i], ref.xy_base_m[j]
    var_m2 = float(_own_sigma_m(crossings, i)[0] ** 2 + _own_sigma_m(ref, j)[0] ** 2)
    known = turning.with_point(moved, by, seen[0], there[0], var_m2)
    if known is None or known.cov[TURNED, TURNED] > _VAGUE_RAD**2:
        return None
    fit = _about_point(before, known, seen, there, var_m2)
    turn_rad = float(fit.b_from_a[2])
    return Registration(fit, seen, there, turn_rad, shown, 1.0, 1, 1.0, kinds[i], by_lines=False), known


def _about_point(before: Turning, known: Turning, seen: Array, there: Array, var_m2: float) -> RigidFit:
    """The motion by a point (1, 2) of both views and the turn that is known with it, which was `before`.

    A robot that is far off its heading is on an arc about the point; by how much that leaves its tangent is added.
    """
    turn_rad = float(known.mean[TURNED] - before.mean[TURNED])
    var, was = float(known.cov[TURNED, TURNED]), float(before.cov[TURNED, TURNED])
    one = RigidFit(np.zeros(3), np.ones(1, bool), 0.0, np.zeros((3, 3)), var_m2)
    fit = with_known_rotation(one, seen, there, turn_rad, math.sqrt(max(var - was, 0.0)))
    arc_m2 = 0.5 * float(seen[0] @ seen[0]) * max(var**2 - was**2, 0.0)
    fit.cov[[0, 1], [0, 1]] += arc_m2
    return fit


def _reach_m(moved: Array, by: Array, turning: Turning, crossings: Crossings) -> float:
    """How far from where they are predicted the points of a view may be."""
    at = se2.transform(moved, crossings.xy_base_m) - moved[:2]
    cov = by @ turning.cov @ by.T
    far2 = np.max(np.sum(at**2, axis=1))
    return _POINT_SIGMAS * math.sqrt(se2.greatest_variance(cov[:2, :2]) + far2 * float(cov[2, 2]))


def _turned_as_lines(
    seen: Array, before: Array, own_m: Array, lamp: Bools, turn: _Turn, config: Odometry
) -> RigidFit | None:
    """The motion by most of a few points and the rotation of the lines, where another rotation fits the points best:
    of three points one that is mistaken turns the rest. By one lamp where no others agree, for one lamp can only be
    itself. None where there is neither.

    Args:
        own_m: (N,) standard deviation of a point's displacement.
        lamp: (N,) points that are lamps.
    """
    near_m = np.maximum(config.residual_sigmas * own_m, config.residual_max_m)
    way, used = median_translation(seen, before, turn.rad, turn.axis_rad), np.zeros(len(seen), bool)
    for _ in range(2):  # of those near the median, and of those near that
        used = np.hypot(*(before - se2.transform(way, seen)).T) <= near_m
        if np.count_nonzero(used) < max(_FEWEST_POINTS, 0.5 * len(seen)):
            return _held_by(lamp, seen, before, own_m, turn) if np.count_nonzero(lamp) == 1 else None
        fit = _held_by(used, seen, before, own_m, turn)
        way = fit.b_from_a
    return fit


def _held_by(used: Bools, seen: Array, before: Array, own_m: Array, turn: _Turn) -> RigidFit:
    """The motion by the points that are used, with a known rotation."""
    weight, theta = 1.0 / np.maximum(own_m, CORNER_SIGMA_M) ** 2, np.array([0.0, 0.0, turn.rad])
    unsure = RigidFit(theta, used, 0.0, np.zeros((3, 3)), float(np.mean(own_m[used] ** 2)), weight)
    way = with_known_rotation(unsure, seen, before, turn.rad, turn.sigma_rad).b_from_a
    off2 = np.sum((before - se2.transform(way, seen))[used] ** 2, axis=1)
    fit = replace(unsure, rms_m=math.sqrt(np.mean(off2)), variance_m2=max(unsure.variance_m2, 0.5 * np.mean(off2)))
    return with_known_rotation(fit, seen, before, turn.rad, turn.sigma_rad)


def _some(crossings: Crossings) -> Crossings:
    """Those of a view that are laid on the other one: of very many every so manyth, from line to line, and points."""
    stride = -(-len(crossings) // _MOST)
    if stride <= 1:
        return crossings
    return crossings.of((np.arange(len(crossings)) % stride == 0) | (crossings.crossing_type >= LINE_CROSSINGS))


def points_of(crossings: Crossings) -> Points:
    """Those features that are no crossings of lines."""
    which = np.flatnonzero(crossings.crossing_type >= LINE_CROSSINGS)
    return Points(crossings.xy_base_m[which], crossings.crossing_type[which], _own_sigma_m(crossings, which))


def fewest(crossings: Crossings, config: Odometry) -> int:
    """Correspondences that make a motion: of points, each of which was seen as a whole, two, or a lamp where lines tell
    the direction."""
    if not has_points(crossings):
        return config.min_inliers
    held = crossings.directed and bool(np.any(crossings.crossing_type == LAMP))
    return min(1 if held else _FEWEST_POINTS, config.min_inliers)


def expected_turn(ref: Crossings, crossings: Crossings, predicted_rad: float) -> float:
    """ref_from_curr rotation by the lines of both views, where both have some, else as predicted."""
    if not (ref.directed and crossings.directed):
        return predicted_rad
    return direction_change(ref.psi_rad, crossings.psi_rad, predicted_rad)


def view_size_m(crossings: Crossings) -> float:
    """About the diameter of what a view shows: twice the median distance from its centre."""
    radius_m: float = kernel.median_radius(crossings.xy_base_m)
    return 2.0 * radius_m


def _overlap(fit: RigidFit, ref: Crossings) -> float:
    """About the part of the view that both show."""
    return max(1.0 - float(np.hypot(*fit.b_from_a[:2])) / max(view_size_m(ref), _MIN_VIEW_M), 0.0)


def _independent_sigma_m(crossings: Crossings, which: Ints) -> float:
    """Median standard deviation of the crossings `which`, m, without the part that all of a frame share."""
    return math.sqrt(max(0.5 * median(_own_trace_m2(crossings, which)), 0.0))


def _own_sigma_m(crossings: Crossings, which: Ints) -> Array:
    """(N,) the same of each."""
    return np.sqrt(np.maximum(0.5 * _own_trace_m2(crossings, which), 0.0))


def _own_trace_m2(crossings: Crossings, which: Ints) -> Array:
    cov, common = crossings.cov_base_m2, crossings.common_cov_m2
    return np.asarray(cov[which, 0, 0] + cov[which, 1, 1] - (common[0, 0] + common[1, 1]))
