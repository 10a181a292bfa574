"""What a step found, as the wizard shows it: a verdict in words, and what its plots are drawn from."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ceilvo.calib.session.assemble import assemble, camera_from, refined
from ceilvo.calib.session.session import Session
from ceilvo.calib.solve.lens import lens_of
from ceilvo.calibration import in_base
from ceilvo.camera import CameraModel
from ceilvo.errors import CalibrationError

Array = NDArray[np.float64]

_GRID = (24, 18)
"""Columns and rows of the map of the uncertainty."""
_STEP = 1e-4
"""Of a lens parameter, relative or absolute, for its derivative."""
_HIGHEST_SHARE = 0.1
"""Fields of the map left white because nothing is known there; more and there is no map."""


def verdict(step: str, result: Mapping[str, Any]) -> str:
    """One sentence, or two.

    Raises:
        CalibrationError: never; what the result lacks is left out of the words.
    """
    problems = result.get("problems") or []
    if result.get("verdict") != "PASS":
        return "Not good enough yet: " + ("; ".join(map(str, problems)) or "no verdict")
    try:
        return _WORDS[step](result)
    except (KeyError, TypeError, ValueError, IndexError):
        return "Good."


def _lens(r: Mapping[str, Any]) -> str:
    focal, sigma = float(r["camera"]["fx_px"]), float(r["sigma"][0])
    return (
        f"The lens is good: corners are met to {r['rms_px']:.2f} px, the focal length is known to "
        f"{100 * sigma / focal:.2f} %."
    )


def _ceiling(r: Mapping[str, Any]) -> str:
    lean = float(np.degrees(np.hypot(r["roll_rad"], r["pitch_rad"])))
    return (
        f"The ceiling is {r['height_m']:.3f} m above the lens, known to {1e3 * float(r['sigma'][2]):.1f} mm; "
        f"the camera leans by {lean:.2f} deg."
    )


def _mounting(r: Mapping[str, Any]) -> str:
    x, y = (100 * float(v) for v in r["xy_m"])
    return (
        f"The camera sits {abs(x):.1f} cm {'before' if x >= 0 else 'behind'} the robot's middle, {abs(y):.1f} cm to "
        f"the {'left' if y >= 0 else 'right'}, known to {1e3 * max(map(float, r['sigma'][:2])):.1f} mm, and is turned "
        f"by {np.degrees(float(r['yaw_rad'])):.2f} deg."
    )


def _noise(r: Mapping[str, Any]) -> str:
    low, high = (float(np.polynomial.polynomial.polyval(x, r["sigma_x_m"])) for x in (r["r_min_m"], r["r_max_m"]))
    return (
        f"What the robot sees is off by {1e3 * low:.1f} mm right above it and by {1e3 * high:.1f} mm "
        f"{float(r['r_max_m']):.1f} m away (one sigma)."
    )


def _survey(r: Mapping[str, Any]) -> str:
    return f"The ceiling is good enough everywhere: {r['crossings_per_m2']:.1f} crossings a square metre."


def _check(r: Mapping[str, Any]) -> str:
    return f"Still good: {r['pictures']} new pictures agree with the calibration to {r['rms_px']:.2f} px."


_WORDS: Mapping[str, Callable[[Mapping[str, Any]], str]] = {
    "intrinsics": _lens, "projection": _ceiling, "mount": _mounting, "sigma": _noise, "survey": _survey,
    "check": _check,
}  # fmt: skip


def plots(session: Session, step: str, result: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Of a step's result, each with its kind: vectors, bars, map or curves."""
    try:
        return list(_plots(session, step, result))
    except (CalibrationError, KeyError, TypeError, ValueError, IndexError):
        return []  # an older session has less in it


def _plots(session: Session, step: str, r: Mapping[str, Any]) -> list[dict[str, Any]]:
    out: list[dict[str, Any]] = []
    lens = session.result("intrinsics")
    if lens is not None and r.get("vectors"):
        camera, cov = camera_from(refined(lens, r) if step == "projection" else r)
        size = [camera.width_px, camera.height_px]
        out.append({"kind": "vectors", "size": size, "vectors": r["vectors"], "rms_px": r["rms_px"]})
        if step == "intrinsics":
            out.append(_map(camera, lens_uncertainty_px(camera, cov), "px", "How far off a ray may be, one sigma"))
    if step == "sigma":
        curves = {
            axis: {k: c[k] for k in ("coefficients", "r_m", "low_m", "high_m", "circle_r_m", "circle_sigma_m")}
            for axis, c in r["curves"].items()
        }
        out.append({"kind": "curves", "curves": curves})
        calibration = assemble(session)
        if calibration is not None:
            camera = calibration.camera
            r_m = np.hypot(*(in_base(calibration, _pixels(camera)) - calibration.mount_xy_m).T)
            x, y = calibration.noise.at(r_m)
            out.append(_map(camera, 1e3 * np.hypot(x, y), "mm", "How far off a crossing on the ceiling is, one sigma"))
    return out


def _map(camera: CameraModel, values: Array, unit: str, title: str) -> dict[str, Any]:
    columns, rows = _GRID
    known = np.isfinite(values)
    if np.mean(~known) > _HIGHEST_SHARE:
        raise ValueError("no map")
    shown = [float(f"{v:.4g}") if ok else None for v, ok in zip(values, known, strict=True)]
    return {
        "kind": "map", "columns": columns, "rows": rows, "values": shown, "unit": unit, "title": title,
        "size": [camera.width_px, camera.height_px],
    }  # fmt: skip


def _pixels(camera: CameraModel) -> Array:
    """(N, 2) middles of the map's fields, row by row."""
    columns, rows = _GRID
    u, v = np.meshgrid((np.arange(columns) + 0.5) / columns, (np.arange(rows) + 0.5) / rows)
    return np.column_stack([u.ravel() * camera.width_px, v.ravel() * camera.height_px]) - 0.5


def lens_uncertainty_px(camera: CameraModel, cov: Array) -> Array:
    """(N,) sigma of where a ray falls in the picture, for the map's fields, px, both axes together.

    Args:
        cov: of fx, fy, cx, cy and the distortion.
    """
    found = lens_of(camera)
    if found is None:
        raise ValueError("no lens of calib")
    make, p = found
    rays = camera.rays(_pixels(camera))
    columns = []
    for i in range(len(p)):
        step = np.zeros(len(p))
        step[i] = _STEP * max(1.0, abs(p[i]))
        columns.append((make(p + step).pixels(rays) - make(p - step).pixels(rays)) / (2.0 * step[i]))
    jacobian = np.stack(columns, axis=-1)  # (N, 2, K)
    return np.asarray(np.sqrt(np.einsum("nik,kl,nil->n", jacobian, cov, jacobian)), np.float64)
