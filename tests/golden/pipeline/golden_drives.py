"""Golden drives: what a camera and wheels gave, what was asked for, and every estimate that came of it.

`OPENBLAS_NUM_THREADS=1 python tests/golden/pipeline/golden_drives.py` renders the drives and estimates anew, as
the tests do; --estimates: only estimates.
Either is a decision: the estimates change only where the method was meant to change.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import sys
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from ceilvo import se2
from ceilvo.calibration import Calibration
from ceilvo.config import Config, Filter
from ceilvo.daemon.pipeline import Pipeline
from ceilvo.daemon.vision.crossings import cross
from ceilvo.daemon.vision.finder.line_finder import LineFinder
from ceilvo.daemon.vision.kernel import COMPILED
from ceilvo.sim.motion import LapSpec, TiltSpec
from ceilvo.sim.rig import simulated_calibration, simulated_camera
from ceilvo.sim.world import World, WorldSpec
from ceilvo.types import Crossings, Estimate, WheelMotion

HERE = Path(__file__).parent
RATE_HZ = 10.0
PIPELINE_SEED = 20
METHODS: Mapping[str, tuple[str, ...]] = {
    "lap": ("joint", "pfcf_paper", "pf", "ukf"),
    "rocking": ("joint",),
    "calibration_off": ("joint",),
}
WORLDS: Mapping[str, WorldSpec] = {
    "lap": WorldSpec(seed=1101, lap=LapSpec(room_m=3.6, speed_mps=0.5)),
    "rocking": WorldSpec(
        seed=1102, lap=LapSpec(room_m=4.0, speed_mps=0.5), tilt=TiltSpec(amplitude_rad=float(np.radians(1.5)))
    ),
    "calibration_off": WorldSpec(seed=1103, lap=LapSpec(room_m=3.6, speed_mps=0.5)),
}
SECONDS: Mapping[str, float] = {"lap": 16.0, "rocking": 40.0, "calibration_off": 14.0}
WHEEL_SIGMA = np.array([0.004, 0.004, 0.004])
"""[m, m, rad] of one step of the wheels."""

REQUESTS: Mapping[str, Mapping[int, Mapping[str, Any]]] = {
    "lap": {},
    "calibration_off": {},
    "rocking": {
        100: {"do": "silent", "frames": 4},
        155: {"do": "dark", "frames": 5},
        175: {"do": "assume", "off": [0.03, 0.02, 0.01], "sigma": [0.05, 0.05, 0.05]},
        190: {"do": "assume", "off": [0.6, 0.0, 0.0], "sigma": [0.3, 0.3, 0.1]},
        235: {"do": "restart", "off": [0.02, -0.03, 0.01], "sigma": [0.05, 0.05, 0.05]},
        265: {"do": "restart", "off": [0.0, 0.6, 0.0], "sigma": [0.2, 0.2, 0.1]},
        300: {"do": "dark", "frames": 4, "wheels": False},
        320: {"do": "stale", "frames": 3},
        340: {"do": "carried", "frames": 8},
        360: {"do": "reset", "keep_map": True},
        385: {"do": "reset", "keep_map": False},
    },
}
"""By frame: faults of the camera for so many frames, and what somebody asks for before that frame."""


@dataclass(frozen=True)
class Drive:
    """Crossings (None: the frame gave none) and wheels of every frame, at stamps 1 / RATE_HZ apart."""

    name: str
    calibration: Calibration
    config: Config
    crossings: tuple[Crossings, ...]
    wheels: tuple[WheelMotion, ...]


def believed_calibration(name: str) -> Calibration:
    """The simulated rig's; off by 1.5 % in focal length, 1 % in height and .4 deg in tilt where the name says so."""
    if name != "calibration_off":
        return simulated_calibration()
    camera = simulated_camera()
    off = replace(camera, fx_px=1.015 * camera.fx_px, fy_px=1.015 * camera.fy_px)
    return simulated_calibration(off, ceiling_height_m=2.2 * 1.01, pitch_rad=float(np.radians(0.4)))


