"""`calib mount`: the camera's offset and yaw in base, from a spin and a straight run."""

from __future__ import annotations

import argparse
import copy
import sys
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ceilvo.calib.evaluate import scale
from ceilvo.calib.session import plots
from ceilvo.calib.session.assemble import lens_so_far, update_file
from ceilvo.calib.session.common import (
    Progress,
    Subcommands,
    add_step,
    bench_of,
    conclude,
    session_of,
)
from ceilvo.calib.session.session import Session, reading
from ceilvo.calib.session.views import Collection, collect, moved
from ceilvo.calib.session.wheels import LiveWheels, Wheels, live_base, no_wheels, recorded
from ceilvo.calib.solve.mount.experiment import Mount, calibrate, problems, wheel_problems
from ceilvo.calib.solve.mount.tracks import RUN, SPIN, MountPicture
from ceilvo.calib.targets.ceiling_view import GridView
from ceilvo.camera import CameraModel
from ceilvo.config import Base
from ceilvo.config.reader import load_config
from ceilvo.errors import CalibrationError

Array = NDArray[np.float64]

STEP = "mount"
_TURNS = 4
"""Of the spin: four halve the wandering's part in the offset (docs/calibration.md)."""
_TURN_RAD = float(np.radians(360.0 * _TURNS + 15.0))
"""The turns, and 15 deg more: directions are known modulo a quarter turn, steps add up with errors."""
_RUN_M = 2.0
"""Of the run; chosen: fits most rooms, and mount.MIN_RUN_M is less than half of it."""
_SMALL_FRACTION = 0.01
"""Of the picture from one to the next: dozens on a run, under a high ceiling as well."""
_ASK = {
    SPIN: f"turn the robot {_TURNS} times round on the spot, slowly, and a little more",
    RUN: f"drive straight ahead by {_RUN_M:g} m, slowly",
}


def add(commands: Subcommands) -> None:
    p = add_step(
        commands,
        STEP,
        run,
        help="3. where the camera sits on the robot, from a turn on the spot and a straight run",
        description=f"First turn the robot {_TURNS} times round on the spot (its wandering averages out; once does), "
        "then drive it two metres straight ahead.",
        epilog="example: calib mount --config /etc/ceilvo/config.yaml (with its base: the wheels' scale as well); "
        "recorded: --images DIR with folders spin/ and run/ in it, each with wheels.csv where there are wheels: "
        "name,x_m,y_m,theta_rad, a row for each picture",
    )
    p.add_argument("--units", choices=("m", "mm"), help="of wheels.csv, when it is doubtful")


def run(args: argparse.Namespace) -> int:
    session = session_of(args)
    session.begin(STEP)
    camera, cov = lens_so_far(session, "the mount")
    projection = session.need("projection", "the mount")
    tile_m = projection.get("tile_m")
    if tile_m is None:
        raise CalibrationError("mount: found no tile size, the projection was made from points; run it on the grid too")
    if session.force:
        for part in (SPIN, RUN):
            session.set_aside(f"{STEP}-{part}")
    with reading(session.folder / "projection.json"):
        level = np.array([float(projection[k]) for k in ("roll_rad", "pitch_rad", "height_m")])
        tile_m, taped = float(tile_m), scale.read(projection)
    taken = _pictures(args, session, camera, level)
    found = calibrate(camera, taken, tile_m, level, cov)
    wheels = _by_wheels(found)
    bad = problems(found) + _wheel_problems(found, wheels, taped, tile_m)
    kept = {"tile_m": tile_m, "scale": scale.kept(wheels)}
    session.save(STEP, _result(found) | kept | {"problems": bad, "verdict": "FAIL" if bad else "PASS"})
    session.write("mount/paths.svg", plots.paths(found.spin_xy_m.tolist(), found.run_xy_m.tolist()))
    print(update_file(session))
    state, texts = scale.summary([*taped, *wheels])
    if state == "unconfirmed":
        texts = [*texts, scale.tile_alone(tile_m)]
    return conclude(STEP, _rows(found) + [("scale", text) for text in texts], bad, args)


def _by_wheels(m: Mount) -> list[scale.Scale]:
    if m.wheel_scale is None or m.wheel_scale_sigma is None:
        return []
    return [scale.by_wheels(m.run_m, m.wheel_scale, m.wheel_scale_sigma)]


