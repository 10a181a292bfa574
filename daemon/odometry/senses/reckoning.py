"""A way added up step by step, with what its error is made of: new noise in every step, and parameters that are the
same all the way, such as a wheel's scale or a gyro's bias.

The second kind adds up linearly, not as independent steps do; so the derivative of the way by the parameters is kept.
What a parameter drifts by on the way errs from then on only; so the drift's own covariance with the way is kept too.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np

from ceilvo import se2
from ceilvo.types import Array

_SMALL_RAD = 1e-4
"""An arc that turns by less is reckoned by series: differences of cosines would lose its digits."""


@dataclass(frozen=True, slots=True)
class Step:
    """One interval: twist (3,) [m, m, rad] whose arc it is, its derivative by P parameters (3, P), noise (3, 3)."""

    twist: Array
    by_parameters: Array
    noise: Array


@dataclass(slots=True)
class Reckoning:
    """A way (3,) [m, m, rad] since its start, its derivative by the parameters as they were there (3, P), covariance
    of its noise (3, 3), and how long it took.

    Attributes:
        drift: (P,) variances of what the parameters have drifted by since; with_drift: (3, P) covariance of the way
            with that.
    """

    way: Array
    by_parameters: Array
    noise: Array
    seconds: float = 0.0
    drift: Array = field(default_factory=lambda: np.zeros(0))
    with_drift: Array = field(default_factory=lambda: np.zeros((3, 0)))

    def __post_init__(self) -> None:
        if not self.drift.size:  # of an older recording
            self.drift, self.with_drift = np.zeros(self.by_parameters.shape[1]), np.zeros(self.by_parameters.shape)

    @staticmethod
    def start(parameters: int) -> Reckoning:
        none = np.zeros((3, parameters))
        return Reckoning(np.zeros(3), none, np.zeros((3, 3)), 0.0, np.zeros(parameters), none)

    def then(self, step: Step, seconds: float, walk: Array | None = None) -> Reckoning:
        """The way after one more step; walk: (P,) variance by which each parameter drifts in a second."""
        moved, bend = arc(step.twist)
        before, after = _jacobians(self.way, moved)
        on = after @ bend
        way = se2.compose(self.way, moved)
        by_step = on @ step.by_parameters
        drift = self.drift if walk is None else self.drift + 0.5 * seconds * walk  # in the middle of the step
        both = before @ self.with_drift @ by_step.T
        noise = before @ self.noise @ before.T + on @ step.noise @ on.T + both + both.T + (by_step * drift) @ by_step.T
        return Reckoning(
            way,
            before @ self.by_parameters + by_step,
            noise,
            self.seconds + seconds,
            drift if walk is None else self.drift + seconds * walk,
            before @ self.with_drift + by_step * drift,
        )

    def cov(self, parameters: Array) -> Array:
        """(3, 3) of the way, with the covariance (P, P) that the parameters had at its start."""
        return np.asarray(self.noise + self.by_parameters @ parameters @ self.by_parameters.T)

    def share_of(self, before: Reckoning, parameters: Array, moved: Array) -> Array:
        """(3, 3) covariance of the last step, (3,) in base at its start, such that compose_cov of `before` and it gives
        cov(); never less than none, where errors of parameters cancel."""
        f, g = _jacobians(before.way, moved)
        rest = self.cov(parameters) - f @ before.cov(parameters) @ f.T
        value, vector = np.linalg.eigh(g.T @ (0.5 * (rest + rest.T)) @ g)
        return np.asarray((vector * np.maximum(value, 0.0)) @ vector.T)


def arc(twist: Array) -> tuple[Array, Array]:
    """(3,) displacement of a constant twist (3,) [m, m, rad], and its derivative (3, 3) by that."""
    a, c, w = twist.tolist()
    if abs(w) < _SMALL_RAD:
        s, k, ds, dk = 1.0 - w * w / 6.0, 0.5 * w, -w / 3.0, 0.5
    else:
        s, k = math.sin(w) / w, (1.0 - math.cos(w)) / w
        ds, dk = (math.cos(w) - s) / w, (math.sin(w) - k) / w
    by = np.array([[s, -k, a * ds - c * dk], [k, s, a * dk + c * ds], [0.0, 0.0, 1.0]])
    return np.array([s * a - k * c, k * a + s * c, w]), by


def _jacobians(way: Array, moved: Array) -> tuple[Array, Array]:
    """Derivatives (3, 3) of compose(way, moved) by both."""
    c, s = math.cos(float(way[2])), math.sin(float(way[2]))
    x, y, _ = moved.tolist()
    f = np.array([[1.0, 0.0, -s * x - c * y], [0.0, 1.0, c * x - s * y], [0.0, 0.0, 1.0]])
    return f, np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
