"""Messages between robots and their map service: a schema and fields, packed (MessagePack) and compressed (zstd).

Fields are only added within a version; what is not known is ignored. Reading checks everything: sizes before anything
is unpacked, then types and ranges.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import msgpack
import zstandard

from ceilvo.errors import CeilvoError, one_line

SCHEMA = "ceilvo.fleet"
MOST_BYTES = 60_000
"""Of a message; the daemon's sessions drop what is above 64 KiB (drivers/bus/zenoh_session.py)."""
MOST_UNPACKED_BYTES = 100_000
"""Chosen: the largest part and 1500 landmarks of an offer are half of it."""
MOST_TEXT = 200
_MOST_ITEMS = 256
"""Of a list, and of the fields of a message; chosen."""
_LEVEL = 9
"""Of zstd; chosen: 1 ms a message, and 5 % less than level 3."""


class WireError(CeilvoError):
    """What came is no message of ours; one line."""


def packed(kind: str, fields: Mapping[str, Any]) -> bytes:
    """A message; `kind` names it with its version, as in "tile.1".

    Raises:
        WireError: it would be too large.
    """
    plain = msgpack.packb([f"{SCHEMA}.{kind}", dict(fields)])
    out = zstandard.ZstdCompressor(level=_LEVEL, write_checksum=True).compress(plain)
    if len(out) > MOST_BYTES or len(plain) > MOST_UNPACKED_BYTES:
        raise WireError(f"{kind}: {len(plain)} bytes, {len(out)} packed, expected {MOST_BYTES} or fewer; send less")
    return bytes(out)


class Fields:
    """What a message says, read field by field; each is checked when it is read."""

    def __init__(self, kind: str, data: bytes) -> None:
        """
        Raises:
            WireError: it is no message of this kind.
        """
        self._kind = kind
        plain = _decompressed(kind, data)
        try:
            found = msgpack.unpackb(
                plain,
                raw=False,
                strict_map_key=True,
                max_str_len=MOST_TEXT * 4,
                max_bin_len=len(plain),
                max_array_len=_MOST_ITEMS,
                max_map_len=_MOST_ITEMS,
                max_ext_len=0,
            )
        except (ValueError, msgpack.UnpackException) as e:  # its own errors, depth and UTF-8 among them
            raise WireError(f"{kind}: cannot be unpacked: {one_line(e) or type(e).__name__}") from e
        if not (isinstance(found, list) and len(found) == 2 and isinstance(found[1], dict)):
            raise WireError(f"{kind}: is not a schema with its fields")
        if found[0] != f"{SCHEMA}.{kind}":
            raise WireError(f"{kind}: schema is {one_line(repr(found[0]))}, expected {SCHEMA}.{kind}; update the older")
        self._fields: dict[str, Any] = found[1]

    def whole(self, name: str, low: int, high: int) -> int:
        value = self._fields.get(name)
        if type(value) is not int or not low <= value <= high:
            raise self._wrong(name, f"a whole number from {low} to {high}")
        return value

    def number(self, name: str, limit: float) -> float:
        value = self._fields.get(name)
        if not isinstance(value, (int, float)) or isinstance(value, bool) or not abs(value) <= limit:
            raise self._wrong(name, f"a number within {limit:g}")
        return float(value)

    def text(self, name: str) -> str:
        value = self._fields.get(name)
        if not isinstance(value, str) or len(value) > MOST_TEXT or not value.isprintable():
            raise self._wrong(name, f"printable text of {MOST_TEXT} characters at most")
        return value

    def raw(self, name: str, size: int | None = None) -> bytes:
        value = self._fields.get(name)
        if not isinstance(value, bytes) or size not in (None, len(value)):
            raise self._wrong(name, "bytes" if size is None else f"{size} bytes")
        return value

    def pairs(self, name: str, size: int, high: int) -> list[tuple[bytes, int]]:
        """A list of bytes with a whole number from 0 up."""
        value = self._fields.get(name)
        good = isinstance(value, list) and all(
            isinstance(v, list)
            and len(v) == 2
            and isinstance(v[0], bytes)
            and len(v[0]) == size
            and type(v[1]) is int
            and 0 <= v[1] <= high
            for v in value
        )
        if not good or value is None:
            raise self._wrong(name, f"a list of {size} bytes and a whole number")
        return [(v[0], v[1]) for v in value]

    def _wrong(self, name: str, expected: str) -> WireError:
        value = self._fields.get(name, "nothing")
        shown = f"{len(value)} bytes" if isinstance(value, bytes) else one_line(repr(value), 40)
        return WireError(f"{self._kind}: {name} is {shown}, expected {expected}")


def _decompressed(kind: str, data: bytes) -> bytes:
    if len(data) > MOST_BYTES:
        raise WireError(f"{kind}: {len(data)} bytes, expected {MOST_BYTES} or fewer")
    try:
        size = zstandard.get_frame_parameters(data).content_size
        if not 0 < size <= MOST_UNPACKED_BYTES:
            what = "an unknown number of" if size >= 2**63 else size
            raise WireError(f"{kind}: unpacks to {what} bytes, expected 1 to {MOST_UNPACKED_BYTES}")
        plain = bytes(zstandard.ZstdDecompressor().decompress(data, max_output_size=MOST_UNPACKED_BYTES))
    except zstandard.ZstdError as e:
        raise WireError(f"{kind}: cannot be decompressed: {one_line(e)}") from e
    if len(plain) != size:
        raise WireError(f"{kind}: unpacks to {len(plain)} bytes, its head says {size}")
    return plain
