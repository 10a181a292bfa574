"""`calib projection`: static tilt and ceiling height, from the ceiling's grid or from measured points."""

from __future__ import annotations

import argparse
import itertools
import sys
from dataclasses import asdict
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from ceilvo.calib.evaluate import scale
from ceilvo.calib.session.assemble import camera_from, update_file, vectors
from ceilvo.calib.session.common import (
    Subcommands,
    add_step,
    bench_of,
    check_size,
    conclude,
    pictures,
    session_of,
)
from ceilvo.calib.session.session import Session
from ceilvo.calib.session.views import Collection, collect, moved
from ceilvo.calib.session.watch import watch_of
from ceilvo.calib.solve.degeneracy import layout_problem
from ceilvo.calib.solve.dlt import from_points_alone
from ceilvo.calib.solve.grid import from_grid
from ceilvo.calib.solve.joint import Joint
from ceilvo.calib.solve.projection import Mounting, from_points, plausible
from ceilvo.calib.solve.tile_grid import USUAL_TILE_M
from ceilvo.calib.targets.click_page import ClickPage
from ceilvo.calib.targets.marks import Click, clicked, detected, read_marks, together
from ceilvo.calib.targets.points_file import ask_on_terminal, read_points
from ceilvo.calibration_check import HEIGHTS_M, TILES_M
from ceilvo.camera import CameraModel
from ceilvo.errors import CalibrationError

Array = NDArray[np.float64]

Spans: TypeAlias = tuple[list[tuple[Array, Array]], float]

STEP = "projection"
_LOOKS = 10
"""Live pictures in which markers are looked for; chosen: their mean has a third of a corner's noise."""
_PICTURES = 20
"""Of the grid; chosen: beyond them sigma shrinks by less than a fifth for half as many again."""
_FEW = 5
"""Below it the pictures' own scatter, from which sigma comes, is not known."""
_MILLIMETRES = (50.0, 10_000.0)
"""A tile or a height in this range can only be millimetres: no tile has 50 m, no ceiling hangs at 50 m."""
_LISTED, _SHOWN = 12, 5
"""Worst points in the result and on the screen."""
_SIZES_PX = (16, 16_384)
"""Of a picture: --size is wrong beyond them."""


def add(commands: Subcommands) -> None:
    p = add_step(
        commands,
        STEP,
        run,
        help="2. tilt and ceiling height, from the tiled ceiling itself or from measured points",
        description="Put the robot under the tiled ceiling in 10 to 20 places, turned differently; or measure points.",
        epilog="example: calib projection --device /dev/video0 --tile-m 0.6; "
        "points: CSV x_m,y_m,z_m,u_px,v_px, x and y in base, z 0 on the ceiling and negative below, raw pixels",
    )
    p.add_argument("--tile-m", type=float, help=f"side of the ceiling's tiles; simulated: {USUAL_TILE_M:g}")
    p.add_argument(
        "--height-m",
        type=float,
        help="ceiling above the lens by tape, to a centimetre: confirms the scale, and decides where two grids fit",
    )
    p.add_argument("--points", type=Path, metavar="CSV", help="measured points instead of the grid")
    p.add_argument(
        "--marks", type=Path, metavar="CSV", help="measured marks on the ceiling, x_m,y_m[,z_m] in base, to be clicked "
        "in a browser; with a column id they are ArUco markers and are found. With --tile-m two are enough: the way "
        "between them confirms the scale"
    )  # fmt: skip
    p.add_argument("--dictionary", default="5X5_100", help="of the markers (%(default)s)")
    p.add_argument("--listen", default="127.0.0.1:0", metavar="HOST:PORT", help="of the page to click in (%(default)s)")
    p.add_argument("--units", choices=("m", "mm"), help="of the CSV, when it is doubtful")
    p.add_argument(
        "--size", metavar="WxH", help="points without 'calib intrinsics', of a lens without distortion: the picture, px"
    )


