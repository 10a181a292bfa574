"""Image files: read as they are stored, refused where they say to be larger than any camera's picture."""

from __future__ import annotations

import struct
import subprocess
import sys
import zlib

import cv2
import numpy as np
import pytest

from ceilvo.drivers.pictures import decoded

GRAY = np.random.default_rng(1).integers(0, 256, (48, 64), np.uint8)


@pytest.mark.parametrize("kind", [".png", ".bmp", ".pgm", ".tiff"])
def test_grey_levels_come_back(kind: str) -> None:
    data = cv2.imencode(kind, GRAY)[1]
    for given in (data.tobytes(), np.asarray(data, np.uint8)):
        again = decoded(given)
        assert again is not None and again.dtype == np.uint8
        np.testing.assert_array_equal(again, GRAY)


@pytest.mark.parametrize("data", [b"", b"no picture", cv2.imencode(".png", GRAY)[1].tobytes()[:40]])
def test_what_is_no_image_is_none(data: bytes) -> None:
    assert decoded(data) is None


def jpeg(width: int, height: int) -> bytes:
    """A small one that says to be of this size."""
    data = bytearray(cv2.imencode(".jpg", GRAY)[1].tobytes())
    at = data.find(b"\xff\xc0")
    data[at + 5 : at + 9] = struct.pack(">HH", height, width)
    return bytes(data)


def png(width: int, height: int) -> bytes:
    data = bytearray(cv2.imencode(".png", GRAY)[1].tobytes())
    data[16:24] = struct.pack(">II", width, height)
    data[29:33] = struct.pack(">I", zlib.crc32(data[12:29]))
    return bytes(data)


@pytest.mark.parametrize("make", [jpeg, png])
def test_a_size_that_no_camera_has_is_refused_before_it_is_believed(make: object) -> None:
    """In a process of its own, as the daemon is: OpenCV takes the limit when it is loaded."""
    assert callable(make)
    code = (
        "import resource, sys\n"
        "from ceilvo.drivers.pictures import decoded\n"
        "data = bytes.fromhex(sys.stdin.read())\n"
        "before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss\n"
        "print(decoded(data), resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before)\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], input=make(30000, 30000).hex(), capture_output=True, text=True, check=True
    )
    said, grown_kb = done.stdout.split()
    assert said == "None" and int(grown_kb) < 20_000
