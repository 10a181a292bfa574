"""Messages that Foxglove shows without extensions, written by hand: two of its image schemas as Protocol Buffers, the
rest as JSON. Protocol Buffers keep pixels as they are; in JSON they would grow by a third.

Schemas and field numbers are those of foxglove.dev's published message schemas.
"""

from __future__ import annotations

import json
import struct
from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from ceilvo.drivers.pictures import decoded
from ceilvo.errors import FileFormatError

_VARINT, _BYTES, _FIXED32 = 0, 2, 5
"""Wire types of protocol buffers (protobuf.dev, Encoding)."""
_TYPE_INT32, _TYPE_INT64, _TYPE_MESSAGE, _TYPE_FIXED32, _TYPE_STRING, _TYPE_BYTES = 5, 3, 11, 7, 9, 12
"""FieldDescriptorProto.Type of google/protobuf/descriptor.proto."""

Field = tuple[str, int, int, str]
"""Name, number, type of descriptor.proto, name of the message type ("" for scalars)."""

_TIME = ".google.protobuf.Timestamp"
_RAW: Sequence[Field] = (
    ("timestamp", 1, _TYPE_MESSAGE, _TIME),
    ("width", 2, _TYPE_FIXED32, ""),
    ("height", 3, _TYPE_FIXED32, ""),
    ("encoding", 4, _TYPE_STRING, ""),
    ("step", 5, _TYPE_FIXED32, ""),
    ("data", 6, _TYPE_BYTES, ""),
    ("frame_id", 7, _TYPE_STRING, ""),
)
"""Field numbers of foxglove.RawImage."""
_COMPRESSED: Sequence[Field] = (
    ("timestamp", 1, _TYPE_MESSAGE, _TIME),
    ("data", 2, _TYPE_BYTES, ""),
    ("format", 3, _TYPE_STRING, ""),
    ("frame_id", 4, _TYPE_STRING, ""),
)
"""Field numbers of foxglove.CompressedImage."""


def raw_image(unix_ns: int, gray: NDArray[np.uint8], frame_id: str) -> bytes:
    """A foxglove.RawImage of a grey picture (H, W), bit for bit."""
    h, w = gray.shape
    return b"".join(
        (
            _timestamp(unix_ns),
            _fixed32(2, w),
            _fixed32(3, h),
            _bytes(4, b"mono8"),
            _fixed32(5, w),
            _bytes(6, gray.tobytes()),
            _bytes(7, frame_id.encode()),
        )
    )


def read_raw_image(data: bytes) -> NDArray[np.uint8]:
    """The pixels of raw_image().

    Raises:
        FileFormatError: it is anything else.
    """
    fields = dict(_fields(data))
    try:
        w, h, pixels = fields[2], fields[3], fields[6]
        if fields[4] != b"mono8" or fields[5] != w or not isinstance(w, int) or not isinstance(h, int):
            raise ValueError("not a mono8 picture without gaps")
        return np.frombuffer(pixels, np.uint8).reshape(h, w)  # type: ignore[arg-type]
    except (KeyError, TypeError, ValueError) as e:
        raise FileFormatError(f"picture of {len(data)} bytes: {type(e).__name__} {e}; the recording is damaged") from e


def compressed_image(unix_ns: int, data: bytes, image_format: str, frame_id: str) -> bytes:
    """A foxglove.CompressedImage; image_format is "jpeg" or "png"."""
    return b"".join(
        (_timestamp(unix_ns), _bytes(2, data), _bytes(3, image_format.encode()), _bytes(4, frame_id.encode()))
    )


def read_compressed_image(data: bytes) -> NDArray[np.uint8]:
    """The grey pixels of compressed_image().

    Raises:
        FileFormatError: it is anything else.
    """
    picture = dict(_fields(data)).get(2)
    gray = decoded(picture) if isinstance(picture, bytes) else None
    if gray is None:
        raise FileFormatError(f"picture of {len(data)} bytes cannot be decoded; the recording is damaged")
    return gray


def pose_in_frame(unix_ns: int, frame_id: str, x_m: float, y_m: float, qz: float, qw: float) -> bytes:
    """A foxglove.PoseInFrame: a position on the floor and a turn about z."""
    pose = {"position": {"x": x_m, "y": y_m, "z": 0.0}, "orientation": {"x": 0.0, "y": 0.0, "z": qz, "w": qw}}
    return _json({"timestamp": _time(unix_ns), "frame_id": frame_id, "pose": pose})


