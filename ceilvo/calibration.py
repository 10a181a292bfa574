"""What commissioning found out about one camera on one robot in one room, and the geometry that follows from it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ceilvo.camera import CameraModel, LevelView
from ceilvo.errors import CalibrationError

Array = NDArray[np.float64]
_SINGULAR = 1e-12
"""Scale of M's left block below which it has no inverse; a real one has about 1."""
USUAL_FOCAL_PX = 410.0
"""Larger pictures are reduced until they have about as much; a webcam of 640 x 480 that sees 76 deg across: edges are
found there to 0.1 mm on a ceiling 2.2 m above it (docs/bench.md), and a whole look costs some ms."""
_FEWEST_PIXELS = 200_000
"""No picture is reduced to fewer; chosen: 640 x 360 remains of 1920 x 1080, and a long lens keeps what it sees."""
_SIDE_POINTS = 33
"""Along each side of the picture, to find how far it sees; chosen: a lens bends a side smoothly."""
_CIRCLE_CORNERS = 32
"""Of the polygon in place of a circle; chosen: it lacks 0.6 % of the area."""
_SHARP_STEPS = 200
"""In which the end of what is shown sharply is looked for, along each corner's direction; chosen: 1 % of the height."""


@dataclass(frozen=True)
class NoiseCurves:
    """Observation noise against distance r from the point below the camera (eqs. 26-27).

    Attributes:
        sigma_x_m, sigma_y_m: polynomial coefficients in r [m], lowest power first, giving metres.
        sigma_theta_rad: constant.
        r_min_m, r_max_m: measured range; outside it the curves are held so that they never shrink with r.
    """

    sigma_x_m: tuple[float, ...]
    sigma_y_m: tuple[float, ...]
    sigma_theta_rad: float
    r_min_m: float
    r_max_m: float

    def at(self, r_m: Array) -> tuple[Array, Array]:
        """Sigma in x and in y, m, at distances (N,) within the measured range, as the curves have it."""
        # the curves have the lowest power first
        x, y = (np.polyval(np.asarray(c)[::-1], r_m) for c in (self.sigma_x_m, self.sigma_y_m))
        return x, y


@dataclass(frozen=True)
class Calibration:
    """One camera on one robot under one ceiling.

    Attributes:
        camera: lens and sensor.
        projection: (3, 4) M of eq. 5: undistorted pixels from [X, Y, Z, 1], X and Y in base, Z = 0 on the ceiling, up.
        noise: sigma(r).
        camera_id: what identifies the camera ("" = not recorded).
        created: ISO 8601 date of commissioning.
        tile_m: side of the ceiling's tiles, None when unknown or not periodic.
        meta: how good the values are and how they were found (sigma, residuals, notes); kept, never used.
    """

    camera: CameraModel
    projection: Array
    noise: NoiseCurves
    camera_id: str = ""
    created: str = ""
    tile_m: float | None = None
    meta: Mapping[str, Any] = field(default_factory=dict)

    @cached_property
    def _pose(self) -> tuple[Array, Array]:
        """camera_from_base rotation (3, 3) and the camera's position in [X, Y, Z]."""
        p = np.linalg.inv(self.camera.matrix) @ self.projection
        scale = np.cbrt(np.linalg.det(p[:, :3]))
        if not np.isfinite(scale) or abs(scale) < _SINGULAR:
            raise CalibrationError(
                f"projection: determinant of the left 3x3 block is {scale**3:.3g}, expected non-zero; "
                "the points that it was fitted to were degenerate, run 'calib projection' again"
            )
        u, _, vt = np.linalg.svd(p[:, :3] / scale)
        rot = u @ vt
        position = -np.linalg.solve(p[:, :3], p[:, 3])
        return np.asarray(rot, np.float64), np.asarray(position, np.float64)

    @property
    def camera_from_base(self) -> Array:
        """(3, 3) rotation."""
        return self._pose[0]

    @property
    def mount_xy_m(self) -> Array:
        """(2,) camera position in base."""
        return self._pose[1][:2]

    @property
    def ceiling_height_m(self) -> float:
        """Ceiling above the camera."""
        return float(-self._pose[1][2])

    @property
    def driving_nis(self) -> float | None:
        """The filter's NIS per degree of freedom in the worst stretch of the survey's drive, None = not measured."""
        survey = self.meta.get("survey")
        nis = survey.get("nis") if isinstance(survey, Mapping) else None
        return float(nis) if isinstance(nis, int | float) and np.isfinite(nis) and nis > 0 else None

    @cached_property
    def level_view(self) -> LevelView:
        k = self._reduction
        return LevelView(self.camera, self.camera_from_base.T, self.camera.focal_px / k, k)

    @property
    def metres_per_px(self) -> float:
        """Of the ceiling in a pixel of the level view."""
        return self.ceiling_height_m / self.level_view.focal_px

    @property
    def _reduction(self) -> int:
        """A large picture is looked at as a smaller camera would take it: see LevelView.reduction."""
        pixels = self.camera.width_px * self.camera.height_px
        most = int(np.sqrt(pixels / _FEWEST_PIXELS))
        return max(1, min(int(self.camera.focal_px / USUAL_FOCAL_PX + 0.5), most))

    @cached_property
    def level_from_ceiling(self) -> Array:
        """(3, 3) m of eq. 6 for the level view: level pixels from [X, Y, 1] on the ceiling in base."""
        v = self.level_view
        k = np.array([[v.focal_px, 0, self.camera.cx_px], [0, v.focal_px, self.camera.cy_px], [0, 0, 1.0]])
        position = self._pose[1]
        m_full = k @ np.column_stack([np.eye(3), -position])  # eq. 5 for the level view
        return np.asarray(np.delete(m_full, 2, axis=1))  # eq. 6: Z = 0 drops the third column

    @cached_property
    def ceiling_from_level(self) -> Array:
        """(3, 3) m^-1 of eq. 7."""
        return np.asarray(np.linalg.inv(self.level_from_ceiling), np.float64)