def run(args: argparse.Namespace) -> int:
    _checked_height(args.height_m)
    session = session_of(args)
    session.begin(STEP)
    if args.size is not None:
        found, camera, extra = _without_lens(args, session)
    else:
        camera, cov = camera_from(session.need("intrinsics", "the projection"))
        measured = args.points or (args.marks and args.tile_m is None)
        found, extra = _points(args, session, camera, cov) if measured else _grid(args, session, camera, cov)
    scales = _scales(args, found, camera, extra.pop("spans", None))
    wrong = [p for p in (scale.problem(s, found.tile_m) for s in scales) if p]
    bad = plausible(found) + extra.pop("problems", []) + wrong
    extra["scale"] = scale.kept(scales)
    session.save(STEP, _result(found) | extra | {"problems": bad, "verdict": "FAIL" if bad else "PASS"})
    print(update_file(session))
    return conclude(STEP, _rows(found, extra) + _scale_rows(scales, found.tile_m), bad, args)


def _scales(args: argparse.Namespace, found: Mounting, camera: CameraModel, spans: Spans | None) -> list[scale.Scale]:
    """What second sources say of the scale."""
    out = []
    if args.height_m is not None:
        out.append(scale.by_height(found.height_m, float(found.sigma[2]), args.height_m))
    if spans is not None:
        level = np.array([found.roll_rad, found.pitch_rad, found.height_m])
        lens = camera if found.joint is None or not found.joint.agrees else found.joint.camera
        marked = scale.by_marks(lens, level, *spans)
        if marked is None:
            raise CalibrationError(f"{args.marks}: found no two marks in different places, expected two or more")
        out.append(marked)
    return out


def _scale_rows(scales: list[scale.Scale], tile_m: float | None) -> list[tuple[str, str]]:
    state, texts = scale.summary(scales)
    if tile_m is not None and state == "unconfirmed":
        texts = [*texts, scale.tile_alone(tile_m)]
    return [("scale", text) for text in texts]


def _grid(args: argparse.Namespace, session: Session, camera: CameraModel, cov: Any) -> tuple[Mounting, dict[str, Any]]:
    tile_m = tile_of(args)
    spans = None if args.marks is None else _spans(args, (camera.width_px, camera.height_px))
    bench = bench_of(args).places(_PICTURES) if args.simulate else None
    got = collect(
        args, session, STEP, camera, bench, wanted=moved, enough=lambda c: len(c.seen) >= _PICTURES,
        ask=f"put the robot elsewhere, turned differently, {_PICTURES} places in all",
    )  # fmt: skip
    found, _ = from_grid(camera, got.views, tile_m, got.tilt_rad, cov, args.height_m)
    few = [f"{len(got.seen)} pictures, at least {_FEW} needed: other places, other headings"]
    extra: dict[str, Any] = {"pictures": len(got.seen), "method": "grid", "spans": spans, "shots": _each(found, got)}
    if found.joint is not None and found.joint.agrees:
        extra["lens"] = _lens(found.joint, session.need("intrinsics", "the projection"))
    return found, extra | {"problems": few if len(got.seen) < _FEW else []}


def _each(found: Mounting, got: Collection) -> list[dict[str, Any]]:
    """rms of each picture that counts, px of one coordinate; the fit keeps the crossings' pixels as they were."""
    mine = [np.isin(found.uv_px[:, 0], s.view.uv_px[:, 0]) for s in got.seen]
    rms = [float(np.sqrt(np.mean(found.residual_px[m] ** 2))) if m.any() else None for m in mine]
    return [{"name": s.name, "rms_px": r} for s, r in zip(got.seen, rms, strict=True) if r is not None]


