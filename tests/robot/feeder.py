"""Writes grey frames into a v4l2loopback device as a camera would deliver them.

feeder.py DEVICE FRAMES WIDTH HEIGHT RATE_HZ FORMAT FOLDER

Repeats the first frame until FOLDER/go exists, plays FRAMES once, makes FOLDER/played, then repeats the last frame.
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


def set_format(fd: int, fourcc: str, width: int, height: int, line_bytes: int) -> None:
    code = struct.unpack("<I", fourcc.encode())[0]
    pix = (width, height, code, V4L2_FIELD_NONE, line_bytes, line_bytes * height, V4L2_COLORSPACE_SRGB)
    request = bytearray(208)
    struct.pack_into("<I4x7I", request, 0, V4L2_BUF_TYPE_VIDEO_OUTPUT, *pix)
    fcntl.ioctl(fd, VIDIOC_S_FMT, request)
    got = struct.unpack_from("<7I", request, 8)
    if got[:3] != pix[:3]:
        raise SystemExit(f"feeder: asked for {pix[:3]}, the device took {got[:3]}")


def main() -> None:
    device, frames_path, width, height, rate, fourcc, folder_name = sys.argv[1:]
    w, h, folder = int(width), int(height), Path(folder_name)
    frames = np.memmap(frames_path, np.uint8, "r").reshape(-1, h, w)
    buffer = np.full((h, w) if fourcc == "GREY" else (h, w, 2), 128, np.uint8)
    luma = buffer if fourcc == "GREY" else buffer[..., 0]
    fd = os.open(device, os.O_RDWR)
    set_format(fd, fourcc, w, h, w if fourcc == "GREY" else 2 * w)
    period_ns = round(1e9 / float(rate))
    due_ns = time.monotonic_ns()
    index, playing = 0, False
    with (folder / "feed.csv").open("w", buffering=1) as log:
        while True:
            # One buffer, written in place: fresh memory for each frame costs more here than all the rest.
            luma[:] = frames[index]
            # A late frame moves all that follow: a camera does not deliver in bursts.
            due_ns = max(due_ns + period_ns, time.monotonic_ns())
            time.sleep(max(0, due_ns - time.monotonic_ns()) / 1e9)
            before_ns = time.monotonic_ns()
            os.write(fd, buffer.data)
            log.write(f"{index},{before_ns},{time.monotonic_ns()}\n")
            playing = playing or (folder / "go").exists()
            if playing and index < len(frames) - 1:
                index += 1
                if index == len(frames) - 1:
                    (folder / "played").touch()


if __name__ == "__main__":
    main()
