"""Stage 2: straight lines that are all parallel or perpendicular, with the robot's tilt, in one least squares.

Canny's points vote in a Hough transform restricted to the dominant direction; the peaks start a joint least squares
whose unknowns are the common direction, the tilt (roll, pitch) and one offset a line.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from ceilvo.config import Features
from ceilvo.daemon.vision import kernel
from ceilvo.daemon.vision.angles import pixels
from ceilvo.daemon.vision.edge_points import Points
from ceilvo.daemon.vision.edges import Edges
from ceilvo.daemon.vision.line_fit import LAST_GATE_PX, JointFit
from ceilvo.daemon.vision.line_pairing import EdgeSet, fold_direction, pair_edges
from ceilvo.daemon.vision.rolling_shutter import Readout
from ceilvo.daemon.vision.tilt_prior import NOTHING_LATELY, Lately, TiltPrior, rocks
from ceilvo.types import Array, Lines

Array32 = NDArray[np.float32]

_COARSE_GATES_PX = (6.0, 3.0)
"""Distance of a point from its line in the first rounds; chosen: Hough bins are 2 wide, the tilt is not known yet."""
_FINE_BIN_PX = 1.0
"""Hough bin once direction and tilt are known; chosen: half the first one, peaks are sharper then."""
_FINE_GATE_PX = 2.0
"""Gate of the round that follows; chosen: between the coarse gates and the last one, 0.8 to 2."""
_DIRECTION_REACH_DEG = 4.0
"""Gradients this near to the peak of the 1 deg bins are averaged; chosen: wider takes in clutter."""
_MIN_VOTES = 8.0
"""Fewest votes of a line, however few of the edge points were kept; chosen: as features.min_line_deg allows."""
_REACH_MARGIN = 1.2
"""Points may lie this many times further out once the tilt is taken off; chosen, those beyond have no vote."""
_START_POINTS = 4000
"""Points for direction and first rounds, more of them are thinned; chosen: quicker, and the last rounds take all."""
_LEVEL_RAD = np.zeros(2)
_SLOPE_RAD = np.radians(2.5)
"""A view that tilted more is of a ceiling that slopes, and does so again: votes for lines of a level one miss some
there; chosen, robots rock by less."""
_FURTHER_RAD = np.radians([[1.0, 0.0], [-1.0, 0.0], [0.0, 1.0], [0.0, -1.0]])
"""Tilts beside the last one's where a robot that rocks may be next; chosen: under two heights the right one is found
from 0.6 deg off."""
_FALSE_RATIO = 2.0
"""By what factor lines fit worse than lately under a false tilt; chosen: by 4 where it was seen, blurred by 1.3."""
NOISE_RATIO = 1.15
"""Lines that fit worse than lately by this factor are doubted; chosen: a false optimum or moved lines fit worse."""


def dominant_direction(phi_deg: Array32) -> float | None:
    """Direction in [-pi/4, pi/4) that most gradients share modulo 90 deg, or None without points."""
    if len(phi_deg) == 0:
        return None
    found_deg = kernel.direction(phi_deg, _DIRECTION_REACH_DEG, 1 + len(phi_deg) // _START_POINTS)
    return fold_direction(float(np.radians(found_deg)))[0]


def cost_px2(fitting: int, noise_px: float, points: int) -> float:
    """Squared residuals, px^2, of points of which some fit lines: each of the others counts with the gate."""
    return fitting * noise_px**2 + (points - fitting) * LAST_GATE_PX[0] ** 2


@dataclass(frozen=True, slots=True)
class LastFit:
    """What the frames before leave for the next: (2,) tilt of the last, how well lines have fitted lately, px, whether
    the ceiling has several heights, and the scatter of tilts, see TiltTracker."""

    tilt_rad: Array
    noise_px: float
    several: bool = False
    lately: Lately = NOTHING_LATELY

    @property
    def leans(self) -> bool:
        """Whether the ceiling slopes."""
        return bool(np.hypot(*self.tilt_rad) > _SLOPE_RAD)


_NO_LAST_FIT = LastFit(_LEVEL_RAD, 0.0)


@dataclass(frozen=True, slots=True)
class _Problem:
    """Points of one frame and where their lines begin."""

    points: Points
    psi: float
    starts: list[Array]
    config: Features
    focal_px: float
    fraction: float
    readout: Readout | None
    carried_rad: float | None
    several: bool

    def along_carried(self) -> _Problem | None:
        """The same from the last frame's direction, where that is known: gradients tell it to a quarter of a degree."""
        if self.carried_rad is None:
            return None
        psi = self.psi + float((self.carried_rad - self.psi + 0.25 * np.pi) % (0.5 * np.pi) - 0.25 * np.pi)
        if abs(psi - self.psi) > np.radians(self.config.hough_angle_deg):
            return None
        bin_px = pixels(self.config.hough_bin_deg, self.focal_px, _FINE_BIN_PX)
        votes = _votes(self.points, (psi, psi + 0.5 * np.pi), self.focal_px, bin_px)
        need = _least_votes(self.config, self.fraction, self.focal_px)
        return replace(self, psi=psi, starts=_peaks(votes, need, self.config, bin_px))

    def start(self, tilt_rad: Array, tilt: bool = True) -> JointFit:
        """Coarse rounds from the Hough peaks, then peaks again where direction and tilt are known: sharper ones."""
        points, config, fraction = self.points, self.config, self.fraction
        stride = points.stride_for(_START_POINTS)
        few = points.thinned(stride)
        coarse = JointFit(few, self.psi, self.starts, self.focal_px, config, fraction / stride, tilt_rad)
        for gate_px in _COARSE_GATES_PX:
            coarse.assign(gate_px)
            coarse.solve(tilt)
        need = _least_votes(config, fraction, self.focal_px)
        fine = JointFit(
            points, coarse.psi, self.starts, self.focal_px, config, fraction, coarse.tilt, self.readout, self.several
        )
        again = Points(fine.rho, fine.tangent, points.ends, _REACH_MARGIN * points.reach)
        fine.restart(_peaks(_votes(again, (0.0, 0.0), self.focal_px, _FINE_BIN_PX), need, config, _FINE_BIN_PX))
        fine.assign(_FINE_GATE_PX)
        fine.solve(tilt)
        return fine

    def solve(self, tilt_rad: Array) -> _Found:
        """The fit that begins at a tilt, and the tilt that it finds."""
        fit = self.start(tilt_rad)
        return fit, fit.finish()

    def cost(self, found: _Found) -> float:
        """Of a fit, by all points."""
        return cost_px2(len(found[0].line), found[0].noise_px, len(self.points.x))


