"""`ceilvod replay`: a recording from disk through the pipeline, and its distance from a reference."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import cv2
import numpy as np

from ceilvo.calibration import Calibration
from ceilvo.config import Config
from ceilvo.daemon.pipeline import Pipeline
from ceilvo.daemon.replay.inputs import FrameInput
from ceilvo.daemon.replay.replay import Outputs, format_replay, replay
from ceilvo.daemon.replay.summary import RunStatistics
from ceilvo.daemon.replay.trajectory import (
    Alignment,
    TrajectoryError,
    format_error,
    match_stamps,
    read_tum,
    trajectory_error,
)
from ceilvo.drivers.camera.selection import source_camera
from ceilvo.drivers.ports import Camera
from ceilvo.errors import FileFormatError
from ceilvo.types import Estimate

_REFERENCE_TOLERANCE_S = 0.01
"""A reference pose belongs to an estimate when their stamps differ by no more; chosen: a third of 30 Hz' period."""
_PROGRESS_EVERY = 10
"""Estimates between two lines of progress; chosen."""


def replay_recording(
    source: Path, config: Config, calibration: Calibration, outputs: Outputs, reference: Path | None, align: Alignment
) -> int:
    """Run a recording through the pipeline and print what came out; returns the exit code."""
    cv2.setNumThreads(config.service.opencv_threads)
    lens = calibration.camera
    camera = source_camera(source, lens.width_px, lens.height_px, config.camera.rate_hz)
    pipeline = Pipeline(calibration, config, np.random.default_rng(config.service.seed))
    camera.open()
    try:
        estimates = replay(_frames(camera), pipeline, calibration, outputs, progress(), str(source))
    finally:
        camera.close()
    sys.stdout.write(report(estimates, config.service.seed, source, reference, align))
    return 0


def check_source(source: Path) -> None:
    """Whether there are pictures in it at all, before anybody is asked for their calibration.

    Raises:
        FileFormatError: there are none.
    """
    if source.is_dir() and any(source.glob("*.raw.gz")):
        return  # their size is the calibration's to say
    camera = source_camera(source)
    try:
        camera.open()
    except FileFormatError as e:
        raise FileFormatError(f"{e}; replay takes an MCAP file, a folder of pictures or a video") from None
    finally:
        camera.close()


def report(estimates: list[Estimate], seed: int, source: Path, reference: Path | None, align: Alignment) -> str:
    """Lines about what came out, and its distance from a reference if there is one."""
    statistics = RunStatistics(seed)
    for estimate in estimates:
        statistics.add(estimate)
    text = format_replay(estimates, statistics.summary())
    if reference is not None:
        text += format_error(distance(estimates, reference, align), (str(source), str(reference)))
    return text


def distance(estimates: list[Estimate], reference: Path, align: Alignment) -> TrajectoryError:
    """Distance from a TUM trajectory that shares the frames' clock."""
    ref = read_tum(reference)
    stamps = np.array([e.stamp_ns for e in estimates], np.int64)
    i, j = match_stamps(stamps, ref.stamp_ns, round(1e9 * _REFERENCE_TOLERANCE_S))
    if not len(i):
        raise FileFormatError(
            f"{reference}: no stamp within {_REFERENCE_TOLERANCE_S:g} s of a frame's; the two must share a clock"
        )
    return trajectory_error(np.array([e.pose for e in estimates])[i], ref.poses[j], align)


def _frames(camera: Camera) -> Iterator[FrameInput]:
    while (frame := camera.read()) is not None:
        yield FrameInput(frame)


def progress() -> Callable[[int], None]:
    if not sys.stderr.isatty():
        return lambda done: None

    def show(done: int) -> None:
        if done % _PROGRESS_EVERY == 0:
            print(f"\r{done} frames ", end="", file=sys.stderr, flush=True)

    return show
