"""On a periodic ceiling a pose one tile further sees nearly the same: the shifts, and the belief in each."""

from __future__ import annotations

import numpy as np

from ceilvo.daemon.slam.pose_filter import normalised
from ceilvo.types import Array, Landmarks

SAMPLE = 144
REACH_M = 1.6
BIN_M = 0.04
CERTAIN = 0.95
PERIODIC = 0.35
"""Share of the landmarks that must have a neighbour of their kind at a shift for it to be a period."""
CALM, WARY, SURPRISED, SURPRISED_MAPPING = 1e-4, 0.05, 0.2, 0.01
"""Chance per update that the pose is a tile further: always, and when the view surprises (2 sigma; 3 sigma, or
twice in a row). A map in the making grew along the way of the robot, which ties it to its tile."""


def periods(landmarks: Landmarks) -> Array:
    """(P, 2) two shortest shifts, not parallel, under which much of the map looks the same; (0, 2) without period."""
    pick = np.arange(len(landmarks)) if len(landmarks) <= SAMPLE else np.arange(SAMPLE) * (len(landmarks) // SAMPLE)
    at, kind = landmarks.xy_map_m[pick], landmarks.kind[pick]
    if len(landmarks) > SAMPLE:  # a compact part, for neighbours must be in it
        centre = landmarks.xy_map_m[len(landmarks) // 2]
        pick = np.argsort(np.hypot(*(landmarks.xy_map_m - centre).T), kind="stable")[:SAMPLE]
        at, kind = landmarks.xy_map_m[pick], landmarks.kind[pick]
    off = at[:, None] - at[None]
    length = np.hypot(off[..., 0], off[..., 1])
    near = (kind[:, None] == kind[None]) & (length > 0.15) & (length < REACH_M) & (off[..., 0] > -BIN_M)
    shifts = off[near]
    if len(shifts) < 8:
        return np.empty((0, 2))
    votes = np.array([np.sum(np.hypot(*(shifts - s).T) < 1.5 * BIN_M) for s in shifts[: 2 * SAMPLE]])
    good = votes > PERIODIC * len(at)
    found = shifts[: 2 * SAMPLE][good]
    return _basis(np.array([np.mean(shifts[np.hypot(*(shifts - s).T) < 1.5 * BIN_M], axis=0) for s in found]))


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


def lattice(basis: Array) -> Array:
    """(S, 2) no shift first, then all to the neighbouring tiles."""
    if not len(basis):
        return np.zeros((1, 2))
    n = np.array(np.meshgrid(*[[0, 1, -1]] * len(basis), indexing="ij")).reshape(len(basis), -1).T
    return np.asarray(n @ basis, np.float64)


class Tiles:
    """Belief in each shift; the first is none."""

    def __init__(self, shifts: Array) -> None:
        self.shifts = shifts
        self.weight: Array = np.eye(1, len(shifts))[0]

    def weigh(self, log_likelihood: Array, chance: float) -> None:
        """(S,) of one view at all shifts, with the chance that the pose slipped since the last."""
        n = max(len(self.shifts) - 1, 1)
        mixed = (1.0 - chance) * self.weight + chance * (1.0 - self.weight) / n
        self.weight = normalised(np.log(np.maximum(mixed, 1e-300)) + log_likelihood)

    def settle(self) -> None:
        """Begin anew where another shift is nearly certain: a map in the making ends, and a tile back all is mapped."""
        best = int(np.argmax(self.weight))
        if best and self.weight[best] >= CERTAIN:
            self.weight = np.eye(1, len(self.shifts))[0]
