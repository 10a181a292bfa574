"""`calib intrinsics`: the lens, from pictures of a board."""

from __future__ import annotations

import argparse
from typing import Any

import cv2
import numpy as np

from ceilvo.calib.evaluate.coverage import Light, coverage, coverage_picture, light_of, lighter
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
from ceilvo.calib.session.lens_watch import LensWatch
from ceilvo.calib.session.session import Session
from ceilvo.calib.session.views import ALIKE
from ceilvo.calib.session.watch import watch_of
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
from ceilvo.calib.targets.board import DICTIONARY, KINDS, MARKER, TAGS, Board
from ceilvo.calib.targets.finder import BoardFinder, other_board
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


def add(commands: Subcommands) -> None:
    p = add_step(
        commands,
        STEP,
        run,
        help="1. the lens, from pictures of a board ('calib board' prints one)",
        description="Hold the board everywhere in the picture, leaning every way, near and far, 15 to 30 pictures.",
        epilog="example: calib intrinsics --device /dev/video0 --board chessboard --columns 9 --rows 6 --square-mm 25",
    )
    board_options(p)
    p.add_argument(
        "--columns", type=int, default=9, help="inner corners; squares of ChArUco, tags, circles (%(default)s)"
    )
    p.add_argument("--rows", type=int, default=6, help="(%(default)s)")
    p.add_argument(
        "--square-mm", type=float, default=25.0, help="side of a square; from tag to tag, circle to circle; acircles: "
        "row to row (%(default)s)"
    )  # fmt: skip
    p.add_argument("--model", choices=("auto", *MODELS), default="auto", help="lens model (%(default)s)")
    p.add_argument("--window-px", type=from_up(1), help="half side of a corner's window; default: as the squares allow")
    p.add_argument("--keep-all", action="store_true", help="drop no picture, however large its residual")


def board_options(p: argparse.ArgumentParser) -> None:
    """What printing and finding a board have in common."""
    p.add_argument("--board", choices=KINDS, default="chessboard", help="acircles: rows shifted by half (%(default)s)")
    p.add_argument(
        "--marker-mm", type=float, help="side of a marker or a tag, diameter of a circle; default: by the board"
    )
    p.add_argument("--dictionary", help=f"of the markers ({DICTIONARY}; of an AprilGrid {TAGS})")
    p.add_argument("--legacy", action="store_true", help="ChArUco as OpenCV drew it before 4.6, where rows are even")


def run(args: argparse.Namespace) -> int:
    session = session_of(args)
    session.begin(STEP)
    board = board_of(args, args.square_mm)
    shots, size, camera_id, progress, light = _collect(args, session, board)
    progress.end()
    if len(shots) < MIN_SHOTS:
        raise CalibrationError(
            f"intrinsics: found {len(shots)} usable pictures, expected at least {MIN_SHOTS}, better 20; "
            f"they are kept in {session.folder}: take more and run the same command to go on"
        )
    progress.tell("fitting lens models")
    watch_of(args).told(f"{len(shots)} pictures: fitting lens models")
    fit, scores = fit_best(shots, size, args.model, keep_all=args.keep_all)
    progress.end()
    covered = coverage(shots, size, light)
    bad = covered.missing() + problems(fit)
    result = intrinsics_result(fit, scores, camera_id) | {
        "coverage": covered.text,
        "problems": bad,
        "verdict": "FAIL" if bad else "PASS",
        "source": str(args.images or args.device or args.config or "virtual bench"),
        "board": board.text,
    }
    session.save(STEP, result)
    session.write("intrinsics/coverage.png", _png(coverage_picture(shots, size, light=light)))
    drawn = (plots.reprojection, plots.vectors, plots.poses, plots.uncertainty)
    for plot in drawn:
        session.write(f"intrinsics/{plot.__name__}.svg", plot(fit))
    session.write("intrinsics/radial.svg", plots.radial(result["radial"]))
    print(update_file(session)) if session.result("projection") else None
    return conclude(STEP, _rows(fit, scores, covered.text), bad, args)


def board_of(args: argparse.Namespace, square_mm: float) -> Board:
    """The board of the options.

    Raises:
        CalibrationError: there is no such board.
    """
    if 0.001 <= square_mm < 1.0:
        raise CalibrationError(
            f"--square-mm: found {square_mm:g}, which looks like metres; expected {1e3 * square_mm:g}"
        )
    if args.legacy and args.board != "charuco":
        raise CalibrationError(f"--legacy: found a board of kind {args.board}, expected charuco")
    marker_mm = MARKER[args.board] * square_mm if args.marker_mm is None else args.marker_mm
    words = args.dictionary or (TAGS if args.board == "aprilgrid" else DICTIONARY)
    return Board(args.board, args.columns, args.rows, square_mm / 1e3, marker_mm / 1e3, words, args.legacy)