def _wheel_problems(m: Mount, wheels: list[scale.Scale], taped: list[scale.Scale], tile_m: float) -> list[str]:
    """Where a tape confirmed the tile it is the wheels that err, and they may by more."""
    if scale.summary(taped)[0] == "confirmed":
        return wheel_problems(m)
    return [p for p in (scale.problem(s, tile_m) for s in wheels) if p]


def _pictures(args: argparse.Namespace, session: Session, camera: CameraModel, level: Array) -> list[MountPicture]:
    """Pictures of the spin, then of the run, each with its wheels where they are known."""
    simulated = list(bench_of(args).spin_and_run()) if args.simulate else None
    base = load_config(args.config).base if args.config is not None else Base(enabled=False)
    out: list[MountPicture] = []
    with live_base(base, Progress(STEP).note) as link:
        for part in (SPIN, RUN):
            mine = copy.copy(args)
            wheels: Wheels = no_wheels
            if args.images is not None:
                mine.images = args.images / part
                if not mine.images.is_dir():
                    raise CalibrationError(f"{args.images}: found no folder {part!r} in it, expected spin/ and run/")
                wheels = recorded(mine.images, args.units)
            elif simulated is None:
                print(f"{STEP}: now {_ASK[part]}", file=sys.stderr)
            if link is not None:
                wheels = LiveWheels(link)
            got = collect(
                mine,
                session,
                f"{STEP}-{part}",
                camera,
                None if simulated is None else [p for p in simulated if p.label == part],
                tilt_rad=(level[0], level[1]),
                wanted=partial(moved, fraction=_SMALL_FRACTION),
                enough=_turned if part == SPIN else lambda c: _travelled(c) * level[2] >= _RUN_M,
                wheels=wheels,
                ask=_ASK[part],
            )
            out += [MountPicture(part, s.view, s.wheels) for s in got.seen]
    return out


def _turned(c: Collection) -> bool:
    """Whether the views so far go once round: directions are known modulo 90 deg, steps are small."""
    psi = np.array([s.view.psi_rad for s in c.seen])
    return len(psi) > 8 and float(np.abs(np.sum(np.angle(np.exp(4j * np.diff(psi))) / 4.0))) >= _TURN_RAD


def _travelled(c: Collection) -> float:
    """Way in units of the ceiling's height, from step to step."""
    return float(sum(_shift(a.view, b.view) for a, b in zip(c.seen[:-1], c.seen[1:], strict=True)))


def _shift(a: GridView, b: GridView) -> float:
    d = np.hypot(*(b.xy[:, None] - a.xy[None]).transpose(2, 0, 1))
    return float(np.median(d.min(axis=1)))


def _result(m: Mount) -> dict[str, Any]:
    return {
        "xy_m": m.xy_m,
        "yaw_rad": m.yaw_rad,
        "sigma": m.sigma,
        "cov": m.cov,
        "turned_deg": np.degrees(m.turned_rad),
        "run_m": m.run_m,
        "spin_rms_m": m.spin_rms_m,
        "run_rms_m": m.run_rms_m,
        "wheel_scale": m.wheel_scale,
        "wheel_scale_sigma": m.wheel_scale_sigma,
        "wheel_turn": m.wheel_turn,
    }


def _rows(m: Mount) -> list[tuple[str, str]]:
    s = m.sigma
    wheels = (
        "not known"
        if m.wheel_scale is None
        else f"{m.wheel_scale:.4f} +- {m.wheel_scale_sigma:.4f} true over reported way"
    )
    if m.wheel_turn is not None:
        wheels += f", {m.wheel_turn:.4f} of the turn"
    return [
        ("offset", f"{m.xy_m[0]:+.4f} +- {s[0]:.4f} m forward, {m.xy_m[1]:+.4f} +- {s[1]:.4f} m left"),
        ("yaw", f"{np.degrees(m.yaw_rad):+.3f} +- {np.degrees(s[2]):.3f} deg"),
        ("spin", f"{np.degrees(m.turned_rad):.0f} deg, off a circle by {1e3 * m.spin_rms_m:.1f} mm rms"),
        ("run", f"{m.run_m:.2f} m, off the heading by {1e3 * m.run_rms_m:.1f} mm rms"),
        ("wheels", wheels),
    ]
