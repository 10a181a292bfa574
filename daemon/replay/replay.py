"""A recording through the same pipeline, as fast as it goes; the same bytes every time."""

from __future__ import annotations

import traceback
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from ceilvo.calibration import Calibration
from ceilvo.daemon.pipeline import Pipeline
from ceilvo.daemon.replay.drawing.overlay import draw_overlay, draw_particles_panel, previous_pixels, side_by_side
from ceilvo.daemon.replay.inputs import Continuation, FrameInput, Input, apply
from ceilvo.daemon.replay.trajectory import JsonlWriter, TumWriter, estimate_json, tum_line
from ceilvo.errors import FileFormatError, one_line
from ceilvo.types import Array, Estimate

_UNFIT = (
    ArithmeticError,
    AssertionError,
    AttributeError,
    LookupError,
    MemoryError,
    RuntimeError,
    TypeError,
    ValueError,
    cv2.error,
)
"""What numbers and arrays that do not go together raise, in Python, NumPy and OpenCV."""


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
    source: str = "recording",
    watch: Callable[[Input, Estimate], None] = lambda _given, _estimate: None,
) -> list[Estimate]:
    """Estimates of all frames and silences, in order; frames whose size is not the calibration's are refused.

    Args:
        source: names the inputs in messages.
        watch: called after each estimate with the input that it came from; the pipeline is as it was left then.

    Raises:
        FileFormatError: a frame of another size or not after the one before, a recorded state whose parts do not go
            together, or an output that cannot be written.
    """
    camera = calibration.camera
    tum = TumWriter(outputs.tum) if outputs.tum is not None else None
    jsonl = JsonlWriter(outputs.jsonl) if outputs.jsonl is not None else None
    estimates: list[Estimate] = []
    path: list[Array] = []
    restored = False
    try:
        for given in inputs:
            frame = given.frame if isinstance(given, FrameInput) else None
            if frame is not None and frame.gray.shape != (camera.height_px, camera.width_px):
                raise FileFormatError(
                    f"{source}: frame {frame.seq}: {frame.gray.shape[1]} x {frame.gray.shape[0]} px, expected "
                    f"{camera.width_px} x {camera.height_px} px of the calibration; replay it with its own calibration"
                )
            _check_stamp(pipeline, given, source)
            restored = restored or isinstance(given, Continuation)
            estimate = _of_restored(pipeline, given, source) if restored else apply(pipeline, given)
            if estimate is None:
                continue
            estimates.append(estimate)
            watch(given, estimate)
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


def _check_stamp(pipeline: Pipeline, given: Input, source: str) -> None:
    """As the daemon, which drops what is not after the last estimate and does not record it."""
    stamp_ns = given.frame.stamp_ns if isinstance(given, FrameInput) else getattr(given, "stamp_ns", None)
    before_ns = pipeline.dead_reckoning.state.stamp_ns
    if stamp_ns is not None and before_ns is not None and stamp_ns <= before_ns:
        raise FileFormatError(
            f"{source}: a frame or silence at {stamp_ns} ns, expected one after {before_ns} ns; it is damaged"
        )


def _of_restored(pipeline: Pipeline, given: Input, source: str) -> Estimate | None:
    """apply() to a pipeline whose state is from a file: its arrays and numbers are looked at one by one only, and what
    does not go together shows when it is used."""
    try:
        estimate = apply(pipeline, given)
        if estimate is not None:
            estimate_json(estimate)
            tum_line(estimate.stamp_ns, estimate.pose)
        return estimate
    except _UNFIT as e:
        last = traceback.extract_tb(e.__traceback__)[-1]
        raise FileFormatError(
            f"{source}: the state with which it begins does not go together ({type(e).__name__} at "
            f"{Path(last.filename).name}:{last.lineno}: {one_line(e)}); it is damaged, or of another version of ceilvo"
        ) from e


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
