"""The 3x4 matrix M of eq. 5: from point correspondences, or from the ceiling's own grid."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from ceilvo.calib import bundle
from ceilvo.calib.ceiling_view import GridView, Lattice, spacing, to_lattice
from ceilvo.calib.intrinsics import camera_of, parameters_of
from ceilvo.calibration import mount_rotation
from ceilvo.camera import CameraModel
from ceilvo.errors import CalibrationError

Array = NDArray[np.float64]

_REGULAR = 0.6
_ON_GRID = 0.4
_HUBER = 3.0
_MODEL_OF = {("fisheye", 4): "fisheye", ("pinhole", 8): "pinhole8", ("pinhole", 5): "pinhole"}


# -- from points


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
        tile_m: of the grid, None = not from a grid.
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

    @property
    def sigma(self) -> Array:
        return np.sqrt(np.diag(self.cov))


def from_points(camera: CameraModel, xyz_m: Array, uv_px: Array) -> Mounting:
    """Pose of a known lens from four or more points, raw pixels; planar or not.

    Raises:
        CalibrationError: no pose, or one that looks down.
    """
    best: bundle.BundleFit | None = None
    for start in _point_starts(camera, xyz_m, uv_px):

        def residuals(_: int, p: Array, __: Array) -> Array:
            return _points_residual(camera, p, xyz_m, uv_px)

        fit = bundle.solve(residuals, start, np.zeros((1, 0)))
        if fit.shared[2] > 0 and (best is None or fit.rms < best.rms):
            best = fit
    if best is None:
        raise CalibrationError(
            "projection: found no camera that looks up at these points; are columns swapped, is Z up and 0 on the "
            "ceiling?"
        )
    roll, pitch, height, yaw, x, y = (float(v) for v in best.shared)
    residual = best.residuals[0].reshape(-1, 2)
    return Mounting(roll, pitch, height, yaw, np.array([x, y]), best.cov, residual, uv_px, best.rms)


def _points_residual(camera: CameraModel, p: Array, xyz_m: Array, uv_px: Array) -> Array:
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


def with_intrinsics_error(
    solve: Callable[[CameraModel], Array], camera: CameraModel, intrinsics_cov: Array | None, cov: Array
) -> Array:
    """cov plus what the lens' own uncertainty does to the parameters that solve() finds, to first order.

    Args:
        intrinsics_cov: of fx, fy, cx, cy and the distortion; None = the lens is taken as known.
    """
    if intrinsics_cov is None:
        return cov
    model = _MODEL_OF.get((camera.kind, len(camera.distortion)))
    if model is None:
        return cov
    values, vectors = np.linalg.eigh(intrinsics_cov)
    p, size = parameters_of(camera), (camera.width_px, camera.height_px)
    total = np.array(cov, np.float64)
    for value, vector in zip(values, vectors.T, strict=True):
        if value <= 0:
            continue
        step = np.sqrt(value) * vector
        up, down = solve(camera_of(model, p + step, size)), solve(camera_of(model, p - step, size))
        total += np.outer(up - down, up - down) / 4.0
    return total


# -- from the ceiling's grid


@dataclass(frozen=True)
class GridSample:
    """A picture's crossings on the lattice: index (K, 2) tiles, uv_px (K, 2), start (3,) in tiles and rad."""

    index: Array
    uv_px: Array
    start: Array


def grid_samples(views: list[GridView], tile_share: float) -> list[GridSample | None]:
    """For each picture its crossings on the lattice, None where too few are."""
    out: list[GridSample | None] = []
    for view in views:
        lattice: Lattice | None = to_lattice(view, tile_share)
        if lattice is None:
            out.append(None)
        else:
            out.append(GridSample(lattice.index.astype(np.float64), view.uv_px[lattice.used], lattice.xy_yaw))
    return out


