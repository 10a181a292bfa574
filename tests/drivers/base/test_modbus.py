"""What only the serial driver and the simulated base have: bytes on a pty."""

from __future__ import annotations

import json
import os
import select
import signal
import struct
import subprocess
import sys
import time
import tty
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest
from patience import PATIENCE_S

from ceilvo import config
from ceilvo.drivers.base import protocol as bp
from ceilvo.drivers.base.modbus import ModbusBase, port_parity
from ceilvo.drivers.telegrams import BaseStatus, PoseTelegram
from ceilvo.errors import BaseLinkError
from ceilvo.sim import rtu
from ceilvo.sim.base import SimBase
from ceilvo.types import State

TELEGRAM = PoseTelegram(State.TRACKING, 0.9, 1, 0.02, 1.0, -2.0, 0.5, 0.01, 0.02, 0.003, 0.3, 0.0, -0.1, heartbeat=1)
POSE_BYTES = struct.pack(">19H", *bp.encode_pose(TELEGRAM))


def settings(port: str, **change: object) -> config.Base:
    return replace(config.Base(port=port, baud=1_000_000, timeout_s=0.25), **change)  # type: ignore[arg-type]


@pytest.fixture
def sim() -> Iterator[SimBase]:
    with SimBase(baud=1_000_000, turnaround_s=0.0) as sim:
        yield sim


@pytest.fixture
def raw(sim: SimBase) -> Iterator[int]:
    """A descriptor of the line's other end, without any driver."""
    fd = os.open(sim.port, os.O_RDWR | os.O_NOCTTY)
    yield fd
    os.close(fd)


def ask(fd: int, *writes: bytes, size: int, timeout_s: float = 2.0) -> bytes:
    """Bytes read after the writes: `size`, or fewer at the timeout."""
    for w in writes:
        os.write(fd, w)
    got = b""
    deadline = time.monotonic() + timeout_s
    while len(got) < size and select.select([fd], [], [], max(0.0, deadline - time.monotonic()))[0]:
        got += os.read(fd, 256)
    return got


def test_absent_port_is_one_clear_line(tmp_path: Path) -> None:
    base = ModbusBase(settings(str(tmp_path / "ttyUSB9")))
    with pytest.raises(BaseLinkError, match=r"ttyUSB9.*cannot be opened.*No such file") as e:
        base.open()
    assert "\n" not in str(e.value)
    assert not base.is_open


def test_a_file_is_no_serial_port(tmp_path: Path) -> None:
    path = tmp_path / "file"
    path.write_text("")
    with pytest.raises(BaseLinkError, match="cannot be opened"):
        ModbusBase(settings(str(path))).open()


def test_a_port_in_use_is_refused(sim: SimBase) -> None:
    first = ModbusBase(settings(sim.port))
    first.open()
    with pytest.raises(BaseLinkError, match=r"cannot be opened.*lock"):
        ModbusBase(settings(sim.port)).open()
    first.close()


def test_a_pty_gets_no_parity_and_a_missing_port_keeps_it(sim: SimBase) -> None:
    assert port_parity(sim.port, "E") == "N"
    assert port_parity("/dev/null", "E") == "E"
    assert port_parity("/nonexistent", "O") == "O"


def test_no_answer_says_what_to_check(sim: SimBase) -> None:
    base = ModbusBase(settings(sim.port, unit_id=9))
    base.open()
    with pytest.raises(BaseLinkError, match=r"unit 9 gave no answer within 0\.25 s; check its power"):
        base.exchange(TELEGRAM)
    assert len(sim.telegrams) == 0
    base.close()


def test_a_clock_that_is_set_back_prolongs_no_wait(sim: SimBase, monkeypatch: pytest.MonkeyPatch) -> None:
    """pymodbus counted its timeout by the time of day: set back by an hour, a silent base was waited for so long."""
    base = ModbusBase(settings(sim.port, unit_id=9))
    base.open()
    looks = iter(range(2000))  # then it raises: each is a millisecond
    monkeypatch.setattr(time, "time", lambda: -3600.0 * next(looks))
    with pytest.raises(BaseLinkError, match="gave no answer within"):
        base.exchange(TELEGRAM)
    base.close()


def test_garbage_is_shown_in_hex(sim: SimBase) -> None:
    base = ModbusBase(settings(sim.port))
    base.open()
    sim.faults.bad_crc = True
    with pytest.raises(BaseLinkError, match=r"25 bytes that are no Modbus answer \(01 17 14"):
        base.exchange(TELEGRAM)
    base.close()


