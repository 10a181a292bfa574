"""The documented bytes, the golden file and what the driver and the simulated base put on a line are the same."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from ceilvo import config
from ceilvo.config.serial_budget import wire_budget
from ceilvo.drivers.base import protocol as bp
from ceilvo.drivers.base.modbus import ModbusBase
from ceilvo.drivers.telegrams import BaseStatus, PoseTelegram
from ceilvo.sim.base import SimBase
from ceilvo.types import State

ROOT = Path(__file__).parents[3]
GOLDEN: dict[str, Any] = json.loads((ROOT / "tests/golden/base_telegrams.json").read_text())
DOC = (ROOT / "docs/base-protocol.md").read_text()
TELEGRAM = PoseTelegram(**{**GOLDEN["telegram"], "state": State[GOLDEN["telegram"]["state"]]})
STATUS = BaseStatus(**GOLDEN["status"])


def crc_by_division(data: bytes) -> bytes:
    """CRC-16/MODBUS as a polynomial division over one big integer, x^16 + x^15 + x^2 + 1, bits reflected."""
    bits = [int(b) for byte in data for b in f"{byte:08b}"[::-1]]
    bits = [b ^ (i < 16) for i, b in enumerate([*bits, *[0] * 16])]
    for i in range(len(bits) - 16):
        if bits[i]:
            for power in (16, 15, 2, 0):
                bits[i + 16 - power] ^= 1
    crc = sum(b << i for i, b in enumerate(bits[-16:]))
    return crc.to_bytes(2, "little")


def golden_frame(name: str) -> bytes:
    parts = GOLDEN["frames"][name]
    text = "".join("".join(v for _, v in GOLDEN[p]) if p in GOLDEN else p for p in parts)
    body = bytes.fromhex(text)
    return body + crc_by_division(body)


def test_crc_by_division_gives_the_catalogued_check_value() -> None:
    assert crc_by_division(b"123456789") == bytes.fromhex("374b")


@pytest.mark.parametrize("name", GOLDEN["frames"])
def test_the_document_shows_the_golden_frames(name: str) -> None:
    block = re.search(rf"^```{name}\n(.*?)^```", DOC, re.M | re.S)
    assert block is not None
    assert bytes.fromhex(block[1]) == golden_frame(name)


def test_blocks_are_encoded_as_golden() -> None:
    pose = "".join(f"{r:04x}" for r in bp.encode_pose(TELEGRAM))
    status = "".join(f"{r:04x}" for r in bp.encode_status(STATUS))
    assert pose == "".join(v for _, v in GOLDEN["pose_block"])
    assert status == "".join(v for _, v in GOLDEN["status_block"])


class _Scripted(SimBase):
    """The simulated base with a fixed status."""

    def read(self, function: int, address: int, count: int) -> list[int]:
        assert (address, count) == (bp.STATUS_ADDRESS, 10)
        return bp.encode_status(STATUS)


@pytest.fixture
def sim() -> Iterator[SimBase]:
    with _Scripted(baud=1_000_000, turnaround_s=0.0) as sim:
        yield sim


@pytest.mark.parametrize(("function", "codes"), [("fc23", ["fc23"]), ("fc16_fc04", ["fc16", "fc04"])])
def test_golden_frames_are_what_goes_over_the_line(sim: SimBase, function: str, codes: list[str]) -> None:
    base = ModbusBase(config.Base(port=sim.port, baud=1_000_000, function=function, timeout_s=2.0))
    base.open()
    try:
        assert base.exchange(TELEGRAM) == STATUS
    finally:
        base.close()
    expected = []
    for code in codes:
        expected += [("<", golden_frame(f"{code} request")), (">", golden_frame(f"{code} response"))]
    assert list(sim.wire) == expected


def test_the_documents_table_of_times_is_the_budget() -> None:
    rows = re.findall(r"^\| (\d{4,6}) \| (\d\.\d{3} .*?) \|$", DOC, re.M)
    assert [int(r[0]) for r in rows] == [9600, 19200, 38400, 57600, 115200]
    for baud, cells in rows:
        one = wire_budget(config.Base(baud=int(baud)))
        two = wire_budget(config.Base(baud=int(baud), function="fc16_fc04"))
        assert cells.split(" | ") == [
            f"{1e3 * one.char_s:.3f}",
            f"{1e3 * one.gap_s:.2f}",
            f"{1e3 * one.cycle_s:.1f}",
            f"{one.max_rate_hz:.1f}",
            f"{1e3 * two.cycle_s:.1f}",
            f"{two.max_rate_hz:.1f}",
        ]
    assert wire_budget(config.Base()).arithmetic in DOC


def test_the_document_lists_every_state_and_address() -> None:
    for state in State:
        assert f"| {state.value} | {state.name} |" in DOC
    assert f"| {bp.POSE_ADDRESS} | protocol version" in DOC
    assert f"| {bp.STATUS_ADDRESS} | protocol version" in DOC
