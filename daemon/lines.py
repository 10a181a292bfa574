"""Stage 2: straight lines that are all parallel or perpendicular, with the robot's tilt, in one least squares.

Canny's points vote in a Hough transform restricted to the dominant direction; the peaks start a joint least squares
whose unknowns are the common direction, the tilt (roll, pitch) and one offset a line.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ceilvo.config import Features
from ceilvo.daemon.edges import Edges
from ceilvo.daemon.grooves import EdgeSet, fold, join_grooves
from ceilvo.daemon.line_fit import Group, JointFit
from ceilvo.daemon.tilt import NO_TILT, TiltPrior
from ceilvo.types import Array, Lines

Array32 = NDArray[np.float32]

_GATES_PX = (6.0, 3.0)
_COARSE_STRIDE = 3
_FINE_BIN_PX = 1.0
_FINE_GATE_PX = 2.0
_NO_WORSE = 0.95
_VAGUE_RAD = np.radians(0.025)
_DIRECTION_REACH_DEG = 4.0
_ANGLE_STRIDE = 3
_FEWEST_VOTES = 8.0


def dominant_direction(phi_deg: Array32) -> float | None:
    """Direction in [-pi/4, pi/4) that most gradients share modulo 90 deg, or None without points."""
    if len(phi_deg) == 0:
        return None
    folded = np.mod(phi_deg, np.float32(90.0))
    votes = np.bincount(folded.astype(np.int32), minlength=91)
    votes[0] += votes[90]  # float32 rounding may reach 90 itself
    votes = votes[:90]
    peak = float(np.argmax(votes + np.roll(votes, 1) + np.roll(votes, -1))) + 0.5
    off = np.mod(folded - np.float32(peak - 45.0), np.float32(90.0)) - 45.0
    near = off[np.abs(off) < _DIRECTION_REACH_DEG]
    return fold(float(np.radians(peak + float(np.mean(near, dtype=np.float64)))))


def find_lines(edges: Edges, config: Features, focal_px: float, prior: TiltPrior | None = None) -> Lines | None:
    """Lines of one frame, or None when too few edge points agree on a direction.

    Args:
        focal_px: of the level view.
        prior: how this robot has tilted lately; used unless this frame contradicts it.
    """
    found = detect(edges, config, focal_px, prior)
    return None if found is None else found[0]


def detect(
    edges: Edges, config: Features, focal_px: float, prior: TiltPrior | None = None
) -> tuple[Lines, EdgeSet] | None:
    """As find_lines, with the edges under the lines."""
    psi = dominant_direction(edges.phi_deg)
    if psi is None:
        return None
    groups = _split(edges, psi, config.direction_gate_deg)
    psi, starts = _hough(groups, psi, config, edges.share)
    if sum(len(s) for s in starts) < 2:
        return None
    fit = _fitted(groups, psi, starts, config, focal_px, edges.share, np.zeros(2))
    free = fit.finish()
    if config.estimate_tilt:
        expected = np.zeros(2) if prior is None else prior.mean_rad
        vague = float(np.max(free.sigma_rad)) > _VAGUE_RAD
        if vague or fit.doubts(expected, prior):
            level = _fitted(groups, psi, starts, config, focal_px, edges.share, expected, tilt=False)
            fit, free = _held(level, prior) if vague else _better(fit, free, level)
        if prior is not None:
            fit.lean_on(prior)
    return join_grooves(fit, config, edges.share, free)


def _fitted(
    groups: list[Group],
    psi: float,
    starts: list[Array],
    config: Features,
    focal_px: float,
    share: float,
    tilt_rad: Array,
    tilt: bool = True,
) -> JointFit:
    """Coarse rounds from the Hough peaks, then peaks again where direction and tilt are known: those are sharper."""
    few = [Group(g.x[::_COARSE_STRIDE], g.y[::_COARSE_STRIDE]) for g in groups]
    coarse = JointFit(few, psi, starts, focal_px, config, share / _COARSE_STRIDE, tilt_rad)
    for gate_px in _GATES_PX:
        coarse.assign(gate_px)
        coarse.solve(tilt)
    need = max(config.min_line_points * share, _FEWEST_VOTES)
    fine = JointFit(groups, coarse.psi, starts, focal_px, config, share, coarse.tilt)
    fine.restart([_peaks(_votes(rho, _FINE_BIN_PX), need, config, _FINE_BIN_PX) for rho in fine.rho_by_group()])
    fine.assign(_FINE_GATE_PX)
    fine.solve(tilt)
    return fine


def _held(level: JointFit, prior: TiltPrior | None) -> tuple[JointFit, TiltPrior]:
    """So few lines that any tilt fits: then none is read from them."""
    level.hold(prior)
    return level, NO_TILT


def _better(fit: JointFit, free: TiltPrior, level: JointFit) -> tuple[JointFit, TiltPrior]:
    """A fit that began with another tilt must convince clearly more points than one that began where expected."""
    seen = level.finish()
    return (level, seen) if len(level.line) > _NO_WORSE * len(fit.line) else (fit, free)


def _split(edges: Edges, psi: float, gate_deg: float) -> list[Group]:
    """Four groups: axis 0 falling, axis 0 rising, axis 1 falling, axis 1 rising along the normal."""
    turns = (edges.phi_deg - np.float32(np.degrees(psi))) * np.float32(1 / 90.0)
    nearest = np.rint(turns)
    quarter = np.where(np.abs(turns - nearest) < gate_deg / 90.0, nearest.astype(np.int8) & 3, 4)
    members = (edges.uv_px[quarter == q].astype(np.float64) for q in (2, 0, 3, 1))
    return [Group(np.ascontiguousarray(uv[:, 0]), np.ascontiguousarray(uv[:, 1])) for uv in members]


def _hough(groups: list[Group], psi: float, config: Features, share: float) -> tuple[float, list[Array]]:
    """The direction with the sharpest votes and, for each group, line offsets."""
    reach, bin_px = np.radians(config.hough_angle_deg), config.hough_bin_px
    few = [Group(g.x[::_ANGLE_STRIDE], g.y[::_ANGLE_STRIDE]) for g in groups]
    angles = psi + np.linspace(-reach, reach, 5)
    sharpness = [sum(float(np.sum(v[:, 1] ** 2)) for v in _all_votes(few, angle, bin_px)) for angle in angles]
    best = float(angles[int(np.argmax(sharpness))])
    need = max(config.min_line_points * share, _FEWEST_VOTES)
    return best, [_peaks(v, need, config, bin_px) for v in _all_votes(groups, best, bin_px)]


def _all_votes(groups: list[Group], angle: float, bin_px: float) -> list[Array]:
    return [_votes(g.along(angle + 0.5 * np.pi * (k // 2)), bin_px) for k, g in enumerate(groups)]


def _votes(rho: Array, bin_px: float) -> Array:
    """(B, 2) offset and votes of every bin between the first and the last used one."""
    if len(rho) == 0:
        return np.zeros((0, 2))
    cell = np.floor(rho / bin_px).astype(np.int64)
    first = int(cell.min())
    count = np.bincount(cell - first)
    return np.column_stack([(np.arange(len(count)) + first + 0.5) * bin_px, count])


def _peaks(votes: Array, need: float, config: Features, bin_px: float) -> Array:
    """Offsets of local maxima of three neighbouring bins, strongest `max_lines`, sorted."""
    if len(votes) == 0:
        return np.zeros(0)
    count = np.concatenate([[0.0], votes[:, 1], [0.0]])
    three = count[:-2] + count[1:-1] + count[2:]
    left, right = np.concatenate([[0.0], three[:-1]]), np.concatenate([three[1:], [0.0]])
    at = np.flatnonzero((three >= need) & (three > left) & (three >= right))
    at = np.sort(at[np.argsort(-three[at], kind="stable")[: config.max_lines]])
    moment = (count[2:][at] - count[:-2][at]) / three[at]
    return np.asarray(votes[at, 0] + moment * bin_px)
