"""Camera models: from raw pixels to rays and back, and the look-up that takes edge points to the level view."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Literal

import cv2
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Array32 = NDArray[np.float32]

_NEWTON_ROUNDS = 20
"""To invert the fisheye polynomial; chosen: Newton's method doubles the digits each time."""
_SLOPE_LEAST = 1e-9
"""Of the polynomial, where it folds over and has no inverse."""
_ON_AXIS = 1e-12
"""Distance from the axis, focal lengths, below which a ray is on it."""
_UNDISTORT_ROUNDS, _UNDISTORT_PX = 40, 1e-6
"""OpenCV's fixed-point iteration ends after so many rounds, or when it is so near; see _undistort."""
_ROWS_AT_ONCE = 16
"""Of a look-up: what is in between stays in the processor's cache; chosen."""


@dataclass(frozen=True)
class CameraModel:
    """Lens and sensor.

    Attributes:
        kind: "pinhole" (distortion k1 k2 p1 p2 k3 [k4 k5 k6], OpenCV's rational model) or
            "fisheye" (k1 k2 k3 k4, theta_d = theta (1 + k1 theta^2 + ...), OpenCV's equidistant model).
        readout_s: time from the first row's exposure to that of the row after the last, for a rolling shutter; negative
            where the last row is read first, 0 for a global shutter.
    """

    kind: Literal["pinhole", "fisheye"]
    width_px: int
    height_px: int
    fx_px: float
    fy_px: float
    cx_px: float
    cy_px: float
    distortion: tuple[float, ...] = ()
    readout_s: float = 0.0

    def row_delays_s(self, rows: Array) -> Array:
        """How much later than the picture's middle rows are exposed, same shape; a frame's stamp is of its middle."""
        return (rows - 0.5 * (self.height_px - 1)) * (self.readout_s / self.height_px)

    @property
    def matrix(self) -> Array:
        """(3, 3) intrinsic matrix K."""
        return np.array([[self.fx_px, 0, self.cx_px], [0, self.fy_px, self.cy_px], [0, 0, 1.0]])

    @property
    def focal_px(self) -> float:
        """Mean of both directions."""
        return 0.5 * (self.fx_px + self.fy_px)

    def rays(self, uv_px: Array) -> Array:
        """(N, 3) unit vectors in the camera's optical frame for (N, 2) raw pixels."""
        uv = np.asarray(uv_px, np.float64).reshape(-1, 2)
        if self.kind == "fisheye":
            return self._fisheye_rays(uv)
        dist = np.array(self.distortion or (0.0,) * 5)
        xy = _undistort(uv, self.matrix, dist)
        r = np.column_stack([xy, np.ones(len(xy))])
        return np.asarray(r / np.linalg.norm(r, axis=1, keepdims=True))

    def pixels(self, rays: Array) -> Array:
        """(N, 2) raw pixels of (N, 3) rays in the optical frame; a ray that the model cannot image gives nan."""
        r = np.asarray(rays, np.float64).reshape(-1, 3)
        k = _padded(self.distortion, 8)
        if self.kind == "fisheye":
            rho = np.hypot(r[:, 0], r[:, 1])
            th = np.arctan2(rho, r[:, 2])
            t2 = th * th
            scale = th * (1 + t2 * (k[0] + t2 * (k[1] + t2 * (k[2] + t2 * k[3])))) / np.maximum(rho, _ON_AXIS)
            x, y = r[:, 0] * scale, r[:, 1] * scale
        else:
            z = np.where(r[:, 2] > 0, r[:, 2], np.nan)
            a, b = r[:, 0] / z, r[:, 1] / z
            r2 = a * a + b * b
            radial = 1 + r2 * (k[0] + r2 * (k[1] + r2 * k[4]))
            if any(k[5:]):
                radial = radial / (1 + r2 * (k[5] + r2 * (k[6] + r2 * k[7])))
            x = a * radial + 2 * k[2] * a * b + k[3] * (r2 + 2 * a * a)
            y = b * radial + k[2] * (r2 + 2 * b * b) + 2 * k[3] * a * b
        out = np.empty((len(r), 2))
        out[:, 0], out[:, 1] = self.fx_px * x + self.cx_px, self.fy_px * y + self.cy_px
        return out

    def _fisheye_rays(self, uv: Array) -> Array:
        x = (uv[:, 0] - self.cx_px) / self.fx_px
        y = (uv[:, 1] - self.cy_px) / self.fy_px
        k = _padded(self.distortion, 4)
        rd = np.hypot(x, y)
        th = rd.copy()
        for _ in range(_NEWTON_ROUNDS):
            t2 = th * th
            f = th * (1 + t2 * (k[0] + t2 * (k[1] + t2 * (k[2] + t2 * k[3])))) - rd
            df = 1 + t2 * (3 * k[0] + t2 * (5 * k[1] + t2 * (7 * k[2] + t2 * 9 * k[3])))
            th = np.clip(th - f / np.where(np.abs(df) < _SLOPE_LEAST, _SLOPE_LEAST, df), 0.0, np.pi)
        s = np.where(rd > _ON_AXIS, np.sin(th) / np.maximum(rd, _ON_AXIS), 1.0)
        return np.column_stack([x * s, y * s, np.cos(th)])


