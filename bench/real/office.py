"""A drive under an office ceiling that another renderer path-traced, against its exact truth, by default settings."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ceilvo import se2
from ceilvo.bench.real.recordings import recorded, starting_at
from ceilvo.calibration_file import read_calibration
from ceilvo.daemon.pipeline import Pipeline
from ceilvo.daemon.replay.trajectory import match_stamps, read_tum
from ceilvo.errors import FileFormatError
from ceilvo.types import State

_MATCH_NS = 1_000
"""Stamps of the truth are those of the frames, rounded to a nanosecond."""
BARS = {"tracking_worst_mm": 20.0, "heading_worst_deg": 0.5, "nees_mean": 2.5}
"""The first is that of every ceiling with two directions (docs/bench.md), the others chosen."""


def office(folder: Path) -> dict[str, float]:
    """Figures of the drive; prints them with their bars."""
    figures = drive(folder)
    judged = [
        f"{name} {figures[name]:.2f} (<= {bar:g}{'' if figures[name] <= bar else ', MISS'})"
        for name, bar in BARS.items()
    ]
    print(
        f"office_rendered: {figures['frames']:.0f} frames, {figures['path_m']:.1f} m, motions of "
        f"{figures['frames_ok']:.0f}, TRACKING {figures['tracking_pct']:.1f} %, {figures['rms_mm']:.2f} mm rms; "
        + ", ".join(judged)
    )
    return figures


def drive(folder: Path) -> dict[str, float]:
    """Every frame through the pipeline, from the true pose on."""
    calibration, truth = read_calibration(folder / "calibration.yaml"), read_tum(folder / "truth.tum")
    frames = list(recorded(folder))
    i, j = match_stamps(np.array([f.stamp_ns for f in frames]), truth.stamp_ns, _MATCH_NS)
    if len(i) != len(frames):
        raise FileFormatError(f"{folder}/truth.tum: has stamps of {len(i)} of {len(frames)} frames, expected all")
    true = truth.poses[j]
    pipeline = Pipeline(calibration, starting_at(true[0]), np.random.default_rng(1))
    estimates = [pipeline.step(frame) for frame in frames]
    off = np.array([se2.between(t, e.pose) for t, e in zip(true, estimates, strict=True)])
    off_mm, off_deg = 1e3 * np.hypot(off[:, 0], off[:, 1]), np.degrees(np.abs(off[:, 2]))
    tracking = np.array([e.state is State.TRACKING for e in estimates])
    nees = [float(o @ np.linalg.solve(e.cov, o)) / 3.0 for o, e in zip(off, estimates, strict=True)]
    return {
        "frames": float(len(frames)),
        "path_m": float(np.sum(np.hypot(*np.diff(true[:, :2], axis=0).T))),
        "frames_ok": float(sum(e.motion.failure in (None, "first frame") for e in estimates)),
        "tracking_pct": 100.0 * float(np.mean(tracking)),
        "rms_mm": float(np.sqrt(np.mean(off_mm**2))),
        "worst_mm": float(np.max(off_mm)),
        "tracking_worst_mm": float(np.max(off_mm[tracking], initial=0.0)),
        "heading_worst_deg": float(np.max(off_deg)),
        "nees_mean": float(np.mean(nees)),
    }
