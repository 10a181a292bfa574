"""M and a camera without distortion from points alone, for lenses nobody has measured: normalised DLT, then pixels."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from ceilvo.calib.solve import bundle
from ceilvo.calib.solve.lens import camera_of
from ceilvo.calib.solve.projection import Mounting, points_residual
from ceilvo.calibration import mount_angles
from ceilvo.camera import CameraModel

Array = NDArray[np.float64]

_LENS = 4
"""fx, fy, cx, cy."""
_DISTORTION = 5
_TINY = 1e-300
"""Keeps a division by zero away."""
"""Coefficients of the pinhole model, all zero here."""


def from_points_alone(xyz_m: Array, uv_px: Array, size: tuple[int, int]) -> tuple[Mounting, CameraModel, Array]:
    """Lens and mounting from six or more points that are not in one plane; check the layout first (calib.degeneracy).

    Args:
        xyz_m: (N, 3) in base, Z = 0 on the ceiling; uv_px: (N, 2) pixels.
        size: width, height px.

    Returns:
        The mounting, a pinhole camera without distortion, and the covariance (9, 9) of its parameters.
    """

    def residuals(_: int, p: Array, __: Array) -> Array:
        return points_residual(_camera(p[:_LENS], size), p[_LENS:], xyz_m, uv_px)

    fit = bundle.solve(residuals, _start(dlt(xyz_m, uv_px)), np.zeros((1, 0)))
    roll, pitch, height, yaw, x, y = (float(v) for v in fit.shared[_LENS:])
    lens_cov = np.zeros((_LENS + _DISTORTION,) * 2)
    lens_cov[:_LENS, :_LENS] = fit.cov[:_LENS, :_LENS]
    at, residual = np.array([x, y]), fit.residuals[0].reshape(-1, 2)
    mounting = Mounting(roll, pitch, height, yaw, at, fit.cov[_LENS:, _LENS:], residual, uv_px, fit.rms)
    return mounting, _camera(fit.shared[:_LENS], size), lens_cov


def _camera(lens: Array, size: tuple[int, int]) -> CameraModel:
    return camera_of("pinhole", np.concatenate([lens, np.zeros(_DISTORTION)]), size)


def _start(m: Array) -> Array:
    """(10,) fx, fy, cx, cy, roll, pitch, height, yaw, x, y of the DLT's matrix; its skew is left out."""
    k, rot = (np.asarray(a, np.float64) for a in cv2.RQDecomp3x3(m[:, :3])[1:3])
    signs = np.diag(np.sign(np.diag(k)))
    k, rot = k @ signs / abs(k[2, 2]), signs @ rot
    position = -np.linalg.solve(m[:, :3], m[:, 3])
    yaw, roll, pitch = mount_angles(rot)
    return np.array([k[0, 0], k[1, 1], k[0, 2], k[1, 2], roll, pitch, -position[2], yaw, *position[:2]])


def dlt(xyz_m: Array, uv_px: Array) -> Array:
    """(3, 4) M from six or more points that are not in one plane, normalised DLT and Gauss-Newton on pixels.

    Args:
        xyz_m: (N, 3) in base, Z = 0 on the ceiling.
        uv_px: (N, 2) undistorted pixels.

    Returns:
        M with a unit third row of its left block and positive depth. Check the layout first (calib.degeneracy).
    """
    t, x = _normalising(xyz_m)
    u, p = _normalising(uv_px)
    homogeneous = np.column_stack([x, np.ones(len(x))])
    zero = np.zeros_like(homogeneous)
    rows = np.concatenate(
        [
            np.column_stack([homogeneous, zero, -p[:, :1] * homogeneous]),
            np.column_stack([zero, homogeneous, -p[:, 1:] * homogeneous]),
        ]
    )
    m = np.linalg.svd(rows)[2][-1].reshape(3, 4)
    m = _refined(np.linalg.inv(u) @ m @ t, xyz_m, uv_px)
    m = m / np.linalg.norm(m[2, :3])
    depth = np.column_stack([xyz_m, np.ones(len(xyz_m))]) @ m[2]
    return np.asarray(m * (1.0 if np.median(depth) > 0 else -1.0))


def _normalising(points: Array) -> tuple[Array, Array]:
    """Homogeneous transform to zero mean and unit spread, and the transformed points."""
    d = points.shape[1]
    mean = points.mean(axis=0)
    scale = np.sqrt(d) / max(float(np.sqrt(np.mean(np.sum((points - mean) ** 2, axis=1)))), _TINY)
    t = np.eye(d + 1)
    t[:d, :d] *= scale
    t[:d, d] = -scale * mean
    return t, np.asarray((points - mean) * scale)


def _refined(m: Array, xyz_m: Array, uv_px: Array) -> Array:
    """Least squares on pixels in normalised units, the last entry's scale free (the step is a minimum-norm one)."""
    t, x = _normalising(xyz_m)
    u, p = _normalising(uv_px)
    n = u @ m @ np.linalg.inv(t)
    n = n / np.linalg.norm(n)

    def residuals(_: int, q: Array, __: Array) -> Array:
        s = np.column_stack([x, np.ones(len(x))]) @ q.reshape(3, 4).T
        return np.asarray((s[:, :2] / s[:, 2:] - p).ravel())

    fit = bundle.solve(residuals, n.ravel(), np.zeros((1, 0)))
    return np.asarray(np.linalg.inv(u) @ fit.shared.reshape(3, 4) @ t)
