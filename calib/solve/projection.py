"""The pose of a known lens from point correspondences, and what a mounting is."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from ceilvo.calib.solve import bundle
from ceilvo.calib.solve.joint import Joint
from ceilvo.calib.solve.lens import lens_of, reprojection, with_lens_error
from ceilvo.calibration import mount_angles, mount_rotation
from ceilvo.calibration_check import HEIGHTS_M
from ceilvo.camera import CameraModel
from ceilvo.errors import CalibrationError

Array = NDArray[np.float64]


_FRONT = 0.05
"""Cosine to the axis from which a ray can be projected to a plane to find a first pose."""
_FLAT_M = 1e-9
"""Points whose heights differ by less are in one plane as written."""
RMS_PX, _LEAN_MOST_DEG, _HEIGHT_SIGMA = 1.0, 15.0, 0.02
"""Gates of a PASS; chosen: `make bench-calib` finds tilt to 0.01 deg and height to 0.5 mm rms under tiles, so they
catch wrong points and loose cameras."""


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
    return reprojection(camera, rays, uv_px)


def _point_starts(camera: CameraModel, xyz_m: Array, uv_px: Array) -> list[Array]:
    """Every pose that OpenCV's closed forms offer (a plane seen in perspective has two)."""
    rays = camera.rays(uv_px)
    front = rays[:, 2] > _FRONT
    xy = rays[front, :2] / rays[front, 2:]
    points = xyz_m[front]
    flat = float(np.ptp(points[:, 2])) < _FLAT_M
    methods = (cv2.SOLVEPNP_IPPE, cv2.SOLVEPNP_SQPNP) if flat else (cv2.SOLVEPNP_SQPNP, cv2.SOLVEPNP_EPNP)
    out = []
    for method in methods:
        try:
            _, rvecs, tvecs, _ = cv2.solvePnPGeneric(points, xy, np.eye(3), np.zeros(5), flags=method)
        except cv2.error:
            continue
        for rvec, tvec in zip(rvecs, tvecs, strict=True):
            rot = np.asarray(cv2.Rodrigues(rvec)[0], np.float64)
            position = -rot.T @ np.ravel(tvec)
            yaw, roll, pitch = mount_angles(rot)
            out.append(np.array([roll, pitch, -position[2], yaw, *position[:2]]))
    return out


def plausible(m: Mounting, limit_px: float = RMS_PX) -> list[str]:
    """What keeps the mounting from a PASS, with what to do."""
    out = []
    tilt = float(np.degrees(np.hypot(m.roll_rad, m.pitch_rad)))
    low, high = HEIGHTS_M
    if not low <= m.height_m <= high:
        out.append(
            f"the ceiling is {m.height_m:.2f} m above the camera, {low:g} to {high:g} expected: "
            "are tile and units right?"
        )
    if tilt > _LEAN_MOST_DEG:
        out.append(f"the camera leans by {tilt:.1f} deg, at most {_LEAN_MOST_DEG:g} expected: straighten it")
    if m.rms_px > limit_px:
        out.append(
            f"points are off by {m.rms_px:.2f} px (rms), at most {limit_px:g} expected: "
            "look at the worst points, measure them again"
        )
    if m.sigma[2] > _HEIGHT_SIGMA * m.height_m:
        sigma_mm, needed = 1e3 * m.sigma[2], 100 * _HEIGHT_SIGMA
        out.append(f"the height is known to {sigma_mm:.0f} mm only, {needed:g} % needed: more points, spread wider")
    return out
