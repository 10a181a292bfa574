"""On a periodic ceiling a pose whole tiles off sees nearly the same: the shifts, and the belief in each."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ceilvo.daemon.slam.pose_filter import normalised
from ceilvo.types import Array, Landmarks

SAMPLE = 144
"""Landmarks that periods are looked for among; chosen for time, which grows with its square."""
REACH_M = 1.6
"""Longest period; office tiles are 0.3 to 1.25 m."""
BIN_M = 0.04
"""Shifts that differ by less are one; a few sigmas of a landmark."""
SHORTEST_M = 0.15
"""Landmarks nearer than this are the two edges of one joint, not a period."""
FEWEST_SHIFTS = 8
"""Of fewer pairs no period is concluded; chosen."""
CERTAIN = 0.95
"""Weight from which a map in the making takes another shift for certain; chosen."""
TINY = 1e-300
"""In place of a weight of zero, whose logarithm there is not."""
PERIODIC = 0.35
"""Fraction of the landmarks that must have a neighbour of their kind at a shift for it to be a period."""
SLIP_CHANCE, SLIP_CHANCE_2_SIGMA, SLIP_CHANCE_3_SIGMA, SLIP_CHANCE_MAPPING = 1e-4, 0.05, 0.2, 0.01
"""Chance per update that the pose is a tile further: always; when the NIS is beyond 2 sigma; beyond 3 sigma or twice in
a row; the same while a map is made, which grew along the robot's path and so is tied to its tile. Chosen."""
SAME_BINS = 1.5
"""Shifts within so many bins vote for one period."""


def periods(landmarks: Landmarks) -> Array:
    """(P, 2) two shortest shifts, not parallel, under which much of the map looks the same; (0, 2) without period."""
    pick = np.arange(len(landmarks)) if len(landmarks) <= SAMPLE else np.arange(SAMPLE) * (len(landmarks) // SAMPLE)
    at, kind = landmarks.xy_map_m[pick], landmarks.crossing_type[pick]
    if len(landmarks) > SAMPLE:  # a compact part, for neighbours must be in it
        centre = landmarks.xy_map_m[len(landmarks) // 2]
        pick = np.argsort(np.hypot(*(landmarks.xy_map_m - centre).T), kind="stable")[:SAMPLE]
        at, kind = landmarks.xy_map_m[pick], landmarks.crossing_type[pick]
    off = at[:, None] - at[None]
    length = np.hypot(off[..., 0], off[..., 1])
    near = (kind[:, None] == kind[None]) & (length > SHORTEST_M) & (length < REACH_M) & (off[..., 0] > -BIN_M)
    shifts = off[near]
    if len(shifts) < FEWEST_SHIFTS:
        return np.empty((0, 2))
    votes = np.array([np.sum(np.hypot(*(shifts - s).T) < SAME_BINS * BIN_M) for s in shifts[: 2 * SAMPLE]])
    good = votes > PERIODIC * len(at)
    found = shifts[: 2 * SAMPLE][good]
    return _basis(np.array([np.mean(shifts[np.hypot(*(shifts - s).T) < SAME_BINS * BIN_M], axis=0) for s in found]))


def _basis(shifts: Array) -> Array:
    if not len(shifts):
        return np.empty((0, 2))
    order = np.argsort(np.hypot(*shifts.T), kind="stable")
    first = shifts[order[0]]
    for i in order[1:]:
        second = shifts[i]
        cross = first[0] * second[1] - first[1] * second[0]
        if abs(cross) > 0.5 * float(np.hypot(*first) * np.hypot(*second)):
            return np.array([first, second])
    return np.asarray(first[None], np.float64)


def neighbours(basis: Array) -> Array:
    """(S, 2) no shift first, then all to the neighbouring tiles."""
    if not len(basis):
        return np.zeros((1, 2))
    n = np.array(np.meshgrid(*[[0, 1, -1]] * len(basis), indexing="ij")).reshape(len(basis), -1).T
    return np.asarray(n @ basis, np.float64)


@dataclass(slots=True)
class LatticeBelief:
    """Belief in each shift; the first is none.

    Attributes:
        shifts: (S, 2).
        weight: (S,), sums to one.
    """

    shifts: Array
    weight: Array

    @staticmethod
    def at_home(shifts: Array) -> LatticeBelief:
        """Sure of no shift."""
        return LatticeBelief(shifts, np.eye(1, len(shifts))[0])

    def weigh(self, log_likelihood: Array, chance: float) -> None:
        """(S,) of one view at all shifts, with the chance that the pose slipped since the last."""
        n = max(len(self.shifts) - 1, 1)
        mixed = (1.0 - chance) * self.weight + chance * (1.0 - self.weight) / n
        self.weight = normalised(np.log(np.maximum(mixed, TINY)) + log_likelihood)

    def settle(self) -> None:
        """Begin anew where another shift is nearly certain: a map in the making ends, and a tile back all is mapped."""
        best = int(np.argmax(self.weight))
        if best and self.weight[best] >= CERTAIN:
            self.weight = np.eye(1, len(self.shifts))[0]
