"""Whether a calibration still describes the camera, from pictures of the ceiling's grid."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ceilvo.calib.solve.grid import from_grid
from ceilvo.calib.solve.station import Station, errors_against_grid
from ceilvo.calibration import Calibration, mount_angles
from ceilvo.daemon.slam.association import sigma

Array = NDArray[np.float64]

HEIGHT_FRACTION = 0.005
TILT_RAD = float(np.radians(0.3))
RMS_PX = 0.6
NIS_HIGH = 2.0
LOOK_PX = 0.1
"""Own error of a crossing in one picture, which comes on top of the curves as in the daemon."""


@dataclass(frozen=True)
class Check:
    """Differences from the file with what is allowed; stale has a reason for each that is not."""

    height_off_m: float
    height_limit_m: float
    tilt_off_rad: float
    tilt_limit_rad: float
    rms_px: float
    rms_limit_px: float
    nis: float
    nis_limit: float
    pictures: int
    stale: tuple[str, ...]


def check(calibration: Calibration, stations: list[Station]) -> Check:
    """Tilt, height and reprojection from the grid seen now, and the noise curves against what is left.

    Raises:
        CalibrationError: fewer than six pictures show the grid, or it is not regular.
    """
    tile_m = calibration.tile_m or 0.6
    _, roll, pitch = mount_angles(calibration.camera_from_base)
    now, _ = from_grid(calibration.camera, [s.views[0] for s in stations], tile_m, (roll, pitch))
    errors = errors_against_grid(calibration, stations, tile_m, now.height_m)
    sx, sy = sigma(calibration.noise, errors.r_m)
    look = LOOK_PX * calibration.ceiling_height_m / calibration.camera.fx_px
    nis = float(np.mean(np.concatenate([errors.dx_m**2 / (sx**2 + look**2), errors.dy_m**2 / (sy**2 + look**2)])))
    height_off = now.height_m - calibration.ceiling_height_m
    tilt_off = float(np.hypot(now.roll_rad - roll, now.pitch_rad - pitch))
    height_limit = HEIGHT_FRACTION * calibration.ceiling_height_m + 3.0 * float(now.sigma[2])
    tilt_limit = TILT_RAD + 3.0 * float(np.hypot(*now.sigma[:2]))
    stale = []
    if abs(height_off) > height_limit:
        stale.append(
            f"the ceiling is {1e3 * abs(height_off):.0f} mm {'higher' if height_off > 0 else 'lower'} than calibrated, "
            f"{1e3 * height_limit:.0f} allowed: another room, or the camera's height or lens changed"
        )
    if tilt_off > tilt_limit:
        stale.append(
            f"the camera leans {np.degrees(tilt_off):.2f} deg differently, "
            f"{np.degrees(tilt_limit):.2f} allowed: was it knocked?"
        )
    if now.rms_px > RMS_PX:
        stale.append(f"the grid fits to {now.rms_px:.2f} px only, {RMS_PX:g} allowed: the lens or its focus changed")
    if nis > NIS_HIGH:
        stale.append(f"errors are {np.sqrt(nis):.1f} times what the noise curves say: run 'calib sigma' again")
    return Check(
        height_off, height_limit, tilt_off, tilt_limit, now.rms_px, RMS_PX, nis, NIS_HIGH, len(stations),
        tuple(stale),
    )  # fmt: skip
