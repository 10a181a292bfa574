"""A rolling shutter reads a picture row by row while the robot moves: where its rows would be at one instant.

The instant is that of the middle row, whose time the frame's stamp is. Points are moved by a twist that somebody else
predicted. What is wrong with that bends lines that are straight on the ceiling, and is found in their fit.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from ceilvo import se2
from ceilvo.calibration import Calibration
from ceilvo.types import Array

Array32 = NDArray[np.float32]

_CELL_PX = 8.0
"""Spacing of the table of delays in the level view; chosen: within it the delay changes by 1/50 of the readout."""
_UNKNOWN_SIGMA = np.array([0.3, 0.3, 0.5])
"""[m/s, m/s, rad/s] of a robot of whose motion nothing is known; chosen: what most indoor robots do not exceed."""


@dataclass(frozen=True, slots=True)
class TwistPrior:
    """(3,) [m/s, m/s, rad/s] in base while a frame is read, with standard deviations (3,)."""

    mean: Array
    sigma: Array


_UNKNOWN = TwistPrior(np.zeros(3), _UNKNOWN_SIGMA)


@dataclass(frozen=True, slots=True)
class Readout:
    """How one frame was read.

    Attributes:
        rows: (H + 1, 4) what takes level pixels of each row to the middle's instant, as kernel.level_points has it.
        delay_s: (rows, columns) of level rays, every cell apart from `low` on, after the middle row; 0 out of view.
        low, cell: (2,) and one number, as rays.
        mount: (2,) the camera's position in base, over the ceiling's height above it.
        twist: (3,) that was predicted, with metres over that height.
        twist_info: (3,) inverse variance of a twist's error, with metres over that height.
    """

    rows: Array32
    delay_s: Array32
    low: Array
    cell: float
    mount: Array
    twist: Array
    twist_info: Array

    def skew_px(self, reach_px: float) -> float:
        """By how much a pixel within reach of the principal point is moved at most."""
        turned, shift = np.abs(self.rows[:, 1]), np.hypot(self.rows[:, 2], self.rows[:, 3])
        return float(np.max(turned * reach_px + shift))

    def moved_by(self, x: Array32 | Array, y: Array32 | Array) -> tuple[Array, Array]:
        """(P, 3) each: by how much rays (P,), (P,) move in x and y per unit of twist."""
        table = self.delay_s
        i, j = (
            np.clip(np.rint((v - low) / self.cell).astype(np.int64), 0, size - 1)
            for v, low, size in ((x, self.low[0], table.shape[1]), (y, self.low[1], table.shape[0]))
        )
        delay_s, none = table[j, i].astype(np.float64), np.zeros(len(x))
        along = np.column_stack([delay_s, none, -delay_s * (y + self.mount[1])])
        return along, np.column_stack([none, delay_s, delay_s * (x + self.mount[0])])

    def at_one_instant(self, uv_px: Array, row: Array) -> Array:
        """(N, 2) level pixels that were read in rows (N,), which may lie between two, as the middle's instant has them.

        Pixels count from the principal point.
        """
        above = np.clip(np.floor(row).astype(np.int64), 0, len(self.rows) - 2)
        here = self.rows[above] + (row - above)[:, None] * (self.rows[above + 1] - self.rows[above])
        c, s, x, y = here.T
        return np.column_stack([c * uv_px[:, 0] - s * uv_px[:, 1] + x, s * uv_px[:, 0] + c * uv_px[:, 1] + y])

    def read_at(self, x: Array, y: Array, focal_px: float) -> tuple[Array32, Array32]:
        """(H, W) each, x and y: where level pixels were read that the middle's instant has at x (W,), y (H,)."""
        cell_px = self.cell * focal_px
        first = (np.array([x[0], y[0]]) - focal_px * self.low) / cell_px
        into = np.column_stack([np.eye(2) / cell_px, first])
        flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
        delay_s = cv2.warpAffine(self.delay_s, into, (len(x), len(y)), flags=flags, borderMode=cv2.BORDER_REPLICATE)
        vx, vy, turn = self.twist.tolist()
        along = focal_px * vx - turn * (y[:, None] + focal_px * self.mount[1])
        across = focal_px * vy + turn * (x + focal_px * self.mount[0])
        moved_x, moved_y = delay_s * along.astype(np.float32), delay_s * across.astype(np.float32)
        return (x - moved_x).astype(np.float32), (y[:, None] - moved_y).astype(np.float32)

    def cov_of_twist(self, rays: Array) -> Array:
        """(N, 2, 2) by which the twist's error may have moved rays (N, 2)."""
        by_twist = np.stack(self.moved_by(rays[:, 0], rays[:, 1]), axis=1)
        return np.asarray((by_twist / self.twist_info) @ by_twist.transpose(0, 2, 1))


class RollingShutter:
    """How the pictures of one camera are read."""

    def __init__(self, calibration: Calibration, max_view_deg: float) -> None:
        camera, view = calibration.camera, calibration.level_view
        self.rolls = camera.readout_s != 0.0
        if not self.rolls:
            return
        self._height_m, self._focal_px = calibration.ceiling_height_m, view.focal_px
        self._mount = calibration.mount_xy_m / self._height_m
        rows = np.arange(camera.height_px // view.reduction + 1.0)  # of the picture that is looked at
        self._row_delays_s = camera.row_delays_s(view.whole_px(rows))
        seen = view.lookup(max_view_deg, round(_CELL_PX)).reshape(-1, 2)
        self._low_px = np.nanmin(seen, axis=0)
        x, y = (
            np.arange(a, b + _CELL_PX, _CELL_PX) for a, b in zip(self._low_px, np.nanmax(seen, axis=0), strict=True)
        )
        level = np.stack(np.meshgrid(x + camera.cx_px, y + camera.cy_px), -1)
        row = view.to_raw(level.reshape(-1, 2))[:, 1].reshape(len(y), len(x))
        row = np.where((row >= 0) & (row < camera.height_px), row, 0.5 * (camera.height_px - 1))
        self._delay_s = camera.row_delays_s(row).astype(np.float32)

    def readout(self, twist: TwistPrior | None) -> Readout | None:
        """How a frame was read while the robot moved as predicted, None with a global shutter."""
        if not self.rolls:
            return None
        twist = twist or _UNKNOWN
        moved = se2.driven(twist.mean, self._row_delays_s)
        c, s = np.cos(moved[:, 2]), np.sin(moved[:, 2])
        x, y = self._mount
        along = moved[:, 0] / self._height_m + c * x - s * y - x
        across = moved[:, 1] / self._height_m + s * x + c * y - y
        rows = np.column_stack([c, s, self._focal_px * along, self._focal_px * across]).astype(np.float32)
        per_height = np.array([1.0 / self._height_m, 1.0 / self._height_m, 1.0])
        low, cell = self._low_px / self._focal_px, _CELL_PX / self._focal_px
        mean, info = twist.mean * per_height, (twist.sigma * per_height) ** -2
        return Readout(rows, self._delay_s, low, cell, self._mount, mean, info)
