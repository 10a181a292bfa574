"""The calibration file from the session's results, as soon as there are enough of them."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import suppress
from dataclasses import asdict, replace
from datetime import date
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ceilvo.calib.evaluate import scale
from ceilvo.calib.session.session import CALIBRATION, STEPS, Session, reading
from ceilvo.calib.solve.intrinsics import Intrinsics
from ceilvo.calib.solve.lens import camera_of
from ceilvo.calibration import Calibration, NoiseCurves, mount_rotation, projection_matrix
from ceilvo.calibration_file import read_calibration, render_calibration, write_calibration
from ceilvo.camera import CameraModel
from ceilvo.errors import CalibrationError
from ceilvo.json_values import json_value

Array = NDArray[np.float64]

_VECTORS = 400
"""Drawn at the most; chosen: more would cover one another."""

UNMEASURED = NoiseCurves((0.010, 0.0, 0.006), (0.010, 0.0, 0.006), 0.01, 0.0, 2.5)
"""Noise until `calib sigma` has measured it: deliberately large."""


def intrinsics_result(fit: Intrinsics, scores: Mapping[str, float], camera_id: str) -> dict[str, Any]:
    return {
        "camera": asdict(fit.camera),
        "camera_id": camera_id,
        "model": fit.model,
        "sigma": fit.sigma,
        "cov": fit.cov,
        "rms_px": fit.rms_px,
        "held_out_rms_px": dict(scores),
        "shots": [{"name": s.name, "rms_px": r} for s, r in zip(fit.shots, fit.shot_rms_px, strict=True)],
        "dropped": [{"name": n, "reason": r} for n, r in fit.dropped],
        "radial": radial_profile(fit),
        "vectors": vectors(fit.uv_px, fit.residual_px),
    }


def vectors(uv_px: Array, residual_px: Array) -> list[list[float]]:
    """u, v and the residual there, px, of points spread evenly over all: for a plot."""
    every = max(1, len(uv_px) // _VECTORS)
    rows: list[list[float]] = np.column_stack([uv_px, residual_px])[::every].round(4).tolist()
    return rows


def radial_profile(fit: Intrinsics, rings: int = 8) -> list[dict[str, float]]:
    """Mean residual along the radius, and rms, in rings about the principal point: what the lens model leaves."""
    centre = np.array([fit.camera.cx_px, fit.camera.cy_px])
    off = fit.uv_px - centre
    r = np.hypot(*off.T)
    along = np.sum(fit.residual_px * off, axis=1) / np.maximum(r, 1e-9)
    out = []
    for rows in np.array_split(np.argsort(r), rings):
        if len(rows):
            rms = float(np.sqrt(np.mean(np.sum(fit.residual_px[rows] ** 2, axis=1))))
            out.append({"r_px": float(r[rows].mean()), "along_px": float(along[rows].mean()), "rms_px": rms})
    return out


def camera_from(result: Mapping[str, Any]) -> tuple[CameraModel, Array]:
    """The lens of an intrinsics result and the covariance of its parameters."""
    try:
        c = dict(result["camera"])
        c["distortion"] = tuple(c["distortion"])
        camera = CameraModel(**c)
        cov = np.array(result["cov"], np.float64)
        camera_of(str(result["model"]), np.zeros(4 + len(camera.distortion)), (1, 1))
        if cov.shape != (4 + len(camera.distortion),) * 2:
            raise ValueError(f"covariance is {cov.shape}")
    except (KeyError, TypeError, ValueError) as e:
        raise CalibrationError(f"intrinsics.json: damaged ({e}); run 'calib intrinsics' again with --force") from None
    return camera, cov


def lens_so_far(session: Session, reason: str) -> tuple[CameraModel, Array]:
    """The lens of the board, or as refined by the projection on the grid if that was of the same board's lens.

    Raises:
        CalibrationError: there is none, or it is damaged.
    """
    lens, projection = session.need("intrinsics", reason), session.result("projection")
    with reading(session.folder):
        return camera_from(refined(lens, projection))


def refined(lens: Mapping[str, Any], projection: Mapping[str, Any] | None) -> Mapping[str, Any]:
    better = None if projection is None else projection.get("lens")
    return better if better and better.get("of") == lens.get("camera") else lens


def assemble(session: Session) -> Calibration | None:
    """What the results say so far, None before the projection.

    Raises:
        CalibrationError: a result is damaged.
    """
    results = {step: session.result(step) for step in (*STEPS, "shutter")}
    lens, projection = results["intrinsics"], results["projection"]
    if lens is None or projection is None:
        return None
    with reading(session.folder):
        calibration = _assembled(lens, projection, results)
        with suppress(CalibrationError):  # values are for who writes it; here it is about their types
            render_calibration(calibration, CALIBRATION)
    return calibration


def _assembled(
    lens: Mapping[str, Any], projection: Mapping[str, Any], results: Mapping[str, Mapping[str, Any] | None]
) -> Calibration:
    mount, sigma, survey, check = (results[step] for step in ("mount", "sigma", "survey", "check"))
    shutter = results["shutter"]
    best = refined(lens, projection)
    camera, _ = camera_from(best)
    xy, yaw = projection.get("xy_m"), projection.get("yaw_rad")
    if mount is not None:
        xy, yaw = mount["xy_m"], mount["yaw_rad"]
    notes = []
    if projection.get("lens") and best is lens:
        notes.append("the lens was measured anew since: 'calib projection --force' is to be done")
    if xy is None:
        xy, yaw = (0.0, 0.0), 0.0
        notes.append("offset and yaw of the camera not measured: 'calib mount' is to be done")
    if sigma is None:
        notes.append("noise not measured: 'calib sigma' is to be done")
    rotation = mount_rotation(float(yaw or 0.0), projection["roll_rad"], projection["pitch_rad"])
    meta: dict[str, Any] = {
        "intrinsics": {"model": lens["model"], "sigma": best["sigma"], "rms_px": lens["rms_px"]},
        "projection": {k: projection[k] for k in ("sigma", "rms_px")},
    }
    if mount is not None:
        meta["mount"] = {k: mount[k] for k in ("sigma", "wheel_scale")}
    if shutter is not None:
        camera = replace(camera, readout_s=float(shutter["readout_s"]))
        meta["shutter"] = {"sigma_s": shutter["sigma_s"]}
    if sigma is not None:
        meta["sigma"] = {k: sigma[k] for k in ("samples", "bias_m")}
    projection_m = projection_matrix(camera, rotation, (float(xy[0]), float(xy[1])), projection["height_m"])
    noise = UNMEASURED if sigma is None else noise_from(sigma)
    driven = survey is not None and survey.get("nis") is not None
    if survey is not None and driven and survey.get("of") == identity(projection_m, noise):
        meta["survey"] = {"nis": survey["nis"]}
    else:
        notes.append("NIS of a drive not measured, a stale calibration is noticed late: 'calib survey' is to be done")
    if check is not None:
        meta["check"] = {k: check[k] for k in ("nis", "verdict")}
    meta["scale"], to_do = scale.of_session(projection, mount)
    notes += [to_do] if to_do else []
    if notes:
        meta["to_do"] = notes
    return Calibration(
        camera=camera,
        projection=projection_m,
        noise=noise,
        camera_id=str(lens.get("camera_id", "")),
        created=date.today().isoformat(),
        tile_m=projection.get("tile_m"),
        meta=json_value({**meta, "session": "calib"}),
    )


def identity(projection: Array, noise: NoiseCurves) -> list[str]:
    """Tells calibrations apart: a drive's NIS says nothing about another one."""
    return [f"{v:.6g}" for v in (*projection.ravel(), *noise.sigma_x_m, *noise.sigma_y_m, noise.sigma_theta_rad)]


def noise_from(result: Mapping[str, Any]) -> NoiseCurves:
    return NoiseCurves(
        tuple(result["sigma_x_m"]),
        tuple(result["sigma_y_m"]),
        result["sigma_theta_rad"],
        result["r_min_m"],
        result["r_max_m"],
    )


def update_file(session: Session) -> str:
    """Write calibration.yaml anew from the results; what was there stays as .bak. A line about it.

    Raises:
        CalibrationError: there is a file that calib did not write, or that was edited, and no force.
    """
    calibration = assemble(session)
    if calibration is None:
        return ""
    path = session.calibration_file
    there = path.exists()
    if there and not session.force:
        try:
            ours = read_calibration(path).meta.get("session") == "calib"
        except CalibrationError:
            ours = False
        if not ours:
            raise CalibrationError(
                f"{path}: found a file that calib did not put together, or one edited since; the result is kept, "
                "pass --force to replace the file (it stays as .bak)"
            )
    write_calibration(path, calibration, force=there)
    to_do = calibration.meta.get("to_do")
    return f"{path}: written" + (f"; {'; '.join(to_do)}" if to_do else "")