_Found = tuple[JointFit, TiltPrior]


def find_lines(edges: Edges, config: Features, focal_px: float, prior: TiltPrior | None = None) -> Lines | None:
    """Lines of one frame, or None when too few edge points agree on a direction.

    Args:
        focal_px: of the level view.
        prior: how this robot has tilted lately; used unless this frame contradicts it.
    """
    found = detect(edges, config, focal_px, prior)
    return None if found is None else found[0]


def detect(
    edges: Edges,
    config: Features,
    focal_px: float,
    prior: TiltPrior | None = None,
    last: LastFit = _NO_LAST_FIT,
    readout: Readout | None = None,
    psi_rad: float | None = None,
    carried_rad: float | None = None,
) -> tuple[Lines, EdgeSet] | None:
    """As find_lines, with the edges under the lines.

    Args:
        last: of the frames before; where to begin for a robot that rocks.
        readout: of a rolling shutter.
        psi_rad: the direction, where it is known; else it is that of most gradients.
        carried_rad: that of the last frame, as this one should show it; tried besides where the fit is doubtful.
    """
    psi = dominant_direction(edges.phi_deg) if psi_rad is None else psi_rad
    if psi is None:
        return None
    x, y, ends = kernel.split(
        edges.uv_px, edges.phi_deg, float(np.degrees(psi)), config.direction_gate_deg, 1.0 / focal_px
    )
    points = Points(x, y, ends, _reach(x, y))
    voting = points.turned_back(last.tilt_rad) if last.leans else points
    psi, starts = _hough(voting, psi, config, edges.fraction, focal_px)
    if sum(len(s) for s in starts) < 2:
        return None
    problem = _Problem(points, psi, starts, config, focal_px, edges.fraction, readout, carried_rad, last.several)
    if not (rocks(prior) and config.estimate_tilt):
        fit, free = _solve_steady(problem, prior, last)
    else:
        fit, free = _solve_rocking(problem, last)
    if prior is not None and config.estimate_tilt:
        fit.apply_prior(prior)
    return pair_edges(fit, config, edges.fraction, free)


