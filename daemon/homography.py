"""Outlier rejection by the homography between two frames: RANSAC first, then the least squares of eqs. 1-4."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Bools = NDArray[np.bool_]

_MIN_POINTS = 5


def least_squares(xy: Array, uv: Array) -> Array:
    """(3, 3) H with k [u v 1]^T = H [x y 1]^T and m9 = 1 (in normalised coordinates), for (N >= 4, 2) points.

    Raises:
        numpy.linalg.LinAlgError: the points do not determine H.
    """
    to_a, to_b = _normaliser(xy), _normaliser(uv)
    x, y = ((xy - to_a[:2, 2] / -to_a[0, 0]) * to_a[0, 0]).T
    u, v = ((uv - to_b[:2, 2] / -to_b[0, 0]) * to_b[0, 0]).T
    zero, one = np.zeros_like(x), np.ones_like(x)
    k = np.empty((2 * len(x), 8))  # eq. 3
    k[0::2] = np.column_stack([x, y, one, zero, zero, zero, -x * u, -y * u])
    k[1::2] = np.column_stack([zero, zero, zero, x, y, one, -x * v, -y * v])
    big_u = np.column_stack([u, v]).reshape(-1)  # eq. 2
    m = np.linalg.solve(k.T @ k, k.T @ big_u)  # eq. 4
    h = np.linalg.inv(to_b) @ np.append(m, 1.0).reshape(3, 3) @ to_a
    return np.asarray(h / h[2, 2])


def consistent(xy: Array, uv: Array, threshold_px: float) -> Bools:
    """(N,) which correspondences one homography explains; all of them when there are too few to tell."""
    everything = np.ones(len(xy), bool)
    if len(xy) < _MIN_POINTS:
        return everything
    h, mask = cv2.findHomography(xy, uv, cv2.RANSAC, threshold_px)
    if h is None or np.count_nonzero(mask) < _MIN_POINTS:
        return everything
    kept = mask.reshape(-1) > 0
    try:
        return residual_px(least_squares(xy[kept], uv[kept]), xy, uv) < threshold_px
    except np.linalg.LinAlgError:
        return kept


def residual_px(h: Array, xy: Array, uv: Array) -> Array:
    """(N,) distance of uv from H xy (eq. 1)."""
    p = np.column_stack([xy, np.ones(len(xy))]) @ h.T
    return np.asarray(np.hypot(*(p[:, :2] / p[:, 2:] - uv).T))


def _normaliser(p: Array) -> Array:
    """Similarity that centres points and scales them to a mean distance of sqrt(2) (Hartley 1997)."""
    centre = p.mean(axis=0)
    scale = np.sqrt(2.0) / max(float(np.mean(np.hypot(*(p - centre).T))), 1e-12)
    return np.array([[scale, 0, -scale * centre[0]], [0, scale, -scale * centre[1]], [0, 0, 1.0]])
