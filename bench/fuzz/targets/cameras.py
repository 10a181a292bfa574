"""What comes from cameras: folders of images, raw frames, videos, and what a V4L2 driver answers."""

from __future__ import annotations

import errno
import gzip
import struct
import zlib
from functools import lru_cache
from random import Random
from typing import Any

import cv2
import numpy as np

from ceilvo.bench.fuzz.engine.mutations import mutated
from ceilvo.bench.fuzz.engine.target import HEIGHT_PX, WIDTH_PX, Target, file, folder, frame
from ceilvo.calib.targets.board import Board
from ceilvo.calib.targets.ceiling_view import CeilingReader
from ceilvo.calib.targets.finder import BoardFinder
from ceilvo.calib.targets.sources import FolderSource
from ceilvo.config import Camera as CameraConfig
from ceilvo.drivers.camera import v4l2_query
from ceilvo.drivers.camera.mock_v4l2 import MockV4l2Device
from ceilvo.drivers.camera.pixel_formats import LAYOUTS, luma
from ceilvo.drivers.camera.recorded import FolderCamera, VideoCamera
from ceilvo.drivers.camera.v4l2_camera import V4l2Camera
from ceilvo.drivers.ports import Camera
from ceilvo.errors import BadFrameError
from ceilvo.sim.rig import simulated_camera

_MOST_FRAMES = 20
"""Read of one recording."""
_FORMATS = ("GREY", "YUYV", "MJPG", *sorted(set(LAYOUTS) - {"GREY", "YUYV"}))
"""By the first byte of an input; the order of the first three is the corpus's."""


def _read_all(camera: Camera) -> None:
    try:
        camera.open()
        for _ in range(_MOST_FRAMES):
            if camera.read() is None:
                return
    finally:
        camera.close()


def _index(data: bytes) -> None:
    """frames.csv beside two images."""
    for k in range(2):
        if not (folder() / f"frames/{k}.png").exists():
            file(f"frames/{k}.png", _encoded(".png"))
    path = file("frames/frames.csv", data)
    _read_all(FolderCamera(path.parent))


def _image(data: bytes) -> None:
    """For the daemon, which takes any type, and for calib, which looks for a board and for joints."""
    path = file("image/a.png", data)
    for picture in FolderSource(path.parent):
        if not picture.problem:
            BoardFinder(Board())(picture.gray)
            if picture.gray.shape == (HEIGHT_PX, WIDTH_PX):
                CeilingReader(simulated_camera(width_px=WIDTH_PX, height_px=HEIGHT_PX))(picture.gray)
    _read_all(FolderCamera(path.parent))


def _raw_frames(data: bytes) -> None:
    path = file("raw/a.raw.gz", data)
    _read_all(FolderCamera(path.parent, width_px=16, height_px=12))


def _video(data: bytes) -> None:
    _read_all(VideoCamera(file("video.avi", data)))


def _driver(data: bytes) -> None:
    """A driver whose answers are these bytes, one after another, and then no more."""
    at = 0

    def ioctl(fd: int, code: int, raw: bytearray) -> object:
        nonlocal at
        size = code >> 16 & 0x3FFF
        if at + size > len(data):
            raise OSError(errno.EINVAL, "no more")
        raw[:size] = data[at : at + size]
        at += size
        return 0

    offer = v4l2_query.query("/dev/null", "YUYV", 640, 480, ioctl)
    for sizes in offer.sizes.values():
        for size in sizes:
            size.has(640, 480)
            str(size)


def _buffer(data: bytes) -> None:
    """First byte: the format, and how OpenCV shapes the buffer."""
    first, raw = (data[0], np.frombuffer(data[1:], np.uint8)) if data else (0, np.zeros(0, np.uint8))
    luma(raw.reshape(1, -1) if first & 128 else raw, _FORMATS[first % 128 % len(_FORMATS)], 16, 12)


