"""What a calibration that is a little off does to features on the ceiling."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from ceilvo.calibration import Calibration, in_base, projection_matrix
from ceilvo.camera import CameraModel
from ceilvo.types import Array

UNKNOWNS = ("height", "focal", "k1", "tilt_x_rad", "tilt_y_rad")
"""Relative error of height and focal length, error of k1, and of the mounting's tilt about base x and y. The mounting's
yaw and place on the robot are none: without wheels no view tells them from the robot's pose."""
_STEPS = np.array([1e-4, 1e-4, 1e-3, 1e-4, 1e-4])
"""Of central differences; chosen: some .1 mm on the ceiling, where the bend over a step is nanometres."""
_CELLS = 96
"""Of the look-up along either side; chosen: cells of 4 cm, over which what is off by mm is as good as bilinear."""


@dataclass(frozen=True)
class CalibrationPrior:
    """Standard deviations of the unknowns before the drive.

    Attributes:
        height, focal: relative; .5 % is a tape held against a ceiling of 2.2 m to 1 cm, .3 % a chessboard's focal
            length.
        k1: relative to k1, and at least k1_least.
        tilt_deg: of the mounting; a spirit level and a robot that does not stand quite level.
    """

    height: float = 0.005
    focal: float = 0.003
    k1: float = 0.05
    k1_least: float = 0.01
    tilt_deg: float = 0.5

    def sigma(self, camera: CameraModel) -> Array:
        """(5,) of the UNKNOWNS."""
        k1 = abs(camera.distortion[0]) if camera.distortion else 0.0
        tilt = np.radians(self.tilt_deg)
        return np.array([self.height, self.focal, max(self.k1 * k1, self.k1_least), tilt, tilt])


def corrected(calibration: Calibration, correction: Array) -> Calibration:
    """The calibration with a correction (5,) of its UNKNOWNS."""
    height, focal, k1, about_x, about_y = (float(v) for v in correction)
    camera = calibration.camera
    distortion = camera.distortion or (0.0,) * 5
    grown = replace(
        camera,
        fx_px=camera.fx_px * np.exp(focal),
        fy_px=camera.fy_px * np.exp(focal),
        distortion=(distortion[0] + k1, *distortion[1:]),
    )
    mount = calibration.mount_xy_m
    projection = projection_matrix(
        grown,
        calibration.camera_from_base @ _tilted(about_x, about_y),
        (float(mount[0]), float(mount[1])),
        calibration.ceiling_height_m * float(np.exp(height)),
    )
    return replace(calibration, camera=grown, projection=projection)


def _tilted(about_x: float, about_y: float) -> Array:
    """(3, 3) rotation about base x, then y."""
    cx, sx, cy, sy = np.cos(about_x), np.sin(about_x), np.cos(about_y), np.sin(about_y)
    x = np.array([[1, 0, 0], [0, cx, -sx], [0, sx, cx]])
    y = np.array([[cy, 0, sy], [0, 1, 0], [-sy, 0, cy]])
    return np.asarray(y @ x, np.float64)


class CalibrationField:
    """Where features are by a corrected calibration that were placed by another, from a look-up over the view.

    Args:
        calibration: by which they were placed.
        xy_m: (O, 2) in base: what the look-up has to reach.
    """

    def __init__(self, calibration: Calibration, xy_m: Array) -> None:
        self._calibration = calibration
        reach = xy_m if len(xy_m) else np.zeros((1, 2))
        self._low = reach.min(axis=0) - 1e-6
        self._step = (reach.max(axis=0) + 1e-6 - self._low) / _CELLS
        ticks = [self._low[i] + self._step[i] * np.arange(_CELLS + 1) for i in (0, 1)]
        grid = np.stack(np.meshgrid(*ticks, indexing="ij"), axis=-1).reshape(-1, 2)
        level = np.column_stack([grid, np.ones(len(grid))]) @ calibration.level_from_ceiling.T
        self._raw = calibration.level_view.to_raw(level[:, :2] / level[:, 2:])
        cell = (xy_m - self._low) / self._step
        corner = np.minimum(cell.astype(np.int64), _CELLS - 1)
        part = cell - corner
        self._corner = corner @ np.array([_CELLS + 1, 1])
        self._weights = np.stack(
            [
                (1.0 - part[:, 0]) * (1.0 - part[:, 1]),
                (1.0 - part[:, 0]) * part[:, 1],
                part[:, 0] * (1.0 - part[:, 1]),
                part[:, 0] * part[:, 1],
            ]
        )
        self._xy = xy_m
        self._off = self._sampled(in_base(calibration, self._raw))  # of the look-up itself: as good as 0

    def at(self, correction: Array) -> tuple[Array, Array]:
        """(O, 2) where the features are, and (O, 2, 5) how that grows with the correction; nan where no lens sees."""
        jacobian = np.empty((len(self._xy), 2, len(UNKNOWNS)))
        for i, step in enumerate(_STEPS):
            two = []
            for sign in (1.0, -1.0):
                moved = correction.copy()
                moved[i] += sign * step
                two.append(in_base(corrected(self._calibration, moved), self._raw))
            jacobian[..., i] = self._sampled((two[0] - two[1]) / (2.0 * step))
        placed = self._sampled(in_base(corrected(self._calibration, correction), self._raw))
        return self._xy + (placed - self._off), jacobian

    def _sampled(self, table: Array) -> Array:
        """Bilinear, (O, 2) of a table over the grid."""
        out = np.zeros((len(self._xy), 2))
        for weight, beside in zip(self._weights, (0, 1, _CELLS + 1, _CELLS + 2), strict=True):
            out += weight[:, None] * table[self._corner + beside]
        return out