def _undistort(uv_px: Array, matrix: Array, distortion: Array) -> Array:
    """(N, 2) pinhole coordinates; OpenCV's default of 5 iterations stops 0.04 px short in a wide lens' corners."""
    until = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, _UNDISTORT_ROUNDS, _UNDISTORT_PX)
    points = uv_px.reshape(-1, 1, 2)
    with_criteria: Any = getattr(cv2, "undistortPointsIter", None)  # OpenCV 4's name
    if with_criteria is not None:
        return np.asarray(with_criteria(points, matrix, distortion, np.eye(3), np.eye(3), until)).reshape(-1, 2)
    return np.asarray(cv2.undistortPoints(points, matrix, distortion, criteria=until), np.float64).reshape(-1, 2)


def _padded(k: tuple[float, ...], n: int) -> tuple[float, ...]:
    return k + (0.0,) * (n - len(k))


@dataclass(frozen=True)
class LevelView:
    """A virtual pinhole that stands where the camera does, looks straight up and has its axes along base's.

    In it parallel and perpendicular lines of the ceiling stay parallel and perpendicular, whatever the lens and
    however the camera is mounted, so the paper's line model holds exactly.

    Attributes:
        camera: the real one.
        level_from_camera: (3, 3) rotation.
        focal_px: focal length of the virtual pinhole; its principal point is the real camera's.
        reduction: so many raw pixels along either side of the picture are looked at as one.
    """

    camera: CameraModel
    level_from_camera: Array
    focal_px: float
    reduction: int = 1
    _lookups: dict[tuple[float, int], Array32] = field(default_factory=dict, init=False, repr=False, compare=False)

    def from_raw(self, uv_px: Array) -> Array:
        """(N, 2) level pixels of raw pixels; nan at and beyond the horizon."""
        r = self.camera.rays(uv_px) @ self.level_from_camera.T
        z = np.where(r[:, 2] > 1e-3, r[:, 2], np.nan)
        return np.column_stack(
            [
                self.focal_px * r[:, 0] / z + self.camera.cx_px,
                self.focal_px * r[:, 1] / z + self.camera.cy_px,
            ]
        )

    def to_raw(self, uv_level_px: Array) -> Array:
        """(N, 2) raw pixels of level pixels."""
        uv = np.asarray(uv_level_px, np.float64).reshape(-1, 2)
        r = np.column_stack(
            [
                (uv[:, 0] - self.camera.cx_px) / self.focal_px,
                (uv[:, 1] - self.camera.cy_px) / self.focal_px,
                np.ones(len(uv)),
            ]
        )
        return self.camera.pixels(r @ self.level_from_camera)

    def reduced(self, gray: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """The picture as it is looked at: means over squares of pixels; what fills no square at its end is left out."""
        k = self.reduction
        if k == 1:
            return gray
        height, width = gray.shape[0] // k, gray.shape[1] // k
        whole = gray[: k * height, : k * width]
        return np.asarray(cv2.resize(whole, (width, height), interpolation=cv2.INTER_AREA), np.uint8)

    def whole_px(self, uv_px: Array) -> Array:
        """Raw pixels (N, 2) of pixels of the reduced picture: the middle of a square is the pixel's."""
        return (uv_px + 0.5) * self.reduction - 0.5 if self.reduction > 1 else uv_px

    def reduced_px(self, uv_px: Array) -> Array:
        """Pixels (N, 2) of the reduced picture of raw ones."""
        return (uv_px + 0.5) / self.reduction - 0.5 if self.reduction > 1 else uv_px

    def lookup(self, max_view_deg: float, step_px: int = 1) -> Array32:
        """(rows, columns, 2) level pixels, relative to the principal point, of every step_px-th pixel of reduced().

        nan where the ray is more than max_view_deg off the vertical. The last row and column are at or beyond the
        frame's edge, so that bilinear interpolation reaches every pixel of it. Made once for all who look up alike.
        """
        made = self._lookups.get((max_view_deg, step_px))
        if made is None:
            made = self._lookups[max_view_deg, step_px] = self._made(max_view_deg, step_px)
            made.flags.writeable = False
        return made

    def _made(self, max_view_deg: float, step_px: int) -> Array32:
        count = _steps(self.camera.height_px // self.reduction, step_px)
        bands = range(0, count, _ROWS_AT_ONCE)
        return np.concatenate(
            [self.rows_of_lookup(max_view_deg, step_px, k, min(k + _ROWS_AT_ONCE, count)) for k in bands]
        )

    def rows_of_lookup(self, max_view_deg: float, step_px: int, first: int, last: int) -> Array32:
        """(last - first, columns, 2) these rows of lookup(), made now."""
        columns = _steps(self.camera.width_px // self.reduction, step_px)
        x, y = (step_px * np.arange(*ends, dtype=np.float64) for ends in ((0, columns), (first, last)))
        grid = np.stack(np.meshgrid(x, y), axis=-1)
        centre = np.array([self.camera.cx_px, self.camera.cy_px])
        uv = (self.from_raw(self.whole_px(grid.reshape(-1, 2))) - centre).reshape(grid.shape)
        uv[~(np.hypot(uv[..., 0], uv[..., 1]) <= self.focal_px * np.tan(np.radians(max_view_deg)))] = np.nan
        return np.asarray(uv, np.float32)


def _steps(pixels: int, step_px: int) -> int:
    """Every step_px-th of so many pixels, the last one at or beyond the frame's edge."""
    return -(-(pixels - 1) // step_px) + 1