def _spans(args: argparse.Namespace, size: tuple[int, int]) -> Spans:
    """Pictures of two marks or more on the ceiling, and sigma of a mark's place in them, px."""
    if args.simulate:
        xyz, clicks = _practised(args)
        return [(xyz, clicks)], scale.CLICK_PX
    marks = read_marks(args.marks, args.units, ask_on_terminal)
    with pictures(args, None) as source:
        usable = (p for p in source if not p.problem and not check_size(p, size, "the lens has"))
        if marks.ids is not None:
            some = itertools.islice(usable, _LOOKS) if source.info.live else usable
            return together(marks, some, args.dictionary), scale.MARKER_PX
        some = itertools.islice(usable, _LOOKS if source.info.live else 1)  # a robot that stands, or the first picture
        xyz, uv, _ = clicked(marks, some, _click(args))
    return [(xyz, uv)], scale.CLICK_PX


def _practised(args: argparse.Namespace) -> tuple[Array, Array]:
    """xyz_m (N, 3) and clicks (N, 2) of the virtual bench's own marks; the page shows how far off each click was."""
    gray, xyz, true_px = bench_of(args).marks()
    print(f"{STEP}: practice: the virtual bench's own marks, not those of {args.marks}", file=sys.stderr)
    names = [f"the disc at {x:+.2f}, {y:+.2f} m" for x, y, _ in xyz]
    return xyz, _click(args)(gray, names, true_px)


def _click(args: argparse.Namespace) -> Click:
    return watch_of(args).click() or ClickPage(args.listen)


def _checked_height(height_m: float | None) -> None:
    low, high = HEIGHTS_M
    if height_m is None or low <= height_m <= high:
        return
    if height_m > _MILLIMETRES[0]:
        raise CalibrationError(
            f"--height-m: found {height_m:g}, which looks like millimetres; expected {height_m / 1e3:g}"
        )
    raise CalibrationError(f"--height-m: found {height_m:g}, expected {low:g} to {high:g}, above the camera's lens")


def _lens(joint: Joint, board: dict[str, Any]) -> dict[str, Any]:
    """As `calib intrinsics` has it; of says which lens it was refined from."""
    sigma = np.sqrt(np.diag(joint.lens_cov))
    if "model" not in board or "camera" not in board:
        raise CalibrationError("intrinsics.json: found no model or camera; run 'calib intrinsics' again with --force")
    return {
        "camera": asdict(joint.camera), "model": board["model"], "sigma": sigma, "cov": joint.lens_cov,
        "of": board["camera"],
    }  # fmt: skip


def tile_of(args: argparse.Namespace) -> float:
    tile_m = USUAL_TILE_M if args.tile_m is None and args.simulate else args.tile_m
    if tile_m is None:
        raise CalibrationError(
            "projection: found no tile size, expected --tile-m (measure one tile, joint to joint) or --points"
        )
    if _MILLIMETRES[0] <= tile_m <= _MILLIMETRES[1]:
        raise CalibrationError(f"--tile-m: found {tile_m:g}, which looks like millimetres; expected {tile_m / 1e3:g}")
    low, high = TILES_M
    if not low <= tile_m <= high:
        raise CalibrationError(f"--tile-m: found {tile_m:g}, expected {low:g} to {high:g}")
    return float(tile_m)


def _points(
    args: argparse.Namespace, session: Session, camera: CameraModel, cov: Any
) -> tuple[Mounting, dict[str, Any]]:
    size = (camera.width_px, camera.height_px)
    xyz, uv, how = _measured(args, session, size)
    _sound(how, xyz, uv, size, known_lens=True)
    return _of_points(from_points(camera, xyz, uv, cov), how)


def _measured(args: argparse.Namespace, session: Session, size: tuple[int, int]) -> tuple[Array, Array, str]:
    """xyz_m and uv_px of measured points, and where from; marks that were found or clicked are kept as such."""
    if args.points is not None:
        return *read_points(args.points, args.units), f"points of {args.points}"
    if args.simulate:
        return *_practised(args), "marks clicked for practice"
    marks = read_marks(args.marks, args.units, ask_on_terminal)
    with pictures(args, None) as source:
        usable = (p for p in source if not p.problem and not check_size(p, size, "the lens has"))
        some = itertools.islice(usable, _LOOKS) if source.info.live else usable
        if marks.ids is None:
            xyz, uv, count = clicked(marks, some, _click(args))
        else:
            xyz, uv, count = detected(marks, some, args.dictionary, least=4)
    rows = "\n".join(",".join(f"{v:.4f}" for v in row) for row in np.column_stack([xyz, uv]))
    kept = session.write("projection/points.csv", f"x_m,y_m,z_m,u_px,v_px\n{rows}\n")
    return (
        xyz,
        uv,
        f"{len(xyz)} marks {'clicked' if marks.ids is None else 'found'} in {count} pictures, kept in {kept}",
    )


