"""How a robot tilts: what the last seconds showed is the prior for the next frame.

A robot on a good floor does not tilt at all, and then estimating tilt from every frame alone only adds noise: the
height of the ceiling turns a hundredth of a degree into half a millimetre. A robot that rocks is believed at once.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ceilvo.types import Array, Lines

_MEMORY = 45.0
_FEWEST = 15
_SLACK = 2.0
_FAIR_RAD = np.radians(0.1)
_FLOOR_RAD = np.radians(0.0005)


@dataclass(frozen=True, slots=True)
class TiltPrior:
    """Rotation about base x and y: mean_rad (2,) with standard deviations sigma_rad (2,)."""

    mean_rad: Array
    sigma_rad: Array


class TiltTracker:
    """Mean and spread of the tilt over about the last 45 frames, freed of the estimates' own noise."""

    def __init__(self) -> None:
        self._count = 0.0
        self._mean = np.zeros(2)
        self._square = np.zeros(2)
        self._noise = np.zeros(2)

    def note(self, lines: Lines | None) -> None:
        """Take in what one frame alone said; one that can hardly tell counts little."""
        if lines is None:
            return
        noise = lines.free_tilt_sigma_rad**2
        weight = 1.0 / (1.0 + float(np.max(noise)) / _FAIR_RAD**2)
        self._count += weight
        rate = weight * max(1.0 / _MEMORY, 1.0 / max(self._count, 1.0))
        off = lines.free_tilt_rad - self._mean
        self._mean = self._mean + rate * off
        self._square = (1.0 - rate) * (self._square + rate * off**2)
        self._noise = self._noise + rate * (noise - self._noise)

    def prior(self) -> TiltPrior | None:
        """For the next frame; None until enough was seen."""
        if self._count < _FEWEST:
            return None
        own = np.maximum(self._square - self._noise, 0.0)
        return TiltPrior(self._mean, np.sqrt(_SLACK * own + self._noise / self._count_in_mean() + _FLOOR_RAD**2))

    def _count_in_mean(self) -> float:
        return min(self._count, _MEMORY)
