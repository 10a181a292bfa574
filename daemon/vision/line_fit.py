"""The joint least squares of a frame's lines: one direction, the robot's tilt, one offset a line."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from ceilvo.config import Features
from ceilvo.daemon.vision import kernel
from ceilvo.daemon.vision.kernel.arguments import Ends
from ceilvo.daemon.vision.kernel.reference import median
from ceilvo.daemon.vision.tilt_prior import TiltPrior
from ceilvo.types import Array, Ints

Array32 = NDArray[np.float32]

_LAST_GATE_PX = (0.8, 2.0)
_LAST_GATE_SIGMAS = 3.0
_CORRELATED_POINTS = 27.0
_SIGMA_FLOOR_PX = 0.02
_TILT_CHI2 = 9.21
_SPREAD_STRIDE = 3
_DOUBT_RAD = np.radians(0.3)
_HELD_RAD = np.radians(0.02)
# with few lines tilt rests on what no noise model knows: bloom of lamps, remains of the lens
_WEAK_RAD = np.radians(0.014)


@dataclass(frozen=True, slots=True)
class Points:
    """Edge points as rays (x, y, 1), (P,) each, none further than `reach` from the centre.

    `ends` bounds the four groups (see kernel/reference.py).
    """

    x: Array32
    y: Array32
    ends: Ends
    reach: float

    def stride_to(self, enough: int) -> int:
        """Every how many-th point makes about so many."""
        return max(len(self.x) // enough, 1)

    def thinned(self, stride: int) -> Points:
        """Every stride-th point of each group."""
        at = [slice(a, b, stride) for a, b in pairwise(self.ends)]
        x, y = ([v[s] for s in at] for v in (self.x, self.y))
        a, b, c, d, e = np.cumsum([0, *(len(v) for v in x)]).tolist()
        return Points(np.concatenate(x), np.concatenate(y), (a, b, c, d, e), self.reach)


class JointFit:
    """Joint least squares: n(psi) . p(tilt) = offset of the point's line.

    `line` is a point's line; `rho` and `tangent` are its coordinates across and along it, as rays of a level robot.
    """

    def __init__(
        self,
        points: Points,
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
        self._x, self._y, self.ends = points.x, points.y, points.ends
        self.restart(starts)
        self.covariance = np.eye(3)
        self.noise_px = 1.0
        self._place()

    @property
    def axis(self) -> Ints:
        return np.asarray(self.line_group // 2, np.int64)

    def uv(self) -> Array32:
        """(P, 2) px of the remaining points as a level robot would see them."""
        half, c, s = self.ends[2], np.float32(np.cos(self.psi)), np.float32(np.sin(self.psi))
        first, second = self.rho.copy(), self.tangent.copy()
        first[half:], second[half:] = -self.tangent[half:], self.rho[half:]
        uv = np.column_stack([c * first - s * second, s * first + c * second])
        return np.asarray(uv * np.float32(self._focal), np.float32)

    def extents(self) -> tuple[Array, Array]:
        """Where the points of every line (L,) begin and end along it, px."""
        low, high = kernel.extents(self.tangent, self.line, len(self.offset))
        return low * self._focal, high * self._focal

    def _place(self) -> None:
        """Turn the seen rays back by the robot's tilt."""
        self.rho, self.tangent = kernel.project(self._x, self._y, self.ends[2], self.psi, self.tilt)

    def assign(self, gate_px: float) -> None:
        """Give every point the nearest line of its axis and polarity within the gate; drop points of no line."""
        order = np.lexsort((self.offset, self.line_group))
        counts = np.bincount(self.line_group, minlength=4)
        self._x, self._y, self.rho, self.tangent, line, self.ends = kernel.assign(
            self._x,
            self._y,
            self.rho,
            self.tangent,
            self.ends,
            self.offset[order] / self._focal,
            counts,
            gate_px / self._focal,
        )
        self.line = order.astype(np.int32)[line]

    def restart(self, starts: list[Array]) -> None:
        """Lines to fit, by their offsets in each group."""
        self.offset = np.concatenate(starts)
        self.line_group = np.repeat(np.arange(4), [len(s) for s in starts])
        self.support = np.zeros(len(self.offset), np.int64)

    def doubts(self, expected_rad: Array, prior: TiltPrior | None) -> bool:
        """Whether the tilt found is far from what was expected: then a false optimum is possible."""
        off = np.abs(self.tilt - expected_rad)
        spread = _DOUBT_RAD if prior is None else np.maximum(3.0 * prior.sigma_rad, _DOUBT_RAD)
        return bool(np.any(off > spread))

    def start(self, line_of_point: NDArray[np.int32], expected_offset: Array) -> None:
        """Begin from given lines instead of gates: the line of every point, in the points' order."""
        self.line = line_of_point
        self.offset = expected_offset
        self._place()

    def last_gate_px(self) -> float:
        """A few standard deviations of the points that fit, in bounds: jagged edges need more than clean ones."""
        spread = np.abs(self.rho[::_SPREAD_STRIDE] * self._focal - self.offset[self.line[::_SPREAD_STRIDE]])
        sigma = 1.4826 * median(spread)
        return float(np.clip(_LAST_GATE_SIGMAS * sigma, *_LAST_GATE_PX))

    def solve(self, tilt: bool = True) -> None:
        """One Gauss-Newton step on (psi, tilt); the offsets are eliminated by centring every line.

        Args:
            tilt: False holds the tilt where it is.
        """
        n = len(self.offset)
        self.support, total, product = kernel.sums(self.rho, self.tangent, self.line, self.ends[2], n)
        means = total / np.maximum(self.support, 1)[:, None]
        # sums of products about every line's own mean
        scatter = (product - total.T @ means) * self._focal**2
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

    def hold(self) -> None:
        """The last round with the tilt where it is."""
        self.assign(self.last_gate_px())
        self.solve(tilt=False)
        self.covariance = self.covariance + np.diag([0.0, _HELD_RAD**2, _HELD_RAD**2])

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
        mean = kernel.means(self.rho, self.line, len(self.offset)) * self._focal
        self.offset = np.where(self.support > 0, mean, self.offset)

    def _tilt_from_axes(self) -> Array:
        """(2, 2): tilt about base x and y from tilt about the two line normals."""
        c, s = np.cos(self.psi), np.sin(self.psi)
        return np.array([[c, -s], [s, c]])

    def finish(self) -> TiltPrior:
        """The last round; returns the tilt of this frame alone."""
        self.assign(self.last_gate_px())
        self.solve()
        grow = np.ones(3)
        grow[1:] += np.diag(self.covariance)[1:] / _WEAK_RAD**2
        self.covariance = self.covariance * np.outer(grow, grow)
        return TiltPrior(self.tilt, np.sqrt(np.diag(self.covariance)[1:]))

    def cost(self, points: int) -> float:
        """Squared residuals, px^2, of so many points that were there: those that fit no line count with the gate."""
        return len(self.line) * self.noise_px**2 + (points - len(self.line)) * _LAST_GATE_PX[0] ** 2

    def sigma_px(self) -> Array:
        """Standard deviations of the offsets."""
        return np.asarray(self.noise_px * np.sqrt(self.correlated / np.maximum(self.support, 1)) + _SIGMA_FLOOR_PX)