def _stamps(data: bytes) -> None:
    """Numbers of 8 bytes: what the driver says of the time of each frame."""
    stamps = iter(v for (v,) in struct.iter_unpack("<d", data[: len(data) // 8 * 8]))
    device = MockV4l2Device(sizes=((64, 48),))
    device.stamp_msec = lambda ns: next(stamps, ns / 1e6)
    camera = V4l2Camera(CameraConfig(width_px=64, height_px=48, pixel_format="GREY", exposure_us=None), device)
    try:
        camera.open()
        for _ in range(4):
            try:
                camera.read()
            except BadFrameError:
                continue
    finally:
        camera.close()


# -- what to start from


@lru_cache
def _encoded(suffix: str, small: bool = False) -> bytes:
    gray = frame(0).gray[:12, :16] if small else frame(0).gray
    return bytes(cv2.imencode(suffix, np.ascontiguousarray(gray))[1].tobytes())


def _images() -> tuple[bytes, ...]:
    colour = cv2.cvtColor(frame(1).gray, cv2.COLOR_GRAY2BGR)
    jpeg = cv2.imencode(".jpg", colour, [cv2.IMWRITE_JPEG_PROGRESSIVE, 1])[1].tobytes()
    kinds = (".png", ".jpg", ".bmp", ".pgm", ".tiff", ".webp")
    return (*(_encoded(k, small=k != ".png") for k in kinds), bytes(jpeg), _encoded(".jpg"))


@lru_cache
def _videos() -> tuple[bytes, ...]:
    path = folder() / "seed.avi"
    fourcc = cv2.VideoWriter.fourcc(*"MJPG")
    writer = cv2.VideoWriter(str(path), cv2.CAP_FFMPEG, fourcc, 30.0, (32, 24))
    for k in range(3):
        writer.write(cv2.cvtColor(np.ascontiguousarray(frame(k).gray[:24, :32]), cv2.COLOR_GRAY2BGR))
    writer.release()
    return (path.read_bytes(),) if path.exists() else ()


def _answers() -> tuple[bytes, ...]:
    """As vivid's: its name, one format of one size, thirty frames a second, one control."""
    q = v4l2_query
    capability = q._CAPABILITY.pack(b"uvcvideo", b"a camera", b"usb-1", 0x60000, 0x85200001, 0x4200001)
    format_ = q._FORMAT.pack(0, 1, 0, b"YUYV", b"YUYV", 0)
    size = q._SIZE.pack(0, b"YUYV", 1, 640, 480, 0, 0, 0, 0)
    stepwise = q._SIZE.pack(0, b"YUYV", 3, 2, 1280, 2, 2, 720, 2)
    interval = q._INTERVAL.pack(0, b"YUYV", 640, 480, 1, 1, 30, 0, 0, 0, 0)
    control = q._CONTROL.pack(0x980913, 1, b"gain", 0, 255, 1, 16, 0)
    return (capability + format_ + size + interval + 3 * control, capability + 2 * format_ + stepwise + 2 * interval)


def _buffers() -> tuple[bytes, ...]:
    grey = np.ascontiguousarray(frame(0).gray[:12, :16])
    yuyv = np.stack([grey, np.full_like(grey, 128)], axis=-1)
    plain = (b"\0" + grey.tobytes(), b"\1" + yuyv.tobytes(), b"\2" + _encoded(".jpg", small=True))
    sizes = ((name, round(12 * layout.planes) * layout.line_bytes(16)) for name, layout in LAYOUTS.items())
    return plain + tuple(bytes([_FORMATS.index(name)]) + bytes(size) for name, size in sizes)


def _size_lies(data: bytes, rng: Random) -> bytes:
    """The size that an image says it has, before anything else."""
    if rng.random() < 0.7:
        return mutated(data, rng)
    out, word = bytearray(data), struct.pack(">H", rng.choice((0, 1, 255, 8192, 30000, 32767, 65535)))
    at = data.find(b"\xff\xc0") if data.find(b"\xff\xc0") >= 0 else data.find(b"\xff\xc2")
    if at >= 0:
        for where in rng.choice(((5,), (7,), (5, 7))):
            out[at + where : at + where + 2] = word
    elif data.startswith(b"\x89PNG"):
        for where in rng.choice(((18,), (22,), (18, 22))):
            out[where : where + 2] = word
        out[29:33] = struct.pack(">I", zlib.crc32(out[12:29]))
    return bytes(out)


_INDEX = b"stamp_ns,file\n1000,0.png\n34000000,1.png\n"


def _times() -> tuple[bytes, ...]:
    return (struct.pack("<4d", 1000000.0, 1000033.0, 1000066.0, 1000099.0), struct.pack("<2d", 0.0, -1.0))


def _gzipped() -> tuple[bytes, ...]:
    return (gzip.compress(bytes(range(192)) * 2, mtime=0),)


TARGETS: dict[str, Any] = {
    "frames_csv": Target(_index, lambda: (_INDEX, b"\xef\xbb\xbf" + _INDEX.replace(b"\n", b"\r\n"))),
    "image": Target(_image, _images, _size_lies),
    "raw_frames": Target(_raw_frames, _gzipped),
    "video": Target(_video, _videos),
    "v4l2_driver": Target(_driver, _answers),
    "v4l2_buffer": Target(_buffer, _buffers, _size_lies),
    "v4l2_stamps": Target(_stamps, _times),
}
