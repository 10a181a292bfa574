"""Outlier rejection by the homography between two frames: RANSAC first, then the least squares of eqs. 1-4."""

from __future__ import annotations

import math

import cv2
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Bools = NDArray[np.bool_]

_MIN_POINTS = 5
"""Fewest correspondences that can contradict a homography: four determine it."""
_MIN_SPREAD = 1e-12
"""px or m; points closer together count as one, and are not divided by 0."""


def least_squares(xy: Array, uv: Array) -> Array:
    """(3, 3) H with k [u v 1]^T = H [x y 1]^T and m9 = 1 (in normalised coordinates), for (N >= 4, 2) points.

    Raises:
        numpy.linalg.LinAlgError: the points do not determine H.
    """
    (sx, x0, y0), (su, u0, v0) = _normaliser(xy), _normaliser(uv)
    x, y, u, v = (xy[:, 0] - x0) * sx, (xy[:, 1] - y0) * sx, (uv[:, 0] - u0) * su, (uv[:, 1] - v0) * su
    k = np.zeros((2 * len(x), 8))  # eq. 3
    k[0::2, 0] = k[1::2, 3] = x
    k[0::2, 1] = k[1::2, 4] = y
    k[0::2, 2] = k[1::2, 5] = 1.0
    k[0::2, 6], k[0::2, 7], k[1::2, 6], k[1::2, 7] = -x * u, -y * u, -x * v, -y * v
    big_u = np.stack([u, v], axis=1).reshape(-1)  # eq. 2
    m = np.linalg.solve(k.T @ k, k.T @ big_u)  # eq. 4
    to_xy = np.array([[sx, 0, -sx * x0], [0, sx, -sx * y0], [0, 0, 1.0]])
    from_uv = np.array([[1 / su, 0, u0], [0, 1 / su, v0], [0, 0, 1.0]])
    h = from_uv @ np.append(m, 1.0).reshape(3, 3) @ to_xy
    return np.asarray(h / h[2, 2])


def consistent(xy: Array, uv: Array, threshold_px: float) -> Bools:
    """(N,) which correspondences (N, 2) one homography explains; all of them when there are too few to tell."""
    everything = np.ones(len(xy), bool)
    if len(xy) < _MIN_POINTS:
        return everything
    h, mask = cv2.findHomography(xy, uv, cv2.USAC_FAST, threshold_px)
    if h is None or np.count_nonzero(mask) < _MIN_POINTS:
        return everything
    kept = mask.reshape(-1) > 0
    try:
        return residual_px(least_squares(xy[kept], uv[kept]), xy, uv) < threshold_px
    except np.linalg.LinAlgError:
        return kept


def residual_px(h: Array, xy: Array, uv: Array) -> Array:
    """(N,) distance of uv from H xy."""
    p = xy @ h[:, :2].T + h[:, 2]  # eq. 1
    return np.asarray(np.hypot(p[:, 0] / p[:, 2] - uv[:, 0], p[:, 1] / p[:, 2] - uv[:, 1]))


def _normaliser(p: Array) -> tuple[float, float, float]:
    """Scale to a mean distance of sqrt(2) from the centre, and that centre (Hartley 1997)."""
    x, y = p.mean(axis=0).tolist()
    spread = float(np.mean(np.hypot(p[:, 0] - x, p[:, 1] - y)))
    return math.sqrt(2.0) / max(spread, _MIN_SPREAD), x, y
