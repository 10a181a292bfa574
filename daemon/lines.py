"""Stage 2: straight lines that are all parallel or perpendicular, with the robot's tilt, in one least squares.

Canny's points vote in a Hough transform restricted to the dominant direction; the peaks start a joint least squares
whose unknowns are the common direction, the tilt (roll, pitch) and one offset a line.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ceilvo.config import Features
from ceilvo.daemon.edges import Edges
from ceilvo.daemon.tilt import TiltPrior
from ceilvo.types import LineKind, Lines

Array = NDArray[np.float64]
Array32 = NDArray[np.float32]
Ints = NDArray[np.int64]

_GATES_PX = (6.0, 2.5)
_LAST_GATE_PX = (0.8, 2.0)
_LAST_GATE_SIGMAS = 3.0
_DIRECTION_REACH_DEG = 4.0
_SAME_LINE_PX = 3.0
_ANGLE_STRIDE = 3
_FEWEST_VOTES = 8.0
_APART_PX = 1e6
_FEWEST_SUPPORT = 4.0
_CORRELATED_POINTS = 27.0
_TILT_CHI2 = 9.21
_SIGMA_FLOOR_PX = 0.02


@dataclass(frozen=True, slots=True)
class _Group:
    """Edge points whose gradient is along one axis, with one polarity: x, y (P,) px."""

    x: Array
    y: Array

    def along(self, angle: float) -> Array:
        return np.asarray(np.cos(angle) * self.x + np.sin(angle) * self.y)


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
    return _fold(float(np.radians(peak + float(np.mean(near, dtype=np.float64)))))


def find_lines(edges: Edges, config: Features, focal_px: float, prior: TiltPrior | None = None) -> Lines | None:
    """Lines of one frame, or None when too few edge points agree on a direction.

    Args:
        focal_px: of the level view.
        prior: how this robot has tilted lately; used unless this frame contradicts it.
    """
    psi = dominant_direction(edges.phi_deg)
    if psi is None:
        return None
    groups = _split(edges, psi, config.direction_gate_deg)
    psi, starts = _hough(groups, psi, config, edges.share)
    if sum(len(s) for s in starts) < 2:
        return None
    fit = _Fit(groups, psi, starts, focal_px, config, edges.share)
    for gate_px in _GATES_PX:
        fit.assign(gate_px)
        fit.solve()
    fit.assign(fit.last_gate_px())
    fit.solve()
    free = TiltPrior(fit.tilt, np.sqrt(np.diag(fit.covariance)[1:]))
    if prior is not None and config.estimate_tilt:
        fit.lean_on(prior)
    return _join_grooves(fit, config, edges.share, free)


def _split(edges: Edges, psi: float, gate_deg: float) -> list[_Group]:
    """Four groups: axis 0 falling, axis 0 rising, axis 1 falling, axis 1 rising along the normal."""
    turns = (edges.phi_deg - np.float32(np.degrees(psi))) * np.float32(1 / 90.0)
    nearest = np.rint(turns)
    quarter = np.where(np.abs(turns - nearest) < gate_deg / 90.0, nearest.astype(np.int8) & 3, 4)
    members = (edges.uv_px[quarter == q].astype(np.float64) for q in (2, 0, 3, 1))
    return [_Group(np.ascontiguousarray(uv[:, 0]), np.ascontiguousarray(uv[:, 1])) for uv in members]


def _hough(groups: list[_Group], psi: float, config: Features, share: float) -> tuple[float, list[Array]]:
    """The direction with the sharpest votes and, for each group, line offsets."""
    reach, bin_px = np.radians(config.hough_angle_deg), config.hough_bin_px
    few = [_Group(g.x[::_ANGLE_STRIDE], g.y[::_ANGLE_STRIDE]) for g in groups]
    angles = psi + np.linspace(-reach, reach, 5)
    sharpness = [sum(float(np.sum(v[:, 1] ** 2)) for v in _all_votes(few, angle, bin_px)) for angle in angles]
    best = float(angles[int(np.argmax(sharpness))])
    need = max(config.min_line_points * share, _FEWEST_VOTES)
    return best, [_peaks(v, need, config) for v in _all_votes(groups, best, bin_px)]


def _all_votes(groups: list[_Group], angle: float, bin_px: float) -> list[Array]:
    return [_votes(g.along(angle + 0.5 * np.pi * (k // 2)), bin_px) for k, g in enumerate(groups)]


def _votes(rho: Array, bin_px: float) -> Array:
    """(B, 2) offset and votes of every bin between the first and the last used one."""
    if len(rho) == 0:
        return np.zeros((0, 2))
    cell = np.floor(rho / bin_px).astype(np.int64)
    first = int(cell.min())
    count = np.bincount(cell - first)
    return np.column_stack([(np.arange(len(count)) + first + 0.5) * bin_px, count])


def _peaks(votes: Array, need: float, config: Features) -> Array:
    """Offsets of local maxima of three neighbouring bins, strongest `max_lines`, sorted."""
    if len(votes) == 0:
        return np.zeros(0)
    count = np.concatenate([[0.0], votes[:, 1], [0.0]])
    three = count[:-2] + count[1:-1] + count[2:]
    left, right = np.concatenate([[0.0], three[:-1]]), np.concatenate([three[1:], [0.0]])
    at = np.flatnonzero((three >= need) & (three > left) & (three >= right))
    at = np.sort(at[np.argsort(-three[at], kind="stable")[: config.max_lines]])
    moment = (count[2:][at] - count[:-2][at]) / three[at]
    return np.asarray(votes[at, 0] + moment * config.hough_bin_px)


class _Fit:
    """Joint least squares: n(psi) . p(tilt) = offset of the point's line.

    Points stand group after group. `line` is a point's line, or the number of lines for "none".
    """

    def __init__(
        self, groups: list[_Group], psi: float, starts: list[Array], focal_px: float, config: Features, share: float
    ) -> None:
        self.psi = psi
        self.tilt = np.zeros(2)
        self._focal, self._config = focal_px, config
        self.correlated = 1.0 + _CORRELATED_POINTS * share  # neighbours on a line share their error
        self._seen_x = np.concatenate([g.x for g in groups]) / focal_px
        self._seen_y = np.concatenate([g.y for g in groups]) / focal_px
        self._ends = np.cumsum([0, *(len(g.x) for g in groups)])
        self.offset = np.concatenate(starts)
        self.line_group = np.repeat(np.arange(4), [len(s) for s in starts])
        self.support = np.zeros(len(self.offset), np.int64)
        self.covariance = np.eye(3)
        self.noise_px = 1.0
        self._place()

    @property
    def axis(self) -> Ints:
        return np.asarray(self.line_group // 2, np.int64)

    @property
    def uv(self) -> Array:
        """(P, 2) px of the remaining points as a level robot would see them."""
        x, y = self._level()
        return np.column_stack([x, y]) * self._focal

    def _place(self) -> None:
        """Turn the seen rays back by the robot's tilt; rho is along a point's normal, tangent along its line."""
        x, y = self._level()
        c, s = np.cos(self.psi), np.sin(self.psi)
        half = self._ends[2]
        self.rho, self._tangent = c * x + s * y, c * y - s * x
        swap = self.rho[half:].copy()
        self.rho[half:] = self._tangent[half:]
        self._tangent[half:] = -swap

    def _level(self) -> tuple[Array, Array]:
        a, b = self.tilt
        x, y = self._seen_x, self._seen_y
        scale = 1.0 / (1.0 + a * y - b * x)
        return (x + b) * scale, (y - a) * scale

    def assign(self, gate_px: float) -> None:
        """Give every point the nearest line of its axis and polarity within the gate; drop points of no line."""
        rho_px = self.rho * self._focal
        key = rho_px + np.repeat(_APART_PX * np.arange(4.0), np.diff(self._ends))
        line_key = self.offset + _APART_PX * self.line_group
        order = np.argsort(line_key, kind="stable")
        sorted_key = line_key[order]
        nearest = np.searchsorted(0.5 * (sorted_key[1:] + sorted_key[:-1]), key)
        keep = np.flatnonzero(np.abs(key - sorted_key[nearest]) < gate_px)
        self.line = order[nearest[keep]]
        counts = np.bincount(self.line_group[self.line], minlength=4)
        self._ends = np.concatenate([[0], np.cumsum(counts)])
        self._seen_x, self._seen_y = self._seen_x[keep], self._seen_y[keep]
        self.rho, self._tangent = self.rho[keep], self._tangent[keep]

    def last_gate_px(self) -> float:
        """A few standard deviations of the points that fit, in bounds: jagged edges need more than clean ones."""
        spread = np.abs(self.rho * self._focal - self.offset[self.line])
        sigma = 1.4826 * float(np.median(spread)) if len(spread) else 0.0
        return float(np.clip(_LAST_GATE_SIGMAS * sigma, *_LAST_GATE_PX))

    def solve(self) -> None:
        """One Gauss-Newton step on (psi, tilt); the offsets are eliminated by centring every line."""
        n = len(self.offset)
        self.support = np.bincount(self.line, minlength=n)
        count = np.maximum(self.support, 1)
        rows = np.stack([self.rho, self._tangent, *self._tilt_rows()])
        means = np.stack([np.bincount(self.line, row, n) for row in rows]) / count
        # sums of products about every line's own mean
        scatter = (rows @ rows.T - (means * count) @ means.T) * self._focal**2
        scatter_r, r_jac, info_jac = scatter[0, 0], scatter[0, 1:], scatter[1:, 1:]
        mean_square = scatter_r / max(len(self.line), 1)
        self.noise_px = max(float(np.sqrt(max(mean_square, 0.0))), _SIGMA_FLOOR_PX)
        weight = 1.0 / (self.noise_px**2 * self.correlated)
        prior = np.radians(self._config.tilt_prior_deg if self._config.estimate_tilt else 1e-6)
        turn = self._tilt_from_axes()
        prior_info = np.zeros((3, 3))
        prior_info[0, 0], prior_info[1, 1], prior_info[2, 2] = 1e-3, prior**-2, prior**-2
        info = weight * info_jac + prior_info
        gradient = weight * r_jac + np.array([0.0, *(turn.T @ self.tilt / prior**2)])
        covariance = np.asarray(np.linalg.inv(info))
        step = -covariance @ gradient
        to_base = np.eye(3)
        to_base[1:, 1:] = turn
        self.covariance = to_base @ covariance @ to_base.T
        self.psi += float(step[0])
        self.tilt = self.tilt + turn @ step[1:]
        self._place()
        self._settle()

    def lean_on(self, prior: TiltPrior) -> None:
        """Combine with what is known of the tilt, unless the two disagree; psi follows through its correlation."""
        off = prior.mean_rad - self.tilt
        spread = self.covariance[1:, 1:] + np.diag(prior.sigma_rad**2)
        if float(off @ np.linalg.solve(spread, off)) > _TILT_CHI2:
            return
        gain = self.covariance[:, 1:] @ np.linalg.inv(spread)
        step = gain @ off
        self.covariance = self.covariance - gain @ self.covariance[1:, :]
        self.psi += float(step[0])
        self.tilt = self.tilt + step[1:]
        self._place()
        self._settle()

    def _settle(self) -> None:
        """Offsets as the means of their points."""
        n = len(self.offset)
        mean_rho = np.bincount(self.line, self.rho, n) / np.maximum(self.support, 1)
        self.offset = np.where(self.support > 0, mean_rho * self._focal, self.offset)

    def _tilt_from_axes(self) -> Array:
        """(2, 2): tilt about base x and y from tilt about the two line normals."""
        c, s = np.cos(self.psi), np.sin(self.psi)
        return np.array([[c, -s], [s, c]])

    def _tilt_rows(self) -> tuple[Array, Array]:
        """d rho / d tilt about the normal of axis 0 and of axis 1; a ray r seen by a tilted robot moves by -w x r."""
        rho, tangent, half = self.rho, self._tangent, self._ends[2]
        across, own = rho * tangent, 1.0 + rho * rho
        return np.concatenate([-across[:half], -own[half:]]), np.concatenate([own[:half], -across[half:]])


def _join_grooves(fit: _Fit, config: Features, share: float, free: TiltPrior) -> Lines | None:
    """Falling and rising edges that lie close together are the two sides of one groove: keep its centre line."""
    keep = np.flatnonzero(fit.support >= max(0.5 * share * config.min_line_points, _FEWEST_SUPPORT))
    if len(keep) < 2:
        return None
    order = keep[np.lexsort((fit.offset[keep], fit.axis[keep]))]
    order = order[_distinct(fit, order)]
    offset, axis, group = fit.offset[order], fit.axis[order], fit.line_group[order]
    partner = _pairs(offset, axis, group % 2, config.groove_px)
    first = (partner < 0) | (partner > np.arange(len(order)))  # one entry a pair
    new_of_old = np.full(len(fit.offset), -1, np.int64)
    index = np.cumsum(first) - 1
    new_of_old[order] = np.where(first, index, index[np.maximum(partner, 0)])
    other = np.where(partner >= 0, partner, np.arange(len(order)))
    paired = partner >= 0
    edge_kind = np.where(group % 2 == 1, LineKind.RISING, LineKind.FALLING)
    support = fit.support[order]
    sigma = fit.noise_px * np.sqrt(fit.correlated / support) + _SIGMA_FLOOR_PX
    joined = np.where(paired, 0.5 * (offset + offset[other]), offset)
    joined_sigma = np.where(paired, 0.5 * np.hypot(sigma, sigma[other]), sigma)
    point_line = new_of_old[fit.line]
    used = point_line >= 0
    psi, turned = _fold_turns(fit.psi)
    lines = Lines(
        psi_rad=psi,
        psi_sigma_rad=float(np.sqrt(fit.covariance[0, 0])),
        axis=axis[first],
        offset_px=joined[first],
        sigma_px=joined_sigma[first],
        kind=np.where(paired, LineKind.GROOVE, edge_kind)[first].astype(np.int64),
        support=np.where(paired, support + support[other], support)[first],
        tilt_rad=fit.tilt,
        tilt_sigma_rad=np.sqrt(np.diag(fit.covariance)[1:]),
        free_tilt_rad=free.mean_rad,
        free_tilt_sigma_rad=free.sigma_rad,
        points=fit.uv[used],
        point_line=point_line[used],
    )
    return _turn_axes(lines, turned)


def _distinct(fit: _Fit, order: Ints) -> NDArray[np.bool_]:
    """False for a line that stands within 3 px of a stronger one of its own axis and polarity."""
    good = np.ones(len(order), bool)
    for g in range(4):
        ids = np.flatnonzero(fit.line_group[order] == g)
        close = np.flatnonzero(np.diff(fit.offset[order[ids]]) < _SAME_LINE_PX)
        for k in close:
            a, b = ids[k], ids[k + 1]
            good[a if fit.support[order[a]] < fit.support[order[b]] else b] = False
    return good


def _pairs(offset: Array, axis: Ints, rising: Ints, groove_px: float) -> Ints:
    """Index of every line's partner, or -1: neighbours of opposite polarity, closest pairs first."""
    partner = np.full(len(offset), -1, np.int64)
    gap = np.diff(offset)
    fits = (np.diff(axis) == 0) & (np.diff(rising) != 0) & (gap < groove_px)
    for k in np.argsort(gap, kind="stable"):
        if fits[k] and partner[k] < 0 and partner[k + 1] < 0:
            partner[k], partner[k + 1] = k + 1, k
    return partner


def _turn_axes(lines: Lines, turned: int) -> Lines:
    """Rename the axes after psi was folded by `turned` quarter turns (clockwise)."""
    axis, offset, kind = lines.axis, lines.offset_px, lines.kind
    for _ in range(turned % 4):
        # psi was taken a quarter turn back: old axis 0 is new axis 1, old axis 1 is new axis 0 reversed
        sign = np.where(axis == 1, -1, 1)
        axis, offset, kind = 1 - axis, offset * sign, kind * sign
    return replace(lines, axis=axis, offset_px=offset, kind=kind)


def _fold(psi: float) -> float:
    return _fold_turns(psi)[0]


def _fold_turns(psi: float) -> tuple[float, int]:
    """psi in [-pi/4, pi/4) and the quarter turns taken off it."""
    turns = int(np.floor((psi + 0.25 * np.pi) / (0.5 * np.pi)))
    return psi - turns * 0.5 * np.pi, turns


def _wrap(a: Array) -> Array:
    return np.asarray((a + np.pi) % (2.0 * np.pi) - np.pi)
