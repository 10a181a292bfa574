"""MCAP recordings, as bytes and signed again after their messages were changed; trajectories to compare with."""

from __future__ import annotations

import io
import struct
import zlib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from random import Random

import numpy as np
from mcap.opcode import Opcode
from mcap.records import Attachment, Channel, Chunk, Message, Metadata, Schema
from mcap.stream_reader import StreamReader, breakup_chunk
from mcap.writer import MCAP0_MAGIC, CompressionType, Writer

from ceilvo.bench.fuzz.engine.mutations import mutated, mutated_json
from ceilvo.bench.fuzz.engine.target import Target, file, folder, frame, pipeline, printed, rig, wheels
from ceilvo.bench.fuzz.targets.pipeline_inputs import driven, mutated_state
from ceilvo.calibration_file import render_calibration
from ceilvo.daemon.app.estimator import Estimator
from ceilvo.daemon.replay.inputs import Continuation
from ceilvo.daemon.replay.recording import RecordingTap, versions
from ceilvo.daemon.replay.replay import Outputs
from ceilvo.daemon.replay.rerun import Rerun, replay_run
from ceilvo.daemon.replay.snapshot import snapshot_json
from ceilvo.daemon.replay.trajectory import compare
from ceilvo.drivers.recording import foxglove, mcap_file
from ceilvo.drivers.recording.mcap_file import Head, McapFile
from ceilvo.drivers.recording.mcap_file import Message as Recorded
from ceilvo.drivers.recording.mcap_reader import open_recording
from ceilvo.drivers.recording.scene import Scenery
from ceilvo.types import Pose

_UNIX_NS = 1_700_000_000 * 10**9
_FRAMES = 5
"""Of a recording: a mutant takes a tenth of a second to replay."""
_LARGEST = 1 << 20
"""Bytes of a message that is mutated as a tree."""


def _recording(data: bytes) -> None:
    """`ceilvod replay FILE`, and every message of it."""
    path = file("fuzz.mcap", data)
    outputs = Outputs(folder() / "fuzz.tum", folder() / "fuzz.jsonl")
    for _ in open_recording(path).messages():
        pass
    with printed():
        replay_run(Rerun(path), outputs, None, "none")


def _pictures(data: bytes) -> None:
    """First byte: which of the two kinds."""
    read = foxglove.read_compressed_image if data[:1] >= b"\x80" else foxglove.read_raw_image
    read(data[1:])


def _trajectory(data: bytes) -> None:
    """A TUM file as the reference of a replay."""
    path = file("reference.tum", data)
    compare(path, path, "se2")


# -- a recording taken apart and put together again


Part = Attachment | Metadata | Schema | Channel | Message


@dataclass
class _Parts:
    """What is in a recording, in order; attachments and metadata come first, as the daemon writes them."""

    records: list[Part]
    compression: CompressionType = CompressionType.ZSTD


def taken_apart(data: bytes) -> _Parts:
    """Records of a whole recording; of one that is damaged, those up to there."""
    out = _Parts([])
    try:
        for record in _opened(data):
            if isinstance(record, Part):
                out.records.append(record)
    except Exception:
        pass
    return out


def _opened(data: bytes) -> Iterator[object]:
    for record in StreamReader(io.BytesIO(data), emit_chunks=True).records:
        if isinstance(record, Chunk):
            yield from breakup_chunk(record)
        else:
            yield record


def put_together(parts: _Parts) -> bytes:
    """A recording with lengths and checksums that are right."""
    out = io.BytesIO()
    writer = Writer(out, chunk_size=1 << 18, compression=parts.compression)
    writer.start(library="fuzz")
    schemas, channels = {0: 0}, {}
    for r in parts.records:
        if isinstance(r, Metadata):
            writer.add_metadata(r.name, dict(r.metadata))
        elif isinstance(r, Attachment):
            writer.add_attachment(r.create_time, r.log_time, r.name, r.media_type, r.data)
        elif isinstance(r, Schema):
            schemas[r.id] = writer.register_schema(r.name, r.encoding, r.data)
        elif isinstance(r, Channel):
            channels[r.id] = writer.register_channel(r.topic, r.message_encoding, schemas.get(r.schema_id, 0))
        elif r.channel_id in channels:
            writer.add_message(channels[r.channel_id], r.log_time, r.data, r.publish_time, r.sequence)
    writer.finish()  # type: ignore[no-untyped-call]
    return out.getvalue()


