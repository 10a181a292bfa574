"""A recording through the same pipeline, as fast as it goes; the same bytes every time."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from ceilvo.calibration import Calibration
from ceilvo.daemon.pipeline import Pipeline
from ceilvo.daemon.replay.inputs import FrameInput, Input, apply
from ceilvo.daemon.replay.overlay import draw_overlay, draw_particles_panel, previous_pixels, side_by_side
from ceilvo.daemon.replay.trajectory import JsonlWriter, TumWriter
from ceilvo.errors import FileFormatError
from ceilvo.types import Array, Estimate


@dataclass(frozen=True)
class Outputs:
    """Where results go; None = not wanted. A picture is made of every `picture_every`-th frame."""

    tum: Path | None = None
    jsonl: Path | None = None
    pictures: Path | None = None
    picture_every: int = 10


def replay(
    inputs: Iterable[Input],
    pipeline: Pipeline,
    calibration: Calibration,
    outputs: Outputs,
    progress: Callable[[int], None] = lambda done: None,
) -> list[Estimate]:
    """Estimates of all frames and silences, in order; frames whose size is not the calibration's are refused.

    Raises:
        FileFormatError: a frame of another size, or an output that cannot be written.
    """
    camera = calibration.camera
    tum = TumWriter(outputs.tum) if outputs.tum is not None else None
    jsonl = JsonlWriter(outputs.jsonl) if outputs.jsonl is not None else None
    estimates: list[Estimate] = []
    path: list[Array] = []
    try:
        for given in inputs:
            frame = given.frame if isinstance(given, FrameInput) else None
            if frame is not None and frame.gray.shape != (camera.height_px, camera.width_px):
                raise FileFormatError(
                    f"frame {frame.seq}: {frame.gray.shape[1]} x {frame.gray.shape[0]} px, expected "
                    f"{camera.width_px} x {camera.height_px} px of the calibration; replay it with its own calibration"
                )
            estimate = apply(pipeline, given)
            if estimate is None:
                continue
            estimates.append(estimate)
            path.append(estimate.pose)
            for writer in (tum, jsonl):
                if writer is not None:
                    writer.write(estimate)
            if frame is not None and outputs.pictures is not None and (len(estimates) - 1) % outputs.picture_every == 0:
                picture(pipeline, calibration, estimate, np.array(path), outputs.pictures / f"{frame.seq:06d}.png")
            progress(len(estimates))
    finally:
        for writer in (tum, jsonl):
            if writer is not None:
                writer.close()
    return estimates


def picture(pipeline: Pipeline, calibration: Calibration, estimate: Estimate, path: Array, file: Path) -> None:
    """Lines and crossings on the frame beside particles and map, as an image file."""
    view = pipeline.vision.view
    if view is None:
        return
    before = None if view.crossings is None else previous_pixels(view.crossings, estimate.motion, calibration)
    frame = draw_overlay(view.frame.gray, view.lines, view.crossings, calibration.level_view, before, scale=2)
    particles, weights = pipeline.filter.particles()
    m = pipeline.filter.landmarks()
    panel = draw_particles_panel(
        particles, weights, m.xy_map_m, m.cov_m2, estimate.pose, path[:, :2], size_px=frame.shape[0]
    )
    file.parent.mkdir(parents=True, exist_ok=True)
    captions = {"left": "lines and crossings", "right": "particles, landmarks, path"}
    if not cv2.imwrite(str(file), side_by_side(frame, panel, captions)):
        raise FileFormatError(f"{file}: cannot be written; check the folder and the disk")


def format_replay(estimates: list[Estimate], summary: dict[str, Any]) -> str:
    """A few lines about a replay."""
    failed = [e for e in estimates if not e.motion.ok]
    states = {name: sum(e.state.name == name for e in estimates) for name in sorted({e.state.name for e in estimates})}
    rows = [
        f"frames     {len(estimates)} in {summary['seconds']:.2f} s, {summary['distance_m']:.2f} m travelled",
        f"motions    {len(estimates) - len(failed)} good, {len(failed)} predicted",
        "states     " + ", ".join(f"{count} {name}" for name, count in states.items()),
    ]
    if estimates:
        x, y, theta = estimates[-1].pose
        rows.append(f"last pose  {x:.4f} m, {y:.4f} m, {np.degrees(theta):.3f} deg")
    return "\n".join(rows) + "\n"
