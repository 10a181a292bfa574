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
GOLDEN: dict[int, dict[str, Any]] = {
    version: json.loads((ROOT / "tests/golden" / name).read_text())
    for version, name in ((1, "base_telegrams.json"), (2, "base_telegrams_2.json"))
}
DOC = (ROOT / "docs/base-protocol.md").read_text()
TELEGRAM = {v: PoseTelegram(**{**g["telegram"], "state": State[g["telegram"]["state"]]}) for v, g in GOLDEN.items()}
STATUS = {v: BaseStatus(**g["status"]) for v, g in GOLDEN.items()}


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


def golden_frame(name: str, version: int) -> bytes:
    golden = GOLDEN[version]
    parts = golden["frames"][name]
    text = "".join("".join(v for _, v in golden[p]) if p in golden else p for p in parts)
    body = bytes.fromhex(text)
    return body + crc_by_division(body)


def test_crc_by_division_gives_the_catalogued_check_value() -> None:
    assert crc_by_division(b"123456789") == bytes.fromhex("374b")


@pytest.mark.parametrize("version", GOLDEN)
@pytest.mark.parametrize("name", GOLDEN[1]["frames"])
def test_the_document_shows_the_golden_frames(name: str, version: int) -> None:
    title = name if version == 1 else f"version {version}, {name}"
    block = re.search(rf"^```{title}\n(.*?)^```", DOC, re.M | re.S)
    assert block is not None
    assert bytes.fromhex(block[1]) == golden_frame(name, version)


@pytest.mark.parametrize("version", GOLDEN)
def test_blocks_are_encoded_as_golden_and_read_back(version: int) -> None:
    pose, status = bp.encode_pose(TELEGRAM[version]), bp.encode_status(STATUS[version])
    for registers, block in ((pose, "pose_block"), (status, "status_block")):
        assert "".join(f"{r:04x}" for r in registers) == "".join(v for _, v in GOLDEN[version][block])
    assert bp.decode_status(status, version) == STATUS[version]
    assert bp.decode_pose(pose, version).predicted_s == pytest.approx(0.04 * (version == 2))


class _Scripted(SimBase):
    """The simulated base with a fixed status."""

    def read(self, function: int, address: int, count: int) -> list[int]:
        assert (address, count) == (bp.STATUS_ADDRESS, {1: 10, 2: 16}[self.model.version])
        return bp.encode_status(STATUS[self.model.version])


@pytest.fixture(params=GOLDEN)
def sim(request: pytest.FixtureRequest) -> Iterator[SimBase]:
    with _Scripted(baud=1_000_000, turnaround_s=0.0, version=request.param) as sim:
        yield sim


@pytest.mark.parametrize(("function", "codes"), [("fc23", ["fc23"]), ("fc16_fc04", ["fc16", "fc04"])])
def test_golden_frames_are_what_goes_over_the_line(sim: SimBase, function: str, codes: list[str]) -> None:
    version = sim.model.version
    settings = config.Base(port=sim.port, baud=1_000_000, function=function, timeout_s=2.0, protocol=version)
    base = ModbusBase(settings)
    base.open()
    try:
        assert base.exchange(TELEGRAM[version]) == STATUS[version]
    finally:
        base.close()
    expected = []
    for code in codes:
        sent, answered = (golden_frame(f"{code} {what}", version) for what in ("request", "response"))
        expected += [("<", sent), (">", answered)]
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
