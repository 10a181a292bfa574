"""A base controller on Modbus RTU, through pymodbus' synchronous client. Reconnecting is the caller's (BaseLink)."""

from __future__ import annotations

import logging
import os
import struct
import termios
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import serial
from pymodbus.client import ModbusSerialClient
from pymodbus.exceptions import ConnectionException, ModbusException
from pymodbus.pdu import ModbusPDU

from ceilvo.config import Base
from ceilvo.config.serial_budget import status_registers, stop_bits
from ceilvo.drivers.base.protocol import POSE_ADDRESS, STATUS_ADDRESS, decode_status, encode_pose
from ceilvo.drivers.telegrams import BaseStatus, PoseTelegram
from ceilvo.errors import BaseLinkError

_FC_READ_INPUT, _FC_WRITE, _FC_READ_WRITE = 4, 16, 23
"""Function codes of MODBUS Application Protocol 1.1b3, section 6."""
_PTY_MAJORS = range(136, 144)
"""Device numbers of pseudo-terminals, which have no parity (Linux, Documentation/admin-guide/devices.txt)."""
_ILLEGAL_FUNCTION = 1
"""Exception code of a base that lacks a function (the same, section 7)."""
_EXCEPTIONS = {
    _ILLEGAL_FUNCTION: "illegal function",
    2: "illegal address; the register map differs from docs/base-protocol.md",
    3: "illegal value; the base refuses the pose block, compare protocol versions",
    4: "device failure; see the base's own diagnosis",
    6: "busy; lower base.rate_hz",
}
"""Exception codes of the same, section 7, and what to do about each."""


def port_parity(port: str, parity: str) -> str:
    """The parity to open a port with: a pseudo-terminal has none, and some C libraries refuse to set it there."""
    try:
        return "N" if os.major(Path(port).stat().st_rdev) in _PTY_MAJORS else parity
    except OSError:
        return parity


class _Client(ModbusSerialClient):
    """With a timeout that nobody prolongs who sets the clock: pymodbus's own goes by the time of day."""

    def _wait_for_data(self) -> int:
        """Bytes that are there once no more come, or at the timeout."""
        size, end_s = 0, time.monotonic() + self.comm_params.timeout_connect
        while time.monotonic() <= end_s:
            available = int(self._in_waiting())  # type: ignore[no-untyped-call]
            if size and available in (0, size):
                break
            size = available
            time.sleep(self._recv_interval)
        return size


