"""Rays of a camera's pixels, and where they meet a plane."""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np
from numpy.typing import NDArray

from ceilvo.calibration import Calibration

Array = NDArray[np.float64]
Array32 = NDArray[np.float32]

_STEEPEST = 12.0  # tan of the largest angle off the vertical that is drawn, beyond any ceiling


def turned(m: Array, tilt: Array) -> Array:
    """The homography for rays of a camera that the tilt has turned about its own centre."""
    return np.asarray(m @ cv2.Rodrigues(np.array([tilt[0], tilt[1], 0.0]))[0]) if tilt.any() else m


def middle(of_rows: Array) -> Array:
    """The pose or tilt of the middle of a picture's rows."""
    return of_rows if of_rows.ndim == 1 else np.asarray(of_rows[len(of_rows) // 2])


def along_rows(homography: Callable[[Array, Array], Array], pose: Array, tilt: Array) -> Array:
    """(3, 3) of a pose, or (N, 3, 3) of the poses of a rolling shutter."""
    if pose.ndim == 1:
        return homography(pose, tilt)
    return np.stack([homography(p, t) for p, t in zip(pose, tilt, strict=True)])


def map_rays(rays: Array32, m: Array, out: Array32) -> None:
    """Where rays (H, W, 2) meet a texture; m: (3, 3), or (N, 3, 3) from the first row's to the last's in even steps."""
    if m.ndim == 2:
        if np.array_equal(m[2], [0.0, 0.0, 1.0]):
            cv2.transform(rays, m[:2], dst=out)
        else:
            cv2.perspectiveTransform(rays, m, dst=out)
        return
    bounds = np.linspace(0.0, len(rays) - 1.0, len(m))
    for k in range(len(m) - 1):  # linear between the two that a row lies between
        rows = np.arange(int(np.ceil(bounds[k])), int(np.ceil(bounds[k + 1])) + (k == len(m) - 2))
        band = slice(rows[0], rows[-1] + 1)
        part = ((rows - bounds[k]) / (bounds[k + 1] - bounds[k])).astype(np.float32)[:, None, None]
        map_rays(rays[band], m[k], out[band])
        other = np.empty_like(out[band])
        map_rays(rays[band], m[k + 1], other)
        other -= out[band]
        other *= part
        out[band] += other


def level_rays(calibration: Calibration) -> Array32:
    """(H, W, 2) x / z and y / z of each pixel's ray in base."""
    cam = calibration.camera
    grid = np.stack(np.meshgrid(np.arange(cam.width_px), np.arange(cam.height_px)), axis=-1)
    r = cam.rays(grid.reshape(-1, 2).astype(np.float64)) @ calibration.camera_from_base  # base_from_camera, transposed
    xy = r[:, :2] / np.maximum(r[:, 2:], 1e-6)
    steep = np.maximum(np.hypot(xy[:, 0], xy[:, 1]) / _STEEPEST, 1.0)
    return np.asarray((xy / steep[:, None]).reshape(cam.height_px, cam.width_px, 2), np.float32)


def vignette(calibration: Calibration, loss: float) -> Array32:
    """(H, W) factor, 1 at the principal point and 1 - loss in the farthest corner."""
    cam = calibration.camera
    x = np.arange(cam.width_px)[None, :] - cam.cx_px
    y = np.arange(cam.height_px)[:, None] - cam.cy_px
    r2 = x * x + y * y
    return np.asarray(1.0 - loss * r2 / r2.max(), np.float32)


def footprints(rays: Array32, focal_px: float) -> Array32:
    """(H, W) side of what a pixel sees of a level ceiling, over that of a pixel straight below it.

    Args:
        rays: (H, W, 2) of level_rays.
    """
    along_y, along_x = (np.asarray(np.gradient(rays, axis=axis), np.float32) for axis in (0, 1))
    area = np.abs(along_x[..., 0] * along_y[..., 1] - along_x[..., 1] * along_y[..., 0])
    return np.asarray(np.sqrt(area) * focal_px, np.float32)
