"""`calib shutter`: how the camera reads its rows, from a pan over the ceiling."""

from __future__ import annotations

import argparse
from pathlib import Path

from ceilvo.calib.evaluate.shutter import measure
from ceilvo.calib.session.assemble import update_file
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
from ceilvo.calibration import Calibration
from ceilvo.errors import CalibrationError
from ceilvo.types import Frame

STEP = "shutter"
_MOST_FRAMES = 300
"""Kept in memory: ten seconds at 30 Hz."""


def add(commands: Subcommands) -> None:
    p = add_step(
        commands,
        STEP,
        run,
        help="for robots that turn fast, after mount: does the camera read row by row, how long, which way?",
        description="Turn the robot to and fro on the spot for some seconds, at 0.5 rad/s or more, under the ceiling. "
        "The time between the rows under which lines are straightest is the camera's.",
        epilog="example: calib shutter --config /etc/ceilvo/config.yaml; recorded: --images DIR with frames.csv in it, "
        "because times count",
    )
    p.add_argument("--calibration", type=Path, metavar="FILE", help="default: the session's calibration.yaml")
    p.add_argument("--seconds", type=float, default=6.0, help="of a live pan (%(default)s)")


def run(args: argparse.Namespace) -> int:
    session = session_of(args)
    session.begin(STEP)
    _, calibration = calibration_of(args)
    frames = _frames(args, calibration)
    found = measure(calibration, frames)
    bad = found.problems()
    result = {"readout_s": found.readout_s if found.rolls else 0.0, "sigma_s": found.sigma_s}
    session.save(STEP, result | {"frames": found.frames, "problems": bad, "verdict": "FAIL" if bad else "PASS"})
    print(update_file(session))
    rows = [
        ("pan", f"{len(frames)} frames, {found.frames} used, corners at {found.speed_ps:.2f} focal lengths a second"),
        ("shutter", found.text),
    ]
    return conclude(STEP, rows, bad, args)


def _frames(args: argparse.Namespace, calibration: Calibration) -> list[Frame]:
    progress = Progress(STEP)
    out: list[Frame] = []
    with pictures(args, bench_of(args).pan() if args.simulate else None) as source:
        for frame in frames_of(source, calibration.camera, args.seconds, progress):
            out.append(frame)
            progress.tell(f"{len(out)} frames; go on turning")
            if len(out) == _MOST_FRAMES:
                break
    progress.end()
    if len(out) < 2:
        raise CalibrationError(f"shutter: found {len(out)} usable frames, a pan of some seconds needed")
    return out
