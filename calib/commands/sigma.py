"""`calib sigma`: how far off observations are, against the distance to the feature."""

from __future__ import annotations

import argparse
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from ceilvo import se2
from ceilvo.calib.commands import circles
from ceilvo.calib.session import plots
from ceilvo.calib.session.assemble import assemble, update_file
from ceilvo.calib.session.common import (
    Progress,
    Subcommands,
    add_step,
    bench_of,
    conclude,
    pictures,
    session_of,
)
from ceilvo.calib.session.session import Session
from ceilvo.calib.session.views import Collection, Seen, collect
from ceilvo.calib.solve.sigma import Curve, Errors, Noise, fit, problems
from ceilvo.calib.solve.station import Station, errors_against_grid
from ceilvo.calib.targets.ceiling_view import GridView
from ceilvo.calib.targets.points_file import ask_on_terminal, in_metres, read_table
from ceilvo.calib.targets.sources import Picture
from ceilvo.calibration import Calibration, mount_angles
from ceilvo.errors import CalibrationError

STEP = "sigma"
_STATIONS, _LOOKS = 18, 4
"""Chosen: 18 places, whose scatter is known to a sixth, and four looks at each, which halve a picture's own noise."""
_STILL_PX = 0.6
"""Median move of the crossings below which nothing moved; a crossing has about 0.1 px of noise."""
_TURN_RAD = 7.0
"""Beyond a full turn: headings are in degrees."""
_ERRORS = ("r_m", "dx_m", "dy_m", "dtheta_rad")
_POSES = ("x_m", "y_m", "theta_rad", "seen_x_m", "seen_y_m", "seen_theta_rad")


def add(commands: Subcommands) -> None:
    p = add_step(
        commands,
        STEP,
        run,
        help="4. observation noise against distance: sigma_x(r), sigma_y(r), sigma_theta",
        description="Either measured poses on three or more circles about a feature (--csv), or nothing but standing: "
        "put the robot in 12 to 20 places, turned differently, and let it stand for a second in each.",
        epilog="example: calib sigma --device /dev/video0; "
        "CSV: x_m,y_m,theta_rad (measured pose, the feature at the origin),seen_x_m,seen_y_m,seen_theta_rad "
        "(the feature as seen in base, the heading as estimated), or r_m,dx_m,dy_m,dtheta_rad",
    )
    p.add_argument(
        "--circles", action="store_true", help="asks for the robot's measured pose, looks, and asks for the next: "
        "three or more circles about one crossing of joints, which is the origin"
    )  # fmt: skip
    p.add_argument("--csv", type=Path, metavar="FILE", help="the measurements, instead of pictures")
    p.add_argument("--units", choices=("m", "mm"), help="of the CSV, when it is doubtful")


def run(args: argparse.Namespace) -> int:
    session = session_of(args)
    session.begin(STEP)
    if session.force:
        session.set_aside(circles.SAMPLES)
    if args.csv is not None:
        errors, how = errors_of_csv(args.csv, args.units), str(args.csv)
    elif args.circles:
        errors, how = _circles(args, session)
    else:
        errors, how = _standing(args, session)
    noise = fit(errors)
    bad = problems(noise)
    result = _result(noise, errors) | {"method": how, "problems": bad, "verdict": "FAIL" if bad else "PASS"}
    session.save(STEP, result)
    curves = {"x": _curve(noise.x), "y": _curve(noise.y)}
    session.write("sigma/curves.svg", plots.sigma(curves))
    session.write(
        "sigma/errors.svg",
        plots.scatter({"r_m": errors.r_m.tolist(), "dx_m": errors.dx_m.tolist(), "dy_m": errors.dy_m.tolist()}),
    )
    print(update_file(session))
    return conclude(STEP, _rows(noise, len(errors.r_m), how), bad, args)


def errors_of_csv(path: Path, units: str | None) -> Errors:
    """Errors as they stand, or from measured poses and what was seen there.

    Raises:
        CalibrationError: columns, numbers or units.
    """
    try:
        header = path.read_text(encoding="utf-8-sig").split("\n", 1)[0]
    except (OSError, UnicodeDecodeError) as e:
        raise CalibrationError(f"{path}: cannot be read ({e})") from None
    if "seen_x_m" not in header:
        t = read_table(path, _ERRORS)
        t = in_metres(path, t, _ERRORS[:3], units, ask_on_terminal)
        if (t["r_m"] < 0).any() or np.abs(np.concatenate([t["dx_m"], t["dy_m"]])).max() > np.abs(t["r_m"]).max():
            raise CalibrationError(f"{path}: r_m must be the distance and larger than the errors; are columns swapped?")
        return Errors(t["r_m"], t["dx_m"], t["dy_m"], t["dtheta_rad"])
    t = read_table(path, _POSES)
    t = in_metres(path, t, ("x_m", "y_m", "seen_x_m", "seen_y_m"), units, ask_on_terminal)
    if np.abs(t["theta_rad"]).max() > _TURN_RAD:
        raise CalibrationError(
            f"{path}: theta_rad reaches {np.abs(t['theta_rad']).max():g}, expected radians; is it in degrees?"
        )
    out = []
    for x, y, th, sx, sy, sth in zip(*(t[c] for c in _POSES), strict=True):
        true = se2.transform(se2.inverse(np.array([x, y, th])), np.zeros((1, 2)))[0]
        out.append((np.hypot(*true), sx - true[0], sy - true[1], se2.wrap(float(sth - th))))
    r, dx, dy, dth = np.array(out).T
    if np.median(np.hypot(dx, dy)) > 0.5 * np.median(r):
        raise CalibrationError(
            f"{path}: what was seen is {np.median(np.hypot(dx, dy)):.2f} m off what was measured (median); "
            "are columns swapped, is the feature at the origin, is seen_x_m in base?"
        )
    return Errors(r, dx, dy, dth)


