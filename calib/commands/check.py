"""`calib check`: is a calibration still good? From pictures of the tiled ceiling, in less than a minute."""

from __future__ import annotations

import argparse
from datetime import datetime, timezone
from pathlib import Path
from typing import Any

import numpy as np

from ceilvo.calib.commands.sigma import stations
from ceilvo.calib.evaluate.check import Check, check
from ceilvo.calib.session.common import Subcommands, add_step, bench_of, calibration_of, conclude
from ceilvo.calib.session.session import Session
from ceilvo.calib.session.views import collect, moved
from ceilvo.calibration import mount_angles
from ceilvo.calibration_check import check_fits
from ceilvo.errors import CalibrationError

STEP = "check"
_PICTURES = 12
""""A dozen"; chosen: less than a minute's work."""
_GO_ON_S = 600.0
"""An interrupted check goes on for so long; later the camera may have been knocked in between."""


def add(commands: Subcommands) -> None:
    p = add_step(
        commands,
        STEP,
        run,
        help="6. is a calibration still good? in less than a minute",
        description="Push the robot about under the tiled ceiling; a dozen pictures are compared with the file.",
        epilog="example: calib check --config /etc/ceilvo/config.yaml --calibration /etc/ceilvo/calibration.yaml",
    )
    p.add_argument("--calibration", type=Path, metavar="FILE", help="default: the session's calibration.yaml")


def run(args: argparse.Namespace) -> int:
    file, calibration = calibration_of(args)
    if calibration.tile_m is None:
        raise CalibrationError(f"{file}: tile_m: found null, expected the tile's side; the check needs a tiled ceiling")
    session = Session(args.session, force=True)  # a check may be repeated at any time; all are kept in checks.jsonl
    if args.force or session.samples_age_s(STEP) > _GO_ON_S:
        session.set_aside(STEP)
    bench = bench_of(args).places(_PICTURES) if args.simulate else None
    _, roll, pitch = mount_angles(calibration.camera_from_base)
    got = collect(
        args, session, STEP, calibration.camera, bench, tilt_rad=(roll, pitch), wanted=moved,
        enough=lambda c: len(c.seen) >= _PICTURES, ask="push the robot about under the tiled ceiling",
    )  # fmt: skip
    check_fits(calibration, "the camera", got.camera_id, calibration.camera.width_px, calibration.camera.height_px)
    found = check(calibration, stations(got))
    result = _result(found, str(file))
    session.save(STEP, result)
    session.log("checks", {"at": datetime.now(timezone.utc).isoformat(timespec="seconds")} | result)
    session.set_aside(STEP)
    bad = [f"stale, because {reason}" for reason in found.stale]
    again = "calib projection, calib mount and calib sigma again, with --force"
    code = conclude(STEP, _rows(found), bad, args, then=again)
    if not bad:
        print("still good")
    return code


def _result(c: Check, file: str) -> dict[str, Any]:
    return {
        "file": file,
        "height_off_m": c.height_off_m,
        "tilt_off_rad": c.tilt_off_rad,
        "rms_px": c.rms_px,
        "nis": c.nis,
        "nis_limit": c.nis_limit,
        "pictures": c.pictures,
        "problems": c.stale,
        "verdict": "FAIL" if c.stale else "PASS",
    }


def _rows(c: Check) -> list[tuple[str, str]]:
    return [
        ("pictures", str(c.pictures)),
        ("height", f"{1e3 * c.height_off_m:+.1f} mm off the file's, {1e3 * c.height_limit_m:.1f} allowed"),
        ("tilt", f"{np.degrees(c.tilt_off_rad):.3f} deg off the file's, {np.degrees(c.tilt_limit_rad):.3f} allowed"),
        ("reprojection", f"{c.rms_px:.3f} px rms, {c.rms_limit_px:.2f} allowed"),
        ("NIS", f"{c.nis:.2f} per degree of freedom, {c.nis_limit:.2f} allowed"),
    ]
