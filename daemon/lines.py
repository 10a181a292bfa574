"""Stage 2: straight lines that are all parallel or perpendicular, with the robot's tilt, in one least squares.

Canny's points vote in a Hough transform restricted to the dominant direction; the peaks start a joint least squares
whose unknowns are the common direction, the tilt (roll, pitch) and one offset a line.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ceilvo.config import Features
from ceilvo.daemon import kernel
from ceilvo.daemon.edges import Edges
from ceilvo.daemon.grooves import EdgeSet, fold, join_grooves
from ceilvo.daemon.line_fit import JointFit, Points
from ceilvo.daemon.tilt import NO_TILT, TiltPrior
from ceilvo.types import Array, Lines

Array32 = NDArray[np.float32]

_GATES_PX = (6.0, 3.0)
_FINE_BIN_PX = 1.0
_FINE_GATE_PX = 2.0
_NO_WORSE = 0.95
_VAGUE_RAD = np.radians(0.025)
_DIRECTION_REACH_DEG = 4.0
_FEWEST_VOTES = 8.0
_TILT_GROWS = 1.2
_ENOUGH_TO_START = 4000


def dominant_direction(phi_deg: Array32) -> float | None:
    """Direction in [-pi/4, pi/4) that most gradients share modulo 90 deg, or None without points."""
    if len(phi_deg) == 0:
        return None
    folded = _modulo_90(phi_deg[:: 1 + len(phi_deg) // _ENOUGH_TO_START])
    votes = np.bincount(np.clip(folded.astype(np.int32), 0, 89), minlength=90)  # rounding may reach 90, or fall below 0
    peak = float(np.argmax(votes + np.roll(votes, 1) + np.roll(votes, -1))) + 0.5
    off = _modulo_90(folded - np.float32(peak - 45.0)) - np.float32(45.0)
    near = off[np.abs(off) < _DIRECTION_REACH_DEG]
    return fold(float(np.radians(peak + float(np.mean(near, dtype=np.float64)))))


def _modulo_90(degrees: Array32) -> Array32:
    return degrees - np.float32(90.0) * np.floor(degrees * np.float32(1 / 90.0))


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
    x, y, ends = kernel.split(
        edges.uv_px, edges.phi_deg, float(np.degrees(psi)), config.direction_gate_deg, 1.0 / focal_px
    )
    points = Points(x, y, ends, _reach(x, y))
    psi, starts = _hough(points, psi, config, edges.share, focal_px)
    if sum(len(s) for s in starts) < 2:
        return None
    fit = _fitted(points, psi, starts, config, focal_px, edges.share, np.zeros(2))
    free = fit.finish()
    if config.estimate_tilt:
        expected = np.zeros(2) if prior is None else prior.mean_rad
        vague = float(np.max(free.sigma_rad)) > _VAGUE_RAD
        if vague or fit.doubts(expected, prior):
            level = _fitted(points, psi, starts, config, focal_px, edges.share, expected, tilt=False)
            fit, free = _held(level, prior) if vague else _better(fit, free, level)
        if prior is not None:
            fit.lean_on(prior)
    return join_grooves(fit, config, edges.share, free)


def _reach(x: Array32, y: Array32) -> float:
    """No point is further from the centre."""
    return float(np.hypot(*(max(v.max(initial=0.0), -v.min(initial=0.0)) for v in (x, y))))


def _fitted(
    points: Points,
    psi: float,
    starts: list[Array],
    config: Features,
    focal_px: float,
    share: float,
    tilt_rad: Array,
    tilt: bool = True,
) -> JointFit:
    """Coarse rounds from the Hough peaks, then peaks again where direction and tilt are known: those are sharper."""
    stride = points.stride_to(_ENOUGH_TO_START)
    coarse = JointFit(points.thinned(stride), psi, starts, focal_px, config, share / stride, tilt_rad)
    for gate_px in _GATES_PX:
        coarse.assign(gate_px)
        coarse.solve(tilt)
    need = max(config.min_line_points * share, _FEWEST_VOTES)
    fine = JointFit(points, coarse.psi, starts, focal_px, config, share, coarse.tilt)
    again = Points(fine.rho, fine.tangent, points.ends, _TILT_GROWS * points.reach)
    fine.restart(_peaks(_votes(again, (0.0, 0.0), focal_px, _FINE_BIN_PX), need, config, _FINE_BIN_PX))
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


def _hough(points: Points, psi: float, config: Features, share: float, focal_px: float) -> tuple[float, list[Array]]:
    """The direction with the sharpest votes and, for each group, line offsets."""
    reach, bin_px = np.radians(config.hough_angle_deg), config.hough_bin_px
    angles = (psi + np.linspace(-reach, reach, 5)).tolist()
    stride = points.stride_to(_ENOUGH_TO_START)
    few = (_votes(points, (a, a + 0.5 * np.pi), focal_px, bin_px, stride) for a in angles)
    best = angles[int(np.argmax([np.vdot(v, v) for v in few]))]
    need = max(config.min_line_points * share, _FEWEST_VOTES)
    votes = _votes(points, (best, best + 0.5 * np.pi), focal_px, bin_px)
    return best, _peaks(votes, need, config, bin_px)


def _votes(
    points: Points, angles_rad: tuple[float, float], focal_px: float, bin_px: float, stride: int = 1
) -> NDArray[np.int64]:
    """(4, B) votes of each group, for bins to either side of offset 0."""
    half = int(points.reach * focal_px / bin_px) + 3
    return kernel.vote(points.x, points.y, points.ends, angles_rad, focal_px / bin_px, half, stride)


def _peaks(votes: NDArray[np.int64], need: float, config: Features, bin_px: float) -> list[Array]:
    """For each group, rising offsets of its strongest `max_lines` local maxima of three neighbouring bins."""
    three = np.zeros_like(votes)
    three[:, 1:-1] = votes[:, :-2] + votes[:, 1:-1] + votes[:, 2:]
    inner = three[:, 1:-1]
    group, at = np.nonzero((inner >= need) & (inner > three[:, :-2]) & (inner >= three[:, 2:]))
    at = at + 1
    strength = three[group, at]
    moment = (votes[group, at + 1] - votes[group, at - 1]) / strength
    offset = (at - votes.shape[1] // 2 + 0.5 + moment) * bin_px
    return [_strongest(offset[group == g], strength[group == g], config.max_lines) for g in range(len(votes))]


def _strongest(offset: Array, strength: NDArray[np.int64], most: int) -> Array:
    if len(offset) <= most:
        return offset
    return np.asarray(offset[np.sort(np.argsort(-strength, kind="stable")[:most])])