def resigned(data: bytes, rng: Random) -> bytes:
    """One to three records changed; what is around them is as it should be."""
    parts = taken_apart(data)
    how = rng.random()
    if not parts.records or how < 0.1:
        return mutated(data, rng)
    topics = {r.id: r.topic for r in parts.records if isinstance(r, Channel)}
    heard = [k for k, r in enumerate(parts.records) if not isinstance(r, Message) or topics.get(r.channel_id) in _HEARD]
    for _ in range(0 if how < 0.25 else rng.choice((1, 1, 2, 3))):
        at = rng.choice(heard) % len(parts.records)
        parts.records[at : at + 1] = _changed(parts.records[at], topics, rng)
    parts.compression = rng.choice((CompressionType.NONE, CompressionType.LZ4, CompressionType.ZSTD))
    try:
        return _chunk_changed(parts, rng) if how < 0.25 else put_together(parts)
    except Exception:  # a value that the format has no room for
        return mutated(data, rng)


_CHUNK = struct.Struct("<QQQI")
"""First and last time, size when unpacked, checksum (mcap.dev, Chunk)."""


def _chunk_changed(parts: _Parts, rng: Random) -> bytes:
    """The bytes inside of a chunk changed, with the checksum and mostly with the sizes that belong to them."""
    parts.compression = CompressionType.NONE
    data = put_together(parts)
    chunks, at = [], len(MCAP0_MAGIC)
    while at + _HEAD.size <= len(data) - len(MCAP0_MAGIC):
        opcode, length = _HEAD.unpack_from(data, at)
        if opcode == Opcode.CHUNK:
            chunks.append((at, at + _HEAD.size + length))
        at += _HEAD.size + length
    start, end = rng.choice(chunks)
    first, last, _, _ = _CHUNK.unpack_from(data, start + _HEAD.size)
    records = data[start + _HEAD.size + _CHUNK.size + 12 : end]  # behind an empty name and the records' size
    records = mutated(records, rng)
    size = len(records) if rng.random() < 0.8 else rng.choice(_WHOLE)
    head = _CHUNK.pack(first, last, size, zlib.crc32(records)) + struct.pack("<IQ", 0, len(records))
    body = head + records
    return data[:start] + _HEAD.pack(Opcode.CHUNK, len(body)) + body + data[end:]


_HEAD = struct.Struct("<BQ")
"""Of every record: opcode and length (mcap.dev)."""
_HEARD = frozenset(t.topic for t in (mcap_file.INPUT, mcap_file.FEATURES, mcap_file.FRAMES, mcap_file.PICTURES))
"""What a replay looks into."""


_WHOLE = (0, 1, 2**31, 2**32 - 1, 2**63, 2**64 - 1)


def _changed(r: Part, topics: Mapping[int, str], rng: Random) -> list[Part]:
    if isinstance(r, Message):
        how = rng.random()
        if how < 0.04:
            return [r, r]
        if how < 0.08:
            return []
        if how < 0.14:
            return [replace(r, sequence=rng.choice(_WHOLE) & 0xFFFFFFFF)]
        if how < 0.18:
            return [replace(r, log_time=rng.choice(_WHOLE))]
        if how < 0.24:
            return [replace(r, channel_id=rng.choice((*topics, 0, 999)))]
        return [replace(r, data=_message_changed(topics.get(r.channel_id, ""), r.data, rng))]
    if isinstance(r, Attachment):
        return [replace(r, data=mutated(r.data, rng)), *([r] if rng.random() < 0.1 else [])]
    if isinstance(r, Metadata):
        key = rng.choice(list(r.metadata) or [""])
        return [replace(r, metadata={**r.metadata, key: _text(mutated(r.metadata.get(key, "").encode(), rng))})]
    if isinstance(r, Channel):
        return [
            replace(r, topic=rng.choice((*topics.values(), "", "/other")), schema_id=rng.choice((r.schema_id, 0, 99)))
        ]
    return [replace(r, data=mutated(r.data, rng))]