def test_a_base_without_fc23_hints_at_the_other_way(sim: SimBase) -> None:
    sim.refused = frozenset({23})
    base = ModbusBase(settings(sim.port))
    base.open()
    with pytest.raises(BaseLinkError, match=r"FC23 with exception 1 .*fc16_fc04"):
        base.exchange(TELEGRAM)
    base.close()
    other = ModbusBase(settings(sim.port, function="fc16_fc04"))
    other.open()
    assert other.exchange(TELEGRAM).motors_on
    other.close()


def test_a_version_the_base_does_not_know_is_refused_by_it(sim: SimBase) -> None:
    base = ModbusBase(settings(sim.port))
    base.open()
    with pytest.raises(BaseLinkError, match="exception 3"):
        base.exchange(replace(TELEGRAM, version=3))
    assert len(sim.telegrams) == 0
    base.close()


def _pty() -> tuple[int, int]:
    master, slave = os.openpty()
    tty.setraw(slave)
    return master, slave


def test_input_left_over_is_not_taken_for_an_answer() -> None:
    """A whole valid answer lies in the input before the request; the true one comes after it."""
    master, slave = _pty()
    with SimBase(baud=1_000_000, turnaround_s=0.0, port=master) as sim:
        base = ModbusBase(settings(os.ttyname(slave)))
        base.open()
        old = bp.encode_status(BaseStatus(False, True, True, True, 1, 2, 3, 4))
        os.write(master, rtu.with_crc(struct.pack(">BBB10H", 1, 23, 20, *old)))
        assert select.select([slave], [], [], 2.0)[0]
        status = base.exchange(TELEGRAM)
        assert (status.e_stop, status.wheel_x_count) == (False, 0)
        base.close()
        assert len(sim.telegrams) == 1
    os.close(master)
    os.close(slave)


def test_on_an_existing_serial_device_that_is_then_lost() -> None:
    master, slave = _pty()
    with SimBase(baud=115200, turnaround_s=0.0, port=os.ttyname(slave)) as sim:
        os.close(slave)
        assert len(ask(master, rtu.with_crc(struct.pack(">BBHH", 1, 4, 1100, 10)), size=25)) == 25
        assert sim.port.startswith("/dev/pts/")
        os.close(master)


@pytest.mark.parametrize("cut", [1, 2, 7, 10, 11, 50])
def test_a_request_in_two_pieces(sim: SimBase, raw: int, cut: int) -> None:
    request = rtu.with_crc(struct.pack(">BBHHHHB", 1, 23, 1100, 10, 1000, 19, 38) + POSE_BYTES)
    answer = ask(raw, request[:cut], request[cut:], size=25)
    assert len(answer) == 25
    assert answer[:3] == bytes((1, 23, 20))
    assert len(sim.telegrams) == 1


@pytest.mark.parametrize(
    ("request_hex", "code"),
    [
        ("01 04 044c 000b", 2),
        ("01 04 044b 0001", 2),
        ("01 04 03e8 0013", 2),
        ("01 03 0000 0001", 2),
        ("01 04 044c 0000", 3),
        ("01 04 044c 007e", 3),
        ("01 10 03e9 0001 02 0001", 2),
        ("01 10 03e8 0002 02 0001", 3),
        ("01 05 0000 ff00", 1),
        ("01 2b 0e 01 00", 1),
    ],
)
def test_the_simulated_base_refuses_what_is_not_in_its_map(sim: SimBase, raw: int, request_hex: str, code: int) -> None:
    request = bytes.fromhex(request_hex)
    answer = ask(raw, rtu.with_crc(request), size=5)
    assert answer == rtu.with_crc(bytes((1, request[1] | 0x80, code)))


def test_holding_registers_read_back_the_pose(sim: SimBase, raw: int) -> None:
    ask(raw, rtu.with_crc(struct.pack(">BBHHB", 1, 16, 1000, 19, 38) + POSE_BYTES), size=8)
    answer = ask(raw, rtu.with_crc(struct.pack(">BBHH", 1, 3, 1000, 19)), size=43)
    assert answer == rtu.with_crc(bytes((1, 3, 38)) + POSE_BYTES)


def test_requests_with_a_bad_crc_or_for_others_get_no_answer(sim: SimBase, raw: int) -> None:
    good = rtu.with_crc(struct.pack(">BBHH", 1, 4, 1100, 10))
    assert ask(raw, good[:-1] + bytes((good[-1] ^ 1,)), size=1, timeout_s=0.2) == b""
    assert sim.crc_errors == 1
    assert ask(raw, rtu.with_crc(struct.pack(">BBHH", 2, 4, 1100, 10)), size=1, timeout_s=0.1) == b""
    assert len(ask(raw, good, size=25)) == 25


