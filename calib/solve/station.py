"""Noise samples without driving: the robot stands at several places, turned several ways, under its tiled ceiling."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ceilvo import se2
from ceilvo.calib.solve.sigma import Errors
from ceilvo.calib.solve.tile_grid import tile_index
from ceilvo.calib.targets.ceiling_view import GridView
from ceilvo.calibration import Calibration, in_base, mount_angles
from ceilvo.daemon.odometry.rigid import rigid_motion
from ceilvo.errors import CalibrationError

Array = NDArray[np.float64]

_SAME_FRACTION = 0.1
"""Of a tile, within which crossings of two pictures of one station are the same."""
_OUTLIER = 6.0
"""Times the median off the grid beyond which a crossing does not belong; chosen: five sigma of a good one."""
_OUTLIER_M = 0.003
"""What a good crossing may be off, however well the others fit."""
_ROUNDS = 3
"""Of leaving out what does not fit; chosen."""
_MIN_CROSSINGS = 6
"""Left at a station: laying the grid takes three of twelve coordinates."""
MIN_STATIONS = 6
"""What calibration does to one station's crossings is one error: of fewer there is no scatter."""


@dataclass(frozen=True)
class Station:
    """All pictures that were taken at one place and heading."""

    label: str
    views: list[GridView]


def errors_against_grid(
    calibration: Calibration, stations: list[Station], tile_m: float, height_m: float | None = None
) -> Errors:
    """What is left of each crossing when the grid is laid on all of them, in base axes.

    Pictures of one station are averaged: they share what calibration does to them. The three freedoms of laying the
    grid are given back by the usual factor.

    Args:
        height_m: of the ceiling above the camera as seen now, to find the grid; None is the calibration's.

    Raises:
        CalibrationError: too few stations under a regular ceiling.
    """
    tile_over_height = tile_m / (calibration.ceiling_height_m if height_m is None else height_m)
    r, dx, dy, dtheta = [], [], [], []
    used = 0
    for station in stations:
        found = _one(calibration, station, tile_over_height, tile_m)
        if found is None:
            continue
        used += 1
        xy, off, turn = found
        r.append(np.hypot(*(xy - calibration.mount_xy_m).T))
        dx.append(off[:, 0])
        dy.append(off[:, 1])
        dtheta.append(turn)
    if used < MIN_STATIONS:
        raise CalibrationError(
            f"sigma: found the ceiling's grid at {used} of {len(stations)} stations, at least {MIN_STATIONS} needed; "
            "stand at more places, and turned differently"
        )
    return Errors(np.concatenate(r), np.concatenate(dx), np.concatenate(dy), np.array(dtheta))


def _one(
    calibration: Calibration, station: Station, tile_over_height: float, tile_m: float
) -> tuple[Array, Array, float] | None:
    """Crossings in base (K, 2), their errors (K, 2), and the error of the lines' direction."""
    first = tile_index(station.views[0], tile_over_height)
    if first is None:
        return None
    seen = [in_base(calibration, station.views[0].uv_px[first.used])]
    near = _SAME_FRACTION * tile_m
    for view in station.views[1:]:
        other = in_base(calibration, view.uv_px)
        d = np.hypot(*(seen[0][:, None] - other[None]).transpose(2, 0, 1))
        j = d.argmin(axis=1)
        seen.append(np.where((d[np.arange(len(j)), j] < near)[:, None], other[j], np.nan))
    xy = np.asarray(np.nanmean(np.stack(seen), axis=0), np.float64)
    grid = first.index.astype(np.float64) * tile_m
    good = np.ones(len(xy), bool)
    for _ in range(_ROUNDS):
        fit = rigid_motion(grid[good], xy[good])
        off = xy - se2.transform(fit, grid)
        size = np.hypot(*off.T)
        good = size < max(_OUTLIER * float(np.median(size[good])), _OUTLIER_M)
    n = int(good.sum())
    if n < _MIN_CROSSINGS:
        return None
    psi = np.mean([np.exp(4j * v.psi_rad) for v in station.views])
    direction = float(np.angle(psi)) / 4.0 + mount_angles(calibration.camera_from_base)[0]
    turn = float(np.angle(np.exp(4j * (direction - fit[2])))) / 4.0
    return xy[good], off[good] * np.sqrt(2 * n / (2 * n - 3)), turn
