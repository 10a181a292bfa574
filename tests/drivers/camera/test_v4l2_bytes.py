"""Bytes and stamps of V4L2 buffers, made by hand, to brightness and nanoseconds."""

from __future__ import annotations

import math

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ceilvo.config.schema import PIXEL_FORMATS
from ceilvo.drivers.camera.pixel_formats import LAYOUTS, fourcc, luma
from ceilvo.drivers.camera.v4l2_camera import stamp_ns_from_msec
from ceilvo.errors import BadFrameError

W, H = 64, 48


def ramp(w: int, h: int) -> np.ndarray:
    return (np.arange(w * h, dtype=np.uint32) * 7 % 256).astype(np.uint8).reshape(h, w)


# --- bytes to brightness


def test_yuyv_bytes_written_out_by_hand() -> None:
    # two lines of two pixels: Y0 U Y1 V
    raw = np.array([10, 200, 20, 201, 30, 202, 40, 203], np.uint8)
    assert luma(raw, "YUYV", 2, 2).tolist() == [[10, 20], [30, 40]]


def test_grey_bytes_written_out_by_hand() -> None:
    assert luma(np.array([[1, 2, 3, 4, 5, 6]], np.uint8), "GREY", 3, 2).tolist() == [[1, 2, 3], [4, 5, 6]]


def test_deep_and_packed_bytes_written_out_by_hand() -> None:
    """The kernel's tables: Y10 and Y12 in the low bits of two bytes, least first; packed: high bytes, then the rest."""
    two = np.array([0x03, 0x02, 0xFF, 0x03], np.uint8)  # 0x203 and 0x3FF of 0x3FF
    assert luma(two, "Y10", 2, 1).tolist() == [[0x80, 0xFF]]
    assert luma(np.array([0x34, 0x02, 0xFF, 0x0F], np.uint8), "Y12", 2, 1).tolist() == [[0x23, 0xFF]]
    assert luma(np.array([0x34, 0x12, 0xFF, 0xFF], np.uint8), "Y16", 2, 1).tolist() == [[0x12, 0xFF]]
    assert luma(np.array([1, 2, 3, 4, 0xE4, 5, 6, 7, 8, 0xE4], np.uint8), "Y10P", 8, 1).tolist() == [[*range(1, 9)]]
    assert luma(np.array([1, 2, 0xE4, 3, 4, 0xE4], np.uint8), "Y12P", 4, 1).tolist() == [[1, 2, 3, 4]]
    assert luma(np.array([200, 10, 201, 20, 202, 30, 203, 40], np.uint8), "UYVY", 2, 2).tolist() == [[10, 20], [30, 40]]
    nv12 = np.array([1, 2, 99, 3, 4, 99, 128, 128, 99], np.uint8)  # lines of two pixels and a byte of padding
    assert luma(nv12, "NV12", 2, 2).tolist() == [[1, 2], [3, 4]]


def test_samples_of_two_bytes_are_taken_as_opencv_gives_them() -> None:
    deep = (ramp(W, H).astype(np.uint16) << 2) | 3
    assert np.array_equal(luma(deep, "Y10", W, H), ramp(W, H))


