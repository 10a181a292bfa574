"""A small Modbus RTU slave, written from the specification and apart from the client's library.

MODBUS Application Protocol V1.1b3 (6.3, 6.4, 6.12, 6.17, 7); MODBUS over Serial Line V1.02 (2.5.1).
"""

from __future__ import annotations

import struct
from typing import Protocol

ILLEGAL_FUNCTION, ILLEGAL_ADDRESS, ILLEGAL_VALUE, DEVICE_FAILURE = 1, 2, 3, 4
"""Exception codes, MODBUS Application Protocol 1.1b3, section 7."""

READ_HOLDING, READ_INPUT, WRITE_MULTIPLE, READ_WRITE = 3, 4, 16, 23
"""Function codes, the same, section 6."""

_EXCEPTION_BIT = 0x80
"""Set in the function code of an exception (the same, section 7)."""
_REGISTERS_MOST = 125
"""Of one request (the same, section 6)."""
_CRC_START, _CRC_POLYNOMIAL = 0xFFFF, 0xA001
"""MODBUS over serial line 1.02, 6.2.2."""
_BYTE_COUNT_AT = {WRITE_MULTIPLE: 6, READ_WRITE: 10}
"""Where the request says how many bytes follow (the same, section 6)."""


class ModbusFault(Exception):
    """A request that is answered with an exception response."""

    def __init__(self, code: int) -> None:
        super().__init__(f"Modbus exception {code}")
        self.code = code


class Registers(Protocol):
    """The slave's memory; both raise ModbusFault."""

    def read(self, function: int, address: int, count: int) -> list[int]: ...

    def write(self, address: int, values: list[int]) -> None: ...


def crc16(data: bytes) -> int:
    """CRC-16/MODBUS, as a number; low byte first on the wire."""
    crc = _CRC_START
    for byte in data:
        crc ^= byte
        for _ in range(8):
            crc = (crc >> 1) ^ _CRC_POLYNOMIAL if crc & 1 else crc >> 1
    return crc


def with_crc(body: bytes) -> bytes:
    return body + struct.pack("<H", crc16(body))


def crc_is_good(frame: bytes) -> bool:
    return len(frame) >= 4 and with_crc(frame[:-2]) == frame


def request_size(start: bytes) -> int | None:
    """Bytes of the request that begins so, None while unknown or when the function is not supported."""
    if len(start) < 2:
        return None
    if start[1] in (READ_HOLDING, READ_INPUT):
        return 8
    at = _BYTE_COUNT_AT.get(start[1])
    if at is None or len(start) <= at:
        return None
    return at + 1 + start[at] + 2


def answer(request: bytes, registers: Registers, refused: frozenset[int] = frozenset()) -> bytes:
    """The whole response frame to a whole request frame with a good CRC; `refused` functions are not supported."""
    unit, function = request[0], request[1]
    try:
        if function in refused:
            raise ModbusFault(ILLEGAL_FUNCTION)
        body = _execute(function, request[2:-2], registers)
    except ModbusFault as e:
        return with_crc(bytes((unit, function | _EXCEPTION_BIT, e.code)))
    return with_crc(bytes((unit, function)) + body)


def _execute(function: int, data: bytes, registers: Registers) -> bytes:
    if function in (READ_HOLDING, READ_INPUT):
        address, count = struct.unpack(">HH", data)
        return _read(registers, function, address, count)
    if function == WRITE_MULTIPLE:
        address, count, size = struct.unpack(">HHB", data[:5])
        registers.write(address, _values(data[5:], count, size))
        return struct.pack(">HH", address, count)
    if function == READ_WRITE:
        read_address, read_count, address, count, size = struct.unpack(">HHHHB", data[:9])
        registers.write(address, _values(data[9:], count, size))
        return _read(registers, READ_HOLDING, read_address, read_count)
    raise ModbusFault(ILLEGAL_FUNCTION)


def _read(registers: Registers, function: int, address: int, count: int) -> bytes:
    if not 1 <= count <= _REGISTERS_MOST:
        raise ModbusFault(ILLEGAL_VALUE)
    values = registers.read(function, address, count)
    return struct.pack(f">B{count}H", 2 * count, *values)


def _values(data: bytes, count: int, size: int) -> list[int]:
    if count < 1 or size != 2 * count or len(data) != size:
        raise ModbusFault(ILLEGAL_VALUE)
    return list(struct.unpack(f">{count}H", data))