def config_of(name: str, method: str) -> Config:
    x, y, theta = (float(v) for v in World(WORLDS[name]).initial_pose)
    start = Filter(
        initial_pose_x_m=x, initial_pose_y_m=y, initial_pose_theta_deg=float(np.degrees(theta)), method=method
    )
    return Config(filter=start)


# -- the drives on disk: what a filter cannot know better than as float32 is kept so, and is exact as it is read


def record(name: str) -> None:
    """Render a drive and keep what was found in it."""
    world, calibration, config = World(WORLDS[name]), believed_calibration(name), Config()
    finder = LineFinder(calibration, config.features)
    times = np.arange(round(SECONDS[name] * RATE_HZ)) / RATE_HZ
    found: list[Crossings] = []
    for t in times:
        lines = finder(world.frame_at(float(t)), None)
        assert lines is not None, f"{name}: no lines at {t} s"
        found.append(cross(lines, calibration, config.features))
    odom = np.array([world.wheel_odometry_at(float(t)) for t in times])
    steps = np.concatenate([np.zeros((1, 3)), se2.between(odom[:-1], odom[1:])])
    columns = {
        "count": np.array([len(c) for c in found], np.int16),
        "uv_px": np.concatenate([c.uv_px for c in found]).astype(np.float32),
        "xy_base_m": np.concatenate([c.xy_base_m for c in found]).astype(np.float32),
        "cov_base_m2": np.concatenate([c.cov_base_m2[:, [0, 0, 1], [0, 1, 1]] for c in found]).astype(np.float32),
        "kind": np.concatenate([c.crossing_type for c in found]).astype(np.uint8),
        "frame": np.array(
            [
                [c.psi_rad, c.psi_sigma_rad, *c.tilt_rad, *c.tilt_sigma_rad, *c.common_cov_m2[[0, 0, 1], [0, 1, 1]]]
                for c in found
            ]
        ),
        "wheels": steps.astype(np.float32),
    }
    np.savez_compressed(HERE / f"{name}.npz", allow_pickle=False, **columns)


def load(name: str, method: str) -> Drive:
    with np.load(HERE / f"{name}.npz", allow_pickle=False) as f:
        columns = {k: f[k] for k in f.files}
    ends = np.cumsum(columns["count"].astype(np.int64))
    crossings = []
    for k, end in enumerate(ends):
        rows = slice(end - columns["count"][k], end)
        head = columns["frame"][k]
        crossings.append(
            Crossings(
                columns["uv_px"][rows].astype(np.float64),
                columns["xy_base_m"][rows].astype(np.float64),
                np.ascontiguousarray(columns["cov_base_m2"][rows].astype(np.float64)[:, [[0, 1], [1, 2]]]),
                columns["kind"][rows].astype(np.int64),
                float(head[0]),
                float(head[1]),
                head[2:4].copy(),
                head[4:6].copy(),
                head[6:9][[[0, 1], [1, 2]]],
            )
        )
    wheels = tuple(WheelMotion(w.astype(np.float64), np.diag(WHEEL_SIGMA**2)) for w in columns["wheels"])
    return Drive(name, believed_calibration(name), config_of(name, method), tuple(crossings), wheels)


# -- the run