class ModbusBase:
    """drivers.ports.Base on a serial port. No retries: a late pose is worth less than a new one."""

    def __init__(self, config: Base) -> None:
        self._config = config
        self._client: ModbusSerialClient | None = None
        self._received = b""
        self._late_until_s = 0.0
        # pymodbus logs every timeout at ERROR; each of them is raised from here as a BaseLinkError already.
        logging.getLogger("pymodbus").setLevel(logging.CRITICAL)

    @property
    def is_open(self) -> bool:
        return self._client is not None

    def open(self) -> None:
        c = self._config
        client = _Client(
            c.port,
            baudrate=c.baud,
            parity=port_parity(c.port, c.parity),
            stopbits=stop_bits(c.parity),
            timeout=c.timeout_s,
            retries=0,
            trace_packet=self._note_received,
        )
        if not client.connect():
            raise BaseLinkError(f"base port {c.port}: cannot be opened: {self._why_not_open()}")
        self._client = client

    def exchange(self, telegram: PoseTelegram) -> BaseStatus:
        """One FC23 transaction, or FC16 and FC04; input left over from before is discarded by pymodbus first."""
        values = encode_pose(telegram)
        if self._config.function == "fc23":
            answer = self._request(lambda client: self._read_write(client, values), _FC_READ_WRITE)
        else:
            self._request(lambda client: self._write(client, values), _FC_WRITE)
            answer = self._request(self._read, _FC_READ_INPUT)
        return self._status(answer)

    def read_status(self) -> BaseStatus:
        """Only read (FC04), which moves nothing; raises BaseLinkError as exchange() does."""
        return self._status(self._request(self._read, _FC_READ_INPUT))

    def _status(self, answer: ModbusPDU) -> BaseStatus:
        try:
            return decode_status(list(answer.registers), self._config.protocol)
        except BaseLinkError as e:
            raise BaseLinkError(f"base at {self._config.port}: {e}") from e

    def close(self) -> None:
        client, self._client = self._client, None
        if client is not None:
            with suppress(OSError, termios.error):
                client.close()  # type: ignore[no-untyped-call]

    def _read_write(self, client: ModbusSerialClient, values: list[int]) -> ModbusPDU:
        return client.readwrite_registers(
            read_address=STATUS_ADDRESS,
            read_count=status_registers(self._config.protocol),
            write_address=POSE_ADDRESS,
            values=values,
            device_id=self._config.unit_id,
        )

    def _write(self, client: ModbusSerialClient, values: list[int]) -> ModbusPDU:
        return client.write_registers(POSE_ADDRESS, values, device_id=self._config.unit_id)

    def _read(self, client: ModbusSerialClient) -> ModbusPDU:
        count = status_registers(self._config.protocol)
        return client.read_input_registers(STATUS_ADDRESS, count=count, device_id=self._config.unit_id)

    def _request(self, send: Callable[[ModbusSerialClient], ModbusPDU], function: int) -> ModbusPDU:
        client = self._client
        if client is None:
            raise BaseLinkError(f"base port {self._config.port}: is not open; open it before exchanging telegrams")
        with self._failures():
            self._let_late_answer_pass(client)
            self._received = b""
            answer = send(client)
        self._check(answer, function)
        return answer

    def _let_late_answer_pass(self, client: ModbusSerialClient) -> None:
        """RTU answers carry no number: one that comes too late would be taken for the answer to the next request."""
        if time.monotonic() < self._late_until_s:
            client.recv(None)
        self._late_until_s = 0.0

    def _expect_late_answer(self) -> None:
        self._late_until_s = time.monotonic() + self._config.timeout_s

    @contextmanager
    def _failures(self) -> Iterator[None]:
        """Whatever pymodbus, pyserial or the kernel raise, as BaseLinkError; a lost port is closed."""
        try:
            yield
        except (ConnectionException, OSError, termios.error) as e:
            self.close()
            raise BaseLinkError(f"base port {self._config.port}: lost ({e}); check the adapter and its cable") from e
        except (ModbusException, ValueError, LookupError, struct.error) as e:
            self._expect_late_answer()
            raise BaseLinkError(self._no_answer()) from e

    def _check(self, answer: ModbusPDU, function: int) -> None:
        c = self._config
        if answer.isError():
            code = answer.exception_code
            what = _EXCEPTIONS.get(code, "see the base's manual")
            hint = "; set base.function: fc16_fc04" if code == _ILLEGAL_FUNCTION and function == _FC_READ_WRITE else ""
            raise BaseLinkError(
                f"base at {c.port}: unit {c.unit_id} answers FC{function:02d} with exception {code} ({what}{hint})"
            )
        if answer.function_code != function:
            self._expect_late_answer()
            raise BaseLinkError(
                f"base at {c.port}: answer to FC{answer.function_code:02d}, expected FC{function:02d};"
                f" a late answer, raise base.timeout_s ({c.timeout_s} s)"
            )

    def _no_answer(self) -> str:
        c = self._config
        if not self._received:
            return (
                f"base at {c.port}: unit {c.unit_id} gave no answer within {c.timeout_s} s;"
                f" check its power, wiring, address and {c.baud} baud, parity {c.parity}"
            )
        return (
            f"base at {c.port}: {len(self._received)} bytes that are no Modbus answer ({self._received[:16].hex(' ')});"
            f" check {c.baud} baud, parity {c.parity}, termination, and for a second master on the line"
        )

    def _note_received(self, sending: bool, data: bytes) -> bytes:
        if not sending:
            self._received = data
        return data

    def _why_not_open(self) -> str:
        """pymodbus swallows the reason, so the port is tried once more without it."""
        c = self._config
        hint = f"check base.port ({c.port}), its permissions (group dialout) and that no other program holds it"
        try:
            serial.Serial(c.port, c.baud, parity=port_parity(c.port, c.parity), exclusive=True).close()
        except (OSError, ValueError, termios.error) as e:
            return f"{e}; {hint}"
        return f"it was busy; {hint}"
