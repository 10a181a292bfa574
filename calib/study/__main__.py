"""What commissioning's figures are worth, over many simulated rigs and experiments (make bench-calib).

    python -m ceilvo.calib.study sigma --count 100   generating curves against the confidence band
    python -m ceilvo.calib.study drive --count 8     drift with the found calibration, false alarms
    python -m ceilvo.calib.study rigs --count 50     truth against the reported sigma
    python -m ceilvo.calib.study scale --count 40    wrong tiles: what second sources notice, false refusals

Figures of each rig are kept in build/bench/calib-*.samples.jsonl: an interrupted study goes on, unless the code has
changed. Summaries are in build/bench/calib-*.json. Exit code 1 when a bar is missed.
"""

from __future__ import annotations

import argparse
import hashlib
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.polynomial.polynomial import polyval
from numpy.typing import NDArray

from ceilvo import se2
from ceilvo.calib.practice.virtual_bench import VirtualBench, random_rig
from ceilvo.calib.session.assemble import UNMEASURED
from ceilvo.calib.session.session import Session
from ceilvo.calib.solve import sigma
from ceilvo.calib.solve.grid import from_grid
from ceilvo.calib.solve.intrinsics import Intrinsics, Shot, calibrate
from ceilvo.calib.solve.lens import parameters_of
from ceilvo.calib.solve.mount.experiment import calibrate as calibrate_mount
from ceilvo.calib.solve.mount.tracks import MountPicture
from ceilvo.calib.solve.station import Station, errors_against_grid
from ceilvo.calib.solve.tile_grid import USUAL_TILE_M
from ceilvo.calib.study import drive as drive_study
from ceilvo.calib.study import scale as scale_study
from ceilvo.calib.targets.board import Board
from ceilvo.calib.targets.ceiling_view import CeilingReader
from ceilvo.calib.targets.finder import BoardFinder
from ceilvo.calibration import Calibration, mount_angles, mount_rotation, projection_matrix
from ceilvo.errors import CalibrationError

Array = NDArray[np.float64]

NAMES = ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3", "roll", "pitch", "height", "x", "y", "yaw")
GENERATING = ((0.004,), (0.003, 0.004), (0.003, 0.0, 0.002), (0.002, 0.001, 0.001, 0.0008))
"""Coefficients of true sigma(r), m against m: constant, linear and two curved."""
_RATIO, _INSIDE, _IN_BAND = (0.75, 1.25), 0.95, 0.9
"""Bars of docs/calibration.md: observed over reported sigma, truth inside three sigma, curves inside the band."""
_FALSE, _CAUGHT = 0.01, 0.95
"""Bars of second sources of the scale: right tiles refused, and wrong ones caught, each of 4 % or more."""
FOLDER = Path("build/bench")
_DECIDE = (
    *("calib/targets", "calib/solve", "calib/practice", "sim", "daemon/pipeline.py"),
    *("daemon/vision", "daemon/odometry", "daemon/slam", "daemon/relocalisation"),
)
"""What the figures come from; staleness is not in it, for it is judged from what is kept."""


@dataclass(frozen=True)
class RigResult:
    """Errors (15,) against the truth, the sigma (15,) that commissioning reported, and the calibration found."""

    error: Array
    sigma: Array
    calibration: Calibration


def commission(rig: Calibration, seed: int) -> RigResult:
    """Lens, projection and mount of one rig as `calib --simulate` does them, with two thirds of its pictures."""
    bench = VirtualBench(rig, seed=seed, world_seed=1 + seed % 3)
    lens = _lens(bench, shots=20)
    reader, tile_m = CeilingReader(lens.camera), rig.tile_m or USUAL_TILE_M
    views = [v for v in (reader(p.gray) for p in bench.places(14)) if v.ok]
    projection, _ = from_grid(lens.camera, views, tile_m, reader.tilt_rad, lens.cov)
    camera, cov = lens.camera, lens.cov
    if projection.joint is not None and projection.joint.agrees:
        camera, cov = projection.joint.camera, projection.joint.lens_cov
    level = np.array([projection.roll_rad, projection.pitch_rad, projection.height_m])
    pictures = []
    for p in bench.spin_and_run(80, 44):
        view = reader(p.gray)
        if view.ok:
            pictures.append(MountPicture(p.label, view, p.wheels))
    found = calibrate_mount(camera, pictures, tile_m, level, cov)
    yaw, roll, pitch = mount_angles(rig.camera_from_base)
    error = np.concatenate(
        [
            parameters_of(camera) - parameters_of(rig.camera),
            level - np.array([roll, pitch, rig.ceiling_height_m]),
            found.xy_m - rig.mount_xy_m,
            [se2.wrap(found.yaw_rad - yaw)],
        ]
    )
    rotation = mount_rotation(found.yaw_rad, level[0], level[1])
    at = (float(found.xy_m[0]), float(found.xy_m[1]))
    calibration = replace(
        rig, camera=camera, projection=projection_matrix(camera, rotation, at, level[2]), noise=UNMEASURED
    )
    return RigResult(error, np.concatenate([np.sqrt(np.diag(cov)), projection.sigma[:3], found.sigma]), calibration)