@dataclass(frozen=True, slots=True)
class CeilingShape:
    """How a ceiling differs from one that is level at the calibrated height, as far as a robot found out.

    Attributes:
        drops_m: how much lower than that height parts of it hang.
        slope: its rise in a metre along the map's x and y, and its height above the map's origin over the calibrated
            one; () where it is level.
    """

    drops_m: tuple[float, ...] = ()
    slope: tuple[float, ...] = ()


LEVEL_CEILING, SLOPE_NUMBERS = CeilingShape(), 3


def projection_matrix(
    camera: CameraModel,
    camera_from_base: Array,
    mount_xy_m: tuple[float, float],
    ceiling_height_m: float,
) -> Array:
    """(3, 4) M of eq. 5 from a mounting: rotation (3, 3), camera position in base, ceiling above the camera."""
    position = np.array([mount_xy_m[0], mount_xy_m[1], -ceiling_height_m])
    r = np.asarray(camera_from_base, np.float64)
    return np.asarray(camera.matrix @ np.column_stack([r, -r @ position]))


def to_ceiling(ceiling_from_level: Array, uv_px: Array) -> Array:
    """(M, 2) metres on the ceiling in base for (M, 2) level pixels."""
    s = uv_px @ ceiling_from_level[:, :2].T + ceiling_from_level[:, 2]  # eq. 7
    return np.asarray(s[:, :2] / s[:, 2:], np.float64)


def in_base(calibration: Calibration, uv_px: Array) -> Array:
    """(N, 2) metres on the ceiling in base where raw pixels (N, 2) look; nan at and beyond the horizon."""
    return to_ceiling(calibration.ceiling_from_level, calibration.level_view.from_raw(uv_px))


def visible_polygon(calibration: Calibration, margin_px: float, max_view_deg: float) -> Array:
    """(V, 2) corners in base, counter-clockwise, of a convex part of the ceiling that a level robot sees.

    A lens bends the sides of the picture inwards on the ceiling; what lies beyond the innermost point of a side is left
    out. (0, 2) where nothing remains.

    Args:
        margin_px: so far from the sides of the raw picture at least.
        max_view_deg: and no further off the vertical.
    """
    camera, mount_m = calibration.camera, calibration.mount_xy_m
    reach_m = calibration.ceiling_height_m * np.tan(np.radians(max_view_deg))
    low, right, top = margin_px, camera.width_px - 1.0 - margin_px, camera.height_px - 1.0 - margin_px
    if low >= min(right, top):
        return np.empty((0, 2))
    angle = 2.0 * np.pi * np.arange(_CIRCLE_CORNERS) / _CIRCLE_CORNERS
    polygon = mount_m + reach_m * np.column_stack([np.cos(angle), np.sin(angle)])
    x, y = np.linspace(low, right, _SIDE_POINTS), np.linspace(low, top, _SIDE_POINTS)
    middle = in_base(calibration, np.array([[0.5 * (low + right), 0.5 * (low + top)]]))[0]
    for u, v in ((x, low), (right, y), (x, top), (low, y)):
        side = in_base(calibration, np.column_stack(np.broadcast_arrays(u, v)))
        side = side[np.hypot(*(side - mount_m).T) <= reach_m]
        if len(side) < 2:
            continue
        along = side[-1] - side[0]
        inward = np.array([-along[1], along[0]])
        inward *= np.sign(inward @ (middle - side[0]))
        polygon = _clipped(polygon, inward, float(np.max(side @ inward)))
    return polygon if np.all(np.isfinite(middle)) else np.empty((0, 2))


