"""Where the camera sits on the robot: its offset and yaw in base from a spin on the spot and a straight run."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ceilvo.calib.solve.lens import with_lens_error
from ceilvo.calib.solve.mount.fit import Solution, solve
from ceilvo.calib.solve.mount.tracks import MIN_PICTURES, RUN, SPIN, MountPicture, samples_of
from ceilvo.calib.solve.mount.uncertainty import covariance, lens_response
from ceilvo.calib.solve.mount.wheels import wheel_scale
from ceilvo.camera import CameraModel
from ceilvo.errors import CalibrationError

Array = NDArray[np.float64]

MIN_TURN_RAD = float(np.radians(200.0))
"""Of the spin; chosen: of a smaller arc the circle's centre and the offset are hard to tell apart."""
MIN_RUN_M = 0.8
"""Chosen: yaw's sigma is two places' own over the path between them, and must stay below SIGMA_YAW_RAD."""
SIGMA_XY_M = 0.005
SIGMA_YAW_RAD = float(np.radians(0.3))
"""Gates of a PASS; `make bench-calib` finds 0.34 mm and 0.0014 deg rms on simulated rigs, so they catch bad drives."""
RMS_M = 0.02
"""Gate of both experiments' residuals; chosen: somebody who drives by hand stays below it."""
WHEEL_SCALES = (0.9, 1.1)
"""Gate; a wrong diameter or gear in the base's settings is off by more."""


@dataclass(frozen=True)
class Mount:
    """What came out.

    Attributes:
        xy_m: (2,) camera in base; yaw_rad: of camera in base; sigma: (3,) of x, y, yaw, and cov (3, 3).
        turned_rad, run_m: how far the robot turned and ran.
        spin_rms_m, run_rms_m: residuals of both.
        wheel_scale, wheel_scale_sigma: true over reported distance, None without wheels; wheel_turn: of the turn.
        spin_xy_m: (N, 2) the camera's path in the spin, centred, for a plot; run_xy_m: (M, 2) the base's in the run.
    """

    xy_m: Array
    yaw_rad: float
    cov: Array
    turned_rad: float
    run_m: float
    spin_rms_m: float
    run_rms_m: float
    wheel_scale: float | None
    wheel_scale_sigma: float | None
    wheel_turn: float | None
    spin_xy_m: Array
    run_xy_m: Array

    @property
    def sigma(self) -> Array:
        return np.sqrt(np.diag(self.cov))


def calibrate(
    camera: CameraModel,
    pictures: list[MountPicture],
    tile_m: float,
    level: Array,
    intrinsics_cov: Array | None = None,
) -> Mount:
    """Offset and yaw from pictures under a tiled ceiling, in order of time.

    Args:
        tile_m: side of a tile.
        level: (3,) roll, pitch, height of calib.projection.
        intrinsics_cov: of the lens; None = taken as known.

    Raises:
        CalibrationError: too little turning or running, or the grid was lost on the way.
    """
    spin, run = ([s for s in pictures if s.label == label] for label in (SPIN, RUN))
    for name, part in ((SPIN, spin), (RUN, run)):
        if len(part) < MIN_PICTURES:
            raise CalibrationError(f"mount: found {len(part)} usable pictures of the {name}, {MIN_PICTURES} needed")
    tracks = [samples_of(part, tile_m / float(level[2])) for part in (spin, run)]

    best = solve(camera, tracks, tile_m, level)
    _check(best)
    cov = covariance(camera, best, tile_m)
    if intrinsics_cov is not None:
        cov = with_lens_error(cov, lens_response(camera, best, tile_m, intrinsics_cov.shape[0]), intrinsics_cov)
    scale, scale_sigma, turn = wheel_scale(spin, run, best, tracks)
    return Mount(
        xy_m=best.values[:2],
        yaw_rad=float(best.values[2]),
        cov=cov,
        turned_rad=float(np.ptp(best.spin[:, 2])),
        run_m=best.run_m,
        spin_rms_m=float(np.sqrt(np.mean(best.spin_off**2))),
        run_rms_m=float(np.sqrt(np.mean(best.run_off**2))),
        wheel_scale=scale,
        wheel_scale_sigma=scale_sigma,
        wheel_turn=turn,
        spin_xy_m=best.spin[:, :2] - best.spin[:, :2].mean(axis=0),
        run_xy_m=best.run_base - best.run_base[0],
    )


def _check(s: Solution) -> None:
    turned, run = float(np.ptp(s.spin[:, 2])), s.run_m
    if turned < MIN_TURN_RAD:
        raise CalibrationError(
            f"mount: found a spin of {np.degrees(turned):.0f} deg, at least {np.degrees(MIN_TURN_RAD):.0f} needed; "
            "turn the robot on the spot, four times round"
        )
    if run < MIN_RUN_M:
        raise CalibrationError(f"mount: found a run of {run:.2f} m, at least {MIN_RUN_M} needed; drive straight on")


def problems(m: Mount) -> list[str]:
    """What keeps the result from a PASS, with what to do."""
    out = []
    sigma_mm, sigma_deg = 1e3 * float(m.sigma[:2].max()), float(np.degrees(m.sigma[2]))
    gate_mm, gate_deg, rms_mm = 1e3 * SIGMA_XY_M, np.degrees(SIGMA_YAW_RAD), 1e3 * RMS_M
    if m.sigma[:2].max() > SIGMA_XY_M:
        out.append(f"the offset is known to {sigma_mm:.1f} mm only, {gate_mm:g} needed: turn on the spot, more rounds")
    if m.sigma[2] > SIGMA_YAW_RAD:
        out.append(f"the yaw is known to {sigma_deg:.2f} deg only, {gate_deg:.1f} needed: a longer, straighter run")
    if m.spin_rms_m > RMS_M:
        out.append(
            f"the robot wandered by {1e3 * m.spin_rms_m:.0f} mm in the spin, {rms_mm:g} allowed: turn on the spot"
        )
    if m.run_rms_m > RMS_M:
        off_mm = 1e3 * m.run_rms_m
        out.append(f"the run was off a straight line by {off_mm:.0f} mm, {rms_mm:g} allowed: drive without slip")
    return out


def wheel_problems(m: Mount) -> list[str]:
    """What is wrong with the wheels where the ceiling's scale is known to be right."""
    if m.wheel_scale is None or WHEEL_SCALES[0] < m.wheel_scale < WHEEL_SCALES[1]:
        return []
    return [f"the wheels report {1 / m.wheel_scale:.3f} of the way driven: check their diameter in the base"]