def heard(data: bytes, sent_baud: float, heard_baud: float) -> bytes:
    """What a receiver of another baud makes of 8E1 characters sent one after the other; errors of framing unchecked."""
    levels: list[int] = []
    for byte in data:
        bits = [byte >> k & 1 for k in range(8)]
        levels += [0, *bits, sum(bits) & 1, 1]

    def level(t_s: float) -> int:
        k = int(t_s * sent_baud)
        return levels[k] if k < len(levels) else 1

    out, t_s, step_s = bytearray(), 0.0, 0.1 / max(sent_baud, heard_baud)
    while t_s * sent_baud < len(levels):
        if level(t_s):
            t_s += step_s
            continue
        out.append(sum(level(t_s + (1.5 + k) / heard_baud) << k for k in range(8)))
        t_s += 10.5 / heard_baud
        while not level(t_s):
            t_s += step_s
    return bytes(out)


@pytest.mark.parametrize("ours", [9600, 19200, 57600, 115200])
@pytest.mark.parametrize("theirs", [9600, 19200, 57600, 115200])
def test_at_the_wrong_baud_a_base_keeps_silent_and_hears_the_next_right_one(
    sim: SimBase, raw: int, ours: int, theirs: int
) -> None:
    request = rtu.with_crc(struct.pack(">BBHHHHB", 1, 23, 1100, 10, 1000, 19, 38) + POSE_BYTES)
    garbled = heard(request, ours, theirs)
    assert (garbled == request) is (ours == theirs)
    if ours != theirs:
        assert ask(raw, garbled, size=1, timeout_s=0.1) == b""
        assert len(sim.telegrams) == 0
    assert len(ask(raw, request, size=25)) == 25
    assert len(sim.telegrams) == 1


def test_crc_check_value() -> None:
    assert rtu.crc16(b"123456789") == 0x4B37


def test_an_exchange_is_never_faster_than_its_line() -> None:
    with SimBase(baud=9600, turnaround_s=0.002) as sim:
        base = ModbusBase(settings(sim.port, baud=9600, timeout_s=20.0))
        base.open()
        begun_s = time.monotonic()
        base.exchange(TELEGRAM)
        elapsed_s = time.monotonic() - begun_s
        base.close()
    assert elapsed_s >= 76 * 11 / 9600 + 0.002


def test_the_link_leads_to_the_pty_of_the_moment_and_vanishes_with_it(tmp_path: Path) -> None:
    link = tmp_path / "tty-base"
    sim = SimBase(port_link=link)
    assert not link.is_symlink()
    sim.start()
    assert link.resolve().is_char_device()
    sim.stop()
    sim.stop()
    assert not link.is_symlink()
    sim.start()
    assert link.resolve().is_char_device()
    sim.stop()


@pytest.fixture
def program(tmp_path: Path) -> Iterator[subprocess.Popen[str]]:
    args = [sys.executable, "-m", "ceilvo.sim.base", "--baud", "1000000", "--turnaround-ms", "0"]
    args += ["--port-link", str(tmp_path / "tty-base"), "--log", str(tmp_path / "telegrams.jsonl")]
    with subprocess.Popen(args, stdout=subprocess.PIPE, text=True) as process:
        yield process
        process.kill()


def test_as_a_program(program: subprocess.Popen[str], tmp_path: Path) -> None:
    assert program.stdout is not None
    port = program.stdout.readline().strip()
    assert port == str(tmp_path / "tty-base")
    base = ModbusBase(settings(port, timeout_s=20.0))
    base.open()
    before_ns = time.monotonic_ns()
    for i in range(3):
        base.exchange(replace(TELEGRAM, heartbeat=i, sequence=10 + i))
    base.close()
    program.send_signal(signal.SIGTERM)
    assert program.wait(PATIENCE_S) == 0
    lines = [json.loads(line) for line in (tmp_path / "telegrams.jsonl").read_text().splitlines()]
    assert [(line["sequence"], line["state"]) for line in lines] == [(10 + i, "TRACKING") for i in range(3)]
    assert all(before_ns <= line["recv_ns"] <= time.monotonic_ns() for line in lines)
    assert abs(lines[0]["x_m"] - 1.0) < 1e-9
    assert not Path(port).is_symlink()