def estimates(drive: Drive) -> Iterator[Estimate]:
    """Every frame of a drive, with its faults and requests, through a pipeline."""
    rng = np.random.default_rng(PIPELINE_SEED)
    pipeline = Pipeline(drive.calibration, drive.config, rng)
    fault: Mapping[str, Any] = {}
    until, stamp_ns = 0, 10**9
    pose = np.zeros(3)
    for k, seen in enumerate(drive.crossings):
        stamp_ns += round(1e9 / RATE_HZ)
        request = REQUESTS[drive.name].get(k)
        if request is not None and "frames" in request:
            fault, until = request, k + request["frames"]
        elif request is not None:
            pipeline = _asked(pipeline, drive, request, pose, rng)
        kind = fault["do"] if k < until else ""
        wheels = drive.wheels[k]
        given: WheelMotion | None = wheels
        if kind == "carried":
            given = WheelMotion(np.zeros(3), wheels.cov)
        elif k < until and not fault.get("wheels", True):
            given = None
        if kind == "silent":
            estimate = pipeline.step_crossings(stamp_ns, None, given, missing="camera silent")
        elif kind in ("dark", "carried"):
            estimate = pipeline.step_crossings(stamp_ns, None, given)
        elif kind == "stale":
            estimate = pipeline.step_crossings(stamp_ns, drive.crossings[until - fault["frames"]], given)
        else:
            estimate = pipeline.step_crossings(stamp_ns, seen, given)
        pose = estimate.pose
        yield estimate


def _asked(
    pipeline: Pipeline, drive: Drive, request: Mapping[str, Any], pose: np.ndarray, rng: np.random.Generator
) -> Pipeline:
    if request["do"] == "reset":
        pipeline.reset(request["keep_map"])
        return pipeline
    cov, off = np.diag(np.square(request["sigma"])), pose + np.array(request["off"])
    if request["do"] == "assume":
        pipeline.set_pose(off, cov, "said by somebody")
        return pipeline
    landmarks, axis = pipeline.filter.landmarks(), pipeline.relocaliser.state.map_axis_rad
    assert axis is not None
    again = Pipeline(drive.calibration, drive.config, rng.spawn(1)[0])
    again.load_map(landmarks, axis, off, cov)
    return again


def table(run: Iterator[Estimate]) -> tuple[np.ndarray, list[str]]:
    """(F, 46) every figure of every estimate, and its words."""
    rows, words = [], []
    for e in run:
        d, m = e.health, e.motion
        figures = [*e.pose, *e.cov.ravel(), *e.odom, *e.twist, int(e.state), e.quality, *m.prev_from_curr]
        figures += [*m.cov.ravel(), m.inliers, m.rms_m, m.restarted, d.ess, d.fit_residual, d.nis, d.nis_dof]
        figures += [d.mode_weight, e.crossings, e.landmarks, e.seq]
        rows.append([float(v) for v in figures])
        words.append(f"{e.state.name} {e.reason} | {m.failure or ''}")
    return np.array(rows), words


def on_the_same_platform() -> bool:
    """Whether estimates must be equal to the last bit."""
    return bool(json.loads((HERE / "platform.json").read_text()) == fingerprint())


def fingerprint() -> dict[str, str]:
    """What the last bits depend on: two computers with the same words are the same platform."""
    cpu = [
        v for v in Path("/proc/cpuinfo").read_text().splitlines() if v.startswith(("model name", "CPU part", "flags"))
    ]
    return {
        "machine": platform.machine(),
        "cpu": str(sorted(set(cpu))),
        "numpy": np.__version__,
        "opencv": cv2.__version__,
        "blas_threads": os.environ.get("OPENBLAS_NUM_THREADS", "all"),
        "kernel": "compiled" if COMPILED else "numpy",
    }


def main(arguments: list[str]) -> None:
    p = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    p.add_argument("--estimates", action="store_true", help="keep the drives, estimate anew")
    a = p.parse_args(arguments)
    cv2.setNumThreads(1)
    for name, methods in METHODS.items():
        if not a.estimates:
            record(name)
        for method in methods:
            figures, words = table(estimates(load(name, method)))
            np.savez_compressed(
                HERE / f"{name}.{method}.npz", allow_pickle=False, figures=figures, words=np.array(words)
            )
            print(f"{name} {method}: {len(figures)} estimates")
    (HERE / "platform.json").write_text(json.dumps(fingerprint(), indent=1) + "\n")


if __name__ == "__main__":
    main(sys.argv[1:])
