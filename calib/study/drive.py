"""The daemon driven with a found calibration: its drift against the true one's, and what the staleness monitor does."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ceilvo import se2
from ceilvo.calibration import Calibration
from ceilvo.config import Config
from ceilvo.daemon.integrity.staleness import HIGH, StalenessMonitor, worst_stretch
from ceilvo.daemon.pipeline import Pipeline
from ceilvo.sim.world import World, WorldSpec
from ceilvo.types import Estimate, Frame

Array = NDArray[np.float64]

RATE_HZ = 8.0
GOOD_LAPS, BENT_LAPS = 6, 2
BENT_K1 = 0.04
DRIFT_BAR = 1.2
_FILTER_SEEDS = 3
_BLOCK_S = 10.0
_HOURS = 200.0


def figures(rig: Calibration, found: Calibration, world_seed: int) -> dict[str, Any]:
    """One rig: errors on the first lap, and NIS of the filter lap by lap, good and with a lens that changed.

    The first lap is the survey; the others are driven by the daemon that is watched. The true calibration has the noise
    curves that were found: the simulator's own are cautious, and with them the true one drifts more than the found one.
    """
    world = World(WorldSpec(seed=world_seed), rig)
    k1, *rest = found.camera.distortion
    lap_s = world.path.lap_m / world.spec.lap.speed_mps
    both = {"found": found, "true": replace(rig, noise=found.noise)}
    pipelines = [_pipeline(world, c, 1 + s) for c in both.values() for s in range(_FILTER_SEEDS)]
    errors = iter(_drift(world, pipelines, lap_s))
    drifts = {name: [next(errors) for _ in range(_FILTER_SEEDS)] for name in both}
    good = _nis(world, [_pipeline(world, found, 1)], GOOD_LAPS * lap_s)[0]
    bent = [
        replace(found, camera=replace(found.camera, distortion=(k1 + sign * BENT_K1, *rest))) for sign in (1.0, -1.0)
    ]
    changed = _nis(world, [_pipeline(world, c, 1) for c in bent], BENT_LAPS * lap_s)
    survey = [(t, n) for t, n in good if t < lap_s]
    return {
        "lap_m": world.path.lap_m,
        "drift": {k: np.array(v).tolist() for k, v in drifts.items()},
        "expected_nis": worst_stretch(survey),
        "mean_nis": float(np.mean([n for _, n in survey])),
        "good": good,
        "bent": changed,
        "bent_nis": [float(np.mean([n for _, n in series])) for series in changed],
    }


def _pipeline(world: World, calibration: Calibration, seed: int) -> Pipeline:
    x, y, theta = (float(v) for v in world.initial_pose)
    start = replace(
        Config().filter, initial_pose_x_m=x, initial_pose_y_m=y, initial_pose_theta_deg=float(np.degrees(theta))
    )
    return Pipeline(calibration, replace(Config(), filter=start), np.random.default_rng(seed))


def _steps(world: World, pipelines: list[Pipeline], seconds: float) -> Iterator[tuple[float, list[Estimate]]]:
    for i in range(round(RATE_HZ * seconds)):
        t = i / RATE_HZ
        frame = Frame(i, 1 + round(1e9 * t), world.frame_at(t))
        yield t, [p.step(frame) for p in pipelines]


def _drift(world: World, pipelines: list[Pipeline], lap_s: float) -> list[Array]:
    """For each pipeline rms and worst error of the pose and rms error of the odometry, m, on a lap."""
    pose: list[list[float]] = [[] for _ in pipelines]
    odometry: list[list[float]] = [[] for _ in pipelines]
    start = world.truth_at(0.0)
    for t, estimates in _steps(world, pipelines, lap_s):
        truth = world.truth_at(t)
        for k, e in enumerate(estimates):
            pose[k].append(float(np.hypot(*(e.pose - truth)[:2])))
            odometry[k].append(float(np.hypot(*se2.between(truth, se2.compose(start, e.odom))[:2])))
    return [np.array([_rms(p), max(p), _rms(o)]) for p, o in zip(pose, odometry, strict=True)]


def _rms(values: list[float] | Array) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


def _nis(world: World, pipelines: list[Pipeline], seconds: float) -> list[list[tuple[float, float]]]:
    """For each pipeline (time s, NIS) of every update."""
    out: list[list[tuple[float, float]]] = [[] for _ in pipelines]
    for t, estimates in _steps(world, pipelines, seconds):
        for k, e in enumerate(estimates):
            if e.health.nis_dof > 0:
                out[k].append((t, float(e.health.nis)))
    return out


def _watched(series: list[tuple[float, float]], expected: float) -> dict[str, Any]:
    """What the daemon's monitor makes of it: alarms, seconds to the first, and the highest mean over the expected."""
    monitor, alarms, first, highest = StalenessMonitor(expected), 0, None, 0.0
    for t, nis in series:
        before = monitor.last.stale
        now = monitor.add(round(1e9 * t), nis, 20)
        if now.stale and not before:
            alarms += 1
            first = t - series[0][0] if first is None else first
        highest = max(highest, float(np.nan_to_num(now.mean_nis)) / expected)
    return {"alarms": alarms, "first_s": first, "highest": highest, "seconds": series[-1][0] - series[0][0]}


def _after_survey(record: dict[str, Any]) -> list[tuple[float, float]]:
    """(time s, NIS) from the second lap on."""
    lap_s = record["good"][-1][0] / GOOD_LAPS
    return [(t, n) for t, n in record["good"] if t >= lap_s]


def watched_good(record: dict[str, Any]) -> dict[str, Any]:
    return _watched(_after_survey(record), record["expected_nis"])


