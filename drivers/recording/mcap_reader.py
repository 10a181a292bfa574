"""Reading what drivers.recorder wrote, also when the end is missing."""

from __future__ import annotations

import struct
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import IO

import lz4.frame
import zstandard
from mcap.exceptions import McapError, RecordLengthLimitExceeded
from mcap.records import Attachment, Chunk, Footer, McapRecord, Metadata, Schema
from mcap.records import Channel as ChannelRecord
from mcap.records import Message as MessageRecord
from mcap.stream_reader import CRCValidationError, StreamReader, breakup_chunk
from mcap.writer import MCAP0_MAGIC

from ceilvo.drivers.recording.mcap_file import CALIBRATION, CONFIG, FORMAT_VERSION, METADATA
from ceilvo.errors import FileFormatError, one_line

_MAX_BYTES = 256 << 20
"""Of a record or an unpacked chunk: far more than ceilvo writes, less than a computer's memory."""
_DAMAGE = (
    *(McapError, CRCValidationError, zstandard.ZstdError, struct.error),
    *(ValueError, ArithmeticError, LookupError, RuntimeError, MemoryError),
)
"""What bytes that are no recording raise in the libraries that read them."""


@dataclass(frozen=True, slots=True)
class Recorded:
    """A message; log_ns since 1970."""

    topic: str
    log_ns: int
    number: int
    data: bytes


@dataclass
class Recording:
    """A recording's head, and its messages when they are asked for.

    Attributes:
        metadata: what the recorder wrote of itself.
        attachments: files by name.
        problem: after messages() came to its end: "" or why it ended before the file was complete.
    """

    path: Path
    metadata: Mapping[str, str]
    attachments: Mapping[str, bytes]
    problem: str = field(default="", init=False)

    def text(self, name: str) -> str:
        """Raises FileFormatError when there is no such attachment, or when it is no text."""
        try:
            return self.attachments[name].decode()
        except (KeyError, UnicodeDecodeError) as e:
            raise FileFormatError(f"{self.path}: {name} is not in it ({type(e).__name__})") from e

    def messages(self) -> Iterator[Recorded]:
        """In the order of the file, up to where it can be read; see `problem` afterwards."""
        topics: dict[int, str] = {}
        with self.path.open("rb") as stream:
            records = _records(stream)
            while True:
                try:
                    record = next(records, None)
                except _DAMAGE as e:
                    self.problem = _what(e, self.path)
                    return
                if record is None:
                    return
                if isinstance(record, ChannelRecord):
                    topics[record.id] = record.topic
                elif isinstance(record, MessageRecord) and record.channel_id in topics:
                    yield Recorded(topics[record.channel_id], record.log_time, record.sequence, record.data)


def open_recording(path: Path) -> Recording:
    """The head of a recording of this program.

    Raises:
        FileFormatError: no MCAP file, one of somebody else's, or cut short before its first chunk.
    """
    metadata: dict[str, str] = {}
    attachments: dict[str, bytes] = {}
    try:
        with path.open("rb") as stream:
            for record in _records(stream):
                if isinstance(record, Metadata) and record.name == METADATA:
                    metadata = record.metadata
                elif isinstance(record, Attachment):
                    attachments[record.name] = record.data
                if isinstance(record, Schema) or {CONFIG, CALIBRATION} <= attachments.keys():
                    break
    except OSError as e:
        raise FileFormatError(f"{path}: cannot be read: {e.strerror}") from e
    except _DAMAGE as e:
        raise FileFormatError(f"{path}: no recording that can be read: {_what(e, path)}") from e
    if metadata.get("format") != str(FORMAT_VERSION):
        found = one_line(metadata.get("format", "none"))
        raise FileFormatError(
            f"{path}: recording format {found}, expected {FORMAT_VERSION}; 'ceilvod record' writes one"
        )
    return Recording(path, metadata, attachments)


def _records(stream: IO[bytes]) -> Iterator[McapRecord]:
    """Records with chunks opened, their checksums checked and their sizes limited."""
    reader = StreamReader(stream, emit_chunks=True, record_size_limit=_MAX_BYTES)
    for record in reader.records:
        if isinstance(record, Footer):
            return
        if not isinstance(record, Chunk):
            yield record
            continue
        yield from breakup_chunk(_unpacked(record), validate_crc=True)


def _unpacked(chunk: Chunk) -> Chunk:
    """Never more than the chunk says of itself: a few kilobytes may unpack to a computer's memory.

    Raises:
        ValueError: it says too much, or is more than it says.
    """
    size = chunk.uncompressed_size
    if size > _MAX_BYTES:
        raise ValueError(f"a chunk of {size} bytes, expected at most {_MAX_BYTES}")
    if chunk.compression == "lz4":
        data = lz4.frame.LZ4FrameDecompressor().decompress(chunk.data, max_length=size + 1)
    elif chunk.compression == "zstd":
        if zstandard.frame_content_size(chunk.data) != size:  # what the frame promises is what would be taken
            raise ValueError(f"a chunk of {size} bytes whose frame says otherwise")
        data = zstandard.ZstdDecompressor().decompressobj().decompress(chunk.data)
    else:
        return chunk
    if len(data) != size:
        raise ValueError(f"a chunk of {len(data)} bytes or more says that it has {size}")
    return replace(chunk, compression="", data=data)


def _what(error: BaseException, path: Path) -> str:
    with path.open("rb") as stream:
        stream.seek(max(0, path.stat().st_size - len(MCAP0_MAGIC)))
        whole = stream.read() == MCAP0_MAGIC
    if not whole:
        return "it ends in the middle (power cut, killed, or still being written)"
    if isinstance(error, CRCValidationError):
        return "a checksum is wrong"
    if isinstance(error, RecordLengthLimitExceeded):
        return "a record has an impossible length"
    return f"damaged: {one_line(error) or type(error).__name__}"
