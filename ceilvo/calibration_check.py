"""Whether a calibration's values are possible, and whether it belongs to the camera that was opened."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from datetime import date

import numpy as np

from ceilvo.calibration import Calibration, NoiseCurves
from ceilvo.camera import CameraModel
from ceilvo.errors import CalibrationError, one_line

DISTORTION_COUNTS = {"pinhole": (0, 4, 5, 8), "fisheye": (0, 4)}
"""How many coefficients OpenCV's models take."""
HEIGHTS_M = (0.3, 30.0)
"""Of a ceiling above the camera, chosen: from a cellar's to a hall's; beyond it units or axes are mixed up."""
TILES_M = (0.05, 10.0)
"""Side of a tile; the usual ones have 0.3 to 1.2 m, beyond these units are mixed up."""
_WIDTHS_PX, _HEIGHTS_PX = (64, 7680), (64, 4320)
"""From a thumbnail to 8K UHD."""
_FOCALS_PX = (10.0, 1e5)
"""From a fisheye on the smallest picture to a telephoto on the largest."""
_CENTRE = (-0.5, 1.5)
"""Principal point over the picture's size: a cropped sensor's may lie outside, but not by more than half of it."""
_DISTORTION_MOST = 1e3
"""Of a coefficient; a rational model's may be large, these are rubbish."""
_READOUT_MOST_S = 0.2
"""Of all rows; the slowest webcam sensors take 0.1 s at their full size, and more is microseconds mixed up."""
_NOISE_R_MOST_M, _SIGMA_MOST_M, _SIGMA_MOST_RAD = 100.0, 10.0, 1.0
"""Of the noise curves: beyond what a ceiling shows and what would still be called a measurement."""
_COEFFICIENTS_MOST = 8
"""Of a noise polynomial; calib fits four at the most."""
_CURVE_POINTS = 64
"""At which a noise curve must be above zero; chosen, polynomials of few coefficients are smooth between them."""
_ENTRY_MOST = 1e9
"""Of M: the largest focal length times the highest ceiling, 3e6 px m, and room; sums of larger ones overflow."""
_FLAT = 1e-9
"""Singular value over the largest below which M's left block has no inverse."""
_SHEAR = 1.25
"""Largest over smallest singular value: 1 for a rotation; a measured M has skew and an aspect ratio of a little."""
_LEAN_MOST_RAD = float(np.radians(80.0))
"""Of a camera that looks up; beyond it the ceiling is not in the picture."""
_MOUNT_MOST_M = 5.0
"""From the base's origin; chosen, indoor robots are smaller."""


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


def scale_of(calibration: Calibration) -> tuple[str, str]:
    """ "confirmed", "unconfirmed" or "contradicted" by a second source, and what there is to say of it, a line.

    Files of before there was such a check say nothing of it: unconfirmed.
    """
    scale = calibration.meta.get("scale")
    known = scale if isinstance(scale, Mapping) else {}
    state = known.get("state")
    sources = known.get("sources")
    said = "; ".join(one_line(s) for s in sources) if isinstance(sources, list) else ""
    if state not in ("confirmed", "contradicted"):
        tile = "its lengths" if calibration.tile_m is None else f"its tile of {calibration.tile_m:g} m"
        return "unconfirmed", (
            f"scale unconfirmed: nothing but {tile} says how long a metre is; 'calib projection --height-m', --marks, "
            "or 'calib mount' with wheels confirms it"
        )
    if state == "contradicted":
        return state, f"scale contradicted: {said}; measure the tile again and run 'calib projection --force'"
    return state, f"scale confirmed: {said}"


