"""Chunks that claim little and are much: they must cost what they claim."""

from __future__ import annotations

import resource

import lz4.frame
import pytest
import zstandard
from mcap.records import Chunk

from ceilvo.drivers.recording.mcap_reader import _unpacked

BOMB = 400 << 20


def chunk(compression: str, data: bytes, size: int) -> Chunk:
    return Chunk(compression, data, 0, 0, 0, size)


@pytest.mark.parametrize("compression", ["lz4", "zstd"])
def test_what_is_honest_is_unpacked(compression: str) -> None:
    raw = bytes(range(256)) * 100
    packed = lz4.frame.compress(raw) if compression == "lz4" else zstandard.compress(raw)
    assert _unpacked(chunk(compression, packed, len(raw))).data == raw
    with pytest.raises(ValueError, match=r"a chunk of"):
        _unpacked(chunk(compression, packed, len(raw) + 1))


@pytest.mark.parametrize("compression", ["lz4", "zstd"])
@pytest.mark.parametrize("claims", [0, 1000])
def test_a_bomb_is_refused_before_it_goes_off(compression: str, claims: int) -> None:
    pack = lz4.frame.compress if compression == "lz4" else zstandard.compress
    packed = pack(bytes(BOMB >> 3)) if compression == "zstd" else _packed_in_parts()
    before_kb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    with pytest.raises(ValueError, match=r"a chunk of"):
        _unpacked(chunk(compression, packed, claims))
    grown_kb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before_kb
    assert grown_kb < 20_000, f"{grown_kb} kB more for {len(packed)} bytes that say they are {claims}"


def _packed_in_parts() -> bytes:
    """BOMB zeros, never all of them in memory: that would hide what unpacking takes."""
    packer = lz4.frame.LZ4FrameCompressor()
    parts = [packer.begin(), *(packer.compress(bytes(1 << 20)) for _ in range(BOMB >> 20)), packer.flush()]
    return b"".join(parts)


def test_a_chunk_that_claims_a_computer_full_is_not_tried() -> None:
    with pytest.raises(ValueError, match="expected at most"):
        _unpacked(chunk("lz4", b"", 1 << 40))
