"""Bytes of a V4L2 buffer to brightness: grey, YUV, raw Bayer, 8 to 16 bits, packed or not, and JPEG.

Names are V4L2's four characters without trailing blanks, layouts those of linux/videodev2.h and the kernel's
"Image Formats" (MIPI's packed ones: the high eight bits of some pixels, then a byte with the rest of each).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from ceilvo.drivers.pictures import decoded
from ceilvo.errors import BadFrameError

Bytes = NDArray[np.uint8]


@dataclass(frozen=True, slots=True)
class Layout:
    """Where the brightness of a pixel is.

    Attributes:
        group: pixels that share `group_bytes` bytes; a line is a whole number of groups.
        bits: of a sample of two bytes, the low ones; 8: its high byte, or the only one, is at `at` and every `step`
            bytes on, for as many pixels as the group has.
        mosaic: OpenCV's code for brightness from a Bayer pattern, None for brightness itself.
        planes: size of the whole picture beside that of its brightness.
    """

    group: int
    group_bytes: int
    bits: int = 8
    at: int = 0
    step: int = 1
    mosaic: int | None = None
    planes: float = 1.0

    def line_bytes(self, width_px: int) -> int:
        return -(-width_px // self.group) * self.group_bytes


_BAYER: Mapping[str, tuple[int, tuple[str, ...]]] = {
    "BGGR": (cv2.COLOR_BayerBGGR2GRAY, ("BA81", "BG10", "BG12", "BYR2", "pBAA", "pBCC")),
    "GBRG": (cv2.COLOR_BayerGBRG2GRAY, ("GBRG", "GB10", "GB12", "GB16", "pGAA", "pGCC")),
    "GRBG": (cv2.COLOR_BayerGRBG2GRAY, ("GRBG", "BA10", "BA12", "GR16", "pgAA", "pgCC")),
    "RGGB": (cv2.COLOR_BayerRGGB2GRAY, ("RGGB", "RG10", "RG12", "RG16", "pRAA", "pRCC")),
}
_DEPTHS: tuple[Callable[[int | None], Layout], ...] = (
    lambda mosaic: Layout(1, 1, mosaic=mosaic),
    lambda mosaic: Layout(1, 2, bits=10, mosaic=mosaic),
    lambda mosaic: Layout(1, 2, bits=12, mosaic=mosaic),
    lambda mosaic: Layout(1, 2, bits=16, mosaic=mosaic),
    lambda mosaic: Layout(4, 5, mosaic=mosaic),
    lambda mosaic: Layout(2, 3, mosaic=mosaic),
)
LAYOUTS: Mapping[str, Layout] = {
    **dict(zip(("GREY", "Y10", "Y12", "Y16", "Y10P", "Y12P"), (d(None) for d in _DEPTHS), strict=True)),
    "YUYV": Layout(2, 4, step=2),
    "UYVY": Layout(2, 4, at=1, step=2),
    "NV12": Layout(1, 1, planes=1.5),
    **{name: depth(code) for code, names in _BAYER.values() for name, depth in zip(names, _DEPTHS, strict=True)},
}
"""Of all formats but MJPG."""


def fourcc(pixel_format: str) -> int:
    """V4L2's number for a name."""
    return int.from_bytes(pixel_format.ljust(4).encode("ascii"), "little")


def luma(raw: NDArray[np.uint8] | NDArray[np.uint16], pixel_format: str, width_px: int, height_px: int) -> Bytes:
    """Brightness of one frame as cv2.VideoCapture gives it with CAP_PROP_CONVERT_RGB = 0.

    Of more than eight bits the high eight are taken. A Bayer pattern's colours are interpolated first, so pixels of
    different colours under one light are alike.

    Args:
        raw: the buffer's bytes in any shape, or its samples of two bytes; OpenCV 4.11 gives one row of bytes, other
            versions (H, W) for GREY and (H, W, 2) for YUYV. Lines may be padded at their end. MJPG is the JPEG file,
            possibly padded with zeros.
        pixel_format: one of LAYOUTS, or "MJPG".

    Returns:
        (height_px, width_px) uint8, contiguous, not sharing memory with raw.

    Raises:
        BadFrameError: too few bytes, or no JPEG of that size.
    """
    data = np.ascontiguousarray(raw).reshape(-1).view(np.uint8)
    if pixel_format == "MJPG":
        return _jpeg_luma(data, width_px, height_px)
    layout = LAYOUTS[pixel_format]
    needed = layout.line_bytes(width_px)
    stride = int(data.size / (layout.planes * height_px))
    if stride < needed or round(stride * layout.planes * height_px) != data.size:
        raise BadFrameError(
            f"frame of {data.size} bytes, expected {round(needed * layout.planes * height_px)} "
            f"({pixel_format} {width_px}x{height_px}); the transfer was cut short"
        )
    lines = data[: height_px * stride].reshape(height_px, stride)[:, :needed]
    gray = _samples(lines, layout, width_px)
    return gray if layout.mosaic is None else np.asarray(cv2.cvtColor(gray, layout.mosaic), np.uint8)


def _samples(lines: Bytes, layout: Layout, width_px: int) -> Bytes:
    """(H, W) the high eight bits of each pixel."""
    if layout.bits > 8:
        low, high = lines[:, 0 : 2 * width_px : 2], lines[:, 1 : 2 * width_px : 2]
        return np.asarray((high << np.uint8(16 - layout.bits)) | (low >> np.uint8(layout.bits - 8)), np.uint8)
    if layout.group * layout.step == layout.group_bytes:
        return np.array(lines[:, layout.at :: layout.step][:, :width_px], order="C")
    groups = lines.reshape(len(lines), -1, layout.group_bytes)[:, :, : layout.group]
    return np.array(groups.reshape(len(lines), -1)[:, :width_px], order="C")


def _jpeg_luma(data: Bytes, width_px: int, height_px: int) -> Bytes:
    whole = data.size > 0 and data.tobytes().rfind(b"\xff\xd9") >= 0  # some versions decode half a file without a word
    image = decoded(data) if whole else None
    if image is None:
        raise BadFrameError(f"frame of {data.size} bytes is no whole JPEG; the transfer was cut short")
    if image.shape != (height_px, width_px):
        raise BadFrameError(f"JPEG of {image.shape[1]}x{image.shape[0]}, expected {width_px}x{height_px}")
    return image
