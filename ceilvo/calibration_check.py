"""Whether a calibration's values are possible, and whether it belongs to the camera that was opened."""

from __future__ import annotations

import re
from collections.abc import Iterator
from datetime import date

import numpy as np

from ceilvo.calibration import Calibration, NoiseCurves
from ceilvo.camera import CameraModel
from ceilvo.errors import CalibrationError

DISTORTION_COUNTS = {"pinhole": (0, 4, 5, 8), "fisheye": (0, 4)}
"""How many coefficients OpenCV's models take."""


def check_fits(calibration: Calibration, camera_name: str, camera_id: str, width: int, height: int) -> None:
    """Refuse a calibration of another camera or another resolution.

    Args:
        camera_name: for the message.
        camera_id: what the opened camera says it is; empty on either side = not checked.
        width, height: of its frames, px.

    Raises:
        CalibrationError: naming everything that differs.
    """
    differs = []
    have, want = (width, height), (calibration.camera.width_px, calibration.camera.height_px)
    if have != want:
        differs.append(f"frames of {have[0]} x {have[1]} px, expected {want[0]} x {want[1]} px")
    if camera_id and calibration.camera_id and camera_id != calibration.camera_id:
        differs.append(f"camera id {camera_id!r}, expected {calibration.camera_id!r}")
    if differs:
        raise CalibrationError(
            f"calibration does not fit {camera_name}: found {' and '.join(differs)}; "
            "use the calibration of this camera or calibrate it"
        )


def value_problems(c: Calibration) -> Iterator[str]:
    """`key: found X, expected Y` for every value that no real camera, robot or ceiling has."""
    yield from _camera_problems(c.camera)
    yield from _noise_problems(c.noise)
    yield from _projection_problems(c)
    if c.tile_m is not None and not 0.05 <= c.tile_m <= 10.0:
        yield f"tile_m: found {c.tile_m:g}, expected 0.05 to 10 or null"
    if c.created and not _is_date(c.created):
        yield f"created: found {c.created!r}, expected an ISO date such as 2026-01-31, or nothing"


def _is_date(text: str) -> bool:
    try:
        date.fromisoformat(text[:10])
    except ValueError:
        return False
    return re.fullmatch(r"\d{4}-\d\d-\d\d([T ][0-9:.+Z-]+)?", text) is not None


def _camera_problems(c: CameraModel) -> Iterator[str]:
    ranges = (
        ("width_px", 64, 7680),
        ("height_px", 64, 4320),
        ("fx_px", 10.0, 1e5),
        ("fy_px", 10.0, 1e5),
        ("cx_px", -0.5 * c.width_px, 1.5 * c.width_px),
        ("cy_px", -0.5 * c.height_px, 1.5 * c.height_px),
    )
    for key, low, high in ranges:
        value = getattr(c, key)
        if not low <= value <= high:
            yield f"camera.{key}: found {value:g}, expected {low:g} to {high:g}"
    counts = DISTORTION_COUNTS.get(c.kind)
    if counts is None:
        yield f"camera.kind: found {c.kind!r}, expected pinhole or fisheye"
    elif len(c.distortion) not in counts:
        yield f"camera.distortion: found {len(c.distortion)} numbers, expected {_either(counts)} for {c.kind}"
    if not all(abs(k) <= 1e3 for k in c.distortion):
        yield f"camera.distortion: found {c.distortion}, expected coefficients of at most 1000"


def _either(counts: tuple[int, ...]) -> str:
    return ", ".join(str(n) for n in counts[:-1]) + f" or {counts[-1]}"


def _noise_problems(n: NoiseCurves) -> Iterator[str]:
    if not 0.0 <= n.r_min_m < n.r_max_m <= 100.0:
        yield f"noise.r_min_m, r_max_m: found {n.r_min_m:g} and {n.r_max_m:g}, expected 0 <= r_min_m < r_max_m <= 100"
        return
    r = np.linspace(n.r_min_m, n.r_max_m, 64)
    for key in ("sigma_x_m", "sigma_y_m"):
        k = getattr(n, key)
        if not 1 <= len(k) <= 8:
            yield f"noise.{key}: found {len(k)} coefficients, expected 1 to 8"
            continue
        sigma = np.polynomial.polynomial.polyval(r, k)
        if not (np.isfinite(sigma).all() and sigma.min() > 0.0 and sigma.max() <= 10.0):
            yield (
                f"noise.{key}: found values from {sigma.min():.3g} to {sigma.max():.3g} m between r_min_m and r_max_m, "
                "expected above 0 and at most 10"
            )
    if not 0.0 < n.sigma_theta_rad <= 1.0:
        yield f"noise.sigma_theta_rad: found {n.sigma_theta_rad:g}, expected above 0 and at most 1"


def _projection_problems(c: Calibration) -> Iterator[str]:
    """Whether M is a camera that looks up at a ceiling."""
    if np.shape(c.projection) != (3, 4) or not np.isfinite(c.projection).all():
        yield "projection: found something else, expected 3 x 4 finite numbers"
        return
    if not (c.camera.fx_px > 0 and c.camera.fy_px > 0):
        return
    left = np.linalg.solve(c.camera.matrix, c.projection[:, :3])
    spread = np.linalg.svd(left, compute_uv=False)
    if spread[2] <= 1e-9 * spread[0] or spread[0] > 1.25 * spread[2]:
        yield (
            "projection: found a left 3 x 3 block that is not the camera matrix times a rotation (singular values "
            f"{spread[0]:.3g}, {spread[1]:.3g}, {spread[2]:.3g}, expected equal); calibrate again"
        )
        return
    if not 0.3 <= c.ceiling_height_m <= 30.0:
        yield f"projection: found a ceiling {c.ceiling_height_m:.3g} m above the camera, expected 0.3 to 30"
    if c.camera_from_base[2, 2] < np.cos(np.radians(80.0)):
        off = np.degrees(np.arccos(np.clip(c.camera_from_base[2, 2], -1.0, 1.0)))
        yield f"projection: found a camera {off:.0f} deg off the vertical, expected it to look up, at most 80"
    if np.hypot(*c.mount_xy_m) > 5.0:
        yield f"projection: found a camera {np.hypot(*c.mount_xy_m):.3g} m beside the base's origin, expected at most 5"
