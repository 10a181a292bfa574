"""The motion while two views share a single point, and no lines: it holds the position, and inertia the heading.

One point tells two of a motion's three numbers in each frame. What the third may be follows from the last twist and
from how fast that changes, as where nothing is seen; so a filter over twist and acceleration takes the point frame by
frame. What neither knows stays in its covariance: the heading, and the way about the point that comes with it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from ceilvo import se2
from ceilvo.types import Array

TWIST, ACCEL, TURNED = slice(0, 3), slice(3, 6), 6
"""Parts of the state."""
_CHI2 = 18.4
"""Squared distance of a point from where it is predicted: chi squared with 2 degrees of freedom exceeds it once in
10,000."""
_ONE = np.eye(3)
_EASED_S = 0.3
"""Time constant of a robot's acceleration ahead and about itself, a first-order Gauss-Markov process; chosen: corners
are eased into within a few tenths of a second."""
_SIDEWAYS_S = 1.0
"""The same of its speed sideways, which goes back to 0; chosen."""


@dataclass(frozen=True, slots=True)
class Turning:
    """What is known while a single point holds the position.

    Attributes:
        mean: (7,) twist [m/s, m/s, rad/s], its change per second, and the turn since two points were last seen, rad.
        cov: (7, 7) of it.
        accel_var: (3,) of the acceleration of such a robot, but sideways, where its speed is what is known.
        sideways_mps: standard deviation of that; 0: it stays as it is.
    """

    mean: Array
    cov: Array
    accel_var: Array
    sideways_mps: float = 0.0

    @staticmethod
    def nothing() -> Turning:
        """Where no twist is known."""
        return Turning(np.zeros(7), np.zeros((7, 7)), np.zeros(3))

    @staticmethod
    def of(twist: Array, twist_var: Array, span_s: float, accel: tuple[float, float], sideways_mps: float) -> Turning:
        """After a full motion: its twist is off by an unknown acceleration since the middle of its span.

        Args:
            twist: (3,) with the variance of its measurement, twist_var (3,), the mean over span_s.
            accel: standard deviations of the acceleration, m/s^2 and rad/s^2.
        """
        accel_var = np.array([accel[0], 0.0, accel[1]]) ** 2
        half_s = 0.5 * span_s
        mean, cov = np.zeros(7), np.zeros((7, 7))
        mean[TWIST] = twist
        cov[TWIST, TWIST] = np.diag(twist_var + half_s**2 * accel_var)
        cov[ACCEL, ACCEL] = np.diag(accel_var)
        cov[TWIST, ACCEL] = cov[ACCEL, TWIST] = np.diag(half_s * accel_var)
        return Turning(mean, cov, accel_var, sideways_mps)

    def after(self, dt_s: float) -> Turning:
        """dt_s later."""
        on, lasts = np.eye(7), math.exp(-dt_s / _EASED_S)
        back = math.exp(-dt_s / _SIDEWAYS_S) if self.sideways_mps > 0.0 else 1.0
        on[TWIST, ACCEL] = dt_s * _ONE
        on[ACCEL, ACCEL] = lasts * _ONE
        on[1, 1] = back
        on[TURNED, 2], on[TURNED, 5] = dt_s, 0.5 * dt_s**2
        cov = on @ self.cov @ on.T
        cov[ACCEL, ACCEL] += (1.0 - lasts**2) * np.diag(self.accel_var)
        cov[1, 1] += (1.0 - back**2) * self.sideways_mps**2
        return replace(self, mean=on @ self.mean, cov=cov)

    def moved(self, dt_s: float) -> tuple[Array, Array]:
        """(3,) prev_from_curr of the last dt_s, and (3, 7) its derivative."""
        by = np.zeros((3, 7))
        by[:, TWIST], by[:, ACCEL] = dt_s * _ONE, -0.5 * dt_s**2 * math.exp(dt_s / _EASED_S) * _ONE
        return by @ self.mean, by

    @property
    def twist_var(self) -> Array:
        """(3,) of the twist."""
        return np.array(np.diag(self.cov)[TWIST])

    def told(self, guess: Array, cov: Array, elapsed_s: float) -> Turning:
        """Where wheels or a gyro tell the motion (3,) of the next elapsed_s with cov (3, 3): no inertia is needed."""
        mean, told = np.zeros(7), np.zeros((7, 7))
        mean[TWIST], mean[TURNED] = guess / elapsed_s, self.mean[TURNED]
        told[TWIST, TWIST], told[TURNED, TURNED] = cov / elapsed_s**2, self.cov[TURNED, TURNED]
        return Turning(mean, told, np.zeros(3))

    def with_point(self, moved: Array, by: Array, seen: Array, there: Array, var_m2: float) -> Turning | None:
        """With a point (2,) of both views, by what moved() says: a Kalman update; None where it is not there."""
        at = se2.transform(moved, seen[None])[0]
        lever = at - moved[:2]
        h = np.array([[1.0, 0.0, -lever[1]], [0.0, 1.0, lever[0]]]) @ by
        off, spread = there - at, h @ self.cov @ h.T + var_m2 * np.eye(2)
        if off @ np.linalg.solve(spread, off) > _CHI2:
            return None
        gain = np.linalg.solve(spread, h @ self.cov).T
        left = np.eye(7) - gain @ h
        cov = left @ self.cov @ left.T + var_m2 * gain @ gain.T
        return replace(self, mean=self.mean + gain @ off, cov=cov)
