"""Correspondences of point features between two frames: near the prediction, of the same kind, mutually nearest.

Outliers are rejected by the homography between the frames: least squares of eqs. 1-4, after RANSAC where needed.
"""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np
from numpy.typing import NDArray

from ceilvo.daemon.odometry import kernel
from ceilvo.types import Landmarks

Array = NDArray[np.float64]
Ints = NDArray[np.int64]
Bools = NDArray[np.bool_]
Near = Callable[[Array, float], tuple[Ints, Landmarks]]
"""Labels and landmarks within a reach of the box around points (M, 2), see PoseFilter.landmarks_near."""
_SLACK = 1e-12
"""Of the largest number, for rounding."""
MOST_PAIRS = 20_000
"""So many distances are all looked at; of more points only those near in x. Chosen: there both take about as long."""
_MIN_POINTS = 5
"""Fewest correspondences that can contradict a homography: four determine it."""
_MANY_POINTS = 20
"""Fewest correspondences that tell without RANSAC that none is wrong; chosen: eight unknowns bend to one of few."""


def mutual_nearest(a: Array, kind_a: Ints, b: Array, kind_b: Ints, radius: float) -> tuple[Ints, Ints]:
    """Index pairs (i, j) of points (N, 2) and (M, 2) that are each other's nearest of their kind within a radius.

    Points and radius are in one unit; kinds are (N,) and (M,).
    """
    if len(a) * len(b) > MOST_PAIRS:
        return _among_many(a, kind_a, b, kind_b, radius)
    i, j = kernel.mutual_nearest(
        np.ascontiguousarray(a, np.float64),
        np.ascontiguousarray(kind_a, np.int64),
        np.ascontiguousarray(b, np.float64),
        np.ascontiguousarray(kind_b, np.int64),
        radius,
    )
    return i, j


def _among_many(a: Array, kind_a: Ints, b: Array, kind_b: Ints, radius: float) -> tuple[Ints, Ints]:
    """The same from the pairs that are near; of equally near points any may be the nearest."""
    i, j = _near_pairs(a, kind_a, b, kind_b, radius)
    d2 = (a[i, 0] - b[j, 0]) ** 2 + (a[i, 1] - b[j, 1]) ** 2
    near = np.flatnonzero((kind_a[i] == kind_b[j]) & (d2 < radius * radius))
    farthest_first = near[np.argsort(-d2[near], kind="stable")]
    i, j = i[farthest_first], j[farthest_first]
    nearest_to_a, nearest_to_b = np.full(len(a), -1), np.full(len(b), -1)
    nearest_to_a[i], nearest_to_b[j] = j, i  # the last one stays
    found = np.flatnonzero(nearest_to_a >= 0)
    found = found[nearest_to_b[nearest_to_a[found]] == found]
    return found, nearest_to_a[found]


def _near_pairs(a: Array, kind_a: Ints, b: Array, kind_b: Ints, radius: float) -> tuple[Ints, Ints]:
    """Pairs among which are all of one kind within a radius: points stand in strips along y, by kind, as wide as it."""
    low = np.min(b, axis=0)
    strip_a, strip_b = (np.floor((p[:, 0] - low[0]) / radius) for p in (a, b))
    strips = np.max(strip_b) + 3.0
    strip_a = np.clip(strip_a, -2.0, strips - 1.0)
    length = np.ptp(b[:, 1]) + 4.0 * radius
    y_a = np.clip(a[:, 1] - low[1], -2.0 * radius, length)
    key = (kind_b * strips + strip_b) * length + (b[:, 1] - low[1])
    order = np.argsort(key, kind="stable")
    key = key[order]
    reach = radius + _SLACK * np.max(np.abs(key))
    found = []
    for beside in (-1.0, 0.0, 1.0):
        at = (kind_a * strips + strip_a + beside) * length + y_a
        start = np.searchsorted(key, at - reach, side="left")
        count = np.searchsorted(key, at + reach, side="right") - start
        i = np.repeat(np.arange(len(a)), count)
        found.append((i, order[np.arange(len(i)) - np.repeat(np.cumsum(count) - count - start, count)]))
    i, j = (np.concatenate(part) for part in zip(*found, strict=True))
    return i, j


def consistent(xy: Array, uv: Array, threshold_px: float) -> Bools:
    """(N,) which correspondences (N, 2) one homography explains; all of them when there are too few to tell."""
    everything = np.ones(len(xy), bool)
    if len(xy) < _MIN_POINTS:
        return everything
    if len(xy) >= _MANY_POINTS and np.all(_explained(xy, uv, everything, threshold_px)):
        return everything  # RANSAC would not reject any, and takes several times as long
    h, mask = cv2.findHomography(xy, uv, cv2.USAC_FAST, threshold_px)
    if h is None or np.count_nonzero(mask) < _MIN_POINTS:
        return everything
    return _explained(xy, uv, mask.reshape(-1) > 0, threshold_px)


def _explained(xy: Array, uv: Array, kept: Bools, threshold_px: float) -> Bools:
    """(N,) which ones the homography of those that are kept explains; these where they do not determine it."""
    try:
        return np.asarray(kernel.homography_residuals(xy, uv, kept) < threshold_px)
    except np.linalg.LinAlgError:
        return kept
