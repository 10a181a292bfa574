"""The heights that there are: lines of one height are measured together.

A level is known by its ratio, calibrated over true height. Level 0 is the calibrated one, whose ratio is 1 by
definition. What others are follows from it, while both are in view.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, fields

import numpy as np
from numpy.typing import NDArray

from ceilvo.types import Array, Ints

SAME = 0.012
"""Ratios that differ by less are one level: 2.6 cm at 2.2 m; chosen."""
SIGMAS = 3.0
"""A line is on a level within so many standard deviations."""
_VAGUE = 0.05
"""A line whose own ratio is known worse founds no level: 11 cm at 2.2 m; chosen."""
_DIFFERENT = 0.04
"""By so much at least a line that founds a level differs from all others: 8.5 cm at 2.2 m; chosen."""
_BESIDE, _NEAT = 0.018, 0.004
"""By so much from all but the calibrated one, where its ratio is known so well; chosen: the edges of thin bars are at
two heights, a bar between them seems to be at a third, and lines of neither are on that."""
_SLOWEST, _FASTEST = 0.4, 4.0
"""Ratios beyond are no heights of a ceiling; chosen."""
_LEAST_INFO, _MOST_INFO = 0.01**-2, 0.0005**-2
"""A level is measured anew from so much on; and never known better: what all lines share does not average out."""
_MOST = 12
"""Levels kept; chosen."""
_REMEMBERED = 0.004
"""Standard deviation of a ratio that an earlier run found: 9 mm of height at 2.2 m; chosen."""
_LINES, _LINES_ABOVE = 2, 3
"""Lines that found a level where none of them was followed for long, and above the calibrated one; chosen: things hang
from a ceiling, and one line that false tilts moved, joints of 3 levels over a robot that rocks, was a height of 2.5 m
where the ceiling is at 2.2."""


def believed(ratio: float, alike: int, long: bool) -> bool:
    """Whether so many lines that move past alike found a level; long: one of them was followed for long."""
    return alike >= _LINES_ABOVE if ratio < 1.0 else alike >= _LINES or long


@dataclass(slots=True)
class Levels:
    """Heights found so far.

    Attributes:
        ratio: (N,) of each level; the first is 1.
        info: (N,) inverse variances, infinite of the first.
        ended_ratio, ended_info: the same of lines that are out of view.
    """

    ratio: Array = field(default_factory=lambda: np.ones(1))
    info: Array = field(default_factory=lambda: np.full(1, np.inf))
    ended_ratio: Array = field(default_factory=lambda: np.ones(1))
    ended_info: Array = field(default_factory=lambda: np.zeros(1))

    def __len__(self) -> int:
        return len(self.ratio)

    def nearest(self, ratio: Array, sigma: Array) -> tuple[Ints, Array, Array]:
        """Of each measured ratio (T,): the nearest level, and by how much it and the next one miss it, in units of what
        its standard deviation allows."""
        off = np.abs(ratio[:, None] - self.ratio)
        miss = off / np.maximum(SIGMAS * np.sqrt(sigma[:, None] ** 2 + 1.0 / self.info), SAME)
        order = np.argsort(miss, axis=1)
        every = np.arange(len(miss))
        second = miss[every, order[:, 1]] if len(self) > 1 else np.full(len(miss), np.inf)
        return order[:, 0], miss[every, order[:, 0]], second

    def unlisted(self, ratio: Array, sigma: Array) -> NDArray[np.bool_]:
        """(T,) lines that are on no level, clearly."""
        off = self.apart(ratio)
        beside = np.abs(ratio - self.ratio[0]) > _DIFFERENT
        least = np.where(beside & (sigma < _NEAT), _BESIDE, _DIFFERENT)
        clear = off > np.maximum(least, SIGMAS * sigma)
        return np.asarray((sigma < _VAGUE) & clear & (ratio > _SLOWEST) & (ratio < _FASTEST))

    def apart(self, ratio: Array) -> Array:
        """(T,) by how much ratios (T,) differ from that of the nearest level."""
        return np.asarray(np.min(np.abs(ratio[:, None] - self.ratio), axis=1))

    def found(self, ratio: float, sigma: float) -> None:
        """A new level, if there is room."""
        if len(self) < _MOST:
            self.ratio, self.info = np.append(self.ratio, ratio), np.append(self.info, sigma**-2)
            self.ended_ratio, self.ended_info = np.append(self.ended_ratio, ratio), np.append(self.ended_info, 0.0)

    def drops_m(self, height_m: float) -> tuple[float, ...]:
        """How much lower than the calibrated height of height_m the others are."""
        return tuple((height_m * (1.0 - 1.0 / self.ratio[1:])).tolist())

    @staticmethod
    def of_drops(drops_m: Sequence[float], height_m: float) -> Levels:
        """Those of an earlier run; what no line can be at is left out."""
        out = Levels()
        for drop in drops_m:
            ratio = np.array([height_m / (height_m - drop) if drop < height_m else np.inf])
            if out.unlisted(ratio, np.full(1, _REMEMBERED))[0]:
                out.found(float(ratio[0]), _REMEMBERED)
        return out

    def without(self, others: Levels) -> Levels:
        """Those that are none of the others."""
        own = np.min(np.abs(self.ratio[:, None] - others.ratio), axis=1) >= SAME
        own[0] = True
        return Levels(*(getattr(self, f.name)[own] for f in fields(self)))

    def merged(self) -> Ints:
        """(N,) the new number of each level, after those that turned out to be one were made one."""
        number = np.arange(len(self))
        for k in range(len(self) - 1, 0, -1):
            same = int(np.argmin(np.abs(self.ratio[:k] - self.ratio[k])))
            if abs(self.ratio[same] - self.ratio[k]) < 0.5 * SAME:
                number = np.where(number == k, same, number - (number > k))
                for name in ("ratio", "info", "ended_ratio", "ended_info"):
                    setattr(self, name, np.delete(getattr(self, name), k))
        return number

    def refine(self, level: Ints, ratio: Array, sigma: Array, ended: NDArray[np.bool_]) -> None:
        """Measure the levels by the lines (T,) on them; those that have ended are remembered."""
        for k in range(1, len(self)):
            of = (level == k) & np.isfinite(sigma)
            if not np.any(of):
                continue
            now, info = self._pooled(k, ratio[of], sigma[of])
            if info > _LEAST_INFO:
                self.ratio[k], self.info[k] = now, min(info, _MOST_INFO)
            of &= ended
            if np.any(of):
                self.ended_ratio[k], self.ended_info[k] = self._pooled(k, ratio[of], sigma[of])

    def _pooled(self, k: int, ratio: Array, sigma: Array) -> tuple[float, float]:
        weight = np.append(sigma**-2.0, self.ended_info[k])
        return float(np.average(np.append(ratio, self.ended_ratio[k]), weights=weight)), float(np.sum(weight))