def _collect(
    args: argparse.Namespace, session: Session, board: Board
) -> tuple[list[Shot], tuple[int, int], str, Progress, Light | None]:
    """Shots of this run and of the interrupted one before it, on disk as soon as they are found."""
    progress, finder, watch = Progress(STEP), BoardFinder(board, args.window_px), LensWatch(watch_of(args), STEP)
    bench = bench_of(args).board(board, _SIMULATED) if args.simulate else None
    with pictures(args, bench) as source:
        subject = board.subject | {"source": source.info.name, "window_px": args.window_px}
        shots, size, done, light = kept(session, board, subject)
        if source.info.live:
            progress.note(f"{session.folder / 'intrinsics' / 'live.png'} shows what is covered, anew with each picture")
        if done:
            progress.note(f"going on with {len(shots)} pictures of the run before")
        seen = rejected = alike = 0
        unseen: list[Picture] = []
        for picture in source:
            for index in watch.dropped():
                session.drop_sample(STEP, index)
                del shots[index]
            if watch.ended:
                break
            seen += 1
            if picture.name in done and not source.info.live:
                continue
            reason = picture.problem or check_size(picture, size, "the others are")
            if not reason:
                sighting = finder(picture.gray)
                reason = sighting.reason
                new = not sighting.ok or not source.info.filmed
                if not new and not _is_new(board, shots, sighting.ids, sighting.uv_px, picture):
                    alike += 1
                    progress.tell(f"{len(shots)} taken; move the board")
                    watch(picture, ALIKE, sighting.uv_px, shots, light)
                    continue
            if reason:
                rejected += 1
                if not source.info.live:
                    progress.note(f"{picture.name}: rejected, {reason}")
                progress.tell(f"{len(shots)} taken; {reason}")
                watch(picture, reason, None, shots, light)
                if "not seen" in reason and len(unseen) < 3:
                    unseen.append(picture)
            else:
                h, w = picture.gray.shape
                size = (w, h)
                here = light_of(picture.gray)
                record = {
                    "name": picture.name,
                    "width_px": w,
                    "height_px": h,
                    "ids": sighting.ids,
                    "uv_px": sighting.uv_px,
                    "light": here,
                }
                session.add_sample(STEP, record)
                shots.append(Shot(picture.name, board.corners_m[sighting.ids], sighting.uv_px))
                light = lighter(light, here) if light is not None or len(shots) == 1 else None
                covered = coverage(shots, size, light)
                progress.tell(f"{len(shots)} taken, {rejected} rejected; {covered.text}")
                watch(picture, "", sighting.uv_px, shots, light, covered)
                if source.info.live:
                    session.write("intrinsics/live.png", _png(coverage_picture(shots, size, picture.gray, light)))
                    if (len(shots) >= _LIVE_ENOUGH and not covered.missing()) or len(shots) >= _LIVE_MOST:
                        break
            if source.info.live and seen >= _LIVE_FRAMES:
                break
        _explain_nothing(shots, unseen, board, seen, rejected)
        if size is None:
            raise CalibrationError(f"{source.info.name}: found no usable picture among {seen}")
        left_out = f", {alike} left out that are like others" if alike and not source.info.live else ""
        progress.note(f"{len(shots)} pictures used, {rejected} rejected{left_out}")
        return shots, size, source.info.camera_id, progress, light


def _explain_nothing(shots: list[Shot], unseen: list[Picture], board: Board, seen: int, rejected: int) -> None:
    if shots:
        return
    other = next((o for o in (other_board(board, p.gray) for p in unseen) if o), "")
    if other:
        raise CalibrationError(f"intrinsics: found a board of {other} of the board that is used")
    raise CalibrationError(
        f"intrinsics: found the {board.text} in none of {seen} pictures ({rejected} rejected, reasons above); "
        "the whole board must be in the picture, flat, in focus and evenly lit"
    )


def kept(
    session: Session, board: Board, subject: dict[str, Any]
) -> tuple[list[Shot], tuple[int, int] | None, set[str], Light | None]:
    """Shots of an interrupted run, the size of its pictures, their names, and the most light in each part of them.

    Raises:
        CalibrationError: they are of something else, or damaged.
    """
    records = session.samples(STEP, subject)
    with session.reading_samples(STEP):
        shots = [_shot(board, record) for record in records if record.get("ids")]
        size = (int(records[0]["width_px"]), int(records[0]["height_px"])) if records else None
        light = None
        if records and all("light" in record for record in records):  # older runs kept none
            for record in records:
                light = lighter(light, np.array(record["light"], np.int64))
        return shots, size, {str(record["name"]) for record in records}, light


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
