"""A simulated AIM-style base: a Modbus RTU slave on a pty (or a given tty) that paces itself at its baud rate.

python -m ceilvo.sim.base --baud 115200 --port-link /tmp/base --log telegrams.jsonl
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import random
import select
import signal
import sys
import threading
import time
import tty
from collections import deque
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import IO

import serial

from ceilvo.config.serial_budget import bits_per_char, frame_gap_s, pose_registers, status_registers, stop_bits
from ceilvo.drivers.base.mock_base import BaseFaults, BaseModel, Odometry, ReceivedTelegram, standing_still
from ceilvo.drivers.base.modbus import port_parity
from ceilvo.drivers.base.protocol import POSE_ADDRESS, STATUS_ADDRESS
from ceilvo.drivers.ports import Clock
from ceilvo.drivers.telegrams import PROTOCOL_VERSION
from ceilvo.errors import BaseLinkError
from ceilvo.sim import rtu

_INCOMPLETE_S = 0.05
"""A request that pauses for this long is dropped; a real slave takes 3.5 characters, a pty is not that regular."""
_CHUNK_S = 0.002
"""Of an answer's bytes that are written at once: short against an answer, so that timing is the line's."""


class SimBase:
    """A base at the end of a serial line; start() after stop() brings it back with its memory (see also reboot()).

    Attributes:
        model: what it does with the telegrams, its faults and its e-stop.
        refused: function codes that it does not know, for example {23}.
        crc_errors: requests dropped.
        wire: the last frames, ("<" received or ">" sent, bytes).
    """

    def __init__(
        self,
        *,
        baud: int = 115200,
        parity: str = "E",
        unit_id: int = 1,
        turnaround_s: float = 0.001,
        heartbeat_timeout_s: float = 0.5,
        odometry: Odometry = standing_still,
        clock: Clock = time.monotonic_ns,
        port: str | int | None = None,
        port_link: Path | None = None,
        log: Path | None = None,
        version: int = PROTOCOL_VERSION,
        gyro: Callable[[float], float] | None = None,
    ) -> None:
        """port: None makes a pty, a path is opened as a serial port, a number is an open file descriptor.

        port_link: a symbolic link that always leads to the pty of the moment. log: a JSON line for each telegram.
        """
        self.model = BaseModel(
            clock, odometry, heartbeat_timeout_s, on_telegram=self._write_log, version=version, gyro=gyro
        )
        self.refused: frozenset[int] = frozenset()
        self.crc_errors = 0
        self.wire: deque[tuple[str, bytes]] = deque(maxlen=64)
        self._unit_id = unit_id
        self._baud, self._parity = baud, parity
        self._char_s = bits_per_char(parity) / baud
        self._gap_s = frame_gap_s(baud, parity)
        self._turnaround_s = turnaround_s
        self._given_port, self._port_link, self._log_path = port, port_link, log
        self._pose = [0] * pose_registers(version)
        self._random = random.Random(1)
        self._port = ""
        self._fd = -1
        self._open_things = contextlib.ExitStack()
        self._log: IO[str] | None = None
        self._stopping = threading.Event()
        self._wake_r = self._wake_w = -1
        self._thread: threading.Thread | None = None

    @property
    def port(self) -> str:
        """Path of the serial device to connect to: the link if there is one."""
        return str(self._port_link or self._port)

    @property
    def faults(self) -> BaseFaults:
        return self.model.faults

    @property
    def telegrams(self) -> deque[ReceivedTelegram]:
        return self.model.telegrams

    def __enter__(self) -> SimBase:
        self.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.stop()

    def start(self) -> None:
        """Raises OSError or serial.SerialException when the given port cannot be used."""
        if self._thread is not None:
            return
        with contextlib.ExitStack() as things:
            self._wake_r, self._wake_w = os.pipe()
            things.callback(_close, self._wake_r, self._wake_w)
            self._fd = self._open_line(things)
            if self._log_path is not None:
                self._log = things.enter_context(self._log_path.open("a", encoding="utf-8", buffering=1))
            self._open_things = things.pop_all()
        self._stopping.clear()
        self._thread = threading.Thread(target=self._serve, name="sim-base", daemon=True)
        self._thread.start()

    def stop(self) -> None:
        """Ends the thread; a pty and its link vanish, as an unplugged adapter does. Idempotent."""
        thread, self._thread = self._thread, None
        if thread is None:
            return
        self._stopping.set()
        os.write(self._wake_w, b"x")
        thread.join()
        self._open_things.close()
        self._log = None

    def reboot(self) -> None:
        self.model.reboot()

    def read(self, function: int, address: int, count: int) -> list[int]:
        """rtu.Registers: the status block in both register spaces, the pose block as holding registers."""
        blocks = {STATUS_ADDRESS: self.model.read_status}
        if function == rtu.READ_HOLDING:
            blocks[POSE_ADDRESS] = self._pose.copy
        for start, values in blocks.items():
            registers = pose_registers if start == POSE_ADDRESS else status_registers
            size = registers(self.model.version)
            if start <= address and address + count <= start + size:
                return values()[address - start : address - start + count]
        raise rtu.ModbusFault(rtu.ILLEGAL_ADDRESS)

    def write(self, address: int, values: list[int]) -> None:
        """rtu.Registers: the pose block, whole or not at all."""
        if address != POSE_ADDRESS or len(values) != pose_registers(self.model.version):
            raise rtu.ModbusFault(rtu.ILLEGAL_ADDRESS)
        try:
            self.model.write_pose(values)
        except BaseLinkError as e:
            raise rtu.ModbusFault(rtu.ILLEGAL_VALUE) from e
        self._pose = values

    def _open_line(self, things: contextlib.ExitStack) -> int:
        if isinstance(self._given_port, int):
            return self._given_port
        if self._given_port is not None:
            self._port = self._given_port
            parity = port_parity(self._port, self._parity)
            line = serial.Serial(self._port, self._baud, parity=parity, stopbits=stop_bits(self._parity), timeout=0)
            things.callback(line.close)
            return int(line.fileno())
        master, slave = os.openpty()
        things.callback(_close, master, slave)
        # Our own slave descriptor stays open: without any, reading the master fails with EIO.
        tty.setraw(slave)
        os.set_blocking(master, False)
        self._port = os.ttyname(slave)
        if self._port_link is not None:
            _link(self._port_link, self._port)
            things.callback(self._port_link.unlink, missing_ok=True)
        return master

    def _serve(self) -> None:
        buffer, since_s = b"", 0.0
        while not self._stopping.is_set():
            ready, _, _ = select.select([self._fd, self._wake_r], [], [], _INCOMPLETE_S if buffer else None)
            if self._fd in ready:
                since_s = since_s if buffer else time.monotonic()
                buffer += self._receive()
                size = rtu.request_size(buffer)
                if size is not None and len(buffer) >= size and rtu.crc_is_good(buffer[:size]):
                    self._handle(buffer[:size], since_s)
                    buffer = buffer[size:]
            elif buffer:
                self._handle(buffer, since_s)
                buffer = b""

    def _receive(self) -> bytes:
        """b"" when there is nothing after all, or, after a pause, when the other end of a given tty is gone."""
        try:
            data = os.read(self._fd, 1024)
        except BlockingIOError:
            return b""
        except OSError:
            data = b""
        if not data:
            self._stopping.wait(_INCOMPLETE_S)
        return data

    def _handle(self, request: bytes, since_s: float) -> None:
        self.wire.append(("<", request))
        faults = self.faults
        if not rtu.crc_is_good(request):
            self.crc_errors += 1
            return
        if request[0] != self._unit_id or faults.silent:
            return
        arrived_s = since_s + len(request) * self._char_s + self._gap_s
        if self._wait_until(arrived_s):
            return
        response = self._respond(request)
        if not self._wait_until(arrived_s + self._turnaround_s + faults.slow_s):
            self._transmit(response)

    def _respond(self, request: bytes) -> bytes:
        faults = self.faults
        if faults.exception_code:
            return rtu.with_crc(bytes((request[0], request[1] | 0x80, faults.exception_code)))
        response = rtu.answer(request, self, self.refused)
        if faults.bad_crc:
            return response[:-1] + bytes((response[-1] ^ 0xFF,))
        if faults.garbage:
            return self._random.randbytes(len(response))
        return response

    def _transmit(self, frame: bytes) -> None:
        self.wire.append((">", frame))
        size = max(1, int(_CHUNK_S / self._char_s))
        begun_s = time.monotonic()
        for i in range(0, len(frame), size):
            chunk = frame[i : i + size]
            if self._wait_until(begun_s + (i + len(chunk)) * self._char_s):
                return
            # Nobody reads: a real line would lose the bytes as well.
            with contextlib.suppress(OSError):
                os.write(self._fd, chunk)

    def _wait_until(self, at_s: float) -> bool:
        """True when stopping."""
        return self._stopping.wait(at_s - time.monotonic())

    def _write_log(self, received: ReceivedTelegram) -> None:
        if self._log is None:
            return
        line = {"recv_ns": received.recv_ns, "recv_unix_ns": received.recv_unix_ns, **asdict(received.telegram)}
        line["state"] = received.telegram.state.name
        self._log.write(json.dumps(line) + "\n")


def _close(*fds: int) -> None:
    for fd in fds:
        os.close(fd)


def _link(link: Path, target: str) -> None:
    """Replace the link in one step, so that it never leads nowhere while it exists."""
    fresh = link.with_name(f".{link.name}.{os.getpid()}")
    fresh.unlink(missing_ok=True)
    fresh.symlink_to(target)
    fresh.replace(link)


def main(argv: list[str] | None = None) -> int:
    """Serve until SIGTERM or SIGINT; the path of the port is the first line printed."""
    p = argparse.ArgumentParser(prog="python -m ceilvo.sim.base", description="Simulated base controller, Modbus RTU.")
    p.add_argument("--baud", type=int, default=115200)
    p.add_argument("--parity", choices=("N", "E", "O"), default="E")
    p.add_argument("--unit-id", type=int, default=1)
    p.add_argument("--turnaround-ms", type=float, default=1.0)
    p.add_argument("--heartbeat-timeout-s", type=float, default=0.5)
    p.add_argument("--port", help="serve on this serial device instead of a new pty")
    p.add_argument("--fd", type=int, help="serve on this open file descriptor instead of a new pty")
    p.add_argument("--port-link", type=Path, help="symbolic link to make to the pty")
    p.add_argument("--protocol", type=int, choices=(1, 2), default=PROTOCOL_VERSION)
    p.add_argument("--log", type=Path, help="append every pose telegram as a JSON line")
    a = p.parse_args(argv)
    stop = threading.Event()
    for s in (signal.SIGTERM, signal.SIGINT):
        signal.signal(s, lambda *_: stop.set())
    base = SimBase(
        baud=a.baud,
        parity=a.parity,
        unit_id=a.unit_id,
        turnaround_s=1e-3 * a.turnaround_ms,
        heartbeat_timeout_s=a.heartbeat_timeout_s,
        port=a.port if a.fd is None else a.fd,
        port_link=a.port_link,
        log=a.log,
        version=a.protocol,
    )
    try:
        base.start()
    except OSError as e:
        print(f"simulated base: {a.port or a.port_link or a.log}: {e}", file=sys.stderr)
        return 1
    print(base.port, flush=True)
    stop.wait()
    base.stop()
    return 0


if __name__ == "__main__":
    sys.exit(main())
