"""Outlier rejection by the homography between two frames: least squares of eqs. 1-4, after RANSAC where needed."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from ceilvo.daemon.odometry import kernel

Array = NDArray[np.float64]
Bools = NDArray[np.bool_]

_MIN_POINTS = 5
"""Fewest correspondences that can contradict a homography: four determine it."""
_MANY_POINTS = 20
"""Fewest correspondences that tell without RANSAC that none is wrong; chosen: eight unknowns bend to one of few."""


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
