"""One MCAP file while it is written, and the channels that ceilvo writes (docs/recording.md)."""

from __future__ import annotations

import contextlib
import json
import os
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

from ceilvo import __version__
from ceilvo.drivers.recording import foxglove

FORMAT_VERSION = 1
"""Of ceilvo's recordings; a reader refuses any other."""
METADATA = "ceilvo"
CONFIG, CALIBRATION = "config.yaml", "calibration.yaml"
FLUSH_S = 1.0
"""A chunk ends at least this often: what a killed process loses."""
SYNC_S = 5.0
"""Chunks are on the disk at least this often: what a power cut loses."""
_CHUNK_BYTES = 1 << 20
"""Of a chunk at the most; it ends after a second in any case (docs/recording.md)."""
_PROTOBUF = "protobuf"
_ANYTHING = b'{"type":"object"}'
"""The schema of every JSON object."""
_MAY_BE_NULL = frozenset(
    (
        *("failure", "rms_m", "fit_residual", "unique_ancestors", "ess", "nis", "nis_low", "nis_high", "mode_weight"),
        *("calibration_mean_nis", "estimate_age_s", "base_link_age_s", "used_rate_hz", "camera_rate_hz", "fps"),
    )
)
"""Quantities of JSON messages that are not always known."""


@dataclass(frozen=True, slots=True)
class Channel:
    """Schema and encoding of a topic.

    Attributes:
        varied: its messages are JSON of several kinds, which nobody plots.
    """

    topic: str
    schema_name: str
    encoding: str = "json"
    varied: bool = False

    @property
    def schema(self) -> bytes:
        """Empty: it is inferred from the first message, which is JSON then."""
        if self.encoding == _PROTOBUF:
            return foxglove.schema(self.schema_name)
        return _ANYTHING if self.varied else b""


FRAMES = Channel("/camera", "foxglove.RawImage", _PROTOBUF)
PICTURES = Channel("/camera/jpeg", "foxglove.CompressedImage", _PROTOBUF)
POSE = Channel("/pose", "foxglove.PoseInFrame", _PROTOBUF)
EVENT = Channel("/event", "foxglove.Log", _PROTOBUF)
TRANSFORMS = Channel("/tf", "foxglove.FrameTransforms", _PROTOBUF)
CAMERA = Channel("/camera/calibration", "foxglove.CameraCalibration", _PROTOBUF)
SCENE = Channel("/scene", "foxglove.SceneUpdate", _PROTOBUF)
FEATURES = Channel("/features", "ceilvo.features.1", varied=True)
INPUT = Channel("/input", "ceilvo.input.1", varied=True)
ESTIMATE = Channel("/estimate", "ceilvo.estimate.1")
LATENCY = Channel("/latency", "ceilvo.latency.1")
TELEGRAM = Channel("/telegram", "ceilvo.telegram.1")
BASE_STATUS = Channel("/base_status", "ceilvo.base_status.1")
HEALTH = Channel("/health", "ceilvo.health.1")


@dataclass(frozen=True, slots=True)
class Message:
    """stamp_ns is CLOCK_MONOTONIC; `data` is called in the recorder's thread with the same instant since 1970."""

    channel: Channel
    stamp_ns: int
    data: Callable[[int], bytes]
    number: int = 0


@dataclass(frozen=True, slots=True)
class Head:
    """What a file starts with.

    Attributes:
        metadata: names and texts.
        attachments: files by name; they make the recording self-contained.
        unix_minus_monotonic_ns: fixed for the whole run, so that a step of the wall clock does not tear a recording.
        raw_frames: frames as they are, whose noise is not worth the time of zstd: chunks are LZ4.
    """

    metadata: Mapping[str, str]
    attachments: Mapping[str, bytes]
    unix_minus_monotonic_ns: int
    raw_frames: bool = False


class McapFile:
    """Not thread-safe. Every method may raise OSError."""

    def __init__(self, path: Path, head: Head, stamp_ns: int, **metadata: str) -> None:
        """Refuses a path that exists."""
        from mcap.writer import CompressionType, Writer  # slow to load: the daemon's first pose does not wait for it

        self.path = path
        self._head = head
        self._channels: dict[Channel, int] = {}
        self._flushed_ns = self._synced_ns = self.started_ns = stamp_ns
        self._dirty = False
        self._stream = path.open("xb")
        compression = CompressionType.LZ4 if head.raw_frames else CompressionType.ZSTD
        self._writer = Writer(self._stream, chunk_size=_CHUNK_BYTES, compression=compression)
        self._writer.start(library=f"ceilvo {__version__}")
        self._writer.add_metadata(METADATA, {"format": str(FORMAT_VERSION), **head.metadata, **metadata})
        unix_ns = stamp_ns + head.unix_minus_monotonic_ns
        for name, data in head.attachments.items():
            self._writer.add_attachment(unix_ns, unix_ns, name, "application/yaml", data)
        self.flush()

    @property
    def size(self) -> int:
        """Bytes so far, the chunk in progress not counted."""
        return self._stream.tell()

    def write(self, message: Message) -> None:
        unix_ns = message.stamp_ns + self._head.unix_minus_monotonic_ns
        data = message.data(unix_ns)
        channel = self._channels.get(message.channel)
        if channel is None:
            channel = self._channels[message.channel] = self._register(message.channel, data)
        self._writer.add_message(channel, unix_ns, data, unix_ns, message.number & 0xFFFFFFFF)
        self._dirty = True

    def tick(self, now_ns: int) -> None:
        """Call it often: ends the chunk, and forces it to the disk, when that is due."""
        if self._dirty and now_ns - self._flushed_ns >= FLUSH_S * 1e9:
            self.flush()
            self._flushed_ns, self._dirty = now_ns, False
            if now_ns - self._synced_ns >= SYNC_S * 1e9:
                os.fdatasync(self._stream.fileno())
                self._synced_ns = now_ns

    def flush(self) -> None:
        self._writer.flush()  # type: ignore[no-untyped-call]

    def close(self) -> None:
        """With the index at the end that readers use to seek."""
        try:
            self._writer.finish()  # type: ignore[no-untyped-call]
            self._stream.flush()
            os.fdatasync(self._stream.fileno())
        finally:
            self.abandon()

    def abandon(self) -> None:
        """Close it as it is, on a disk that takes no more; never raises. What was flushed stays readable."""
        with contextlib.suppress(OSError):
            self._stream.close()

    def _register(self, channel: Channel, first: bytes) -> int:
        schema = channel.schema or json.dumps(_schema_of(json.loads(first))).encode()
        kind = _PROTOBUF if channel.encoding == _PROTOBUF else "jsonschema"
        schema_id = self._writer.register_schema(channel.schema_name, kind, schema)
        return self._writer.register_channel(channel.topic, channel.encoding, schema_id)


def _schema_of(value: object) -> dict[str, object]:
    """A JSON schema of what an example shows for certain; plots need it to offer fields. It says nothing of what may be
    null: Foxglove reads no schema in which a field has two types."""
    if isinstance(value, dict):
        said = {
            k: v for k, v in value.items() if k not in _MAY_BE_NULL and v is not None and v != [] and not _nested(v)
        }
        return {"type": "object", "properties": {k: _schema_of(v) for k, v in said.items()}}
    if isinstance(value, list):
        return {"type": "array", "items": _schema_of(value[0])}
    return {"type": "boolean" if isinstance(value, bool) else "string" if isinstance(value, str) else "number"}


def _nested(value: object) -> bool:
    return isinstance(value, list) and any(isinstance(v, list | dict) or v is None for v in value)
