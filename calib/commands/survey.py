"""`calib survey`: drive or push the robot through the room once and learn what its ceiling is worth."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from ceilvo.calib.evaluate.survey import Survey, flicker
from ceilvo.calib.session.assemble import identity, update_file
from ceilvo.calib.session.common import (
    Progress,
    Subcommands,
    add_step,
    bench_of,
    calibration_of,
    conclude,
    frames_of,
    pictures,
    session_of,
)
from ceilvo.calib.session.session import Session
from ceilvo.calib.session.watch import Look, Watch, watch_of
from ceilvo.calib.targets.sources import Picture
from ceilvo.calibration import Calibration
from ceilvo.config import Config
from ceilvo.daemon.integrity.staleness import STRETCH_S, worst_stretch
from ceilvo.daemon.pipeline import Pipeline
from ceilvo.errors import CalibrationError
from ceilvo.types import Frame

STEP = "survey"
_SIMULATED = 240
"""Frames of the virtual bench, one lap."""


def add(commands: Subcommands) -> None:
    p = add_step(
        commands,
        STEP,
        run,
        help="5. is the ceiling good enough? drive through the room once",
        description="Drive or push the robot once through all of the room; Ctrl-C ends it and gives the verdict.",
        epilog="example: calib survey --config /etc/ceilvo/config.yaml",
    )
    p.add_argument("--calibration", type=Path, metavar="FILE", help="default: the session's calibration.yaml")
    p.add_argument("--seconds", type=float, default=300.0, help="longest live drive (%(default)s)")


def run(args: argparse.Namespace) -> int:
    session = session_of(args)
    session.begin(STEP)
    _, calibration = calibration_of(args)
    survey, ended = _drive(args, calibration)
    light = flicker(survey.light)
    bad = survey.problems()
    _save(session, survey, calibration, light.text, bad)
    print(update_file(session))
    rows = [
        ("drive", f"{len(survey.path)} frames, {len(survey.cells)} places of 0.5 m{', ended early' if ended else ''}"),
        ("crossings", f"{survey.density:.1f} a square metre"),
        ("ambiguity", f"{100 * survey.ambiguity:.0f} % of what is seen is the same one tile on"),
        ("poor places", f"{len(survey.poor())}"),
        ("dark places", f"{len(survey.dark())}"),
        ("vision failed", f"{100 * survey.failed:.1f} % of the frames"),
        ("NIS", _nis_text(survey.mean_nis, worst_stretch(survey.nis))),
        ("flicker", light.text),
        ("map", str(session.folder / "survey" / "map.png")),
    ]
    return conclude(STEP, rows + [("note", n) for n in survey.notes()], bad, args)


def _nis_text(mean: float | None, worst: float | None) -> str:
    if mean is None or worst is None:
        return "too few updates"
    return f"{mean:.2f} per degree of freedom, {worst:.2f} in the worst {STRETCH_S:.0f} s"


def _drive(args: argparse.Namespace, calibration: Calibration) -> tuple[Survey, bool]:
    """All frames through the daemon's own pipeline; whether Ctrl-C ended it."""
    progress, survey, watch = Progress(STEP), Survey(calibration), watch_of(args)
    pipeline = Pipeline(calibration, Config(), np.random.default_rng(args.seed))
    bench = bench_of(args).drive(_SIMULATED) if args.simulate else None
    with pictures(args, bench) as source:
        try:
            for frame in frames_of(source, calibration.camera, args.seconds, progress):
                estimate = pipeline.step(frame)
                view = pipeline.vision.view
                ok = estimate.motion.ok or not survey.path
                survey.add(frame.gray, estimate, view.crossings if view else None, ok)
                progress.tell(f"{len(survey.path)} frames, {len(survey.cells)} places, {estimate.crossings} crossings")
                seen = None if view is None else view.crossings
                _tell(watch, survey, frame, np.zeros((0, 2)) if seen is None else seen.uv_px)
                if watch.ended:
                    break
            ended = watch.ended
        except KeyboardInterrupt:
            if not survey.path:
                raise
            ended = True
    progress.end()
    if len(survey.path) < 10:
        raise CalibrationError(f"survey: found {len(survey.path)} usable frames, at least 10 needed; drive on")
    return survey, ended


def _tell(watch: Watch, survey: Survey, frame: Frame, uv_px: NDArray[np.float64]) -> None:
    if not watch.present:
        return
    picture = Picture(f"frame {frame.seq}", frame.stamp_ns, frame.gray)
    facts = {"frames": len(survey.path), "places": len(survey.cells)}
    watch.looked(Look(STEP, picture, "", True, uv_px, (), facts, "drive once through all of the room"))


def _save(session: Session, survey: Survey, calibration: Calibration, light: str, bad: list[str]) -> None:
    ok, png = cv2.imencode(".png", survey.picture())
    if ok:
        session.write("survey/map.png", png.tobytes())
    result: dict[str, Any] = {
        "frames": len(survey.path),
        "places": len(survey.cells),
        "crossings_per_m2": survey.density,
        "ambiguity": survey.ambiguity,
        "poor_places": len(survey.poor()),
        "dark_places": len(survey.dark()),
        "failed_share": survey.failed,
        "nis": worst_stretch(survey.nis),
        "mean_nis": survey.mean_nis,
        "of": identity(calibration.projection, calibration.noise),
        "flicker": light,
        "notes": survey.notes(),
        "problems": bad,
        "verdict": "FAIL" if bad else "PASS",
    }
    session.save(STEP, result)