def _circles(args: argparse.Namespace, session: Session) -> tuple[Errors, str]:
    """Live, from a folder in the order of the poses, or on the virtual bench, which answers the questions itself."""
    calibration = _so_far(session)
    prompt: circles.Prompt = circles.terminal_prompt
    bench = None
    if args.simulate:
        answers, bench = bench_of(args).circles()
        prompt = partial(_answer, answers)
    with pictures(args, bench) as source:
        subject = {"source": source.info.name, "size": [calibration.camera.width_px, calibration.camera.height_px]}
        tilt, take, note = mount_angles(calibration.camera_from_base)[1:], circles.taker(source), Progress(STEP).note
        samples = circles.collect(calibration, session, subject, take, tilt, prompt, note)
    return circles.errors_of(calibration, samples), f"{len(samples)} measured poses"


def _answer(answers: list[str], number: int, _: str) -> str:
    return answers[number] if number < len(answers) else ""


def _so_far(session: Session) -> Calibration:
    session.need("projection", "the noise")
    calibration = assemble(session)
    if calibration is None:
        raise CalibrationError(f"{session.folder}: found no lens and projection; run 'calib intrinsics' first")
    return calibration


def _standing(args: argparse.Namespace, session: Session) -> tuple[Errors, str]:
    calibration = _so_far(session)
    if calibration.tile_m is None:
        raise CalibrationError("sigma: found no tile size in the session, standing still needs it; measure with --csv")
    bench = bench_of(args).stations(_STATIONS, _LOOKS) if args.simulate else None
    got = collect(
        args,
        session,
        STEP,
        calibration.camera,
        bench,
        tilt_rad=mount_angles(calibration.camera_from_base)[1:],
        wanted=_wanted,
        enough=lambda c: len(stations(c)) > _STATIONS,
        ask=f"let the robot stand for a second, turn it or put it elsewhere, {_STATIONS} places in all",
    )
    whole = [s for s in stations(got) if len(s.views) >= 2]
    return errors_against_grid(calibration, whole, calibration.tile_m), f"standing at {len(whole)} places"


def stations(c: Collection) -> list[Station]:
    """Runs of pictures in which nothing moved."""
    out: list[Station] = []
    last: Seen | None = None
    for seen in c.seen:
        if last is not None and seen.label == last.label and _still(seen.view, last.view):
            out[-1].views.append(seen.view)
        else:
            out.append(Station(seen.label, [seen.view]))
        last = seen
    return out


def _still(a: GridView, b: GridView) -> bool:
    d = np.hypot(*(a.uv_px[:, None] - b.uv_px[None]).transpose(2, 0, 1)).min(axis=1)
    return bool(np.median(d) < _STILL_PX)


def _wanted(c: Collection, view: GridView, _: Picture) -> bool:
    """Live: up to the usual number of looks at each station."""
    run = 0
    for seen in reversed(c.seen):
        if not _still(view, seen.view):
            break
        run += 1
    return run < _LOOKS


def _result(n: Noise, e: Errors) -> dict[str, Any]:
    c = n.curves
    return {
        "sigma_x_m": c.sigma_x_m,
        "sigma_y_m": c.sigma_y_m,
        "sigma_theta_rad": c.sigma_theta_rad,
        "sigma_theta_sigma": n.sigma_theta_sigma,
        "r_min_m": c.r_min_m,
        "r_max_m": c.r_max_m,
        "bias_m": n.bias_m,
        "bias_sigma_m": n.bias_sigma_m,
        "samples": len(e.r_m),
        "curves": {"x": _curve(n.x), "y": _curve(n.y)},
    }


def _curve(c: Curve) -> dict[str, Any]:
    return {k: (v.tolist() if isinstance(v, np.ndarray) else v) for k, v in c.__dict__.items()}


def _rows(n: Noise, samples: int, how: str) -> list[tuple[str, str]]:
    rows = [("method", f"{how}, {samples} samples")]
    for name, c in (("x", n.x), ("y", n.y)):
        polynomial = " + ".join(f"{1e3 * k:.3f} r^{i}" if i else f"{1e3 * k:.3f}" for i, k in enumerate(c.coefficients))
        scores = ", ".join(f"{i}: {v:.3f}" for i, v in enumerate(c.order_scores))
        rows.append((f"sigma_{name}(r)", f"{polynomial} mm; order {c.order} by cross-validation ({scores})"))
        for k in (0, len(c.r_m) // 2, -1):
            rows.append(("", f"r {c.r_m[k]:.2f} m: 95 % band {1e3 * c.low_m[k]:.2f} to {1e3 * c.high_m[k]:.2f} mm"))
    rows.append(("sigma_theta", f"{np.degrees(n.sigma_theta_rad):.4f} +- {np.degrees(n.sigma_theta_sigma):.4f} deg"))
    bias = ", ".join(f"{1e3 * b:+.2f} +- {1e3 * e:.2f}" for b, e in zip(n.bias_m, n.bias_sigma_m, strict=True))
    rows.append(("mean error", f"{bias} mm"))
    low, high = n.x.r_m[0], n.x.r_m[-1]
    rows.append(
        ("elsewhere", f"below {low:.2f} m held, beyond {high:.2f} m growing in proportion to r, never shrinking")
    )
    return rows
