"""A camera on a robot, as commissioning would have found it."""

from __future__ import annotations

from typing import Literal

import numpy as np

from ceilvo.calibration import Calibration, NoiseCurves, mount_rotation, projection_matrix
from ceilvo.camera import CameraModel

_WIDTH_PX, _FOCALS_PX, _OFF_CENTRE_PX = 640, (410.3, 409.1), (3.2, -3.1)
"""A webcam of 76 deg across, not quite square and not quite centred; chosen. Other sizes see the same."""
_SIGMA_M, _SIGMA_THETA_RAD, _R_MAX_M = (0.003, 0.0, 0.002), 0.002, 2.5
"""Noise curves, m against r in m, and of the heading: cautious, `calib sigma` finds less (docs/calibration.md)."""
PINHOLE_DISTORTION = (-0.150, 0.030, 6e-4, -4e-4, -0.002)
"""k1, k2, p1, p2, k3 of a cheap wide webcam lens; chosen."""
FISHEYE_DISTORTION = (-0.020, 0.004, -0.002, 0.0003)
"""k1 to k4; chosen."""
CAMERA_ID = "ceilvo-sim"


def simulated_camera(
    kind: Literal["pinhole", "fisheye"] = "pinhole",
    width_px: int = _WIDTH_PX,
    height_px: int = 480,
    distortion: tuple[float, ...] | None = None,
    readout_s: float = 0.0,
) -> CameraModel:
    """A lens with fx, fy of 410.3, 409.1 px at 640 px width (fisheye 205.2, 204.6), scaled with the width."""
    scale = width_px / _WIDTH_PX
    f = 1.0 if kind == "pinhole" else 0.5
    if distortion is None:
        distortion = PINHOLE_DISTORTION if kind == "pinhole" else FISHEYE_DISTORTION
    return CameraModel(
        kind=kind,
        width_px=width_px,
        height_px=height_px,
        fx_px=_FOCALS_PX[0] * f * scale,
        fy_px=_FOCALS_PX[1] * f * scale,
        cx_px=0.5 * (width_px - 1) + _OFF_CENTRE_PX[0] * scale,
        cy_px=0.5 * (height_px - 1) + _OFF_CENTRE_PX[1] * scale,
        distortion=distortion,
        readout_s=readout_s,
    )


def simulated_calibration(
    camera: CameraModel | None = None,
    *,
    mount_xy_m: tuple[float, float] = (0.05, -0.03),
    yaw_rad: float = float(np.radians(2.0)),
    roll_rad: float = 0.0,
    pitch_rad: float = 0.0,
    ceiling_height_m: float = 2.2,
    tile_m: float | None = 0.6,
) -> Calibration:
    """The truth about the simulated camera, with noise curves that crossings measured in its images keep to.

    Args:
        camera: lens and sensor; None is simulated_camera().
        mount_xy_m: camera position in base.
        yaw_rad, roll_rad, pitch_rad: how it is mounted (ceilvo.calibration.mount_rotation).
        ceiling_height_m: ceiling above the camera.
        tile_m: written into the calibration; the ceiling itself is CeilingSpec's.
    """
    camera = camera or simulated_camera()
    rot = mount_rotation(yaw_rad, roll_rad, pitch_rad)
    return Calibration(
        camera=camera,
        projection=projection_matrix(camera, rot, mount_xy_m, ceiling_height_m),
        noise=NoiseCurves(_SIGMA_M, _SIGMA_M, sigma_theta_rad=_SIGMA_THETA_RAD, r_min_m=0.0, r_max_m=_R_MAX_M),
        camera_id=CAMERA_ID,
        created="2024-01-01",
        tile_m=tile_m,
    )