def _sound(how: str, xyz: Array, uv: Array, size: tuple[int, int], known_lens: bool) -> None:
    reason = layout_problem(xyz, uv, size, known_lens)
    if reason:
        raise CalibrationError(f"{how}: {reason}")


def _of_points(found: Mounting, how: str) -> tuple[Mounting, dict[str, Any]]:
    off = np.hypot(*found.residual_px.T)
    listed = [f"point {i + 1}: {off[i]:.2f} px" for i in np.argsort(-off)[:_LISTED]]
    return found, {"method": how, "points": len(off), "points_off": listed}


def _without_lens(args: argparse.Namespace, session: Session) -> tuple[Mounting, CameraModel, dict[str, Any]]:
    """A lens that is not in the session yet comes from the points as well, without distortion."""
    if args.points is None and args.marks is None:
        raise CalibrationError("--size: found neither --points nor --marks; without them 'calib intrinsics' is needed")
    w, _, h = args.size.partition("x")
    if not (w.isdigit() and h.isdigit() and all(_SIZES_PX[0] <= int(v) <= _SIZES_PX[1] for v in (w, h))):
        raise CalibrationError(f"--size: found {args.size!r}, expected WIDTHxHEIGHT, for example 640x480")
    if session.result("intrinsics") is not None and not session.force:
        raise CalibrationError(
            f"--size: found a lens in {session.folder} already, expected none; leave --size out, "
            "or pass --force to replace it"
        )
    size = (int(w), int(h))
    xyz, uv, how = _measured(args, session, size)
    _sound(how, xyz, uv, size, known_lens=False)
    found, camera, cov = from_points_alone(xyz, uv, size)
    lens = {
        "camera": asdict(camera), "camera_id": "", "model": "pinhole", "sigma": np.sqrt(np.diag(cov)), "cov": cov,
        "rms_px": found.rms_px, "source": how, "problems": [], "verdict": "PASS",
    }  # fmt: skip
    session.save("intrinsics", lens)
    found, extra = _of_points(found, f"{how}, lens unknown: DLT, without distortion")
    return found, camera, extra


def _lens_text(joint: Joint) -> str:
    moved = f"{np.sqrt(joint.moved):.1f} of the board's sigma (rms)"
    if not joint.agrees:
        return f"as from the board; the grid would move it by {moved}: do tiles sag, are they uneven, did focus change?"
    c, s = joint.camera, np.sqrt(np.diag(joint.lens_cov))
    return (
        f"refined on the grid, by {moved}: focal length {c.fx_px:.3f} +- {s[0]:.3f}, {c.fy_px:.3f} +- {s[1]:.3f} px, "
        f"centre {c.cx_px:.3f} +- {s[2]:.3f}, {c.cy_px:.3f} +- {s[3]:.3f} px"
    )


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
        "vectors": vectors(m.uv_px, m.residual_px),
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
    if m.joint is not None:
        rows.append(("lens", _lens_text(m.joint)))
    if m.xy_m is not None and m.yaw_rad is not None:
        rows.append(("offset", f"{m.xy_m[0]:+.4f} +- {s[4]:.4f}, {m.xy_m[1]:+.4f} +- {s[5]:.4f} m in base"))
        rows.append(("yaw", f"{np.degrees(m.yaw_rad):+.3f} +- {np.degrees(s[3]):.3f} deg"))
    return rows + [("worst points", line) for line in extra.get("points_off", [])[:_SHOWN]]
