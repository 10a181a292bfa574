"""The translation between two views whose features are at odds: every line and every point has a vote.

Where an edge was taken for the one beside it all crossings on it are off together, so a line has one vote. Votes err
with heavy tails about the truth, and the prediction counts as one that does not.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ceilvo.daemon.odometry.lines.through import lines_through
from ceilvo.se2 import rotation
from ceilvo.types import Array, Ints

_ONE_LINE_M = 1e-3
"""Crossings that differ by less across a line lie on it: in its own view they are where it was fitted."""
_AGREE_SIGMAS = 3.0
"""Within which a feature agrees: 99.7 %."""
_ROUNDS = 8
"""Of weighing anew; chosen: what a vote moves the result by then is far below its sigma."""


@dataclass(frozen=True, slots=True)
class Agreed:
    """The translation (2,) m, its covariance (2, 2), and (N,) the features that agree with it."""

    translation: Array
    cov: Array
    used: NDArray[np.bool_]


@dataclass(frozen=True, slots=True)
class _Votes:
    """Along one axis: (V,) displacements and their standard deviations, m; what is predicted, and its variance."""

    value: Array
    sigma: Array
    predicted: float
    var: float

    def weight(self, at: float) -> Array:
        """(V,) 1 / m^2: of Student's t with one degree of freedom."""
        return 2.0 / (1.0 + ((self.value - at) / self.sigma) ** 2) / self.sigma**2

    def cost(self, at: float) -> float:
        """-2 log-likelihood of a displacement."""
        tails = 2.0 * np.sum(np.log1p(((self.value - at) / self.sigma) ** 2))
        return float(tails) + (at - self.predicted) ** 2 / self.var

    def settled(self, at: float) -> float:
        """The likeliest displacement near one."""
        for _ in range(_ROUNDS):
            weight = self.weight(at)
            at = float((weight @ self.value + self.predicted / self.var) / (np.sum(weight) + 1.0 / self.var))
        return at

    def likeliest(self) -> tuple[float, float]:
        """The likeliest displacement and its variance, which covers others that are nearly as likely."""
        ends = np.array([self.settled(float(start)) for start in (*self.value, self.predicted)])
        cost = np.array([self.cost(float(end)) for end in ends])
        best = int(np.argmin(cost))
        own = 1.0 / (0.5 * float(np.sum(self.weight(float(ends[best])))) + 1.0 / self.var)  # the Gaussian middle of it
        _, first = np.unique(np.round((ends - ends[best]) / np.sqrt(own)), return_index=True)
        likely = np.exp(0.5 * (cost[best] - cost[first]))
        return float(ends[best]), own + float(likely @ (ends[first] - ends[best]) ** 2 / np.sum(likely))


def agreed(
    off_m: Array, at_m: Array, kinds: Ints, sigma_m: Array, axis_rad: float, predicted_m: Array, cov_m2: Array
) -> Agreed:
    """What most lines and points, and the prediction, agree on, along each axis of the lines by itself.

    Args:
        off_m: (N, 2) displacement of each feature, the rotation taken off.
        at_m: (N, 2) where it is in the view whose lines are along axis_rad.
        kinds, sigma_m: (N,) types, and standard deviations of the displacements.
        predicted_m, cov_m2: (2,) displacement that is expected, with its covariance (2, 2).
    """
    axes = rotation(axis_rad)
    off, cov = off_m @ axes, np.diag(axes.T @ cov_m2 @ axes)
    line, best, var = lines_through(at_m, kinds, axis_rad, _ONE_LINE_M), np.zeros(2), np.zeros(2)
    for axis, predicted in enumerate((predicted_m @ axes).tolist()):
        value, sigma = _by_line(off[:, axis], sigma_m, line[:, axis])
        best[axis], var[axis] = _Votes(value, sigma, predicted, float(cov[axis])).likeliest()
    used = np.all(np.abs(off - best) < _AGREE_SIGMAS * sigma_m[:, None], axis=1)
    return Agreed(axes @ best, axes @ np.diag(var) @ axes.T, used)


def _by_line(off: Array, sigma_m: Array, line: Ints) -> tuple[Array, Array]:
    """(V,) votes and their standard deviations: the means of those that lie on one line (N,)."""
    _, of, count = np.unique(line, return_inverse=True, return_counts=True)
    return np.bincount(of, off) / count, np.bincount(of, sigma_m) / count
