"""A driver without a plan: a robot that stops, speeds up and turns at random, as exactly as it is asked to."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from ceilvo import se2

Array = NDArray[np.float64]

_LASTS_S = 60.0
"""The wishes end after so long; the last one stays."""
_WISH_S = (1.0, 4.0)
_TOP_MPS = {False: (0.15, 0.6), True: (0.2, 1.3)}
"""Of slow robots and of fast ones, as all below; chosen."""
_SPIN_RADPS = (0.5, 1.5)
_CORNER_M = (0.4, 1.5)
_ACCEL_MPS2 = {False: (0.4, 1.5), True: (0.8, 2.0)}
_TURN_ACCEL_RADPS2 = {False: 4.0, True: 12.0}
_FINE = 20
"""Steps of the integration between two poses."""


@dataclass(frozen=True)
class Wander:
    """What a driver wants of a robot: to stand, to turn on the spot, to drive straight, to take a corner, at random."""

    seed: int
    fast: bool = False

    @cached_property
    def limits(self) -> Array:
        """(2,) acceleration m/s^2 and angular acceleration rad/s^2."""
        rng = np.random.default_rng([self.seed, 0xACC])
        return np.array([rng.uniform(*_ACCEL_MPS2[self.fast]), _TURN_ACCEL_RADPS2[self.fast]])

    @cached_property
    def plan(self) -> tuple[Array, Array]:
        """(N,) when a wish begins, and (N, 2) speed m/s and turn rate rad/s."""
        rng = np.random.default_rng([self.seed, 0x901])
        top, t, begin, wish = rng.uniform(*_TOP_MPS[self.fast]), 0.0, [], []
        while t < _LASTS_S:
            lasts, what, side = rng.uniform(*_WISH_S), rng.integers(5), rng.choice([-1.0, 1.0])
            v, spin, r = top * rng.uniform(0.5, 1.0), rng.uniform(*_SPIN_RADPS), rng.uniform(*_CORNER_M)
            begin.append(t)
            wish.append(((0.0, 0.0), (0.0, side * spin), (v, side * v / r), (v, 0.0), (v, 0.0))[what])
            t += min(lasts, 0.5 * np.pi * r / v) if what == 2 else lasts
        return np.array(begin), np.array(wish)

    def at(self, t_s: float) -> Array:
        """(2,) speed m/s and turn rate rad/s that is wanted at a time."""
        begin, wish = self.plan
        return np.asarray(wish[np.searchsorted(begin, t_s, side="right") - 1], np.float64)


def driven(wander: Wander, start: Array, seconds: float, rate_hz: float) -> Iterator[Array]:
    """Poses (3,) at the rate of a robot that does what is wanted as fast as it can."""
    twist, pose, dt_s = np.zeros(2), np.array(start, np.float64), 1.0 / (rate_hz * _FINE)
    most = wander.limits * dt_s
    for k in range(round(seconds * rate_hz)):
        yield pose
        for j in range(_FINE):
            twist = twist + np.clip(wander.at((k + j / _FINE) / rate_hz) - twist, -most, most)
            pose = se2.compose(pose, np.array([twist[0] * dt_s, 0.0, twist[1] * dt_s]))
