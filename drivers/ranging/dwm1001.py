"""What a DWM1001 (Decawave, now Qorvo) says, with its factory firmware PANS: lines of its shell, or its binary TLV.

Formats: "DWM1001 Firmware API Guide", versions 1.0 and 2.2, sections "Shell commands" (les, lec) and "dwm_loc_get".
"""

from __future__ import annotations

import math
import re
import struct

from ceilvo.errors import RangingError, one_line

Measured = tuple[tuple[str, float], ...]
"""Anchor and distance in metres, of one round."""

FARTHEST_M = 1000.0
"""A distance beyond is no distance; the module's own reach is some 60 m."""
WAKE, LES, LEC = b"\r\r", b"les\r", b"lec\r"
"""Two returns within a second enter the shell; either command turns its lines on, and off again when sent twice."""
PROMPT = "dwm>"
LOC_GET = bytes((0x0C, 0x00))
"""dwm_loc_get: position and distances."""
_STATUS, _POSITION, _DISTANCES, _WITH_PLACES = 0x40, 0x41, 0x48, 0x49
"""Types of the answer's parts: return code, own position, distances of an anchor's tags, distances to a tag's anchors
with the anchors' places."""
_HEADER = 2
_STATUSES = {1: "unknown command or broken frame", 2: "internal error", 3: "invalid parameter", 4: "busy"}
_STATUSES |= {5: "operation not permitted; the module is no tag"}
_LES = re.compile(r"([0-9A-Fa-f]{4,16})\[[-0-9.,]*\]=(\S+)")
_LES_ANY = re.compile(r"le_us=|est\[|[0-9A-Fa-f]{4}\[")
_TAG_ENTRY = struct.Struct("<HIB iiiB")
"""Of 0x49: address, distance in mm, its quality in per cent, then x, y, z in mm and their quality."""
_ANCHOR_ENTRY = struct.Struct("<QIB")
"""Of 0x48: address, distance in mm, quality."""


def les_line(line: str) -> Measured | None:
    """Of a line as `1151[5.00,8.00,2.25]=6.48 0CA8[0.00,8.00,2.25]=6.51 le_us=2576 est[6.97,5.17,-1.77,53]`.

    None for what the shell says besides: its greeting, prompt and echo.

    Raises:
        RangingError: it should be a round, and is damaged.
    """
    text = line.strip()
    if not _LES_ANY.search(text):
        return None
    found = tuple((a.upper(), _metres(d, line)) for a, d in _LES.findall(text))
    if not found and "[" in text.replace("est[", ""):
        raise RangingError(
            f"ranging: line {one_line(text)!r} has anchors without distances, expected NAME[x,y,z]=metres"
        )
    return found


def lec_line(line: str) -> Measured | None:
    """Of a line as `DIST,2,AN0,1151,5.00,8.00,2.25,6.44,AN1,0CA8,0.00,8.00,2.25,6.50,POS,6.95,5.37,-1.97,52`.

    None for what the shell says besides, also for lines with a position alone.

    Raises:
        RangingError: it should be a round, and is damaged.
    """
    text = line.strip().removeprefix(PROMPT).strip()
    if not text.startswith("DIST"):
        return None
    words = text.split(",")
    try:
        count = int(words[1])
        rows = [words[2 + 6 * k : 8 + 6 * k] for k in range(count)]
        if any(len(r) != 6 or not r[0].startswith("AN") for r in rows):
            raise ValueError
    except (ValueError, IndexError):
        raise RangingError(
            f"ranging: line {one_line(text)!r} is cut short, expected DIST,n and n times ANk,name,x,y,z,m"
        ) from None
    return tuple((r[1].upper(), _metres(r[5], line)) for r in rows)


def _metres(text: str, line: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not 0.0 <= value <= FARTHEST_M:
        raise RangingError(f"ranging: distance {text!r} in {one_line(line)!r}, expected 0 to {FARTHEST_M:g} m")
    return value


def tlv_size(data: bytes) -> int | None:
    """Bytes of the first answer in data, None while that cannot be told.

    Raises:
        RangingError: it is none.
    """
    if data and data[0] != _STATUS:
        raise RangingError(f"ranging: answer begins with 0x{data[0]:02x}, expected 0x40; is beacons.protocol right?")
    if len(data) < 3:
        return None
    if data[1] != 1:
        raise RangingError(f"ranging: return code of {data[1]} bytes, expected 1")
    if data[2]:
        return 3
    size = 3
    while True:
        if len(data) < size + _HEADER:
            return None
        kind, length = data[size], data[size + 1]
        if kind not in (_POSITION, _DISTANCES, _WITH_PLACES):
            raise RangingError(f"ranging: part 0x{kind:02x} in an answer, expected 0x41, 0x48 or 0x49")
        size += _HEADER + length
        if kind != _POSITION:
            return size


def tlv_answer(data: bytes) -> Measured:
    """Of a whole answer to LOC_GET.

    Raises:
        RangingError: it is none, or says that the module could not answer.
    """
    if tlv_size(data) != len(data):
        raise RangingError(f"ranging: answer of {len(data)} bytes is cut short or too long")
    if data[2]:
        why = _STATUSES.get(data[2], "see the module's manual")
        raise RangingError(f"ranging: the module answers with return code {data[2]} ({why})")
    at = 3
    while data[at] == _POSITION:
        at += _HEADER + data[at + 1]
    kind, body = data[at], data[at + _HEADER :]
    entry = _TAG_ENTRY if kind == _WITH_PLACES else _ANCHOR_ENTRY
    count = body[0] if body else -1
    if len(body) != 1 + count * entry.size:
        raise RangingError(f"ranging: {len(body)} bytes of distances, expected a count and {entry.size} for each")
    out = []
    for k in range(count):
        address, mm, *_ = entry.unpack_from(body, 1 + k * entry.size)
        metres = 1e-3 * mm
        if metres > FARTHEST_M:
            raise RangingError(f"ranging: distance {metres:g} m to {address:04X}, expected at most {FARTHEST_M:g} m")
        out.append((f"{address:04X}", metres))
    return tuple(out)
