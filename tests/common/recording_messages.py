"""Messages for recordings under test: numbered texts and pictures of noise."""

from __future__ import annotations

import json

import numpy as np

from ceilvo.drivers.recording import foxglove
from ceilvo.drivers.recording.mcap_file import CALIBRATION, CONFIG, FRAMES, HEALTH, Head, Message

S = 1_000_000_000
UNIX_NS = 1_700_000_000 * S
HEAD = Head({"robot": "r", "kind": "recording"}, {CONFIG: b"camera: {}\n", CALIBRATION: b"version: 1\n"}, UNIX_NS)


def text(stamp_ns: int, body: object, number: int = 0) -> Message:
    return Message(HEALTH, stamp_ns, lambda _: json.dumps(body).encode(), number)


def noise(seed: int, height: int = 48, width: int = 64) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 256, (height, width), np.uint8)


def picture(stamp_ns: int, number: int) -> Message:
    return Message(FRAMES, stamp_ns, lambda unix_ns: foxglove.raw_image(unix_ns, noise(number), "camera"), number)
