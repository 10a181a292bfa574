"""Everything that reads bytes from outside, as one function each: it returns, or raises an error of ours.

Files with a checksum are signed again after the bytes were mutated, so that what lies behind it is reached.
"""

from __future__ import annotations

import json
import struct
import tempfile
from collections.abc import Callable
from functools import lru_cache
from pathlib import Path

import numpy as np

from ceilvo.calibration_file import read_calibration, sign_calibration, write_calibration
from ceilvo.config import Config
from ceilvo.config.reader import load_config
from ceilvo.config.rendering import render_config
from ceilvo.daemon.map.map_file import _digest, load_map, load_state, save_map, save_state
from ceilvo.drivers.base.mock_base import BaseModel
from ceilvo.drivers.base.protocol import decode_pose, decode_status, encode_pose, encode_status, no_estimate
from ceilvo.drivers.bus.commands import COMMANDS, parse_command
from ceilvo.drivers.bus.messages import decode_pose as decode_pose_message
from ceilvo.errors import CeilvoError
from ceilvo.sim.rig import simulated_calibration
from ceilvo.types import Landmarks, State

Target = Callable[[bytes], None]
_FOLDER = Path(tempfile.mkdtemp(prefix="ceilvo-fuzz-"))


def run(target: Target, data: bytes) -> None:
    """One input; whatever is not ours comes out."""
    try:
        target(data)
    except CeilvoError as e:
        text = str(e)
        if not text.strip() or len(text) > 1_000_000:
            raise AssertionError(f"an error without a usable message: {text[:80]!r}") from e


def config(data: bytes) -> None:
    load_config(_file("config.yaml", data))


def calibration(data: bytes) -> None:
    read_calibration(_file("calibration.yaml", data))


def signed_calibration(data: bytes) -> None:
    sign_calibration(_file("signed.yaml", data))


def stored_map(data: bytes) -> None:
    load_map(_file("map.json", _signed(data)))


def stored_state(data: bytes) -> None:
    load_state(_file("state.json", _signed(data)))


def status_block(data: bytes) -> None:
    decode_status(_registers(data))


def pose_block(data: bytes) -> None:
    decode_pose(_registers(data))


def command(data: bytes) -> None:
    if data:
        parse_command(COMMANDS[data[0] % len(COMMANDS)], data[1:])


def pose_message(data: bytes) -> None:
    decode_pose_message(data)


TARGETS: dict[str, Target] = {
    "config": config,
    "calibration": calibration,
    "signed_calibration": signed_calibration,
    "map": stored_map,
    "state": stored_state,
    "status_block": status_block,
    "pose_block": pose_block,
    "command": command,
    "pose_message": pose_message,
}


@lru_cache
def seeds(name: str) -> tuple[bytes, ...]:
    """Valid inputs to start from."""
    if name == "config":
        return (
            render_config(Config()).encode(),
            b"robot: {name: r}\ncamera: {rate_hz: 15, gain: null}\n",
        )
    if name in ("calibration", "signed_calibration"):
        path = _FOLDER / "seed.yaml"
        write_calibration(path, simulated_calibration(), force=True)
        return (path.read_bytes(),)
    if name == "map":
        path, n = _FOLDER / "seed-map.json", 3
        cov = np.tile(0.01 * np.eye(2), (n, 1, 1))
        save_map(path, Landmarks(np.arange(n), np.ones((n, 2)), cov, np.full(n, 4), np.full(n, 3)), 0.25)
        return (path.read_bytes(),)
    if name == "state":
        path = _FOLDER / "seed-state.json"
        save_state(path, np.array([1.0, 2.0, 0.5]), 0.01 * np.eye(3), State.TRACKING, 1)
        return (path.read_bytes(),)
    if name == "status_block":
        registers = BaseModel().read_status()
        return (
            _packed(registers),
            _packed(encode_status(decode_status(registers))),
        )
    if name == "pose_block":
        return (_packed(encode_pose(no_estimate(1))),)
    if name == "command":
        pose = b'{"x_m": 1.0, "y_m": -2.5, "theta_rad": 0.5, "sigma_m": 0.1}'
        return (
            b"\0" + pose,
            b"\1{}",
            b"\2",
            b'\3{"keep_map": true}',
        )
    return (b'{"schema": "ceilvo.pose.1", "robot": "r", "seq": 1, "stamp_ns": 2, "state": "TRACKING", "cov": [1, 2]}',)


def _file(name: str, data: bytes) -> Path:
    path = _FOLDER / name
    path.write_bytes(data)
    return path


def _signed(data: bytes) -> bytes:
    """With the checksum that belongs to the content, where there is one to be had."""
    try:
        document = json.loads(data)
        document["sha256"] = _digest(document["content"])
        return json.dumps(document).encode()
    except Exception:
        return data


def _registers(data: bytes) -> list[int]:
    return list(struct.unpack(f">{len(data) // 2}H", data[: len(data) // 2 * 2]))


def _packed(registers: list[int]) -> bytes:
    return struct.pack(f">{len(registers)}H", *registers)
