"""A view on another of the same plane, nearer or further away: rotation, translation and scale."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from ceilvo.crossing_types import LINE_CROSSINGS, quarter_turns, turned_type
from ceilvo.daemon.odometry.heights.leaning import lean_of, lines_of, over_floor
from ceilvo.daemon.odometry.matching import mutual_nearest
from ceilvo.robust import median
from ceilvo.se2 import rotation
from ceilvo.types import Array, Crossings

_ROUNDS, _GATE, _LEAST_M = 4, 3.0, 0.0007
"""Fits, each to what lies within so many medians, or so much, of the one before; chosen."""
_MOST = 0.7
"""Share of the points that must lie together: of several heights fewer do; chosen."""
_NEAR_M, _NEARER_M = 0.06, 0.01
"""Within which crossings of two views are the same: before and after their ratio is known; chosen."""
_FEWEST = 8
"""Crossings in both views that tell a scale; chosen: half of them stay in view for 0.3 m."""
_FEWEST_LINES = 6
"""Of both axes, that those crossings must be of: between the edges of two lamps a scale is one number of two places,
and nothing tells that one of them was taken for its neighbour; chosen: twice what scale and place are."""
_BY_TILT = 1.5
"""Of a tilt, times how far off the vertical crossings are: by so much it seems to scale them. A tilt d moves what is at
p, in heights, by p (p d): the mean of both derivatives of that is 1.5 p d."""


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


def of_views(key: Crossings, crossings: Crossings, way: Array, mount_m: Array, height_m: float) -> Similarity | None:
    """The earlier view from this one, by where lines cross; None where too few do. Its sigma has what the tilts of both
    are off by.

    Args:
        way: (3,) key_from_here.
        mount_m: (2,) of the camera in base; height_m: of the ceiling above it.
    """
    turn = float(way[2])
    kinds = turned_type(crossings.crossing_type, quarter_turns(crossings.psi_rad + turn, key.psi_rad))
    lines = np.flatnonzero(crossings.crossing_type < LINE_CROSSINGS)
    # else a rise that turns against base would pass for a scale
    here, then = ((c.xy_base_m - mount_m) @ over_floor(lean_of(c.tilt_rad))[0] for c in (crossings, key))
    found = Similarity(1.0, turn, rotation(turn) @ mount_m + way[:2] - mount_m, 0.0, 0)
    for radius_m in (_NEAR_M, _NEARER_M):
        i, j = mutual_nearest(found.of(here[lines]), kinds[lines], then, key.crossing_type, radius_m)
        closer = similarity(here[lines[i]], then[j], _FEWEST)
        if closer is None or lines_of(key.of(j)) < _FEWEST_LINES:
            return None
        found = closer
    off = np.hypot(*np.mean(here[lines[i]], axis=0)) / height_m
    tilt_rad = math.hypot(float(np.max(key.tilt_sigma_rad)), float(np.max(crossings.tilt_sigma_rad)))
    return replace(found, sigma=math.hypot(found.sigma, _BY_TILT * float(off) * tilt_rad))
