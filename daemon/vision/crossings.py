"""Stage 3: crossings of perpendicular lines, placed on the ceiling (eqs. 5-7)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ceilvo.calibration import Calibration, to_ceiling
from ceilvo.config import Features
from ceilvo.crossing_types import CeilingLines, crossing_type_of
from ceilvo.daemon.vision import kernel
from ceilvo.daemon.vision.angles import pixels
from ceilvo.daemon.vision.kernel.arguments import Arm
from ceilvo.types import Crossings, Lines

Array = NDArray[np.float64]
Ints = NDArray[np.int64]

_BIN_PX = 2.0
"""Length of line that one edge point covers; chosen: wider bins hide gaps, narrower ones are often empty."""
_UNIFORM_BIN_SPACINGS = 1.5
"""The same in spacings of uniformly spaced points; above 1, so that no bin of a line that is there stays empty."""
_CORNER_PX = 2.0
"""An arm may begin this far beyond the crossing; chosen: edges end early at blurred corners."""
_ARM_FRACTION = 0.6
"""Least covered fraction of an arm; chosen: above, faint joints lose crossings; below, mere extensions become some."""
_MIN_BINS = 2.0
"""Fewest covered bins of an arm; chosen: a single point is noise."""
_LEAST_REACH_PX = 6.0
"""Shortest arm in pixels; chosen: three bins, for the small pictures in which an angle is but few pixels."""
_REACH_SPACINGS = 2.5
"""Shortest arm, in mean distances between edge points that were kept; chosen: _MIN_BINS must be possible on it."""

_SQUARE_DEG = 4.0
"""Side of the squares in which crossings are counted once, 29 px at a focal length of 410 px; chosen: a vent is 100."""

VAGUE_RAD = np.radians(0.03)
"""Standard deviation from which a direction may be another: most edges of a plaster ceiling are a stain's now and then;
chosen, tiles and lamps show 0.001 to 0.01 deg, stains and round lamps 0.05 to 0.3."""


def cross(lines: Lines, calibration: Calibration, config: Features) -> Crossings:
    """Crossings where both lines have edge points nearby; the others are crossings of mere extensions.

    Returns:
        M crossings, M may be 0; psi, tilt and their errors are those of the lines.
    """
    first, second = np.flatnonzero(lines.axis == 0), np.flatnonzero(lines.axis == 1)
    view = calibration.level_view
    reach_px = max(pixels(config.crossing_reach_deg, view.focal_px, _LEAST_REACH_PX), _REACH_SPACINGS / lines.fraction)
    normals = _normals(lines.psi_rad)
    arm = _arm(lines, reach_px)
    covered = _covered(lines, first, normals[1], lines.offset_px[second], arm) & (
        _covered(lines, second, normals[0], lines.offset_px[first], arm).T
    )
    i, j = np.nonzero(covered)
    a, b = first[i], second[j]
    uv = np.column_stack([lines.offset_px[a], lines.offset_px[b]]) @ normals
    uv += (view.camera.cx_px, view.camera.cy_px)
    sigma_m = calibration.metres_per_px * np.column_stack([lines.sigma_px[a], lines.sigma_px[b]])
    roll, pitch = (calibration.ceiling_height_m * lines.tilt_sigma_rad).tolist()
    common = np.array([[pitch**2, 0.0], [0.0, roll**2]])
    outer = (normals[:, :, None] * normals[:, None, :]).reshape(2, 4)
    cov = (sigma_m**2 @ outer).reshape(-1, 2, 2) + common
    return Crossings(
        uv_px=uv,
        xy_base_m=to_ceiling(calibration.ceiling_from_level, uv),
        cov_base_m2=cov,
        crossing_type=crossing_type_of(lines.kind[a], lines.kind[b]),
        psi_rad=lines.psi_rad,
        psi_sigma_rad=lines.psi_sigma_rad,
        tilt_rad=lines.tilt_rad,
        tilt_sigma_rad=lines.tilt_sigma_rad,
        common_cov_m2=common,
        lines=_on_ceiling(lines, normals, calibration),
    )


def _on_ceiling(lines: Lines, normals: Array, calibration: Calibration) -> CeilingLines:
    """Lines in base, by the foot of each in the level view, whose axes are along base's."""
    view, normal = calibration.level_view, normals[lines.axis]
    foot = lines.offset_px[:, None] * normal + (view.camera.cx_px, view.camera.cy_px)
    at_m = to_ceiling(calibration.ceiling_from_level, foot)
    sigma_m = calibration.metres_per_px * lines.sigma_px
    return CeilingLines(lines.axis, np.sum(normal * at_m, axis=1), sigma_m, lines.kind)


class Crosser:
    """cross() for one camera. Asked again of the same lines, as for how many places they show, it has the answer."""

    def __init__(self, calibration: Calibration, config: Features) -> None:
        self._calibration, self._config = calibration, config
        self._last: tuple[Lines, Crossings] | None = None

    def __call__(self, lines: Lines) -> Crossings:
        if self._last is None or self._last[0] is not lines:
            self._last = lines, cross(lines, self._calibration, self._config)
        return self._last[1]


def squares_with(crossings: Crossings, focal_px: float) -> int:
    """Squares of the picture that hold a crossing: a vent's dozen of them are worth few."""
    column, row = np.floor(crossings.uv_px / pixels(_SQUARE_DEG, focal_px)).astype(np.int64).T
    return len(set(zip(column.tolist(), row.tolist(), strict=True)))


def _normals(psi: float) -> Array:
    """(2, 2) rows: the normals of axes 0 and 1."""
    c, s = np.cos(psi), np.sin(psi)
    return np.array([[c, s], [-s, c]])


def _arm(lines: Lines, reach_px: float) -> Arm:
    bin_px = _UNIFORM_BIN_SPACINGS / lines.fraction if lines.uniform else _BIN_PX
    # expected of a line that is there: it has an edge point a pixel, of which the fraction was kept
    filled = 1.0 if lines.uniform else 1.0 - (1.0 - lines.fraction) ** bin_px
    need = _ARM_FRACTION * filled * reach_px / bin_px
    return Arm(reach_px, _CORNER_PX, bin_px, max(need, _MIN_BINS))


def _covered(lines: Lines, ids: Ints, normal: Array, at_px: Array, arm: Arm) -> NDArray[np.bool_]:
    """(len(ids), len(at_px)): as kernel.arms(), of the lines `ids`."""
    row = np.full(len(lines.axis), -1, np.int32)
    row[ids] = np.arange(len(ids), dtype=np.int32)
    points, point_line = np.asarray(lines.points, np.float32), np.asarray(lines.point_line, np.int64)
    covered: NDArray[np.bool_] = kernel.arms(points, point_line, row, normal, at_px, arm)
    return covered
