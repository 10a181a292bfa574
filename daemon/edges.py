"""Stage 1: edge points, to sub-pixel, in the level view (noise-adaptive Canny; points are undistorted, not images)."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from ceilvo.calibration import Calibration
from ceilvo.config import Features

Array = NDArray[np.float64]

_MEDIAN_TO_SIGMA = 1.4826
_NOISE_STRIDE = 7


@dataclass(frozen=True, slots=True)
class Edges:
    """Edge points: uv_px (P, 2) in the level view relative to its principal point, gradient direction phi_rad (P,)."""

    uv_px: Array
    phi_rad: Array


class EdgeDetector:
    """Finds edge points in raw frames of one camera; the look-up to the level view is made once."""

    def __init__(self, calibration: Calibration, config: Features) -> None:
        self._config = config
        camera = calibration.camera
        self._width = camera.width_px
        uv, jacobian = calibration.level_view.lookup(config.max_view_deg)
        self._uv = uv.reshape(-1, 2)
        self._jacobian = jacobian.reshape(-1, 4)
        usable = np.isfinite(self._uv[:, 0]).reshape(camera.height_px, camera.width_px)
        usable[[0, -1], :] = False
        usable[:, [0, -1]] = False
        self._usable = usable.astype(np.uint8)

    def __call__(self, gray: NDArray[np.uint8]) -> Edges:
        """Edge points of a (H, W) frame of the calibrated size."""
        size = self._config.smoothing_px
        smooth = cv2.GaussianBlur(gray, (size, size), 0)
        dx = cv2.Sobel(smooth, cv2.CV_16S, 1, 0, ksize=3)
        dy = cv2.Sobel(smooth, cv2.CV_16S, 0, 1, ksize=3)
        noise = _MEDIAN_TO_SIGMA * float(np.median(np.abs(dx[::_NOISE_STRIDE, ::_NOISE_STRIDE])))
        high = max(self._config.canny_sigmas * noise, self._config.canny_floor)
        mask = cv2.Canny(dx, dy, self._config.canny_low_ratio * high, high, L2gradient=True)
        at = np.flatnonzero(cv2.bitwise_and(mask, mask, mask=self._usable))
        return self._to_level(at, np.asarray(dx, np.int16).reshape(-1), np.asarray(dy, np.int16).reshape(-1))

    def _to_level(self, at: NDArray[np.intp], dx: NDArray[np.int16], dy: NDArray[np.int16]) -> Edges:
        gx, gy = dx[at].astype(np.float32), dy[at].astype(np.float32)
        shift, horizontal = _subpixel_shift(at, self._width, gx, gy, dx, dy)
        jac = self._jacobian[at]
        uv = self._uv[at].astype(np.float64)
        step = np.where(horizontal[:, None], jac[:, [0, 2]], jac[:, [1, 3]])
        uv += step * shift[:, None]
        # a gradient is a covector: it turns with the inverse transpose of the look-up's Jacobian
        level_gx = jac[:, 3] * gx - jac[:, 2] * gy
        level_gy = -jac[:, 1] * gx + jac[:, 0] * gy
        return Edges(uv, np.arctan2(level_gy, level_gx).astype(np.float64))


def _subpixel_shift(
    at: NDArray[np.intp],
    width: int,
    gx: NDArray[np.float32],
    gy: NDArray[np.float32],
    dx: NDArray[np.int16],
    dy: NDArray[np.int16],
) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """Peak of the parabola through the gradient magnitude and its neighbours along the steeper image axis."""
    horizontal = np.abs(gx) >= np.abs(gy)
    step = np.where(horizontal, 1, width)
    here = np.hypot(gx, gy)
    before = np.hypot(dx[at - step].astype(np.float32), dy[at - step].astype(np.float32))
    after = np.hypot(dx[at + step].astype(np.float32), dy[at + step].astype(np.float32))
    curvature = 2.0 * here - before - after
    shift = np.where(curvature > 1e-3, 0.5 * (after - before) / np.maximum(curvature, 1e-3), 0.0)
    return np.clip(shift, -0.5, 0.5).astype(np.float32), horizontal
