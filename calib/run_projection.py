"""`calib projection`: static tilt and ceiling height, from the ceiling's grid or from measured points."""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING, Any

import numpy as np

from ceilvo.calib.assemble import camera_from, update_file
from ceilvo.calib.degeneracy import layout_problem
from ceilvo.calib.grid import from_grid
from ceilvo.calib.points_file import read_points
from ceilvo.calib.projection import Mounting, from_points, plausible
from ceilvo.calib.session import Session
from ceilvo.calib.steps import bench_of, conclude, session_of, session_options, source_options
from ceilvo.calib.views import collect, moved
from ceilvo.camera import CameraModel
from ceilvo.errors import CalibrationError

if TYPE_CHECKING:
    from ceilvo.calib.cli import Commands

STEP = "projection"
_PICTURES = 20
_FEW = 5


def add(commands: Commands) -> None:
    p = commands.add_parser(
        STEP,
        help="2. tilt and ceiling height, from the tiled ceiling itself or from measured points",
        description="Put the robot under the tiled ceiling in 10 to 20 places, turned differently; or measure points.",
        epilog="example: calib projection --device /dev/video0 --tile-m 0.6; "
        "points: CSV x_m,y_m,z_m,u_px,v_px, x and y in base, z 0 on the ceiling and negative below, raw pixels",
    )
    session_options(p)
    source_options(p)
    p.add_argument("--tile-m", type=float, help="side of the ceiling's tiles; simulated: 0.6")
    p.add_argument(
        "--height-m", type=float, help="ceiling above the camera by tape, to a tenth; decides where two grids fit"
    )
    p.add_argument("--points", type=str, metavar="CSV", help="measured points instead of the grid")
    p.add_argument("--units", choices=("m", "mm"), help="of the CSV, when it is doubtful")
    p.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    session = session_of(args)
    session.begin(STEP)
    camera, cov = camera_from(session.need("intrinsics", "the projection"))
    found, extra = _points(args, camera, cov) if args.points else _grid(args, session, camera, cov)
    bad = plausible(found, (camera.width_px, camera.height_px)) + extra.pop("problems", [])
    session.save(STEP, _result(found) | extra | {"problems": bad, "verdict": "FAIL" if bad else "PASS"})
    print(update_file(session))
    return conclude(STEP, _rows(found, extra), bad, args)


def _grid(args: argparse.Namespace, session: Session, camera: CameraModel, cov: Any) -> tuple[Mounting, dict[str, Any]]:
    tile_m = tile_of(args)
    bench = bench_of(args).places(_PICTURES) if args.simulate else None
    got = collect(args, session, STEP, camera, bench, wanted=moved, enough=lambda c: len(c.seen) >= _PICTURES)
    found, _ = from_grid(camera, got.views, tile_m, got.tilt_rad, cov, args.height_m)
    few = [f"{len(got.seen)} pictures, at least {_FEW} needed: other places, other headings"]
    return found, {"pictures": len(got.seen), "method": "grid", "problems": few if len(got.seen) < _FEW else []}


def tile_of(args: argparse.Namespace) -> float:
    tile_m = 0.6 if args.tile_m is None and args.simulate else args.tile_m
    if tile_m is None:
        raise CalibrationError(
            "projection: found no tile size, expected --tile-m (measure one tile, joint to joint) or --points"
        )
    if 50.0 <= tile_m <= 10_000.0:
        raise CalibrationError(f"--tile-m: found {tile_m:g}, which looks like millimetres; expected {tile_m / 1e3:g}")
    if not 0.05 <= tile_m <= 10.0:
        raise CalibrationError(f"--tile-m: found {tile_m:g}, expected 0.05 to 10")
    return float(tile_m)


def _points(args: argparse.Namespace, camera: CameraModel, cov: Any) -> tuple[Mounting, dict[str, Any]]:
    from pathlib import Path

    path = Path(args.points)
    xyz, uv = read_points(path, args.units)
    reason = layout_problem(xyz, uv, (camera.width_px, camera.height_px), known_lens=True)
    if reason:
        raise CalibrationError(f"{path}: {reason}")
    found = from_points(camera, xyz, uv, cov)
    worst = np.argsort(-np.hypot(*found.residual_px.T))
    listed = [f"point {i + 1}: {np.hypot(*found.residual_px[i]):.2f} px" for i in worst[:12]]
    return found, {"method": f"points of {path}", "points": len(xyz), "points_off": listed}


def _result(m: Mounting) -> dict[str, Any]:
    return {
        "roll_rad": m.roll_rad,
        "pitch_rad": m.pitch_rad,
        "height_m": m.height_m,
        "yaw_rad": m.yaw_rad,
        "xy_m": m.xy_m,
        "sigma": m.sigma,
        "cov": m.cov,
        "rms_px": m.rms_px,
        "tile_m": m.tile_m,
        "evidence": m.evidence,
    }


def _rows(m: Mounting, extra: dict[str, Any]) -> list[tuple[str, str]]:
    s = m.sigma
    rows = [
        ("method", str(extra["method"]) + (f"; {m.evidence}" if m.evidence else "")),
        ("ceiling height", f"{m.height_m:.4f} +- {s[2]:.4f} m above the camera"),
        ("roll", f"{np.degrees(m.roll_rad):+.3f} +- {np.degrees(s[0]):.3f} deg"),
        ("pitch", f"{np.degrees(m.pitch_rad):+.3f} +- {np.degrees(s[1]):.3f} deg"),
        ("reprojection", f"{m.rms_px:.3f} px rms, {len(m.uv_px)} points"),
    ]
    if m.xy_m is not None and m.yaw_rad is not None:
        rows.append(("offset", f"{m.xy_m[0]:+.4f} +- {s[4]:.4f}, {m.xy_m[1]:+.4f} +- {s[5]:.4f} m in base"))
        rows.append(("yaw", f"{np.degrees(m.yaw_rad):+.3f} +- {np.degrees(s[3]):.3f} deg"))
    return rows + [("worst points", line) for line in extra.get("points_off", [])[:5]]
