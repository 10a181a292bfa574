"""`calib intrinsics`: the lens, from pictures of a board."""

from __future__ import annotations

import argparse
from typing import Any

import cv2
import numpy as np

from ceilvo.calib.evaluate.coverage import coverage, coverage_picture
from ceilvo.calib.session import plots
from ceilvo.calib.session.assemble import intrinsics_result, update_file
from ceilvo.calib.session.common import (
    Progress,
    Subcommands,
    add_step,
    bench_of,
    check_size,
    conclude,
    pictures,
    session_of,
)
from ceilvo.calib.session.session import Session
from ceilvo.calib.solve.intrinsics import (
    MIN_SHOTS,
    MODELS,
    NAMES,
    Intrinsics,
    Shot,
    board_pose,
    fit_best,
    problems,
)
from ceilvo.calib.solve.lens import guessed_camera
from ceilvo.calib.targets.board import Board, BoardFinder, other_board
from ceilvo.calib.targets.sources import Picture
from ceilvo.config.arguments import from_up
from ceilvo.errors import CalibrationError

STEP = "intrinsics"
_SIMULATED = 26
"""Pictures of the virtual bench: enough for every gate."""
_LIVE_MOST = 60
"""Pictures at which a live run ends in any case."""
_LIVE_FRAMES = 20_000
"""Frames looked at; 11 minutes at 30 Hz."""
_NEW_VIEW = 0.12
"""Distance over distance, or rad, by which a live view of the board must differ from those taken."""
_LIVE_ENOUGH = 15
"""Pictures at which a live run ends when the picture is covered."""
_MARKER = 0.72
"""Of a ChArUco square, that its marker fills; chosen."""


def add(commands: Subcommands) -> None:
    p = add_step(
        commands,
        STEP,
        run,
        help="1. the lens, from pictures of a chessboard or ChArUco board",
        description="Hold the board everywhere in the picture, leaning every way, near and far, 15 to 30 pictures.",
        epilog="example: calib intrinsics --device /dev/video0 --board chessboard --columns 9 --rows 6 --square-mm 25",
    )
    p.add_argument("--board", choices=("chessboard", "charuco"), default="chessboard")
    p.add_argument("--columns", type=int, default=9, help="inner corners; of ChArUco: squares (%(default)s)")
    p.add_argument("--rows", type=int, default=6, help="(%(default)s)")
    p.add_argument("--square-mm", type=float, default=25.0, help="side of a square (%(default)s)")
    p.add_argument("--marker-mm", type=float, help="side of a ChArUco marker (0.72 of the square)")
    p.add_argument("--dictionary", default="5X5_100", help="of the markers (%(default)s)")
    p.add_argument("--model", choices=("auto", *MODELS), default="auto", help="lens model (%(default)s)")
    p.add_argument("--window-px", type=from_up(1), help="half side of a corner's window; default: as the squares allow")
    p.add_argument("--keep-all", action="store_true", help="drop no picture, however large its residual")


def run(args: argparse.Namespace) -> int:
    session = session_of(args)
    session.begin(STEP)
    board = _board(args)
    shots, size, camera_id, progress = _collect(args, session, board)
    progress.end()
    if len(shots) < MIN_SHOTS:
        raise CalibrationError(
            f"intrinsics: found {len(shots)} usable pictures, expected at least {MIN_SHOTS}, better 20; "
            f"they are kept in {session.folder}: take more and run the same command to go on"
        )
    progress.tell("fitting lens models")
    fit, scores = fit_best(shots, size, args.model, keep_all=args.keep_all)
    progress.end()
    covered = coverage(shots, size)
    bad = covered.missing() + problems(fit)
    result = intrinsics_result(fit, scores, camera_id) | {
        "coverage": covered.text,
        "problems": bad,
        "verdict": "FAIL" if bad else "PASS",
        "source": str(args.images or args.device or args.config or "virtual bench"),
        "board": board.text,
    }
    session.save(STEP, result)
    session.write("intrinsics/coverage.png", _png(coverage_picture(shots, size)))
    plots.save(session, "intrinsics/radial.svg", plots.radial(result["radial"]))
    print(update_file(session)) if session.result("projection") else None
    return conclude(STEP, _rows(fit, scores, covered.text), bad, args)


def _board(args: argparse.Namespace) -> Board:
    if 0.001 <= args.square_mm < 1.0:
        raise CalibrationError(
            f"--square-mm: found {args.square_mm:g}, which looks like metres; expected {1e3 * args.square_mm:g}"
        )
    square = args.square_mm / 1e3
    marker = (args.marker_mm or _MARKER * args.square_mm) / 1e3
    return Board(args.board, args.columns, args.rows, square, marker, args.dictionary)


