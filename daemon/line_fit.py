"""The joint least squares of a frame's lines: one direction, the robot's tilt, one offset a line."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ceilvo.config import Features
from ceilvo.daemon.tilt import TiltPrior
from ceilvo.types import Array, Ints

_LAST_GATE_PX = (0.8, 2.0)
_LAST_GATE_SIGMAS = 3.0
_CORRELATED_POINTS = 27.0
_SIGMA_FLOOR_PX = 0.02
_TILT_CHI2 = 9.21
_APART_PX = 1e6
_DOUBT_RAD = np.radians(0.3)
_HELD_RAD = np.radians(0.02)


@dataclass(frozen=True, slots=True)
class Group:
    """Edge points whose gradient is along one axis, with one polarity: x, y (P,) px."""

    x: Array
    y: Array

    def along(self, angle: float) -> Array:
        return np.asarray(np.cos(angle) * self.x + np.sin(angle) * self.y)


class JointFit:
    """Joint least squares: n(psi) . p(tilt) = offset of the point's line.

    Points stand group after group. `line` is a point's line, or the number of lines for "none".
    """

    def __init__(
        self,
        groups: list[Group],
        psi: float,
        starts: list[Array],
        focal_px: float,
        config: Features,
        share: float,
        tilt_rad: Array,
    ) -> None:
        self.psi = psi
        self.tilt = tilt_rad
        self._focal, self._config = focal_px, config
        self.correlated = 1.0 + _CORRELATED_POINTS * share  # neighbours on a line share their error
        self._seen_x = np.concatenate([g.x for g in groups]) / focal_px
        self._seen_y = np.concatenate([g.y for g in groups]) / focal_px
        self._ends = np.cumsum([0, *(len(g.x) for g in groups)])
        self.restart(starts)
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

    def restart(self, starts: list[Array]) -> None:
        """Lines to fit, by their offsets in each group."""
        self.offset = np.concatenate(starts)
        self.line_group = np.repeat(np.arange(4), [len(s) for s in starts])
        self.support = np.zeros(len(self.offset), np.int64)

    def rho_by_group(self) -> list[Array]:
        """Coordinates along the normal, px, of all points, group by group."""
        return [self.rho[self._ends[g] : self._ends[g + 1]] * self._focal for g in range(4)]

    def doubts(self, expected_rad: Array, prior: TiltPrior | None) -> bool:
        """Whether the tilt found is far from what was expected: then a false optimum is possible."""
        off = np.abs(self.tilt - expected_rad)
        spread = _DOUBT_RAD if prior is None else np.maximum(3.0 * prior.sigma_rad, _DOUBT_RAD)
        return bool(np.any(off > spread))

    def start(self, line_of_point: Ints, expected_offset: Array) -> None:
        """Begin from given lines instead of gates: the line of every point, in the points' order."""
        self.line = line_of_point
        self.offset = expected_offset
        self._place()

    def last_gate_px(self) -> float:
        """A few standard deviations of the points that fit, in bounds: jagged edges need more than clean ones."""
        spread = np.abs(self.rho * self._focal - self.offset[self.line])
        sigma = 1.4826 * float(np.median(spread)) if len(spread) else 0.0
        return float(np.clip(_LAST_GATE_SIGMAS * sigma, *_LAST_GATE_PX))

    def solve(self, tilt: bool = True) -> None:
        """One Gauss-Newton step on (psi, tilt); the offsets are eliminated by centring every line.

        Args:
            tilt: False holds the tilt where it is.
        """
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
        held = not (tilt and self._config.estimate_tilt)
        prior = np.radians(1e-6 if held else self._config.tilt_prior_deg)
        turn = self._tilt_from_axes()
        prior_info = np.zeros((3, 3))
        prior_info[0, 0], prior_info[1, 1], prior_info[2, 2] = 1e-3, prior**-2, prior**-2
        info = weight * info_jac + prior_info
        gradient = weight * r_jac + np.array([0.0, *(np.zeros(2) if held else turn.T @ self.tilt / prior**2)])
        covariance = np.asarray(np.linalg.inv(info))
        step = -covariance @ gradient
        to_base = np.eye(3)
        to_base[1:, 1:] = turn
        self.covariance = to_base @ covariance @ to_base.T
        self.psi += float(step[0])
        self.tilt = self.tilt + turn @ step[1:]
        self._place()
        self._settle()

    def hold(self, prior: TiltPrior | None) -> None:
        """The last round with the tilt where it is; how far it may be off is what is known beforehand."""
        self.assign(self.last_gate_px())
        self.solve(tilt=False)
        sigma = np.full(2, _HELD_RAD) if prior is None else np.maximum(prior.sigma_rad, _HELD_RAD)
        self.covariance = self.covariance + np.diag([0.0, *(sigma**2)])

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

    def finish(self) -> TiltPrior:
        """The last round; returns the tilt of this frame alone."""
        self.assign(self.last_gate_px())
        self.solve()
        return TiltPrior(self.tilt, np.sqrt(np.diag(self.covariance)[1:]))

    def sigma_px(self) -> Array:
        """Standard deviations of the offsets."""
        return np.asarray(self.noise_px * np.sqrt(self.correlated / np.maximum(self.support, 1)) + _SIGMA_FLOOR_PX)