def _solve_steady(problem: _Problem, prior: TiltPrior | None, last: LastFit) -> _Found:
    """A robot that has not tilted lately, or of which nothing is known yet."""
    fit, free = problem.solve(last.tilt_rad if last.leans else _LEVEL_RAD)
    expected = last.tilt_rad if last.leans else _LEVEL_RAD if prior is None else prior.mean_rad
    if not problem.config.estimate_tilt:
        return fit, free
    vague = fit.is_vague(free, prior, last.lately.usual_rad(last.tilt_rad))
    if not vague and not fit.is_doubtful(expected, prior):
        return fit, free
    level = problem.start(_LEVEL_RAD if vague else expected, tilt=False)
    if vague:  # so few lines that any tilt fits: then none is read from them, nor kept from one frame before
        level.finish_held(held_rad=fit.held_rad(free, last.lately))
        return level, free
    return _best(problem, [(fit, free), (level, level.finish())], last.tilt_rad)


def _solve_rocking(problem: _Problem, last: LastFit) -> _Found:
    """Begin where the last frame was; where that fits worse than lately, false optima are likely: look for a better."""
    found = problem.solve(last.tilt_rad)
    if found[0].noise_px < NOISE_RATIO * last.noise_px:
        return found
    best = _best(problem, [found], _LEVEL_RAD)
    for further in _FURTHER_RAD:
        if best[0].noise_px < _FALSE_RATIO * last.noise_px:
            break
        best = min(best, problem.solve(last.tilt_rad + further), key=problem.cost)
    return best


def _best(problem: _Problem, found: list[_Found], other_rad: Array) -> _Found:
    """The cheapest of the fits found, of one that begins at another tilt, and of one that begins where these ended."""
    carried = problem.along_carried()
    if carried is not None:
        found = [*found, carried.solve(other_rad)]
    best = min((*found, problem.solve(other_rad)), key=problem.cost)
    return min(best, problem.solve(best[0].tilt), key=problem.cost)


def _reach(x: Array32, y: Array32) -> float:
    """No point is further from the centre."""
    return float(np.hypot(*(max(v.max(initial=0.0), -v.min(initial=0.0)) for v in (x, y))))


def _hough(points: Points, psi: float, config: Features, fraction: float, focal_px: float) -> tuple[float, list[Array]]:
    """The direction with the sharpest votes and, for each group, line offsets."""
    reach = np.radians(config.hough_angle_deg)
    bin_px = pixels(config.hough_bin_deg, focal_px, _FINE_BIN_PX)
    angles = (psi + np.linspace(-reach, reach, 5)).tolist()
    stride = points.stride_for(_START_POINTS)
    few = (_votes(points, (a, a + 0.5 * np.pi), focal_px, bin_px, stride) for a in angles)
    best = angles[int(np.argmax([np.vdot(v, v) for v in few]))]
    need = _least_votes(config, fraction, focal_px)
    votes = _votes(points, (best, best + 0.5 * np.pi), focal_px, bin_px)
    return best, _peaks(votes, need, config, bin_px)


def _least_votes(config: Features, fraction: float, focal_px: float) -> float:
    """Of a line: an edge point a pixel of the length it needs, of which a fraction was kept."""
    return max(pixels(config.min_line_deg, focal_px) * fraction, _MIN_VOTES)


def _votes(
    points: Points, angles_rad: tuple[float, float], focal_px: float, bin_px: float, stride: int = 1
) -> NDArray[np.int64]:
    """(4, B) votes of each group, for bins to either side of offset 0."""
    half = int(points.reach * focal_px / bin_px) + 3
    return kernel.vote(points.x, points.y, points.ends, angles_rad, focal_px / bin_px, half, stride)


def _peaks(votes: NDArray[np.int64], need: float, config: Features, bin_px: float) -> list[Array]:
    """For each group, rising offsets of its strongest `max_lines` local maxima of three neighbouring bins."""
    at, strength, ends = kernel.peaks(votes, need)
    offset = at * bin_px
    return [_strongest(offset[a:b], strength[a:b], config.max_lines) for a, b in pairwise(ends)]


def _strongest(offset: Array, strength: NDArray[np.int64], most: int) -> Array:
    if len(offset) <= most:
        return offset
    return np.asarray(offset[np.sort(np.argsort(-strength, kind="stable")[:most])])