def sharp_part(calibration: Calibration, polygon: Array, max_view_deg: float, share: float) -> Array:
    """(V, 2) of a convex polygon in base, the part that is shown nearly as large as right above the camera.

    Args:
        share: of the pixels a metre right above it, at the least.
    """
    angle = 2.0 * np.pi * np.arange(_CIRCLE_CORNERS) / _CIRCLE_CORNERS
    reach_m = calibration.ceiling_height_m * np.tan(np.radians(max_view_deg))
    away_m, along = np.linspace(0.0, reach_m, _SHARP_STEPS), np.column_stack([np.cos(angle), np.sin(angle)])
    at = calibration.mount_xy_m + away_m[:, None] * along[:, None]
    scale = _pixels_per_metre(calibration, at.reshape(-1, 2)).reshape(len(along), -1)
    blurred = scale < share * scale[0, 0]
    for k in np.flatnonzero(np.any(blurred, axis=1)):
        if len(polygon):
            end_m = float(away_m[np.argmax(blurred[k]) - 1])
            polygon = _clipped(polygon, -along[k], -float(along[k] @ calibration.mount_xy_m) - end_m)
    return polygon


def _pixels_per_metre(calibration: Calibration, at: Array) -> Array:
    """(N,) of the raw picture, along the direction in which it shows least, at (N, 2) in base; 0 where it is blind."""
    step = 1e-3 * calibration.ceiling_height_m

    def shown(xy: Array) -> Array:
        rays = np.column_stack([xy - calibration.mount_xy_m, np.full(len(xy), calibration.ceiling_height_m)])
        return calibration.camera.pixels(rays @ calibration.camera_from_base.T)

    here = shown(at)
    jacobian = np.stack([shown(at + step * np.eye(2)[k]) - here for k in (0, 1)], axis=-1) / step
    (a, b), (c, d) = jacobian.transpose(1, 2, 0)
    half_squares, det = 0.5 * (a**2 + b**2 + c**2 + d**2), a * d - b * c
    least = np.sqrt(np.maximum(half_squares - np.sqrt(np.maximum(half_squares**2 - det**2, 0.0)), 0.0))
    return np.asarray(np.nan_to_num(least))  # the lesser singular value


def _clipped(polygon: Array, normal: Array, least: float) -> Array:
    """The part of a convex polygon (V, 2) where normal . p >= least (Sutherland and Hodgman 1974)."""
    above = polygon @ normal - least
    out = []
    for i in range(len(polygon)):
        j = (i + 1) % len(polygon)
        if above[i] >= 0.0:
            out.append(polygon[i])
        if (above[i] >= 0.0) != (above[j] >= 0.0):
            out.append(polygon[i] + above[i] / (above[i] - above[j]) * (polygon[j] - polygon[i]))
    return np.array(out).reshape(-1, 2)


def mount_rotation(yaw_rad: float, roll_rad: float = 0.0, pitch_rad: float = 0.0) -> Array:
    """(3, 3) camera_from_base: turned by yaw about base z, then tilted by pitch about its y and roll about its x."""
    cy, sy = np.cos(yaw_rad), np.sin(yaw_rad)
    cr, sr = np.cos(roll_rad), np.sin(roll_rad)
    cp, sp = np.cos(pitch_rad), np.sin(pitch_rad)
    base_from_camera = (
        np.array([[cy, -sy, 0], [sy, cy, 0], [0, 0, 1.0]])
        @ np.array([[cp, 0, sp], [0, 1, 0], [-sp, 0, cp]])
        @ np.array([[1, 0, 0], [0, cr, -sr], [0, sr, cr]])
    )
    return np.asarray(base_from_camera.T)


def mount_angles(camera_from_base: Array) -> tuple[float, float, float]:
    """yaw, roll, pitch [rad] from which mount_rotation makes the matrix (3, 3)."""
    b = np.asarray(camera_from_base).T
    yaw, roll = np.arctan2(b[1, 0], b[0, 0]), np.arctan2(b[2, 1], b[2, 2])
    return float(yaw), float(roll), float(-np.arcsin(np.clip(b[2, 0], -1.0, 1.0)))
