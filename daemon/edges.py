"""Stage 1: edge points, to sub-pixel, in the level view (noise-adaptive Canny; points are undistorted, not images)."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from ceilvo.calibration import Calibration
from ceilvo.config import Features

Array32 = NDArray[np.float32]
Int16s = NDArray[np.int16]

_MEDIAN_TO_SIGMA = 1.4826
_NOISE_STRIDE = 11
_LEVELS = 1 << 16


@dataclass(frozen=True, slots=True)
class Edges:
    """Edge points.

    Attributes:
        uv_px: (P, 2) in the level view, relative to its principal point.
        phi_deg: (P,) direction of the gradient, along which brightness rises, in [0, 360).
        share: how many of the edge points these are; a frame with very many is sampled evenly.
    """

    uv_px: Array32
    phi_deg: Array32
    share: float = 1.0


class EdgeDetector:
    """Finds edge points in raw frames of one camera; the look-up to the level view is made once."""

    def __init__(self, calibration: Calibration, config: Features) -> None:
        self._config = config
        camera = calibration.camera
        self._width = camera.width_px
        uv, jacobian = calibration.level_view.lookup(config.max_view_deg)
        self._lookup = np.concatenate([uv, jacobian], axis=2).reshape(-1, 6)
        usable = np.isfinite(uv[..., 0])
        usable[[0, -1], :] = False
        usable[:, [0, -1]] = False
        self._usable = usable.astype(np.uint8) * 255
        # a fixed, patternless order of the pixels: a regular one would favour lines at some angle
        self._rank = np.random.default_rng(0).permutation(usable.size) * _LEVELS // usable.size

    def __call__(self, gray: NDArray[np.uint8]) -> Edges:
        """Edge points of a (H, W) frame of the calibrated size."""
        size = self._config.smoothing_px
        smooth = cv2.GaussianBlur(gray, (size, size), 0)
        dx = np.asarray(cv2.Sobel(smooth, cv2.CV_16S, 1, 0, ksize=3), np.int16)
        dy = np.asarray(cv2.Sobel(smooth, cv2.CV_16S, 0, 1, ksize=3), np.int16)
        noise = _MEDIAN_TO_SIGMA * float(np.median(np.abs(dx[::_NOISE_STRIDE, ::_NOISE_STRIDE])))
        high = max(self._config.canny_sigmas * noise, self._config.canny_floor)
        mask = cv2.Canny(dx, dy, self._config.canny_low_ratio * high, high, L2gradient=True)
        mask = cv2.bitwise_and(mask, self._usable)
        if not cv2.countNonZero(mask):
            return Edges(np.zeros((0, 2), np.float32), np.zeros(0, np.float32))
        xy = np.asarray(cv2.findNonZero(mask), np.int32).reshape(-1, 2)
        at, share = self._sample(xy[:, 1] * self._width + xy[:, 0])
        return self._to_level(at, dx.reshape(-1), dy.reshape(-1), share)

    def _sample(self, at: NDArray[np.int32]) -> tuple[NDArray[np.int32], float]:
        share = self._config.max_edge_share * len(self._lookup) / max(len(at), 1)
        if share >= 1.0:
            return at, 1.0
        return at[self._rank.take(at) < share * _LEVELS], share

    def _to_level(self, at: NDArray[np.int32], dx: Int16s, dy: Int16s, share: float) -> Edges:
        gx, gy = dx.take(at).astype(np.float32), dy.take(at).astype(np.float32)
        shift, horizontal = _subpixel_shift(at, self._width, gx, gy, dx, dy)
        u, v, du_dx, du_dy, dv_dx, dv_dy = self._lookup.take(at, axis=0).T
        uv = np.empty((len(at), 2), np.float32)
        uv[:, 0] = u + shift * np.where(horizontal, du_dx, du_dy)
        uv[:, 1] = v + shift * np.where(horizontal, dv_dx, dv_dy)
        # a gradient is a covector: it turns with the inverse transpose of the look-up's Jacobian
        phi = cv2.phase(dv_dy * gx - dv_dx * gy, du_dx * gy - du_dy * gx, angleInDegrees=True)
        return Edges(uv, np.asarray(phi, np.float32).reshape(-1), share)


def _subpixel_shift(
    at: NDArray[np.int32], width: int, gx: Array32, gy: Array32, dx: Int16s, dy: Int16s
) -> tuple[Array32, NDArray[np.bool_]]:
    """Peak of the parabola through the gradient magnitude and its neighbours along the steeper image axis."""
    horizontal = np.abs(gx) >= np.abs(gy)
    step = np.where(horizontal, 1, width).astype(np.int32)
    here = np.hypot(gx, gy)
    before = np.hypot(dx.take(at - step).astype(np.float32), dy.take(at - step).astype(np.float32))
    after = np.hypot(dx.take(at + step).astype(np.float32), dy.take(at + step).astype(np.float32))
    curvature = np.maximum(2.0 * here - before - after, np.float32(1e-3))
    return np.clip(0.5 * (after - before) / curvature, -0.5, 0.5), horizontal
