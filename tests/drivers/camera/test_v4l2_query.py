"""The ioctls of V4L2 against what the kernel says."""

from __future__ import annotations

import ctypes
import errno
import struct
from pathlib import Path

import pytest

from ceilvo.drivers.camera.v4l2_query import (
    ENUM_FMT,
    ENUM_FRAMEINTERVALS,
    ENUM_FRAMESIZES,
    QUERYCAP,
    QUERYCTRL,
    Control,
    Size,
    query,
)
from ceilvo.errors import CameraError


def test_ioctl_numbers_are_the_kernels() -> None:
    """As `strace` shows them for v4l2-ctl on x86-64 and ARM."""
    assert [hex(c) for c in (QUERYCAP, ENUM_FMT, QUERYCTRL, ENUM_FRAMESIZES, ENUM_FRAMEINTERVALS)] == [
        "0x80685600",
        "0xc0405602",
        "0xc0445624",
        "0xc02c564a",
        "0xc034564b",
    ]


class Capability(ctypes.Structure):
    """struct v4l2_capability of videodev2.h, laid out by the C rules."""

    _fields_ = [
        ("driver", ctypes.c_char * 16),
        ("card", ctypes.c_char * 32),
        ("bus_info", ctypes.c_char * 32),
        ("version", ctypes.c_uint32),
        ("capabilities", ctypes.c_uint32),
        ("device_caps", ctypes.c_uint32),
        ("reserved", ctypes.c_uint32 * 3),
    ]


class FormatDescription(ctypes.Structure):
    _fields_ = [
        ("index", ctypes.c_uint32),
        ("type", ctypes.c_uint32),
        ("flags", ctypes.c_uint32),
        ("description", ctypes.c_char * 32),
        ("pixelformat", ctypes.c_uint32),
        ("mbus_code", ctypes.c_uint32),
        ("reserved", ctypes.c_uint32 * 3),
    ]


class FrameSize(ctypes.Structure):
    _fields_ = [
        ("index", ctypes.c_uint32),
        ("pixel_format", ctypes.c_uint32),
        ("type", ctypes.c_uint32),
        ("sizes", ctypes.c_uint32 * 6),
        ("reserved", ctypes.c_uint32 * 2),
    ]


class FrameInterval(ctypes.Structure):
    _fields_ = [
        ("index", ctypes.c_uint32),
        ("pixel_format", ctypes.c_uint32),
        ("width", ctypes.c_uint32),
        ("height", ctypes.c_uint32),
        ("type", ctypes.c_uint32),
        ("fractions", ctypes.c_uint32 * 6),
        ("reserved", ctypes.c_uint32 * 2),
    ]


class QueryControl(ctypes.Structure):
    _fields_ = [
        ("id", ctypes.c_uint32),
        ("type", ctypes.c_uint32),
        ("name", ctypes.c_char * 32),
        ("minimum", ctypes.c_int32),
        ("maximum", ctypes.c_int32),
        ("step", ctypes.c_int32),
        ("default_value", ctypes.c_int32),
        ("flags", ctypes.c_uint32),
        ("reserved", ctypes.c_uint32 * 2),
    ]


def fourcc(name: str) -> int:
    return int(struct.unpack("<I", name.encode())[0])


def kernel(fd: int, code: int, raw: bytearray) -> None:
    """A camera: YUYV at 640x480 (30 and 15 Hz) and MJPG at any size; exposure, and a gain that is disabled."""
    if code == QUERYCAP:
        c = Capability.from_buffer(raw)
        c.driver, c.card, c.capabilities, c.device_caps = b"uvcvideo", b"A camera: it", 0x80000000 | 0x1, 0x1
        return
    if code == QUERYCTRL:
        q = QueryControl.from_buffer(raw)
        if q.id not in (0x009A0902, 0x00980913):
            raise OSError(errno.EINVAL, "Invalid argument")
        q.minimum, q.maximum, q.flags = (3, 2047, 0) if q.id == 0x009A0902 else (0, 9, 0x1)
        return
    index = struct.unpack_from("<I", raw)[0]
    if code == ENUM_FMT and index < 2:
        f = FormatDescription.from_buffer(raw)
        assert f.type == 1
        f.pixelformat = fourcc(("YUYV", "MJPG")[index])
    elif code == ENUM_FRAMESIZES and index < 1:
        s = FrameSize.from_buffer(raw)
        yuyv = s.pixel_format == fourcc("YUYV")
        s.type, values = (1, (640, 480)) if yuyv else (3, (32, 1920, 2, 32, 1080, 4))
        s.sizes[: len(values)] = values
    elif code == ENUM_FRAMEINTERVALS and index < 2:
        i = FrameInterval.from_buffer(raw)
        assert (i.pixel_format, i.width, i.height) == (fourcc("YUYV"), 640, 480)
        i.type, i.fractions[0], i.fractions[1] = 1, 1, (30, 15)[index]
    else:
        raise OSError(errno.EINVAL, "Invalid argument")


def test_a_device_is_asked_as_the_kernel_wants_it() -> None:
    found = query("/dev/null", "YUYV", 640, 480, kernel)
    assert (found.card, found.driver, found.captures, found.max_rate_hz) == ("A camera: it", "uvcvideo", True, 30.0)
    assert found.sizes["YUYV"] == (Size((640, 480), (640, 480)),)
    assert found.sizes["MJPG"] == (Size((32, 32), (1920, 1080), (2, 4)),)
    assert found.sizes["MJPG"][0].has(640, 480) and not found.sizes["MJPG"][0].has(641, 480)
    assert found.controls == {"exposure": Control(3, 2047, True)}


def test_what_is_no_video_device_says_so(tmp_path: Path) -> None:
    for path in ("/dev/null", str(tmp_path / "absent")):
        with pytest.raises(CameraError, match=path):
            query(path, "YUYV", 640, 480)
