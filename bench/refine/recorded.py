"""Drives as recordings that have what vision found in each frame, and no frames."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path

import numpy as np

from ceilvo.calibration import Calibration
from ceilvo.calibration_file import render_calibration
from ceilvo.config import Config
from ceilvo.config.rendering import render_config
from ceilvo.daemon.replay.inputs import FrameInput, Sighting, input_json
from ceilvo.daemon.replay.recording import versions
from ceilvo.daemon.replay.snapshot import value_json
from ceilvo.drivers.recording import mcap_file
from ceilvo.drivers.recording.mcap_file import Head, McapFile, Message
from ceilvo.types import Array, Frame

_BLANK = np.zeros((0, 0), np.uint8)
UNIX_NS = 1_700_000_000 * 10**9
"""When the first drive is said to have begun."""


def record(
    path: Path, sightings: Iterable[Sighting], believed: Calibration, start: Array, begun_s: float = 0.0
) -> None:
    """Write a drive that began at a pose (3,), so many s after the first, by a robot with the calibration."""
    x, y, theta = (float(v) for v in start)
    config = Config()
    place = replace(
        config.filter, initial_pose_x_m=x, initial_pose_y_m=y, initial_pose_theta_deg=float(np.degrees(theta))
    )
    files = {
        mcap_file.CONFIG: render_config(replace(config, filter=place)).encode(),
        mcap_file.CALIBRATION: render_calibration(believed, mcap_file.CALIBRATION).encode(),
    }
    metadata = {**versions(), "robot": config.robot.name, "kind": "flight", "frames": "none"}
    file = McapFile(path, Head(metadata, files, UNIX_NS + round(1e9 * begun_s)), 0, start="fresh")
    for k, seen in enumerate(sightings):
        given = FrameInput(Frame(k, seen.stamp_ns, _BLANK), seen.wheels)
        file.write(_message(mcap_file.FEATURES, seen.stamp_ns, value_json(seen.crossings), k))
        file.write(_message(mcap_file.INPUT, seen.stamp_ns, input_json(given, k), k))
    file.close()


def _message(channel: mcap_file.Channel, stamp_ns: int, data: bytes, number: int) -> Message:
    return Message(channel, stamp_ns, lambda _: data, number)
