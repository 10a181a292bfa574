"""The 3x4 matrix M of eq. 5 from point correspondences, and what a mounting is."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import cv2
import numpy as np
from numpy.typing import NDArray

from ceilvo.calib.solve import bundle
from ceilvo.calib.solve.intrinsics import camera_of, parameters_of
from ceilvo.calibration import mount_rotation
from ceilvo.camera import CameraModel
from ceilvo.errors import CalibrationError

if TYPE_CHECKING:
    from ceilvo.calib.solve.joint import Joint

Array = NDArray[np.float64]

HEIGHTS_M = (0.3, 30.0)
_MODEL_OF = {("fisheye", 4): "fisheye", ("pinhole", 8): "pinhole8", ("pinhole", 5): "pinhole"}


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
    scale = np.sqrt(d) / max(float(np.sqrt(np.mean(np.sum((points - mean) ** 2, axis=1)))), 1e-300)
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


@dataclass(frozen=True)
class Mounting:
    """Where the camera is and how it is turned, from any of the methods.

    Attributes:
        roll_rad, pitch_rad, height_m: static tilt and the ceiling above the camera.
        yaw_rad, xy_m: in base; None where the method cannot see them.
        cov: of (roll, pitch, height) or of (roll, pitch, height, yaw, x, y); intrinsics' errors included when known.
        residual_px: (N, 2) reprojection error of each point, uv_px (N, 2) where.
        rms_px: of one coordinate.
        tile_m: of the grid, None = not from a grid; evidence: what speaks for it.
        joint: the lens as refined on the grid, None where it was not.
    """

    roll_rad: float
    pitch_rad: float
    height_m: float
    yaw_rad: float | None
    xy_m: Array | None
    cov: Array
    residual_px: Array
    uv_px: Array
    rms_px: float
    tile_m: float | None = None
    evidence: str = ""
    joint: Joint | None = None

    @property
    def sigma(self) -> Array:
        return np.sqrt(np.diag(self.cov))


def from_points(camera: CameraModel, xyz_m: Array, uv_px: Array, intrinsics_cov: Array | None = None) -> Mounting:
    """Pose of a known lens from four or more points, raw pixels; planar or not.

    Args:
        intrinsics_cov: of fx, fy, cx, cy and the distortion; None = the lens is taken as exact.

    Raises:
        CalibrationError: no pose, or one that looks down.
    """
    best: bundle.BundleFit | None = None

    def residuals(other: CameraModel) -> bundle.Residuals:
        return lambda _, p, __: points_residual(other, p, xyz_m, uv_px)

    for start in _point_starts(camera, xyz_m, uv_px):
        fit = bundle.solve(residuals(camera), start, np.zeros((1, 0)))
        if fit.shared[2] > 0 and (best is None or fit.rms < best.rms):
            best = fit
    if best is None:
        raise CalibrationError(
            "projection: found no camera that looks up at these points; are columns swapped, is Z up and 0 on the "
            "ceiling?"
        )
    roll, pitch, height, yaw, x, y = (float(v) for v in best.shared)
    residual, cov, lens = best.residuals[0].reshape(-1, 2), best.cov, lens_of(camera)
    if intrinsics_cov is not None and lens is not None:
        moves, _ = bundle.response(lambda p: residuals(lens[0](p)), lens[1], best.shared, np.zeros((1, 0)))
        cov = with_lens_error(cov, moves, intrinsics_cov)
    return Mounting(roll, pitch, height, yaw, np.array([x, y]), cov, residual, uv_px, best.rms)


def points_residual(camera: CameraModel, p: Array, xyz_m: Array, uv_px: Array) -> Array:
    """p: roll, pitch, height, yaw, x, y."""
    rays = (xyz_m - np.array([p[4], p[5], -p[2]])) @ mount_rotation(p[3], p[0], p[1]).T
    return np.asarray(np.nan_to_num(camera.pixels(rays) - uv_px, nan=1e3).ravel())


def _point_starts(camera: CameraModel, xyz_m: Array, uv_px: Array) -> list[Array]:
    """Every pose that OpenCV's closed forms offer (a plane seen in perspective has two)."""
    rays = camera.rays(uv_px)
    front = rays[:, 2] > 0.05
    xy = rays[front, :2] / rays[front, 2:]
    points = xyz_m[front]
    flat = float(np.ptp(points[:, 2])) < 1e-9
    methods = (cv2.SOLVEPNP_IPPE, cv2.SOLVEPNP_SQPNP) if flat else (cv2.SOLVEPNP_SQPNP, cv2.SOLVEPNP_EPNP)
    out = []
    for method in methods:
        try:
            _, rvecs, tvecs, _ = cv2.solvePnPGeneric(points, xy, np.eye(3), np.zeros(5), flags=method)
        except cv2.error:
            continue
        for rvec, tvec in zip(rvecs, tvecs, strict=True):
            rot = cv2.Rodrigues(rvec)[0]
            position = -rot.T @ np.ravel(tvec)
            b = rot.T
            pitch = -np.arcsin(np.clip(b[2, 0], -1, 1))
            out.append(
                np.array(
                    [np.arctan2(b[2, 1], b[2, 2]), pitch, -position[2], np.arctan2(b[1, 0], b[0, 0]), *position[:2]]
                )
            )
    return out


def lens_of(camera: CameraModel) -> tuple[Callable[[Array], CameraModel], Array] | None:
    """The camera as a function of its parameters, and those; None when its model is none of calib's."""
    model = _MODEL_OF.get((camera.kind, len(camera.distortion)))
    if model is None:
        return None
    size = (camera.width_px, camera.height_px)
    return (lambda p: camera_of(model, p, size)), parameters_of(camera)


def with_lens_error(cov: Array, response: Array, lens_cov: Array) -> Array:
    """cov plus what the lens' own uncertainty (K, K) does to the parameters, which move by response (P, K)."""
    return np.asarray(cov + response @ lens_cov @ response.T)


def plausible(m: Mounting, size: tuple[int, int], limit_px: float = 1.0) -> list[str]:
    """What keeps the mounting from a PASS, with what to do."""
    out = []
    tilt = float(np.degrees(np.hypot(m.roll_rad, m.pitch_rad)))
    low, high = HEIGHTS_M
    if not low <= m.height_m <= high:
        out.append(
            f"the ceiling is {m.height_m:.2f} m above the camera, {low:g} to {high:g} expected: "
            "are tile and units right?"
        )
    if tilt > 15.0:
        out.append(f"the camera leans by {tilt:.1f} deg, at most 15 expected: straighten it")
    if m.rms_px > limit_px:
        out.append(
            f"points are off by {m.rms_px:.2f} px (rms), at most {limit_px:g} expected: "
            "look at the worst points, measure them again"
        )
    if m.sigma[2] > 0.02 * m.height_m:
        out.append(f"the height is known to {1e3 * m.sigma[2]:.0f} mm only, 2 % needed: more points, spread wider")
    return out