def with_noise(found: Calibration, rig: Calibration, seed: int) -> Calibration:
    """The calibration with noise curves as `calib sigma` finds them by standing still."""
    _, roll, pitch = mount_angles(found.camera_from_base)
    reader = CeilingReader(found.camera, (roll, pitch))
    stations: dict[str, Station] = {}
    for p in VirtualBench(rig, seed=seed, world_seed=1 + seed % 3).stations(15, 2):
        view = reader(p.gray)
        if view.ok:
            stations.setdefault(p.label, Station(p.label, [])).views.append(view)
    errors = errors_against_grid(found, list(stations.values()), found.tile_m or USUAL_TILE_M)
    return replace(found, noise=sigma.fit(errors, seed).curves)


def _lens(bench: VirtualBench, shots: int) -> Intrinsics:
    board = Board()
    finder, good = BoardFinder(board), []
    for p in bench.board(board, shots):
        seen = finder(p.gray)
        if seen.ok:
            good.append(Shot(p.name, board.corners_m[seen.ids], seen.uv_px))
    h, w = bench.rig.camera.height_px, bench.rig.camera.width_px
    return calibrate(good, (w, h), "pinhole")


# -- kept between runs


def _code() -> str:
    """Fingerprint of all that decides the figures."""
    root = Path(__file__).resolve().parents[2]
    files = [p for name in _DECIDE for p in (sorted((root / name).rglob("*.py")) or [root / name])]
    digest = hashlib.sha256()
    for path in files:
        digest.update(path.relative_to(root).as_posix().encode() + b"\0" + path.read_bytes())
    return digest.hexdigest()[:16]


def each_rig(name: str, count: int, first: int, work: Callable[[int], dict[str, Any]]) -> list[dict[str, Any]]:
    """One record a rig, from the earlier run where there is one; progress goes to standard error."""
    store = Session(FOLDER, force=True)
    done = {r["rig"]: r for r in store.samples(name, {"code": _code()})}
    out: list[dict[str, Any]] = []
    for seed in range(first, first + count):
        if seed not in done:
            started = time.process_time()
            try:
                done[seed] = {"rig": seed, **work(seed)}
            except CalibrationError as e:
                done[seed] = {"rig": seed, "refused": str(e)}
            done[seed]["cpu_s"] = round(time.process_time() - started, 1)
            store.add_sample(name, done[seed])
            text = done[seed].get("refused") or f"{done[seed]['cpu_s']} s"
            print(f"{name}: rig {seed}, {len(out) + 1} of {count}: {text}", file=sys.stderr, flush=True)
        out.append(done[seed])
    return out


def _report(name: str, figures: dict[str, Any]) -> None:
    path = Session(FOLDER, force=True).save(name, {"code": _code(), **figures})
    print(f"figures in {path}")


# -- studies


