"""A ceiling that slopes: how it lies over the floor, from how it leans in the view and how it comes nearer on the way.

Unknown are its rise along two fixed axes, its height where the axes begin and how the robot itself leans. One least
squares has them all: the ceiling's lean turns against the robot when that turns, and its scale changes when the robot
drives; the robot's own does neither.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from ceilvo.se2 import rotation
from ceilvo.types import Array

_RISE_SIGMA, HIGH_SIGMA, _LEAN_SIGMA = 0.1, 0.1, 0.009
"""Beforehand: rise in a metre; height at the start over the calibrated one; lean of a robot, rad. Chosen: attics; a
room calibrated somewhere else in it; and half a degree, for a camera is calibrated on the robot that it stays on."""
_KNOWN_RISE, _KNOWN_HIGH = 0.002, 0.003
"""The same of a plane that an earlier run has found; chosen: a tenth of a degree, and what tiles tell of its height."""
_LEAN_NOISE, _CORRELATED = 0.0035, 4.0
"""rad, of a frame's lean, as all errors of lens and lines make it; and its scatter counts so many times, for a robot
rocks slowly. Chosen."""
_SCATTER_FRAMES = 45.0
"""That the scatter is taken over: as in tilt_prior.py."""
UNKNOWNS = 5
_RISE, _HIGH, _LEAN = slice(0, 2), 2, slice(3, 5)


def _prior_info() -> Array:
    return np.diag(np.array([_RISE_SIGMA, _RISE_SIGMA, HIGH_SIGMA, _LEAN_SIGMA, _LEAN_SIGMA]) ** -2.0)


def _prior_vector() -> Array:
    return np.array([0.0, 0.0, HIGH_SIGMA**-2.0, 0.0, 0.0])


@dataclass(frozen=True, slots=True)
class Plane:
    """A ceiling's plane and a robot's lean.

    Attributes:
        rise: (2,) in a metre along the fixed axes.
        high: height above where the axes begin, over the calibrated height.
        lean: (2,) of the robot, as a rise of the ceiling in base that looks the same.
        cov: (5, 5) of all.
    """

    rise: Array
    high: float
    lean: Array
    cov: Array

    def rises_for_sure(self, least: float, sigmas: float) -> bool:
        """Whether it rises by so much in a metre, clearly."""
        chi2 = float(self.rise @ np.linalg.solve(self.cov[_RISE, _RISE], self.rise))
        return float(np.hypot(*self.rise)) > least and chi2 > sigmas**2

    @property
    def high_sigma(self) -> float:
        return float(np.sqrt(self.cov[_HIGH, _HIGH]))


@dataclass(slots=True)
class PlaneFit:
    """The normal equations so far.

    Attributes:
        info, vector: (5, 5) and (5,) of rise, height and lean.
        mean, scatter: (2,) of the lean along the fixed axes over the last frames, and its variance, rad^2.
        frames: that told a lean.
    """

    info: Array = field(default_factory=_prior_info)
    vector: Array = field(default_factory=_prior_vector)
    mean: Array = field(default_factory=lambda: np.zeros(2))
    scatter: float = 0.0
    frames: int = 0

    @staticmethod
    def beginning(high: float, sigma: float) -> PlaneFit:
        """Nothing known but the height."""
        fit = PlaneFit()
        fit.info[_HIGH, _HIGH], fit.vector[_HIGH] = sigma**-2.0, high * sigma**-2.0
        return fit

    @staticmethod
    def known(rise: Array, high: float) -> PlaneFit:
        """As an earlier run found the plane: a rise (2,) and a height."""
        fit = PlaneFit()
        sigma = np.array([_KNOWN_RISE, _KNOWN_RISE, _KNOWN_HIGH])
        fit.info[:3, :3], fit.vector[:3] = np.diag(sigma**-2.0), np.append(rise, high) * sigma**-2.0
        return fit

    def take_lean(self, lean: Array, turned_rad: float) -> None:
        """Take in how the ceiling leans in a frame.

        Args:
            lean: (2,) rise in base that the view shows.
            turned_rad: of base against the fixed axes.
        """
        turned = rotation(turned_rad) @ lean
        self.frames += 1
        rate = 1.0 / min(self.frames, _SCATTER_FRAMES)
        off = turned - self.mean
        self.mean = self.mean + rate * off
        self.scatter += rate * ((1.0 - rate) * 0.5 * float(off @ off) - self.scatter)
        sigma2 = _LEAN_NOISE**2 + _CORRELATED**2 * self.scatter
        rows = np.zeros((2, UNKNOWNS))
        rows[:, _RISE], rows[:, _LEAN] = rotation(-turned_rad), np.eye(2)
        self._take(rows, lean, sigma2)

    def take_high(self, high: float, sigma: float, camera_m: Array, height_m: float) -> None:
        """Take in the height above the camera at (2,), over the calibrated one of height_m."""
        row = np.array([[*(camera_m / height_m), 1.0, 0.0, 0.0]])
        self._take(row, np.array([high]), sigma**2)

    def with_scale(self, scale: float, sigma: float, before_m: Array, now_m: Array, height_m: float) -> PlaneFit:
        """With the ratio of the heights above the camera, now over before, at (2,) and (2,)."""
        row = np.array([[*((scale * before_m - now_m) / height_m), scale - 1.0, 0.0, 0.0]])
        fit = replace(self, info=self.info.copy(), vector=self.vector.copy())
        fit._take(row, np.zeros(1), sigma**2)
        return fit

    def _take(self, rows: Array, seen: Array, sigma2: float) -> None:
        self.info += rows.T @ rows / sigma2
        self.vector += rows.T @ seen / sigma2

    def solve(self) -> Plane:
        cov = np.asarray(np.linalg.inv(self.info), np.float64)
        found = cov @ self.vector
        return Plane(found[_RISE], float(found[_HIGH]), found[_LEAN], cov)
