"""What a V4L2 device offers, asked with ioctls that do not touch a stream that another program has running.

Layouts and numbers are those of the kernel's videodev2.h; they are the same on every Linux.
"""

from __future__ import annotations

import fcntl
import os
import struct
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

from ceilvo.errors import CameraError

# All numbers below are of the kernel's linux/videodev2.h and v4l2-controls.h.
CONTROLS = {"exposure_auto": 0x009A0901, "exposure": 0x009A0902, "gain": 0x00980913}

_CAPABILITY = struct.Struct("16s32s32sIII12x")
_FORMAT = struct.Struct("III32s4sI12x")
_SIZE = struct.Struct("I4sI6I8x")
_INTERVAL = struct.Struct("I4sIII6I8x")
_CONTROL = struct.Struct("II32siiiiI8x")
_READ, _READ_WRITE = 2, 3  # _IOC_READ, and with _IOC_WRITE, of asm-generic/ioctl.h
_CAPTURE, _CAPTURE_MPLANE, _DEVICE_CAPS = 0x1, 0x1000, 0x80000000  # V4L2_CAP_*
_BUFFER_CAPTURE = 1  # V4L2_BUF_TYPE_VIDEO_CAPTURE
_DISCRETE = 1  # V4L2_FRMSIZE_TYPE_, V4L2_FRMIVAL_TYPE_DISCRETE
_DISABLED, _READ_ONLY = 0x1, 0x4  # V4L2_CTRL_FLAG_*
_MOST = 256
"""Answers of an enumeration, so that a driver that never says the end is left."""

Ioctl = Callable[[int, int, bytearray], object]


def _code(direction: int, number: int, layout: struct.Struct) -> int:
    return direction << 30 | layout.size << 16 | ord("V") << 8 | number


QUERYCAP = _code(_READ, 0, _CAPABILITY)  # VIDIOC_QUERYCAP
ENUM_FMT = _code(_READ_WRITE, 2, _FORMAT)  # VIDIOC_ENUM_FMT
QUERYCTRL = _code(_READ_WRITE, 36, _CONTROL)  # VIDIOC_QUERYCTRL
ENUM_FRAMESIZES = _code(_READ_WRITE, 74, _SIZE)  # VIDIOC_ENUM_FRAMESIZES
ENUM_FRAMEINTERVALS = _code(_READ_WRITE, 75, _INTERVAL)  # VIDIOC_ENUM_FRAMEINTERVALS


@dataclass(frozen=True, slots=True)
class Size:
    """Frame sizes from (min) to (max) px in steps; discrete ones have min = max."""

    min_px: tuple[int, int]
    max_px: tuple[int, int]
    step_px: tuple[int, int] = (1, 1)

    def has(self, width_px: int, height_px: int) -> bool:
        asked = (width_px, height_px)
        return all(
            low <= v <= high and (v - low) % max(step, 1) == 0
            for v, low, high, step in zip(asked, self.min_px, self.max_px, self.step_px, strict=True)
        )

    def __str__(self) -> str:
        low, high = ("x".join(map(str, v)) for v in (self.min_px, self.max_px))
        return low if low == high else f"{low} to {high}"


@dataclass(frozen=True, slots=True)
class Control:
    minimum: int
    maximum: int
    settable: bool


@dataclass(frozen=True, slots=True)
class Offer:
    """What a device can do: sizes by format (fourcc), frame rates at the size asked about, controls it has."""

    card: str
    driver: str
    captures: bool
    sizes: Mapping[str, tuple[Size, ...]]
    max_rate_hz: float | None
    controls: Mapping[str, Control]


def query(node: str, pixel_format: str, width_px: int, height_px: int, ioctl: Ioctl = fcntl.ioctl) -> Offer:
    """Ask a device; frame rates are those of this format and size.

    Raises:
        CameraError: it cannot be opened, or is no video device.
    """
    try:
        fd = os.open(node, os.O_RDWR | os.O_NONBLOCK | os.O_CLOEXEC)
    except OSError as e:
        raise CameraError(f"{node}: cannot be opened: {e.strerror}") from e
    try:
        return _query(fd, pixel_format, width_px, height_px, ioctl)
    except OSError as e:
        raise CameraError(f"{node}: does not answer as a video device: {e.strerror}") from e
    finally:
        os.close(fd)


def _query(fd: int, pixel_format: str, width_px: int, height_px: int, ioctl: Ioctl) -> Offer:
    raw = bytearray(_CAPABILITY.size)
    ioctl(fd, QUERYCAP, raw)
    driver, card, _, _, caps, device_caps = _CAPABILITY.unpack(raw)
    caps = device_caps if caps & _DEVICE_CAPS else caps
    formats = [fourcc for _, _, _, _, fourcc, _ in _each(fd, ioctl, ENUM_FMT, _FORMAT, (_BUFFER_CAPTURE,))]
    return Offer(
        _text(card),
        _text(driver),
        bool(caps & (_CAPTURE | _CAPTURE_MPLANE)),
        {_text(f): tuple(_sizes(fd, ioctl, f)) for f in formats},
        max(_rates(fd, ioctl, pixel_format.ljust(4).encode(), width_px, height_px), default=None),
        {name: c for name, number in CONTROLS.items() if (c := _control(fd, ioctl, number)) is not None},
    )


def _each(
    fd: int, ioctl: Ioctl, code: int, layout: struct.Struct, fields: tuple[object, ...]
) -> Iterator[tuple[Any, ...]]:
    """Answers to index 0, 1, ... with these fields after the index, until the driver says that there are no more."""
    for index in range(_MOST):
        raw = bytearray(layout.size)
        head = struct.pack("I" + "".join("4s" if isinstance(f, bytes) else "I" for f in fields), index, *fields)
        raw[: len(head)] = head
        try:
            ioctl(fd, code, raw)
        except OSError:
            return
        yield layout.unpack(raw)


def _sizes(fd: int, ioctl: Ioctl, fourcc: bytes) -> Iterator[Size]:
    for answer in _each(fd, ioctl, ENUM_FRAMESIZES, _SIZE, (fourcc,)):
        kind, v = answer[2], answer[3:]
        if kind == _DISCRETE:
            yield Size((v[0], v[1]), (v[0], v[1]))
            continue
        yield Size((v[0], v[3]), (v[1], v[4]), (v[2], v[5]))
        return


def _rates(fd: int, ioctl: Ioctl, fourcc: bytes, width_px: int, height_px: int) -> Iterator[float]:
    for answer in _each(fd, ioctl, ENUM_FRAMEINTERVALS, _INTERVAL, (fourcc, width_px, height_px)):
        seconds, per = answer[5], answer[6]  # of the shortest interval, where there is a range
        if seconds > 0:
            yield per / seconds
        if answer[4] != _DISCRETE:
            return


def _control(fd: int, ioctl: Ioctl, number: int) -> Control | None:
    raw = bytearray(_CONTROL.size)
    raw[:4] = struct.pack("I", number)
    try:
        ioctl(fd, QUERYCTRL, raw)
    except OSError:
        return None
    _, _, _, low, high, _, _, flags = _CONTROL.unpack(raw)
    return None if flags & _DISABLED else Control(low, high, not flags & _READ_ONLY)


def _text(raw: bytes) -> str:
    return raw.split(b"\0")[0].decode("latin-1").strip()