def log_line(unix_ns: int, level: int, name: str, message: str) -> bytes:
    """A foxglove.Log; level is Python's (20 = info)."""
    return _json({"timestamp": _time(unix_ns), "level": min(max(level // 10, 1), 5), "message": message, "name": name})


def _json(body: object) -> bytes:
    return json.dumps(body, separators=(",", ":"), allow_nan=False).encode("ascii")


def _time(unix_ns: int) -> dict[str, int]:
    return {"sec": unix_ns // 10**9, "nsec": unix_ns % 10**9}


# -- schemas


def _object(**properties: object) -> dict[str, object]:
    return {"type": "object", "properties": properties}


_NUMBER, _TEXT = {"type": "number"}, {"type": "string"}
_TIME_SCHEMA = _object(sec={"type": "integer"}, nsec={"type": "integer"})
_XYZ = dict.fromkeys("xyz", _NUMBER)

POSE_SCHEMA = _json(
    _object(
        timestamp=_TIME_SCHEMA,
        frame_id=_TEXT,
        pose=_object(position=_object(**_XYZ), orientation=_object(**_XYZ, w=_NUMBER)),
    )
)
LOG_SCHEMA = _json(_object(timestamp=_TIME_SCHEMA, level={"type": "integer"}, message=_TEXT, name=_TEXT))
ANY_SCHEMA = _json({"type": "object"})


def _descriptor(name: str, package: str, message: str, fields: Sequence[Field], needs: Sequence[str]) -> bytes:
    """A FileDescriptorProto with one message."""
    body = _bytes(1, message.encode())
    for field, number, kind, type_name in fields:
        one = _bytes(1, field.encode()) + _varint_field(3, number) + _varint_field(4, 1) + _varint_field(5, kind)
        body += _bytes(2, one + (_bytes(6, type_name.encode()) if type_name else b""))
    head = _bytes(1, name.encode()) + _bytes(2, package.encode())
    return head + b"".join(_bytes(3, n.encode()) for n in needs) + _bytes(4, body) + _bytes(12, b"proto3")


def _schema(message: str, fields: Sequence[Field]) -> bytes:
    """The FileDescriptorSet of a message with a timestamp in it."""
    time_file = "google/protobuf/timestamp.proto"
    seconds: Sequence[Field] = (("seconds", 1, _TYPE_INT64, ""), ("nanos", 2, _TYPE_INT32, ""))
    files = (
        _descriptor(time_file, "google.protobuf", "Timestamp", seconds, ()),
        _descriptor(f"foxglove/{message}.proto", "foxglove", message, fields, (time_file,)),
    )
    return b"".join(_bytes(1, f) for f in files)


# -- Protocol Buffers on the wire


def _varint(value: int) -> bytes:
    out = bytearray()
    while value > 0x7F:
        out.append(value & 0x7F | 0x80)
        value >>= 7
    out.append(value)
    return bytes(out)


def _varint_field(number: int, value: int) -> bytes:
    return _varint(number << 3 | _VARINT) + _varint(value)


def _fixed32(number: int, value: int) -> bytes:
    return _varint(number << 3 | _FIXED32) + struct.pack("<I", value)


def _bytes(number: int, data: bytes) -> bytes:
    return _varint(number << 3 | _BYTES) + _varint(len(data)) + data


def _timestamp(unix_ns: int) -> bytes:
    return _bytes(1, _varint_field(1, unix_ns // 10**9) + _varint_field(2, unix_ns % 10**9))


def _fields(data: bytes) -> Iterator[tuple[int, int | bytes]]:
    """Number and value of the fields of a message that has the kinds used here.

    Raises:
        FileFormatError: bytes missing, or another kind.
    """
    at = 0
    while at < len(data):
        tag, at = _read_varint(data, at)
        if tag & 7 == _VARINT:
            value, at = _read_varint(data, at)
            yield tag >> 3, value
            continue
        size, at = (4, at) if tag & 7 == _FIXED32 else _read_varint(data, at)
        if tag & 7 not in (_FIXED32, _BYTES) or at + size > len(data):
            raise FileFormatError(f"message of {len(data)} bytes is cut short or not ours; the recording is damaged")
        chunk, at = data[at : at + size], at + size
        yield tag >> 3, (struct.unpack("<I", chunk)[0] if tag & 7 == _FIXED32 else chunk)


def _read_varint(data: bytes, at: int) -> tuple[int, int]:
    value = shift = 0
    while at < len(data) and shift < 64:
        value |= (data[at] & 0x7F) << shift
        shift, at = shift + 7, at + 1
        if data[at - 1] < 0x80:
            return value, at
    raise FileFormatError(f"message of {len(data)} bytes is cut short or not ours; the recording is damaged")


RAW_IMAGE_SCHEMA = _schema("RawImage", _RAW)
COMPRESSED_IMAGE_SCHEMA = _schema("CompressedImage", _COMPRESSED)
