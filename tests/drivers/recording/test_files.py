"""MCAP files as written: read by other people's readers, cut anywhere, damaged anywhere."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from mcap.reader import make_reader
from mcap.records import Schema
from mcap.stream_reader import StreamReader
from mcap_protobuf.decoder import DecoderFactory
from recording_messages import HEAD, UNIX_NS, S, noise, picture, text

from ceilvo.drivers.recording import foxglove
from ceilvo.drivers.recording.mcap_file import CALIBRATION, CONFIG, Head, McapFile
from ceilvo.drivers.recording.mcap_reader import open_recording
from ceilvo.errors import FileFormatError

SEED = 20261121


def written(path: Path, count: int = 40, raw: bool = False) -> Path:
    file = McapFile(path, Head(HEAD.metadata, HEAD.attachments, UNIX_NS, raw_frames=raw), 0, start="fresh")
    for i in range(count):
        file.write(picture(i * S // 10, i))
        file.write(text(i * S // 10, {"i": i}, i))
        file.tick(i * S // 10)
    file.close()
    return path


# -- messages


@given(st.integers(1, 40), st.integers(1, 40), st.integers(0, 2**33 * S), st.integers(0, 2**32 - 1))
def test_pictures_are_what_protocol_buffers_decode(width: int, height: int, unix_ns: int, seed: int) -> None:
    gray = noise(seed, height, width)
    for name, data in (
        ("foxglove.RawImage", foxglove.raw_image(unix_ns, gray, "camera")),
        ("foxglove.CompressedImage", foxglove.compressed_image(unix_ns, b"x", "jpeg", "c")),
    ):
        decode = DecoderFactory().decoder_for("protobuf", Schema(1, foxglove.schema(name), "protobuf", name))
        assert decode is not None
        m = decode(data)
        assert m.timestamp.seconds * S + m.timestamp.nanos == unix_ns
    assert (m.format, m.frame_id, m.data) == ("jpeg", "c", b"x")
    np.testing.assert_array_equal(foxglove.read_raw_image(foxglove.raw_image(unix_ns, gray, "")), gray)


@given(st.binary(max_size=200))
def test_any_bytes_are_a_picture_or_our_error(data: bytes) -> None:
    for read in (foxglove.read_raw_image, foxglove.read_compressed_image):
        try:
            assert read(data).dtype == np.uint8
        except FileFormatError as e:
            assert "damaged" in str(e)


# -- files


@pytest.mark.parametrize("raw", [False, True], ids=["zstd", "lz4"])
def test_the_mcap_library_reads_all_of_it(tmp_path: Path, raw: bool) -> None:
    path = written(tmp_path / "a.mcap", raw=raw)
    with path.open("rb") as f:
        reader = make_reader(f, validate_crcs=True, decoder_factories=[DecoderFactory()])
        summary = reader.get_summary()
        assert summary is not None and summary.statistics is not None
        assert summary.statistics.message_count == 80 and summary.statistics.attachment_count == 2
        assert {a.name for a in reader.iter_attachments()} == {CONFIG, CALIBRATION}
        frames = [d.decoded_message for d in reader.iter_decoded_messages(topics=["/camera"])]
        assert [(m.width, m.height, m.encoding) for m in frames] == [(64, 48, "mono8")] * 40
        np.testing.assert_array_equal(np.frombuffer(frames[7].data, np.uint8).reshape(48, 64), noise(7))
        schemas = {s.name: s for s in summary.schemas.values()}
        assert json.loads(schemas["ceilvo.health.1"].data)["properties"] == {"i": {"type": "number"}}
    with path.open("rb") as f:
        assert sum(1 for _ in StreamReader(f, validate_crcs=True).records) > 80


def test_a_chunk_ends_every_second_so_that_little_is_lost(tmp_path: Path) -> None:
    """What was written more than a second ago is in the file of a process that is killed now."""
    file = McapFile(tmp_path / "a.mcap", HEAD, 0)
    for i in range(100):
        file.write(text(i * S // 10, {"i": i}, i))
        file.tick(i * S // 10)
        on_disk = [m.number for m in open_recording(tmp_path / "a.mcap").messages()]
        assert on_disk == list(range(len(on_disk))) and len(on_disk) >= i - 10
    file.abandon()


def test_a_recording_cut_anywhere_gives_all_that_was_before(tmp_path: Path) -> None:
    path = written(tmp_path / "whole.mcap", raw=True)
    data = path.read_bytes()
    whole = list(open_recording(path).messages())
    rng = np.random.default_rng(SEED)
    print("seed", SEED)
    head = max(i for i in range(2000) if not _opens(tmp_path, data[:i]))
    before = -1
    for cut in sorted({head + 1, len(data) - 1, *rng.integers(head + 1, len(data), 120).tolist()}):
        (tmp_path / "cut.mcap").write_bytes(data[:cut])
        recording = open_recording(tmp_path / "cut.mcap")
        found = list(recording.messages())
        assert found == whole[: len(found)]
        assert "ends in the middle" in recording.problem or found == whole
        assert len(found) >= before
        before = len(found)
    assert before == len(whole)  # the last cuts take the index only


def _opens(tmp_path: Path, data: bytes) -> bool:
    (tmp_path / "head.mcap").write_bytes(data)
    try:
        open_recording(tmp_path / "head.mcap")
    except FileFormatError as e:
        assert "head.mcap" in str(e)
        return False
    return True


def test_damaged_bytes_give_a_prefix_or_our_error(tmp_path: Path) -> None:
    """A picture that went through is the one recorded: chunks have checksums."""
    path = written(tmp_path / "whole.mcap", count=12)
    data, whole = path.read_bytes(), list(open_recording(path).messages())
    rng = np.random.default_rng(SEED)
    ended_early = 0
    for _ in range(150):
        broken = bytearray(data)
        for at in rng.integers(0, len(data), rng.integers(1, 4)):
            broken[at] ^= 1 << int(rng.integers(8))
        (tmp_path / "broken.mcap").write_bytes(broken)
        try:
            recording = open_recording(tmp_path / "broken.mcap")
        except FileFormatError:
            continue
        found = list(recording.messages())
        ended_early += bool(recording.problem)
        if recording.problem:
            assert [m.data for m in found] == [m.data for m in whole[: len(found)]]
    assert ended_early > 50


def test_a_file_of_somebody_else_is_refused(tmp_path: Path) -> None:
    from mcap.writer import Writer

    other = tmp_path / "other.mcap"
    with other.open("wb") as f:
        writer = Writer(f)
        writer.start()
        writer.finish()  # type: ignore[no-untyped-call]
    (tmp_path / "text.mcap").write_text("hello, this is no recording")
    for name in ("other.mcap", "text.mcap", "absent.mcap"):
        with pytest.raises(FileFormatError, match=name):
            open_recording(tmp_path / name)