def from_grid(
    camera: CameraModel,
    views: list[GridView],
    tile_m: float,
    tilt_rad: tuple[float, float],
    intrinsics_cov: Array | None = None,
) -> tuple[Mounting, Array]:
    """Static tilt and height from pictures of a tiled ceiling; also (V, 3) each camera pose in its picture's lattice.

    Args:
        tile_m: side of a tile.
        tilt_rad: roll, pitch to start from.

    Raises:
        CalibrationError: the crossings are not regular.
    """
    share, regular = spacing(views)
    if not regular >= _REGULAR:
        raise CalibrationError(
            f"projection: found crossings that are regular to {100 * regular:.0f} %, {100 * _REGULAR:.0f} % expected; "
            "is the ceiling tiled? measure points and use --points instead"
        )
    samples = [s for s in grid_samples(views, share) if s is not None]
    if not samples:
        raise CalibrationError("projection: found no picture with six crossings on the grid; take others")
    on_grid = sum(len(s.index) for s in samples) / sum(len(v.xy) for v in views)
    if on_grid < _ON_GRID:
        raise CalibrationError(
            f"projection: found only {100 * on_grid:.0f} % of the crossings on the grid, "
            f"{100 * _ON_GRID:.0f} % expected; is --tile-m the ceiling's tile? are there fewer lamps elsewhere?"
        )
    start = np.array([*tilt_rad, tile_m / share])
    fit, samples = _grid_fit(camera, samples, tile_m, start)

    def solve(other: CameraModel) -> Array:
        return _grid_solve(other, samples, tile_m, fit.shared, fit.views, rounds=10).shared

    cov = fit.cluster_cov if len(samples) >= 8 else np.maximum(fit.cov, fit.cluster_cov)
    cov = with_intrinsics_error(solve, camera, intrinsics_cov, _at_least(cov, fit.cov))
    residual = np.concatenate(fit.residuals).reshape(-1, 2)
    uv = np.concatenate([s.uv_px for s in samples])
    roll, pitch, height = (float(v) for v in fit.shared)
    return Mounting(roll, pitch, height, None, None, cov, residual, uv, fit.rms, tile_m), fit.views


def _at_least(cov: Array, floor: Array) -> Array:
    """cov with no variance below the floor's."""
    grow = np.sqrt(np.maximum(np.diag(floor) / np.maximum(np.diag(cov), 1e-300), 1.0))
    return np.asarray(cov * np.outer(grow, grow))


def _grid_fit(
    camera: CameraModel, samples: list[GridSample], tile_m: float, start: Array
) -> tuple[bundle.BundleFit, list[GridSample]]:
    """Robust first, then without the crossings that do not belong."""
    views = np.array([[s.start[0] * tile_m, s.start[1] * tile_m, s.start[2]] for s in samples])
    fit = _grid_solve(camera, samples, tile_m, start, views, rounds=30, huber=_HUBER)
    noise = 1.4826 * float(np.median(np.abs(np.concatenate(fit.residuals))))
    clean = []
    for sample, r in zip(samples, fit.residuals, strict=True):
        good = (np.abs(r.reshape(-1, 2)) < max(5.0 * noise, 0.3)).all(axis=1)
        clean.append(replace(sample, index=sample.index[good], uv_px=sample.uv_px[good]))
    keep = [i for i, s in enumerate(clean) if len(s.index) >= 4]
    clean = [clean[i] for i in keep]
    return _grid_solve(camera, clean, tile_m, fit.shared, fit.views[keep], rounds=30), clean


def _grid_solve(
    camera: CameraModel,
    samples: list[GridSample],
    tile_m: float,
    shared: Array,
    views: Array,
    rounds: int,
    huber: float | None = None,
) -> bundle.BundleFit:
    def residuals(i: int, p: Array, view: Array) -> Array:
        return grid_residual(camera, samples[i], tile_m, p, view)

    return bundle.solve(residuals, shared, views, rounds=rounds, huber=huber)


def grid_residual(camera: CameraModel, sample: GridSample, tile_m: float, shared: Array, view: Array) -> Array:
    """Pixels; shared: roll, pitch, height; view: the camera's x, y in the lattice (m) and heading."""
    xyz = np.column_stack([sample.index * tile_m - view[:2], np.full(len(sample.index), shared[2])])
    rays = xyz @ mount_rotation(view[2], shared[0], shared[1]).T
    return np.asarray(np.nan_to_num(camera.pixels(rays) - sample.uv_px, nan=1e3).ravel())


def plausible(m: Mounting, size: tuple[int, int], limit_px: float = 1.0) -> list[str]:
    """What keeps the mounting from a PASS, with what to do."""
    out = []
    tilt = float(np.degrees(np.hypot(m.roll_rad, m.pitch_rad)))
    if not 0.3 <= m.height_m <= 30.0:
        out.append(
            f"the ceiling is {m.height_m:.2f} m above the camera, 0.3 to 30 expected: right tile size? right units?"
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