def rigs(count: int, first: int) -> int:
    """Print a table; the number of bars missed."""

    def work(seed: int) -> dict[str, Any]:
        r = commission(random_rig(seed), seed)
        return {"error": r.error.tolist(), "sigma": r.sigma.tolist()}

    records = each_rig("calib-rigs", count, first, work)
    good = [r for r in records if "error" in r]
    z = np.array([r["error"] for r in good]) / np.array([r["sigma"] for r in good])
    error = np.sqrt(np.mean(np.square([r["error"] for r in good]), axis=0))
    inside, spread = np.abs(z) <= 3.0, np.sqrt(np.mean(z**2, axis=0))
    print(f"{len(good)} of {count} rigs commissioned, {np.mean([r['cpu_s'] for r in good]):.1f} s of processor each")
    print(f"  {'':<7} {'rms error':>10}  observed over reported sigma (bar 0.75-1.25), inside 3 sigma (bar 95 %)")
    for k, name in enumerate(NAMES):
        print(f"  {name:<7} {error[k]:>10.2g}  {spread[k]:.2f}  {100 * inside[:, k].mean():.0f} %")
    ratio = float(np.sqrt(np.mean(z**2)))
    outside = [n for n, s in zip(NAMES, spread, strict=True) if not _RATIO[0] <= s <= _RATIO[1]]
    print(f"all     inside 3 sigma {100 * inside.mean():.1f} %, observed over reported {ratio:.2f}")
    print(f"parameters beyond 25 %: {', '.join(outside) or 'none'}")
    for r in records:
        if "refused" in r:
            print(f"rig {r['rig']}: {r['refused']}")
    rows = {n: {"ratio": s, "inside": i} for n, s, i in zip(NAMES, spread, inside.mean(axis=0), strict=True)}
    _report("calib-rigs", {"rigs": len(good), "of": count, "inside": inside.mean(), "ratio": ratio, "each": rows})
    return int(inside.mean() < _INSIDE) + len(outside) + int(len(good) < count)


def drive(count: int, first: int) -> int:
    """Drift with the found calibration against the true one; staleness; the number of bars missed."""

    def work(seed: int) -> dict[str, Any]:
        rig = random_rig(seed)
        found = with_noise(commission(rig, seed).calibration, rig, seed)
        return drive_study.figures(rig, found, 1 + seed % 3)

    records = [r for r in each_rig("calib-drive", count, first, work) if "refused" not in r]
    figures = drive_study.summary(records)
    for line in drive_study.lines(records, figures):
        print(line)
    _report("calib-drive", figures)
    return sum(not ok for ok in drive_study.bars(figures))


def curves(count: int, first: int) -> int:
    """Print a table; the number of bars missed."""
    inside = {}
    for k in GENERATING:
        hits = [0, 0]
        for seed in range(first, first + count):
            noise = sigma.fit(experiment(k, seed, circles=4, each=20), seed)
            for axis, curve in enumerate((noise.x, noise.y)):
                hits[axis] += curve.covers(np.asarray(polyval(curve.r_m, k), np.float64))
        x, y = inside[str(k)] = [h / count for h in hits]
        text = f"inside the 95 % band x {100 * x:.0f} %, y {100 * y:.0f} % (bar 90)"
        print(f"sigma(r) = {k}: {text}", flush=True)
    _report("calib-sigma", {"inside": inside, "of": count})
    return sum(s < _IN_BAND for pair in inside.values() for s in pair)


def experiment(coefficients: tuple[float, ...], seed: int, circles: int, each: int) -> sigma.Errors:
    """Errors on concentric circles, drawn from known curves."""
    rng = np.random.default_rng([seed, 0xC1])
    r = np.repeat(np.linspace(0.3, 2.0, circles), each)
    s = np.asarray(polyval(r, coefficients), np.float64)
    n = len(r)
    return sigma.Errors(r, s * rng.standard_normal(n), s * rng.standard_normal(n), 0.002 * rng.standard_normal(n))


def scales(count: int, first: int) -> int:
    """Print what second sources refuse; the number of bars missed."""
    records = each_rig("calib-scale", count, first, lambda seed: scale_study.figures(random_rig(seed), seed))
    good = [r for r in records if "refused" not in r]
    lines, shares = scale_study.summary(good)
    print("\n".join(lines))
    _report("calib-scale", {"refused": shares, "rigs": len(good), "of": count})
    right = shares.pop(f"{scale_study.TRUE_TILE_M:g}")
    missed = sum(v > _FALSE for v in right.values())
    return missed + sum(v < _CAUGHT for row in shares.values() for v in row.values()) + int(len(good) < count)


def main(argv: Sequence[str] | None = None) -> int:
    p = argparse.ArgumentParser(
        prog="python -m ceilvo.calib.study",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    p.add_argument("what", choices=("rigs", "sigma", "drive", "scale"))
    p.add_argument("--count", type=int, default=0)
    p.add_argument("--first", type=int, default=0, help="first seed (%(default)s)")
    args = p.parse_args(argv)
    cv2.setNumThreads(1)
    what = {"rigs": (rigs, 50), "sigma": (curves, 100), "drive": (drive, 8), "scale": (scales, 40)}
    study, usual = what[args.what]
    return int(study(args.count or usual, args.first) > 0)


if __name__ == "__main__":
    sys.exit(main())