def summary(records: list[dict[str, Any]]) -> dict[str, Any]:
    """Over all rigs."""
    drift = {k: np.array([row for r in records for row in r["drift"][k]]) for k in ("found", "true")}
    ratio = np.sqrt(np.mean(drift["found"] ** 2, axis=0) / np.mean(drift["true"] ** 2, axis=0))
    alarms, hours, highest = 0, 0.0, 0.0
    for r in records:
        false_alarms, resampled_h, mean = resampled(r, np.random.default_rng([r["rig"], 0x57A1E]))
        alarms, hours, highest = alarms + false_alarms, hours + resampled_h, max(highest, mean)
    watched = [watched_good(r) for r in records]
    bent = [_watched(series, r["expected_nis"]) for r in records for series in r["bent"]]
    return {
        "rigs": len(records),
        "lap_m": records[0]["lap_m"],
        "found_rms_m": np.sqrt(np.mean(drift["found"] ** 2, axis=0)),
        "true_rms_m": np.sqrt(np.mean(drift["true"] ** 2, axis=0)),
        "drift_ratio": ratio,
        "expected_nis": [r["expected_nis"] for r in records],
        "bent_nis": [r["bent_nis"] for r in records],
        "driven_h": sum(w["seconds"] for w in watched) / 3600.0,
        "driven_alarms": sum(w["alarms"] for w in watched),
        "driven_highest": max(w["highest"] for w in watched),
        "resampled_h": hours,
        "resampled_alarms": alarms,
        "resampled_highest": highest,
        "worst_quarter": max(worst_quarter(r) for r in records),
        "bent_noticed": sum(b["alarms"] > 0 for b in bent),
        "bent": len(bent),
        "bent_first_s": [b["first_s"] for b in bent],
    }


def resampled(record: dict[str, Any], rng: np.random.Generator, hours: float = _HOURS) -> tuple[int, float, float]:
    """Alarms in many hours of the rig's own NIS, blocks of ten seconds of it in random order; hours, highest mean.

    Within a block the correlation from update to update is the pipeline's own.
    """
    t, nis = np.array(_after_survey(record)).T
    t -= t[0]
    blocks = [np.flatnonzero((t >= s) & (t < s + _BLOCK_S)) for s in np.arange(0.0, t[-1] - _BLOCK_S, 1.0)]
    monitor, alarms, highest = StalenessMonitor(record["expected_nis"]), 0, 0.0
    for i in range(round(hours * 3600.0 / _BLOCK_S)):
        rows = blocks[int(rng.integers(len(blocks)))]
        for j in rows[::4]:  # every fourth update: the mean is the same, and the study four times as quick
            before = monitor.last.stale
            now = monitor.add(round(1e9 * (i * _BLOCK_S + t[j] - t[rows[0]])), float(nis[j]), 20)
            alarms += int(now.stale and not before)
            highest = max(highest, float(np.nan_to_num(now.mean_nis)) / record["expected_nis"])
    return alarms, hours, highest


def worst_quarter(record: dict[str, Any]) -> float:
    """Mean NIS over the expected in the worst quarter of the lap: of a robot that never leaves it."""
    t, nis = np.array(_after_survey(record)).T
    lap_s = record["good"][-1][0] / GOOD_LAPS
    part = np.floor(4.0 * (t % lap_s) / lap_s)
    return max(float(nis[part == k].mean()) for k in range(4)) / float(record["expected_nis"])


def bars(f: dict[str, Any]) -> list[bool]:
    return [bool(f["drift_ratio"][0] <= DRIFT_BAR), f["driven_alarms"] == 0, f["bent_noticed"] == f["bent"]]


def lines(records: list[dict[str, Any]], f: dict[str, Any]) -> list[str]:
    """For a person."""
    out = []
    for r in records:
        found, true = (1e3 * np.sqrt(np.mean(np.square(r["drift"][k]), axis=0)) for k in ("found", "true"))
        out.append(
            f"rig {r['rig']}: pose {found[0]:.2f} mm rms, {found[1]:.1f} worst with the found calibration, "
            f"{true[0]:.2f}, {true[1]:.1f} with the true one; NIS {r['mean_nis']:.2f}, "
            f"in the survey's worst stretch {r['expected_nis']:.2f}, at most "
            f"{watched_good(r)['highest']:.2f} of that, bent {r['bent_nis'][0]:.1f}, {r['bent_nis'][1]:.1f}"
        )
    rms, worst, odometry = f["drift_ratio"]
    out.append(
        f"drift, found over true calibration, {f['rigs']} rigs, a lap of {f['lap_m']:.1f} m: pose rms {rms:.2f} "
        f"(bar {DRIFT_BAR}), worst {worst:.2f}, odometry {odometry:.2f} "
        f"({1e3 * f['found_rms_m'][2]:.2f} over {1e3 * f['true_rms_m'][2]:.2f} mm)"
    )
    out.append(
        f"false alarms: {f['driven_alarms']} in {f['driven_h']:.2f} h driven (highest mean {f['driven_highest']:.2f} "
        f"of the expected, {HIGH:g} allowed), {f['resampled_alarms']} in {f['resampled_h']:.0f} h resampled (highest "
        f"{f['resampled_highest']:.2f}); staying in the worst quarter of the lap: {f['worst_quarter']:.2f}"
    )
    times = [s for s in f["bent_first_s"] if s is not None]
    out.append(
        f"k1 off by {BENT_K1}: {f['bent_noticed']} of {f['bent']} noticed"
        + (f", after {np.median(times):.0f} s (median), {max(times):.0f} at most" if times else "")
    )
    return out
