"""The walk of one frame through the rooms, as the interpreter takes it: forward, with few returns."""

from __future__ import annotations

import sys
from pathlib import Path
from types import FrameType
from typing import Any

import house
import numpy as np
from golden_drives import HERE

from ceilvo.calibration_file import parse_calibration
from ceilvo.config.reader import parse_config
from ceilvo.daemon.pipeline import Pipeline
from ceilvo.drivers.recording import foxglove
from ceilvo.drivers.recording.mcap_reader import open_recording
from ceilvo.types import Frame

MOST_RETURNS = 4
MOST_ATTRIBUTES, MOST_METHODS = 9, 12  # a stage each, the number of the frame, and what it showed
PAGE = "daemon/pipeline.py"


def walk(pipeline: Pipeline, frame: Frame) -> list[tuple[str, str]]:
    """(room, function) of everything that pipeline.py calls in one step, in order."""
    seen: list[tuple[str, str]] = []

    def note(called: FrameType, event: str, _: Any) -> None:
        caller = called.f_back
        if event == "call" and caller is not None and caller.f_code.co_filename.endswith(PAGE):
            path = Path(called.f_code.co_filename)
            if path.is_relative_to(house.ROOT / "daemon") and not path.match(PAGE):
                seen.append((path.parent.relative_to(house.ROOT).as_posix(), called.f_code.co_name))

    sys.setprofile(note)
    try:
        pipeline.step(frame, on_stage_done=lambda stage: None)
    finally:
        sys.setprofile(None)
    return seen


def recorded() -> tuple[Pipeline, list[np.ndarray]]:
    """A pipeline as it was, with the pictures that it saw."""
    recording = open_recording(HERE.parent / "flight" / "frames.mcap")
    config = parse_config(recording.text("config.yaml"), "config.yaml")
    calibration = parse_calibration(recording.text("calibration.yaml"), "calibration.yaml")
    pictures = [foxglove.read_raw_image(m.data) for m in recording.messages() if m.topic == "/camera"]
    return Pipeline(calibration, config, np.random.default_rng(1)), pictures


def test_the_page_stays_a_page() -> None:
    pipeline, _ = recorded()
    methods = [n for n, v in vars(Pipeline).items() if callable(v) or isinstance(v, property)]
    print(sorted(vars(pipeline)), sorted(methods), sep="\n")
    assert len(vars(pipeline)) <= MOST_ATTRIBUTES
    assert len(methods) <= MOST_METHODS


def test_a_frame_goes_forward_with_at_most_four_returns() -> None:
    pipeline, pictures = recorded()
    for k, gray in enumerate(pictures[:4]):
        steps = walk(pipeline, Frame(k, 10**9 + k * 4 * 10**8, gray))
    assert ("daemon/relocalisation", "look") in steps, "the view of this frame is news"
    rooms = [room for k, (room, _) in enumerate(steps) if k == 0 or room != steps[k - 1][0]]
    floors = [house.floor_of(room) or 0 for room in rooms]
    returns = [rooms[k] for k in range(1, len(rooms)) if floors[k] < floors[k - 1]]
    print(*(f"{room:24} {name}" for room, name in steps), f"{len(rooms)} stays, returns: {returns}", sep="\n")
    stages = ("vision/finder", "odometry", "slam", "relocalisation", "integrity")
    assert {f"daemon/{name}" for name in stages} <= set(rooms)
    assert len(returns) <= MOST_RETURNS
