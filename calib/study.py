"""What commissioning's figures are worth, over many simulated rigs and experiments (make bench-calib).

    python -m ceilvo.calib.study rigs --count 50     truth against the reported sigma
    python -m ceilvo.calib.study sigma --count 100   generating curves against the confidence band
    python -m ceilvo.calib.study drift --count 3     the daemon's drift with the found calibration and with the true one
    python -m ceilvo.calib.study stale --count 4     false alarms of the staleness monitor, and what it notices

Exit code 1 when a bar is missed.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.polynomial.polynomial import polyval
from numpy.typing import NDArray

from ceilvo import se2
from ceilvo.calib import mount, sigma
from ceilvo.calib.assemble import UNMEASURED
from ceilvo.calib.board import Board, BoardFinder
from ceilvo.calib.ceiling_view import CeilingReader
from ceilvo.calib.cli import mount_angles
from ceilvo.calib.grid import from_grid
from ceilvo.calib.intrinsics import Intrinsics, Shot, calibrate, parameters_of
from ceilvo.calib.mount import Step
from ceilvo.calib.stand import Stand, errors_against_grid
from ceilvo.calib.virtual_bench import VirtualBench, random_rig
from ceilvo.calibration import Calibration, mount_rotation, projection_matrix
from ceilvo.config import Config
from ceilvo.daemon.pipeline import Pipeline
from ceilvo.daemon.staleness import StalenessMonitor
from ceilvo.errors import CalibrationError
from ceilvo.sim.world import World, WorldSpec
from ceilvo.types import Frame

Array = NDArray[np.float64]

NAMES = ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3", "roll", "pitch", "height", "x", "y", "yaw")
GENERATING = ((0.004,), (0.003, 0.004), (0.003, 0.0, 0.002), (0.002, 0.001, 0.001, 0.0008))


@dataclass(frozen=True)
class RigResult:
    """Errors (15,) against the truth, the sigma (15,) that commissioning reported, and the calibration found."""

    error: Array
    sigma: Array
    calibration: Calibration


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
    rotation = mount_rotation(found.yaw_rad, level[0], level[1])
    at = (float(found.xy_m[0]), float(found.xy_m[1]))
    calibration = replace(
        rig, camera=lens.camera, projection=projection_matrix(lens.camera, rotation, at, level[2]), noise=UNMEASURED
    )
    return RigResult(error, np.concatenate([lens.sigma, projection.sigma[:3], found.sigma]), calibration)


def with_noise(found: Calibration, rig: Calibration, seed: int) -> Calibration:
    """The calibration with noise curves as `calib sigma` finds them by standing still."""
    _, roll, pitch = mount_angles(found)
    reader = CeilingReader(found.camera, (roll, pitch))
    stands: dict[str, Stand] = {}
    for p in VirtualBench(rig, seed=seed, world_seed=1 + seed % 3).stands(15, 2):
        view = reader(p.gray)
        if view.ok:
            stands.setdefault(p.label, Stand(p.label, [])).views.append(view)
    errors = errors_against_grid(found, list(stands.values()), found.tile_m or 0.6)
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


def drift(count: int, first: int = 0) -> int:
    """Odometry's error after a lap and the filter's worst error, found against true calibration; bars missed."""
    total = np.zeros((2, 2))
    for seed in range(first, first + count):
        rig = random_rig(seed)
        found = with_noise(commission(rig, seed).calibration, rig, seed)
        world = World(WorldSpec(seed=1 + seed % 3), rig)
        figures = np.array([_lap(world, c) for c in (found, rig)])
        total += figures**2
        print(
            f"rig {seed}: end of odometry {1e3 * figures[0, 0]:.1f} mm found, {1e3 * figures[1, 0]:.1f} true; "
            f"worst pose {1e3 * figures[0, 1]:.1f} found, {1e3 * figures[1, 1]:.1f} true",
            flush=True,
        )
    ratio = np.sqrt(total[0] / total[1])
    print(f"found over true: drift of odometry {ratio[0]:.2f}, worst pose {ratio[1]:.2f} (bar 1.2)")
    return int(ratio[1] > 1.2)


def _lap(world: World, calibration: Calibration, rate_hz: float = 12.0) -> tuple[float, float]:
    pipeline = Pipeline(calibration, _config(world), np.random.default_rng(1))
    worst, last = 0.0, np.zeros(3)
    for i in range(round(rate_hz * (world.path.lap_m / world.spec.lap.speed_mps + 2.0))):
        t = i / rate_hz
        estimate = pipeline.step(Frame(i, 1 + round(1e9 * t), world.frame_at(t)))
        truth = world.truth_at(t)
        worst = max(worst, float(np.hypot(*(estimate.pose - truth)[:2])))
        last = se2.between(truth, se2.compose(world.truth_at(0.0), estimate.odom))
    return float(np.hypot(*last[:2])), worst


def _config(world: World) -> Config:
    x, y, theta = (float(v) for v in world.initial_pose)
    start = replace(
        Config().filter, initial_pose_x_m=x, initial_pose_y_m=y, initial_pose_theta_deg=float(np.degrees(theta))
    )
    return replace(Config(), filter=start)


def stale(count: int, first: int = 0, laps: float = 3.0, rate_hz: float = 8.0) -> int:
    """False alarms an hour with a good calibration, and whether a lens that changed is noticed; bars missed."""
    alarms, hours, missed, highest = 0, 0.0, 0, 0.0
    for seed in range(first, first + count):
        rig = random_rig(seed)
        good = with_noise(commission(rig, seed).calibration, rig, seed)
        k1, *rest = good.camera.distortion
        bent = replace(good, camera=replace(good.camera, distortion=(k1 + 0.04, *rest)))
        world = World(WorldSpec(seed=1 + seed % 3), rig)
        pipelines = [Pipeline(c, _config(world), np.random.default_rng(1)) for c in (good, bent)]
        monitors = [StalenessMonitor(), StalenessMonitor()]
        raised, worst = [0, 0], [0.0, 0.0]
        seconds = laps * world.path.lap_m / world.spec.lap.speed_mps
        for i in range(round(rate_hz * seconds)):
            stamp_ns, gray = 1 + round(1e9 * i / rate_hz), world.frame_at(i / rate_hz)
            for k, (pipeline, monitor) in enumerate(zip(pipelines, monitors, strict=True)):
                before = monitor.last.stale
                e = pipeline.step(Frame(i, stamp_ns, gray))
                now = monitor.add(stamp_ns, e.depletion.nis, e.depletion.nis_dof)
                raised[k] += int(now.stale and not before)
                worst[k] = max(worst[k], np.nan_to_num(now.mean_nis))
        alarms, hours, highest = alarms + raised[0], hours + seconds / 3600.0, max(highest, worst[0])
        missed += int(not raised[1])
        print(f"rig {seed}: mean NIS at most {worst[0]:.2f} good, {worst[1]:.2f} bent; alarms {raised}", flush=True)
    print(f"{alarms} false alarms in {hours:.2f} h (highest mean NIS {highest:.2f})")
    print(f"{missed} of {count} bent lenses missed")
    return alarms + missed


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
    p.add_argument("what", choices=("rigs", "sigma", "drift", "stale"))
    p.add_argument("--count", type=int, default=0)
    p.add_argument("--first", type=int, default=0, help="first seed (%(default)s)")
    args = p.parse_args(argv)
    cv2.setNumThreads(1)
    what = {"rigs": (rigs, 50), "sigma": (curves, 100), "drift": (drift, 3), "stale": (stale, 4)}
    study, usual = what[args.what]
    return int(study(args.count or usual, args.first) > 0)


if __name__ == "__main__":
    sys.exit(main())
