"""M and a camera without distortion from points alone, for lenses nobody has measured: normalised DLT, then pixels."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from ceilvo.calib.solve import bundle
from ceilvo.calib.solve.intrinsics import camera_of
from ceilvo.calib.solve.projection import Mounting, dlt, points_residual
from ceilvo.camera import CameraModel

Array = NDArray[np.float64]

_LENS = 4
_DISTORTION = 5


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
    b = rot.T
    pitch = -np.arcsin(np.clip(b[2, 0], -1.0, 1.0))
    angles = (np.arctan2(b[2, 1], b[2, 2]), pitch, -position[2], np.arctan2(b[1, 0], b[0, 0]))
    return np.array([k[0, 0], k[1, 1], k[0, 2], k[1, 2], *angles, *position[:2]])