def value_problems(c: Calibration) -> Iterator[str]:
    """`key: found X, expected Y` for every value that no real camera, robot or ceiling has."""
    yield from _camera_problems(c.camera)
    yield from _noise_problems(c.noise)
    yield from _projection_problems(c)
    if c.tile_m is not None and not TILES_M[0] <= c.tile_m <= TILES_M[1]:
        yield f"tile_m: found {c.tile_m:g}, expected {TILES_M[0]:g} to {TILES_M[1]:g} or null"
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
        ("width_px", *_WIDTHS_PX),
        ("height_px", *_HEIGHTS_PX),
        ("fx_px", *_FOCALS_PX),
        ("fy_px", *_FOCALS_PX),
        ("cx_px", _CENTRE[0] * c.width_px, _CENTRE[1] * c.width_px),
        ("cy_px", _CENTRE[0] * c.height_px, _CENTRE[1] * c.height_px),
        ("readout_s", -_READOUT_MOST_S, _READOUT_MOST_S),
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
    if not all(abs(k) <= _DISTORTION_MOST for k in c.distortion):
        yield f"camera.distortion: found {c.distortion}, expected coefficients of at most {_DISTORTION_MOST:g}"


def _either(counts: tuple[int, ...]) -> str:
    return ", ".join(str(n) for n in counts[:-1]) + f" or {counts[-1]}"


def _noise_problems(n: NoiseCurves) -> Iterator[str]:
    if not 0.0 <= n.r_min_m < n.r_max_m <= _NOISE_R_MOST_M:
        yield f"noise.r_min_m, r_max_m: found {n.r_min_m:g} and {n.r_max_m:g}, expected 0 <= r_min_m < r_max_m <= 100"
        return
    r = np.linspace(n.r_min_m, n.r_max_m, _CURVE_POINTS)
    for key in ("sigma_x_m", "sigma_y_m"):
        k = getattr(n, key)
        if not 1 <= len(k) <= _COEFFICIENTS_MOST:
            yield f"noise.{key}: found {len(k)} coefficients, expected 1 to 8"
            continue
        sigma = np.polyval(k[::-1], r)
        if not (np.isfinite(sigma).all() and sigma.min() > 0.0 and sigma.max() <= _SIGMA_MOST_M):
            yield (
                f"noise.{key}: found values from {sigma.min():.3g} to {sigma.max():.3g} m between r_min_m and r_max_m, "
                "expected above 0 and at most 10"
            )
    if not 0.0 < n.sigma_theta_rad <= _SIGMA_MOST_RAD:
        yield f"noise.sigma_theta_rad: found {n.sigma_theta_rad:g}, expected above 0 and at most 1"


def _projection_problems(c: Calibration) -> Iterator[str]:
    """Whether M is a camera that looks up at a ceiling."""
    if np.shape(c.projection) != (3, 4) or not np.all(np.abs(c.projection) <= _ENTRY_MOST):
        yield f"projection: found something else, expected 3 x 4 finite numbers, at most {_ENTRY_MOST:g}"
        return
    if not (c.camera.fx_px > 0 and c.camera.fy_px > 0):
        return
    left = np.linalg.solve(c.camera.matrix, c.projection[:, :3])
    spread = np.linalg.svd(left, compute_uv=False)
    if spread[2] <= _FLAT * spread[0] or spread[0] > _SHEAR * spread[2]:
        yield (
            "projection: found a left 3 x 3 block that is not the camera matrix times a rotation (singular values "
            f"{spread[0]:.3g}, {spread[1]:.3g}, {spread[2]:.3g}, expected equal); calibrate again"
        )
        return
    low, high = HEIGHTS_M
    if not low <= c.ceiling_height_m <= high:
        yield f"projection: found a ceiling {c.ceiling_height_m:.3g} m above the camera, expected {low:g} to {high:g}"
    upward = float(np.clip(c.camera_from_base[2, 2], -1.0, 1.0))
    if upward < np.cos(_LEAN_MOST_RAD):
        off, most = np.degrees([np.arccos(upward), _LEAN_MOST_RAD])
        yield f"projection: found a camera {off:.0f} deg off the vertical, expected it to look up, at most {most:.0f}"
    beside_m = float(np.hypot(*c.mount_xy_m))
    if beside_m > _MOUNT_MOST_M:
        yield (
            f"projection: found a camera {beside_m:.3g} m beside the base's origin, expected at most {_MOUNT_MOST_M:g}"
        )