@pytest.mark.parametrize("depth", [8, 10, 12, 16, "10 packed", "12 packed"])
@pytest.mark.parametrize("pattern", ["BGGR", "GBRG", "GRBG", "RGGB"])
def test_a_bayer_pattern_of_a_coloured_light_is_even(pattern: str, depth: int | str) -> None:
    """Red 200, green 120, blue 40 everywhere, laid out by the pattern's name: brightness is the same in every pixel."""
    names = {"BGGR": "BA81 BG10 BG12 BYR2 pBAA pBCC", "GBRG": "GBRG GB10 GB12 GB16 pGAA pGCC"}
    names |= {"GRBG": "GRBG BA10 BA12 GR16 pgAA pgCC", "RGGB": "RGGB RG10 RG12 RG16 pRAA pRCC"}
    name = dict(zip([8, 10, 12, 16, "10 packed", "12 packed"], names[pattern].split(), strict=True))[depth]
    colour = {"R": 200, "G": 120, "B": 40}
    cell = np.array([[colour[c] for c in pattern[:2]], [colour[c] for c in pattern[2:]]], np.uint8)
    mosaic = np.tile(cell, (H // 2, W // 2))
    raw: np.ndarray = mosaic
    if isinstance(depth, int) and depth > 8:
        raw = mosaic.astype("<u2") << (depth - 8)
    elif isinstance(depth, str):
        shared = 4 if depth.startswith("10") else 2
        groups = mosaic.reshape(H, -1, shared)
        raw = np.concatenate([groups, np.full_like(groups[:, :, :1], 0x5A)], axis=2)
    gray = luma(raw.reshape(1, -1), name, W, H)
    assert gray.shape == (H, W)
    assert np.abs(gray.astype(int) - round(0.299 * 200 + 0.587 * 120 + 0.114 * 40)).max() <= 1


def test_every_format_of_the_configuration_is_one_that_can_be_read() -> None:
    assert set(PIXEL_FORMATS) == {*LAYOUTS, "MJPG"}
    assert fourcc("Y10") == cv2.VideoWriter.fourcc(*"Y10 ")
    assert fourcc("pBAA") == cv2.VideoWriter.fourcc(*"pBAA")


def test_padded_lines_are_cut() -> None:
    grey = np.array([1, 2, 99, 3, 4, 99], np.uint8)
    yuyv = np.array([1, 0, 2, 0, 99, 99, 3, 0, 4, 0, 99, 99], np.uint8)
    assert luma(grey, "GREY", 2, 2).tolist() == [[1, 2], [3, 4]]
    assert luma(yuyv, "YUYV", 2, 2).tolist() == [[1, 2], [3, 4]]


@given(w=st.integers(1, 20).map(lambda k: 2 * k), h=st.integers(1, 20), pad=st.integers(0, 9), flat=st.booleans())
def test_yuyv_agrees_with_opencv_in_every_layout(w: int, h: int, pad: int, flat: bool) -> None:
    pairs = np.stack([ramp(w, h), 255 - ramp(w, h)], axis=-1)
    truth = cv2.cvtColor(pairs, cv2.COLOR_YUV2GRAY_YUYV)
    raw = pairs
    if pad or flat:
        raw = np.pad(pairs.reshape(h, -1), ((0, 0), (0, pad)), constant_values=7).reshape(1, -1)
    assert np.array_equal(luma(raw, "YUYV", w, h), truth)


def test_luma_keeps_nothing_of_the_buffer_it_came_from() -> None:
    for fmt, raw in (("GREY", ramp(W, H)), ("YUYV", np.stack([ramp(W, H)] * 2, axis=-1))):
        image = luma(raw, fmt, W, H)
        assert image.flags.c_contiguous
        assert not np.shares_memory(image, raw)


def test_jpeg_grey_colour_and_padded() -> None:
    smooth = np.tile(np.linspace(20, 230, W).astype(np.uint8), (H, 1))
    for image in (smooth, cv2.cvtColor(smooth, cv2.COLOR_GRAY2BGR)):
        raw = np.concatenate([cv2.imencode(".jpg", image)[1].reshape(-1), np.zeros(300, np.uint8)])
        got = luma(raw.reshape(1, -1), "MJPG", W, H)
        assert got.shape == (H, W)
        assert np.abs(got.astype(int) - smooth).max() <= 4


@pytest.mark.parametrize(
    ("fmt", "raw", "says"),
    [
        ("GREY", np.zeros(W * H - 1, np.uint8), "cut short"),
        ("YUYV", np.zeros(W * H, np.uint8), "expected 6144"),
        ("GREY", np.zeros(0, np.uint8), "0 bytes"),
        ("MJPG", np.zeros(500, np.uint8), "no whole JPEG"),
        ("MJPG", np.zeros(0, np.uint8), "no whole JPEG"),
        ("MJPG", cv2.imencode(".jpg", ramp(W, H))[1][:-800], "no whole JPEG"),
        ("MJPG", cv2.imencode(".jpg", ramp(32, H))[1], "32x48, expected 64x48"),
    ],
)
def test_unusable_bytes(fmt: str, raw: np.ndarray, says: str) -> None:
    with pytest.raises(BadFrameError, match=says):
        luma(raw, fmt, W, H)


# --- stamps

NOW = 5_000_000_000_000


def test_stamp_is_exact_to_the_microsecond() -> None:
    # CAP_PROP_POS_MSEC of OpenCV: 1000 * tv_sec + tv_usec / 1000.0
    for sec, usec in ((4999, 999_999), (4999, 1), (4998, 123_457)):
        assert stamp_ns_from_msec(1000 * sec + usec / 1000.0, NOW, 0) == sec * 10**9 + usec * 1000


def test_a_stamp_a_little_ahead_is_taken() -> None:
    assert stamp_ns_from_msec((NOW + 40_000_000) / 1e6, NOW, 0) == NOW + 40_000_000


@pytest.mark.parametrize(
    ("pos_msec", "says"),
    [
        (0.0, "stamp 0"),
        (-1.0, "stamp -1"),
        (math.nan, "nan"),
        (math.inf, "inf"),
        (NOW / 1e6 + 51, r"\+51.0 ms from now"),
        (NOW / 1e6 - 2001, r"-2001.0 ms from now"),
        (1.7e12, "from now"),  # the time of day
        (NOW / 1e6 - 20, "not after the last"),
        (NOW / 1e6 - 10, "not after the last"),
    ],
)
def test_unusable_stamps(pos_msec: float, says: str) -> None:
    with pytest.raises(BadFrameError, match=says):
        stamp_ns_from_msec(pos_msec, NOW, NOW - 10_000_000)
