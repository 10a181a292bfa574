"""A reader under test, and what several of them share: a folder for files, a small rig, a short drive."""

from __future__ import annotations

import contextlib
import io
import json
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from ceilvo.bench.fuzz.engine.bounds import Read
from ceilvo.bench.fuzz.engine.mutations import Mutate, mutated
from ceilvo.calibration import Calibration
from ceilvo.config import Config
from ceilvo.daemon.pipeline import Pipeline
from ceilvo.sim.rig import simulated_calibration, simulated_camera
from ceilvo.types import Crossings, Frame, WheelMotion

Gray = NDArray[np.uint8]

WIDTH_PX, HEIGHT_PX = 160, 120
"""Of the small rig's pictures: enough for 30 crossings, and a step of the pipeline takes 10 ms."""
PERIOD_NS = 33_000_000
"""Between its frames."""
_TILE_M = 0.6  # as simulated_calibration() has it
_SEED = 5


@dataclass(frozen=True)
class Target:
    """A reader of bytes from outside.

    Attributes:
        read: returns, or raises a CeilvoError.
        seeds: valid inputs to start from.
        mutate: makes an input that is almost valid from a valid one.
    """

    read: Read
    seeds: Callable[[], tuple[bytes, ...]]
    mutate: Mutate = mutated


@lru_cache
def folder() -> Path:
    """Of this process, gone with it."""
    return Path(_folder().name)


@lru_cache
def _folder() -> tempfile.TemporaryDirectory[str]:
    return tempfile.TemporaryDirectory(prefix="ceilvo-fuzz-")


def file(name: str, data: bytes) -> Path:
    """A file with these bytes; its folders are made."""
    path = folder() / name
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(data)
    return path


def json_of(data: bytes) -> Any:
    """What JSON has to say, None where it is none."""
    try:
        return json.loads(data)
    except (ValueError, RecursionError):
        return None


@contextmanager
def printed() -> Iterator[None]:
    """What a command prints goes nowhere."""
    nowhere = io.StringIO()
    with contextlib.redirect_stdout(nowhere), contextlib.redirect_stderr(nowhere):
        yield


@lru_cache
def rig() -> Calibration:
    """A camera of WIDTH_PX x HEIGHT_PX."""
    return simulated_calibration(simulated_camera(width_px=WIDTH_PX, height_px=HEIGHT_PX, distortion=()))


def pipeline(method: str = "joint") -> Pipeline:
    """A fresh one of the small rig."""
    config = Config()
    filter_ = type(config.filter)(method=method)
    return Pipeline(rig(), type(config)(filter=filter_), np.random.default_rng(_SEED))


@lru_cache
def frame(k: int) -> Frame:
    """The k-th of a drive under dark joints."""
    fine = 4  # pictures are drawn larger and averaged, so that edges have a place between pixels
    tile_px = _TILE_M * rig().camera.fx_px / rig().ceiling_height_m
    gray = np.full((fine * HEIGHT_PX, fine * WIDTH_PX), 180, np.uint8)
    for i in range(-2, 10):
        x, y = (round(fine * (i * tile_px + start + k * speed)) for start, speed in ((3.0, 1.3), (7.0, 0.4)))
        cv2.line(gray, (x, 0), (x, gray.shape[0]), 90, 6)
        cv2.line(gray, (0, y), (gray.shape[1], y), 90, 6)
    gray = np.asarray(cv2.resize(gray, (WIDTH_PX, HEIGHT_PX), interpolation=cv2.INTER_AREA), np.uint8)
    noise = np.random.default_rng(k).integers(-3, 4, gray.shape)
    return Frame(k, (k + 1) * PERIOD_NS, np.clip(gray + noise, 0, 255).astype(np.uint8))


@lru_cache
def crossings(k: int) -> Crossings:
    """What vision finds in frame(k)."""
    finder = pipeline()
    finder.step(frame(k))
    view = finder.vision.view
    assert view is not None and view.crossings is not None
    return view.crossings


def wheels() -> WheelMotion:
    """Between two frames of the drive, about."""
    return WheelMotion(np.array([-0.028, -0.009, 0.0]), np.diag([1e-4, 1e-4, 1e-4]))  # type: ignore[arg-type]
