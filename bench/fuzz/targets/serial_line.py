"""What comes over the serial line: registers, whole answers, a base's wheels; and what the simulated base is sent."""

from __future__ import annotations

import json
import os
import struct
from dataclasses import replace
from functools import lru_cache

import numpy as np

from ceilvo.bench.fuzz.engine.mutations import mutated_json
from ceilvo.bench.fuzz.engine.target import Target, json_of
from ceilvo.config import Base
from ceilvo.drivers.base.mock_base import BaseModel
from ceilvo.drivers.base.modbus import ModbusBase
from ceilvo.drivers.base.protocol import decode_pose, decode_status, encode_pose, encode_status, no_estimate
from ceilvo.drivers.base.wheel_track import WheelTrack
from ceilvo.sim.rtu import answer, crc_is_good, request_size, with_crc

_TIMEOUT_S = 0.004
"""Of the port: nothing is on its way here."""
_UNIT, _READ_WRITE = 1, 23
_PERIOD_NS = 50_000_000
"""Between two answers of the base."""
_SIGNED = 0x80
"""Of the first byte: what follows gets the checksum that belongs to it."""


def _status_block(data: bytes) -> None:
    decode_status(_registers(data))


def _pose_block(data: bytes) -> None:
    decode_pose(_registers(data))


class _Line:
    """A port on which these bytes come whatever is sent."""

    is_open = True

    def __init__(self, data: bytes) -> None:
        self._answer, self._waiting = data, b""

    @property
    def in_waiting(self) -> int:
        return len(self._waiting)

    def write(self, data: bytes) -> int:
        self._waiting = self._answer
        return len(data)

    def read(self, size: int) -> bytes:
        out, self._waiting = self._waiting[:size], self._waiting[size:]
        return out

    def close(self) -> None:
        """It is none."""


@lru_cache
def _terminal() -> str:
    """A pseudo-terminal, so that the port can be opened."""
    return os.ttyname(os.openpty()[1])


def _answers(data: bytes) -> None:
    signed = data[:1] >= bytes([_SIGNED])
    base = ModbusBase(Base(port=_terminal(), timeout_s=_TIMEOUT_S, unit_id=_UNIT))
    base.open()
    try:
        client = base._client
        assert client is not None and client.socket is not None
        client.socket.close()
        client.socket = _Line(with_crc(data[1:]) if signed else data[1:])
        base.exchange(no_estimate(1))
    finally:
        base.close()


def _wheels(data: bytes) -> None:
    """Status blocks of a base that lies; every second is asked about."""
    track, rows = WheelTrack(), json_of(data)
    for k, row in enumerate(rows if isinstance(rows, list) else []):
        if isinstance(row, list) and all(isinstance(v, int) and 0 <= v <= 0xFFFF for v in row):
            track.add(decode_status(row), k * _PERIOD_NS)
            motion = track.between((k - 1) * _PERIOD_NS, k * _PERIOD_NS)
            if motion is not None and not (np.isfinite(motion.prev_from_curr).all() and np.isfinite(motion.cov).all()):
                raise AssertionError(f"a motion that is not finite: {motion}")


class _Memory:
    """Of a base: a few registers."""

    def read(self, function: int, address: int, count: int) -> list[int]:
        return [0] * count

    def write(self, address: int, values: list[int]) -> None:
        """Taken."""


def _requests(data: bytes) -> None:
    """To the simulated base, which answers what has a good checksum."""
    size = request_size(data)
    frame = with_crc(data[: size - 2] if size else data)
    if crc_is_good(frame) and size == len(frame):
        answer(frame, _Memory())


def _answer_seeds() -> tuple[bytes, ...]:
    block = _packed(BaseModel().read_status())
    body = bytes((_UNIT, _READ_WRITE, len(block))) + block
    return (bytes([_SIGNED]) + body, b"\0" + with_crc(body))


def _request_seeds() -> tuple[bytes, ...]:
    read = bytes((_UNIT, 4)) + struct.pack(">HH", 1100, 8)
    write = bytes((_UNIT, 16)) + struct.pack(">HHB4s", 1000, 2, 4, b"\0\1\0\2")
    both = bytes((_UNIT, _READ_WRITE)) + struct.pack(">HHHHB4s", 1100, 8, 1000, 2, 4, b"\0\1\0\2")
    return tuple(with_crc(b) for b in (read, write, both))


def _wheel_seeds() -> tuple[bytes, ...]:
    status = decode_status(BaseModel().read_status())
    moved = (replace(status, wheel_x_count=100 * k, wheel_theta_count=10 * k, clock_ms=50 * k) for k in range(8))
    return (json.dumps([encode_status(m) for m in moved]).encode(),)


def _registers(data: bytes) -> list[int]:
    return list(struct.unpack(f">{len(data) // 2}H", data[: len(data) // 2 * 2]))


def _packed(registers: list[int]) -> bytes:
    return struct.pack(f">{len(registers)}H", *registers)


TARGETS = {
    "status_block": Target(_status_block, lambda: (_packed(BaseModel().read_status()),)),
    "pose_block": Target(_pose_block, lambda: (_packed(encode_pose(no_estimate(1))),)),
    "base_answer": Target(_answers, _answer_seeds),
    "base_wheels": Target(_wheels, _wheel_seeds, mutated_json),
    "base_request": Target(_requests, _request_seeds),
}
