"""A view on another of the same plane, nearer or further away: rotation, translation and scale."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from ceilvo.robust import median
from ceilvo.types import Array

_ROUNDS, _GATE, _LEAST_M = 4, 3.0, 0.0007
"""Fits, each to what lies within so many medians, or so much, of the one before; chosen."""
_MOST = 0.7
"""Share of the points that must lie together: of several heights fewer do; chosen."""


@dataclass(frozen=True, slots=True)
class Similarity:
    """b = scale R(turn) a + step.

    Attributes:
        sigma: standard deviation of the scale.
        points: that it is by.
    """

    scale: float
    turn_rad: float
    step: Array
    sigma: float
    points: int

    def of(self, a: Array) -> Array:
        """(N, 2) points in the other view."""
        c, s = self.scale * math.cos(self.turn_rad), self.scale * math.sin(self.turn_rad)
        return np.asarray(a @ np.array([[c, s], [-s, c]]) + self.step)


def similarity(a: Array, b: Array, fewest: int) -> Similarity | None:
    """The robust least-squares similarity of matched points (N, 2), None where too few lie together."""
    if len(a) < fewest:
        return None
    p, q = a[:, 0] + 1j * a[:, 1], b[:, 0] + 1j * b[:, 1]
    used = np.ones(len(p), bool)
    for _ in range(_ROUNDS):
        middle_p, middle_q = p[used].mean(), q[used].mean()
        spread = float(np.sum(np.abs(p[used] - middle_p) ** 2))
        if not spread > 0.0:
            return None
        turn = np.sum((q[used] - middle_q) * np.conj(p[used] - middle_p)) / spread
        off = np.abs(q - middle_q - turn * (p - middle_p))
        good = off <= max(_GATE * median(off), _LEAST_M)
        if np.array_equal(good, used):
            break
        used = good
    count = int(np.count_nonzero(used))
    if count < max(fewest, _MOST * len(p)):
        return None
    rms = float(np.sqrt(np.mean(off[used] ** 2)))
    step = middle_q - turn * middle_p
    return Similarity(
        abs(turn), float(np.angle(turn)), np.array([step.real, step.imag]), rms / math.sqrt(spread), count
    )
