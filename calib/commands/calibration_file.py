"""`calib show`, `calib sign` and `calib simulate`: what is done with a calibration file as it is."""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

import numpy as np

from ceilvo.calib.evaluate.shutter import first_row
from ceilvo.calib.session.common import Subcommands
from ceilvo.calibration import Calibration, mount_angles
from ceilvo.calibration_check import scale_of
from ceilvo.calibration_file import read_calibration, sign_calibration, write_calibration
from ceilvo.sim.rig import simulated_calibration, simulated_camera


def add(commands: Subcommands) -> None:
    show = commands.add_parser(
        "show",
        help="check a calibration and print its figures",
        epilog="example: calib show commissioning/calibration.yaml",
    )
    show.add_argument("file", type=Path)
    show.set_defaults(run=_show)

    sign = commands.add_parser(
        "sign",
        help="accept an edited calibration: check its values, renew its checksum",
        epilog="example: calib sign commissioning/calibration.yaml",
    )
    sign.add_argument("file", type=Path)
    sign.set_defaults(run=_sign)

    simulate = commands.add_parser(
        "simulate",
        help="write the calibration of the simulated camera",
        epilog="example: calib simulate build/calibration.yaml --lens fisheye",
    )
    simulate.add_argument("file", type=Path)
    simulate.add_argument("--force", action="store_true", help="replace the file and keep it as .bak")
    simulate.add_argument("--lens", choices=("pinhole", "fisheye"), default="pinhole")
    simulate.set_defaults(run=_simulate)


def _show(args: argparse.Namespace) -> int:
    print(describe(read_calibration(args.file)))
    return 0


def _sign(args: argparse.Namespace) -> int:
    sign_calibration(args.file)
    print(f"{args.file}: signed; the file as it was is {args.file.name}.bak")
    return 0


def _simulate(args: argparse.Namespace) -> int:
    truth = {"scale": {"state": "confirmed", "sources": ["the simulator's own truth"]}}
    write_calibration(
        args.file, replace(simulated_calibration(simulated_camera(args.lens)), meta=truth), force=args.force
    )
    print(f"{args.file}: written")
    return 0


def describe(calibration: Calibration) -> str:
    """The figures that a person can check with a tape measure and a spirit level."""
    lines = [f"{name:<17}{value}" for name, value in rows_of(calibration)]
    lines += [f"{'meta':<17}{key}: {value}" for key, value in calibration.meta.items()]
    return "\n".join(lines)


def rows_of(calibration: Calibration) -> tuple[tuple[str, str], ...]:
    """Name and value with its unit of each of them."""
    camera, noise = calibration.camera, calibration.noise
    yaw, roll, pitch = np.round(np.degrees(mount_angles(calibration.camera_from_base)), 2) + 0.0  # + 0.0: no -0.00
    field = 2.0 * np.degrees(np.arccos(np.clip(_corner_cosine(calibration), -1.0, 1.0)))
    x, y = calibration.mount_xy_m
    return (
        (
            "camera",
            f"{calibration.camera_id or 'not recorded'}, {camera.kind}, {camera.width_px} x {camera.height_px} px",
        ),
        ("created", calibration.created or "not recorded"),
        ("focal length", f"{camera.fx_px:.2f}, {camera.fy_px:.2f} px"),
        ("principal point", f"{camera.cx_px:.2f}, {camera.cy_px:.2f} px"),
        ("field of view", f"{field:.1f} deg across the diagonal"),
        ("distortion", ", ".join(f"{k:.5g}" for k in camera.distortion) or "none"),
        ("shutter", _shutter_row(camera.readout_s)),
        ("ceiling", f"{calibration.ceiling_height_m:.3f} m above the camera"),
        ("camera position", f"{x:+.3f} m forward, {y:+.3f} m left of the base's origin"),
        ("camera mounting", f"yaw {yaw:+.2f}, roll {roll:+.2f}, pitch {pitch:+.2f} deg"),
        ("one pixel", f"{1e3 * calibration.ceiling_height_m / camera.fx_px:.2f} mm on the ceiling above the camera"),
        ("tile", f"{calibration.tile_m:g} m" if calibration.tile_m else "unknown"),
        ("scale", scale_of(calibration)[1]),
        ("sigma at r", _sigma_row(calibration)),
        ("sigma of heading", f"{np.degrees(noise.sigma_theta_rad):.3f} deg"),
    )


def _corner_cosine(calibration: Calibration) -> float:
    camera = calibration.camera
    w, h = camera.width_px - 1.0, camera.height_px - 1.0
    corners = camera.rays(np.array([[0, 0], [w, 0], [0, h], [w, h]]))
    return float(corners[:, 2].mean())


def _shutter_row(readout_s: float) -> str:
    if not readout_s:
        return "global, or not measured"
    return f"rolling, {1e3 * abs(readout_s):.2f} ms for all rows, {first_row(readout_s)}"


def _sigma_row(calibration: Calibration) -> str:
    noise = calibration.noise
    parts = []
    for r in np.linspace(noise.r_min_m, noise.r_max_m, 3):
        x, y = (1e3 * np.polynomial.polynomial.polyval(r, k) for k in (noise.sigma_x_m, noise.sigma_y_m))
        parts.append(f"{r:.2f} m: {x:.1f}, {y:.1f} mm")
    return "; ".join(parts)