def _message_changed(topic: str, data: bytes, rng: Random) -> bytes:
    if topic in (mcap_file.FRAMES.topic, mcap_file.PICTURES.topic):
        head = mutated(data[:64], rng) if rng.random() < 0.8 else data[:64]
        return head + (data[64:] if rng.random() < 0.7 else mutated(data[64:], rng))
    if topic == mcap_file.INPUT.topic and len(data) < _LARGEST and data.startswith(b"{"):
        return mutated_state(data, rng)
    return mutated_state(data, rng) if topic == mcap_file.FEATURES.topic else mutated_json(data, rng)


def _text(data: bytes) -> str:
    return data.decode("utf-8", "replace")


# -- what to start from


class _Writer:
    """A recorder that writes at once."""

    due = False

    def __init__(self, path: Path, raw_frames: bool) -> None:
        files = {
            mcap_file.CONFIG: b"robot: {name: r}\n",  # short, for YAML is slow
            mcap_file.CALIBRATION: render_calibration(rig(), "rig").encode(),
        }
        path.unlink(missing_ok=True)
        head = Head({**versions(), "robot": "r", "kind": "recording"}, files, _UNIX_NS, raw_frames=raw_frames)
        self.file = McapFile(path, head, 0, start="fresh")

    def put(self, *messages: Recorded, size: int = 0) -> None:
        for message in messages:
            self.file.write(message)

    def fault(self, reason: str) -> None:
        """There is no ring."""


def _recorded(name: str, frames: str, features: bool) -> bytes:
    """A short drive with everything that can be said to a pipeline."""
    writer = _Writer(folder() / name, frames == "lossless")
    tap = RecordingTap(writer, lambda: 0, Scenery(rig()), frames, features)  # type: ignore[arg-type]
    estimator = Estimator(pipeline(), lambda: 0, lambda a, b: wheels(), tap.input)
    for k in range(_FRAMES):
        estimator.frame(frame(k), live=False)
    if features:
        estimator.set_pose(Pose(np.zeros(3)), np.full(3, 0.1), "said")
        estimator.frame(frame(_FRAMES), live=False)
        estimator.reset(keep_map=True)
        estimator.frame(frame(_FRAMES + 1), live=False)
    writer.file.close()
    return writer.file.path.read_bytes()


def _continued(name: str) -> bytes:
    """One that begins in the middle of a run, with the state that there was."""
    writer = _Writer(folder() / name, False)
    tap = RecordingTap(writer, lambda: 0, Scenery(rig()), "none", True)  # type: ignore[arg-type]
    out = driven()
    tap.input(Continuation(snapshot_json(out.state, "joint")), None, out)
    estimator = Estimator(out, lambda: 0, lambda a, b: wheels(), tap.input)
    for k in (8, 9):
        estimator.frame(frame(k), live=False)
    writer.file.close()
    return writer.file.path.read_bytes()


@lru_cache
def _seeds() -> tuple[bytes, ...]:
    return (
        _recorded("seed-lossless.mcap", "lossless", False),
        _recorded("seed-features.mcap", "none", True),
        _recorded("seed-jpeg.mcap", "jpeg", False),
        _continued("seed-continued.mcap"),
    )


def _picture_seeds() -> tuple[bytes, ...]:
    gray = frame(0).gray[:24, :32]
    raw = b"\0" + foxglove.raw_image(_UNIX_NS, gray, "camera")
    parts = taken_apart(_seeds()[2]).records
    topic = next(r.id for r in parts if isinstance(r, Channel) and r.topic == mcap_file.PICTURES.topic)
    jpeg = next(r.data for r in parts if isinstance(r, Message) and r.channel_id == topic)
    return (raw, b"\xff" + jpeg)


_TUM = "".join(f"{k}.{k:09d} {0.1 * k} 0.2 0 0 0 0 1\n" for k in range(1, 6)).encode()

TARGETS = {
    "recording": Target(_recording, _seeds, resigned),
    "picture_message": Target(_pictures, _picture_seeds),
    "trajectory": Target(_trajectory, lambda: (b"# t x y z qx qy qz qw\n" + _TUM,)),
}
