"""What commissioning's figures are worth, over many simulated rigs and experiments (make bench-calib).

    python -m ceilvo.calib.study rigs --count 50     truth against the reported sigma
    python -m ceilvo.calib.study sigma --count 100   generating curves against the confidence band

Exit code 1 when a bar is missed.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.polynomial.polynomial import polyval
from numpy.typing import NDArray

from ceilvo import se2
from ceilvo.calib import mount, sigma
from ceilvo.calib.board import Board, BoardFinder
from ceilvo.calib.ceiling_view import CeilingReader
from ceilvo.calib.cli import mount_angles
from ceilvo.calib.intrinsics import Intrinsics, Shot, calibrate, parameters_of
from ceilvo.calib.mount import Step
from ceilvo.calib.projection import from_grid
from ceilvo.calib.virtual_bench import VirtualBench, random_rig
from ceilvo.calibration import Calibration
from ceilvo.errors import CalibrationError

Array = NDArray[np.float64]

NAMES = ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3", "roll", "pitch", "height", "x", "y", "yaw")
GENERATING = ((0.004,), (0.003, 0.004), (0.003, 0.0, 0.002), (0.002, 0.001, 0.001, 0.0008))


@dataclass(frozen=True)
class RigResult:
    """Errors (15,) against the truth and the sigma (15,) that commissioning reported."""

    error: Array
    sigma: Array


def commission(rig: Calibration, seed: int, shots: int = 20, places: int = 14, frames: int = 44) -> RigResult:
    """Lens, projection and mount of one rig as `calib --simulate` does them, without the command line."""
    bench = VirtualBench(rig, seed=seed, world_seed=1 + seed % 3)
    lens = _lens(bench, shots)
    reader, tile_m = CeilingReader(lens.camera), rig.tile_m or 0.6
    views = [v for v in (reader(p.gray) for p in bench.places(places)) if v.ok]
    projection, _ = from_grid(lens.camera, views, tile_m, reader.tilt_rad, lens.cov)
    level = np.array([projection.roll_rad, projection.pitch_rad, projection.height_m])
    steps = []
    for p in bench.spin_and_run(frames, frames):
        view = reader(p.gray)
        if view.ok:
            steps.append(Step(p.label, view, p.wheels))
    found = mount.calibrate(lens.camera, steps, tile_m, level, lens.cov)
    yaw, roll, pitch = mount_angles(rig)
    error = np.concatenate(
        [
            parameters_of(lens.camera) - parameters_of(rig.camera),
            level - np.array([roll, pitch, rig.ceiling_height_m]),
            found.xy_m - rig.mount_xy_m,
            [se2.wrap(found.yaw_rad - yaw)],
        ]
    )
    return RigResult(error, np.concatenate([lens.sigma, projection.sigma[:3], found.sigma]))


def _lens(bench: VirtualBench, shots: int) -> Intrinsics:
    board = Board()
    finder, good = BoardFinder(board), []
    for p in bench.board(board, shots):
        seen = finder(p.gray)
        if seen.ok:
            good.append(Shot(p.name, board.corners_m[seen.ids], seen.uv_px))
    h, w = bench.rig.camera.height_px, bench.rig.camera.width_px
    return calibrate(good, (w, h), "pinhole")


def rigs(count: int, first: int = 0) -> int:
    """Print a table; the number of bars missed."""
    results = []
    for seed in range(first, first + count):
        try:
            results.append(commission(random_rig(seed), seed))
        except CalibrationError as e:
            print(f"rig {seed}: {e}")
            continue
        z = results[-1].error / results[-1].sigma
        print(f"rig {seed}: " + " ".join(f"{n} {v:+.1f}" for n, v in zip(NAMES, z, strict=True)), flush=True)
    z = np.array([r.error / r.sigma for r in results])
    inside = np.mean(np.abs(z) <= 3.0)
    spread = np.sqrt(np.mean(z**2, axis=0))
    print(f"{len(results)} of {count} rigs commissioned")
    for name, s, part in zip(NAMES, spread, np.mean(np.abs(z) <= 3.0, axis=0), strict=True):
        print(f"  {name:<7} observed over reported sigma {s:.2f}, inside 3 sigma {100 * part:.0f} %")
    ratio = float(np.sqrt(np.mean(z**2)))
    print(f"all: inside 3 sigma {100 * inside:.1f} % (bar 95), observed over reported {ratio:.2f} (bar 0.75-1.25)")
    return int(inside < 0.95) + int(not 0.75 <= ratio <= 1.25) + int(len(results) < count)


def curves(count: int, first: int = 0, circles: int = 4, each: int = 20) -> int:
    """Print a table; the number of bars missed."""
    missed = 0
    for k in GENERATING:
        hits = [0, 0]
        for seed in range(first, first + count):
            noise = sigma.fit(experiment(k, seed, circles, each), seed)
            for axis, curve in enumerate((noise.x, noise.y)):
                hits[axis] += curve.covers(np.asarray(polyval(curve.r_m, k), np.float64))
        share = [h / count for h in hits]
        missed += sum(s < 0.9 for s in share)
        print(
            f"sigma(r) = {k}: inside the 95 % band x {100 * share[0]:.0f} %, y {100 * share[1]:.0f} % (bar 90)",
            flush=True,
        )
    return missed


def experiment(coefficients: tuple[float, ...], seed: int, circles: int, each: int) -> sigma.Errors:
    """Errors on concentric circles, drawn from known curves."""
    rng = np.random.default_rng([seed, 0xC1])
    r = np.repeat(np.linspace(0.3, 2.0, circles), each)
    s = np.asarray(polyval(r, coefficients), np.float64)
    n = len(r)
    return sigma.Errors(r, s * rng.standard_normal(n), s * rng.standard_normal(n), 0.002 * rng.standard_normal(n))


def main(argv: Sequence[str] | None = None) -> int:
    p = argparse.ArgumentParser(prog="python -m ceilvo.calib.study", description=__doc__)
    p.add_argument("what", choices=("rigs", "sigma"))
    p.add_argument("--count", type=int, default=0)
    p.add_argument("--first", type=int, default=0, help="first seed (%(default)s)")
    args = p.parse_args(argv)
    cv2.setNumThreads(1)
    missed = rigs(args.count or 50, args.first) if args.what == "rigs" else curves(args.count or 100, args.first)
    return int(missed > 0)


if __name__ == "__main__":
    sys.exit(main())
