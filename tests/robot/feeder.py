"""Writes grey frames into a v4l2loopback device as a camera would deliver them.

feeder.py DEVICE FRAMES WIDTH HEIGHT RATE_HZ FORMAT FOLDER

Repeats the first frame until FOLDER/go exists, plays FRAMES once in real time, makes FOLDER/played, then repeats the
last frame. As on a sensor no two frames are equal: one row after the other has its lowest bit turned over.
FOLDER/mode, where it exists, says what is wrong: stall, frozen, black or white. FOLDER/faults.csv gets a line where
this changes: the mode, and when the first frame that it changes was due, in ns of CLOCK_MONOTONIC.
FOLDER/feed.csv gets a line for each write: index in FRAMES, CLOCK_MONOTONIC in ns before and after. v4l2loopback
stamps a buffer while it is written.
"""

from __future__ import annotations

import fcntl
import os
import struct
import sys
import time
from pathlib import Path

import numpy as np

VIDIOC_S_FMT = 0xC0D05605
V4L2_BUF_TYPE_VIDEO_OUTPUT = 2
V4L2_FIELD_NONE = 1
V4L2_COLORSPACE_SRGB = 8
LATEST_OF_PERIOD = 0.2
"""A frame that is later than this share of a period would bear a stamp too far from the moment that it shows."""


COLOURS = np.array([[160, 256], [256, 220]], np.uint16)
"""Of 256, what blue, green, green and red pixels of a sensor show of a light: a lamp that is none too blue."""


def set_format(fd: int, fourcc: str, width: int, height: int, line_bytes: int) -> None:
    code = struct.unpack("<I", fourcc.ljust(4).encode())[0]
    pix = (width, height, code, V4L2_FIELD_NONE, line_bytes, line_bytes * height, V4L2_COLORSPACE_SRGB)
    request = bytearray(208)
    struct.pack_into("<I4x7I", request, 0, V4L2_BUF_TYPE_VIDEO_OUTPUT, *pix)
    fcntl.ioctl(fd, VIDIOC_S_FMT, request)
    got = struct.unpack_from("<7I", request, 8)
    if got[:3] != pix[:3]:
        raise SystemExit(f"feeder: asked for {pix[:3]}, the device took {got[:3]}")


def read_mode(folder: Path) -> str:
    try:
        return (folder / "mode").read_text().strip()
    except FileNotFoundError:
        return ""


class Sensor:
    """One picture in a format of V4L2.

    Attributes:
        gray: (height, width) to be written.
        line_bytes: of a line of brightness.
    """

    def __init__(self, fourcc: str, width: int, height: int) -> None:
        self._fourcc = fourcc
        if fourcc in ("YUYV", "UYVY"):
            self._buffer = np.full((height, width, 2), 128, np.uint8)
            self.gray = self._buffer[..., fourcc.index("Y")]
        elif fourcc == "NV12":
            self._buffer = np.full((height * 3 // 2, width), 128, np.uint8)
            self.gray = self._buffer[:height]
        else:
            self._buffer = self.gray = np.zeros((height, width), np.uint8)
        self._deep = np.zeros((height, width), "<u2")
        self._colours = np.tile(COLOURS, (height // 2, width // 2)) if fourcc == "BA81" else None
        self.line_bytes = width * (2 if fourcc in ("YUYV", "UYVY", "Y16") else 1)

    def data(self) -> memoryview:
        if self._fourcc == "Y16":
            np.left_shift(self.gray, 8, out=self._deep, dtype=np.uint16)
            return self._deep.data
        if self._colours is not None:
            np.multiply(self.gray, self._colours, out=self._deep, dtype=np.uint16)
            return np.ascontiguousarray(self._deep.view(np.uint8)[:, 1::2]).data
        if self._fourcc == "MJPG":
            import cv2

            return memoryview(cv2.imencode(".jpg", self.gray)[1].tobytes())
        return self._buffer.data


def main() -> None:
    device, frames_path, width, height, rate, fourcc, folder_name = sys.argv[1:]
    w, h, folder = int(width), int(height), Path(folder_name)
    frames = np.memmap(frames_path, np.uint8, "r").reshape(-1, h, w)
    sensor = Sensor(fourcc, w, h)
    luma = sensor.gray
    fd = os.open(device, os.O_RDWR)
    set_format(fd, fourcc, w, h, sensor.line_bytes)
    period_ns = round(1e9 / float(rate))
    origin_ns = time.monotonic_ns()
    tick, index, first, was = 0, 0, None, ""
    with (folder / "feed.csv").open("w", buffering=1) as log, (folder / "faults.csv").open("w", buffering=1) as faults:
        while True:
            # The robot drives on while this process is kept waiting: frames whose time has passed are lost.
            tick = max(tick + 1, round((time.monotonic_ns() - origin_ns) / period_ns))
            if first is None and (folder / "go").exists():
                first = tick
            if first is not None:
                index = min(tick - first, len(frames) - 1)
            # One buffer, written in place: fresh memory for each frame costs more here than all the rest.
            mode = read_mode(folder)
            if mode != "frozen":
                luma[:] = {"black": 0, "white": 255}.get(mode, frames[index])
                luma[tick % h] ^= mode not in ("black", "white")
            due_ns = origin_ns + tick * period_ns
            if mode != was:
                faults.write(f"{mode},{due_ns}\n")
                was = mode
            time.sleep(max(0, due_ns - time.monotonic_ns()) / 1e9)
            before_ns = time.monotonic_ns()
            if before_ns - due_ns > LATEST_OF_PERIOD * period_ns:
                continue
            if mode == "stall":
                continue
            os.write(fd, sensor.data())
            log.write(f"{index},{before_ns},{time.monotonic_ns()}\n")
            if index == len(frames) - 1:
                (folder / "played").touch()


if __name__ == "__main__":
    main()