def _collect(
    args: argparse.Namespace, session: Session, board: Board
) -> tuple[list[Shot], tuple[int, int], str, Progress]:
    """Shots of this run and of the interrupted one before it, on disk as soon as they are found."""
    progress, finder = Progress(STEP), BoardFinder(board, args.window_px)
    bench = bench_of(args).board(board, _SIMULATED) if args.simulate else None
    with pictures(args, bench) as source:
        subject = board.subject | {"source": source.info.name, "window_px": args.window_px}
        shots, size, done = kept(session, board, subject)
        if source.info.live:
            progress.note(f"{session.folder / 'intrinsics' / 'live.png'} shows what is covered, anew with each picture")
        if done:
            progress.note(f"going on with {len(shots)} pictures of the run before")
        seen = rejected = 0
        unseen: list[Picture] = []
        for picture in source:
            seen += 1
            if picture.name in done and not source.info.live:
                continue
            reason = picture.problem or check_size(picture, size, "the others are")
            if not reason:
                sighting = finder(picture.gray)
                reason = sighting.reason
                if (
                    sighting.ok
                    and source.info.live
                    and not _is_new(board, shots, sighting.ids, sighting.uv_px, picture)
                ):
                    progress.tell(f"{len(shots)} taken; move the board")
                    continue
            if reason:
                rejected += 1
                if not source.info.live:
                    progress.note(f"{picture.name}: rejected, {reason}")
                progress.tell(f"{len(shots)} taken; {reason}")
                if "not seen" in reason and len(unseen) < 3:
                    unseen.append(picture)
            else:
                h, w = picture.gray.shape
                size = (w, h)
                record = {
                    "name": picture.name,
                    "width_px": w,
                    "height_px": h,
                    "ids": sighting.ids,
                    "uv_px": sighting.uv_px,
                }
                session.add_sample(STEP, record)
                shots.append(Shot(picture.name, board.corners_m[sighting.ids], sighting.uv_px))
                covered = coverage(shots, size)
                progress.tell(f"{len(shots)} taken, {rejected} rejected; {covered.text}")
                if source.info.live:
                    session.write("intrinsics/live.png", _png(coverage_picture(shots, size, picture.gray)))
                    if (len(shots) >= _LIVE_ENOUGH and not covered.missing()) or len(shots) >= _LIVE_MOST:
                        break
            if source.info.live and seen >= _LIVE_FRAMES:
                break
        _explain_nothing(shots, unseen, board, seen, rejected)
        if size is None:
            raise CalibrationError(f"{source.info.name}: found no usable picture among {seen}")
        progress.note(f"{len(shots)} pictures used, {rejected} rejected")
        return shots, size, source.info.camera_id, progress


def _explain_nothing(shots: list[Shot], unseen: list[Picture], board: Board, seen: int, rejected: int) -> None:
    if shots:
        return
    other = next((o for o in (other_board(p.gray) for p in unseen) if o), "") if board.kind == "chessboard" else ""
    if other:
        raise CalibrationError(
            f"intrinsics: found a board of {other} inner corners, expected {board.columns} x {board.rows}; "
            "give --columns and --rows of the board that is used"
        )
    raise CalibrationError(
        f"intrinsics: found the {board.text} in none of {seen} pictures ({rejected} rejected, reasons above); "
        "the whole board must be in the picture, flat, in focus and evenly lit"
    )


def kept(
    session: Session, board: Board, subject: dict[str, Any]
) -> tuple[list[Shot], tuple[int, int] | None, set[str]]:
    """Shots of an interrupted run, the size of its pictures and their names.

    Raises:
        CalibrationError: they are of something else, or damaged.
    """
    records = session.samples(STEP, subject)
    with session.reading_samples(STEP):
        shots = [_shot(board, record) for record in records if record.get("ids")]
        size = (int(records[0]["width_px"]), int(records[0]["height_px"])) if records else None
        return shots, size, {str(record["name"]) for record in records}


def _shot(board: Board, record: dict[str, Any]) -> Shot:
    ids, uv = np.array(record["ids"]), np.array(record["uv_px"], np.float64)
    if uv.shape != (len(ids), 2) or not np.isfinite(uv).all() or ids.min() < 0 or len(np.unique(ids)) < len(ids):
        raise ValueError(f"{len(ids)} corners with places {uv.shape}, or one twice")
    return Shot(str(record["name"]), board.corners_m[ids], uv)


def _is_new(board: Board, shots: list[Shot], ids: Any, uv: Any, picture: Picture) -> bool:
    """Whether a live view differs from those taken: by a tenth of the picture, or in the way the board leans."""
    if not shots:
        return True
    h, w = picture.gray.shape
    guess = guessed_camera((w, h))
    pose = board_pose(guess, Shot("", board.corners_m[ids], uv))
    for shot in shots:
        other = board_pose(guess, shot)
        moved = np.linalg.norm(pose[3:] - other[3:]) / max(float(np.linalg.norm(pose[3:])), 1e-6)
        turn = cv2.Rodrigues(cv2.Rodrigues(pose[:3])[0] @ cv2.Rodrigues(other[:3])[0].T)[0]
        if moved < _NEW_VIEW and float(np.linalg.norm(turn)) < _NEW_VIEW:
            return False
    return True


def _rows(fit: Intrinsics, scores: dict[str, float], covered: str) -> list[tuple[str, str]]:
    c, s = fit.camera, fit.sigma
    rows = [
        ("lens model", fit.model + ("" if not scores else " chosen; rms of pictures left out: " + _scores(scores))),
        ("focal length", f"{c.fx_px:.3f} +- {s[0]:.3f}, {c.fy_px:.3f} +- {s[1]:.3f} px"),
        ("principal point", f"{c.cx_px:.3f} +- {s[2]:.3f}, {c.cy_px:.3f} +- {s[3]:.3f} px"),
        (
            "distortion",
            ", ".join(f"{n} {k:.5f} +- {e:.5f}" for n, k, e in zip(NAMES[fit.model], c.distortion, s[4:], strict=True)),
        ),
        ("pictures", f"{len(fit.shots)} used, {len(fit.dropped)} dropped"),
        ("rms", f"{fit.rms_px:.3f} px; worst picture {fit.shot_rms_px.max():.3f} px"),
        ("coverage", covered),
    ]
    return rows + [("dropped", f"{name}: {reason}") for name, reason in fit.dropped]


def _scores(scores: dict[str, float]) -> str:
    return ", ".join(f"{m} {v:.3f} px" if np.isfinite(v) else f"{m} does not fit" for m, v in scores.items())


def _png(image: Any) -> bytes:
    return bytes(cv2.imencode(".png", image)[1].tobytes())
