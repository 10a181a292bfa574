"""A V4L2 device that is not there, as cv2.VideoCapture shows it, with its faults: for V4l2Camera without hardware.

What it imitates was seen on the kernel's vivid driver with OpenCV 5.0: set() of a format that the device lacks says
True and the device goes on with another one; frames of GREY are (H, W), of YUYV (H, W, 2), of MJPG (1, bytes), where
OpenCV 4.11 gives one row of bytes for all of them; a vanished device makes waiting raise cv2.error.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from ceilvo.drivers.camera.mock_camera import moving_square
from ceilvo.drivers.camera.pixel_formats import fourcc
from ceilvo.errors import CameraError

_WITHOUT_SUPPORT = -1.0
"""OpenCV's answer for a property that a device lacks."""


def _packed(gray: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """(H, 1.5 W): twelve bits a pixel, of which the low four, together in every third byte, are of no account."""
    pairs = gray.reshape(len(gray), -1, 2)
    return np.concatenate([pairs, np.full_like(pairs[:, :, :1], 0xA5)], axis=2).reshape(len(gray), -1)


_PICTURE: Mapping[str, Callable[[NDArray[np.uint8]], NDArray[Any]]] = {
    "GREY": lambda gray: gray,
    "YUYV": lambda gray: np.stack([gray, np.full_like(gray, 128)], axis=-1),
    "UYVY": lambda gray: np.stack([np.full_like(gray, 128), gray], axis=-1),
    "Y10": lambda gray: np.asarray(gray.astype("<u2") << 2 | 3),
    "Y12P": _packed,
}


@dataclass
class MockV4l2Device:
    """The device and the machine around it; every field may be changed while it runs.

    Attributes:
        sizes: it snaps to the first one when asked for another.
        controls: property to value; what is not in it does not exist. limits clamp some of them.
        flat: raw frames as OpenCV 4.11 gives them.
        padding: bytes at the end of each line, but of MJPG.
        stamp_msec: CAP_PROP_POS_MSEC from the time of capture in ns.
        cut: bytes missing at the end of each frame.
        wakes: waits that a signal ends early, before frames come.
        clock_ns: its own time, which only waiting for frames moves on.
    """

    formats: tuple[str, ...] = ("BGR3", "YUYV", "GREY", "MJPG", "UYVY", "Y10", "Y12P")
    sizes: tuple[tuple[int, int], ...] = ((64, 48),)
    rate_hz: float = 30.0
    tells_rate: bool = True
    controls: dict[int, float] = field(
        default_factory=lambda: {cv2.CAP_PROP_AUTO_EXPOSURE: 3, cv2.CAP_PROP_EXPOSURE: 157, cv2.CAP_PROP_GAIN: 16}
    )
    limits: dict[int, tuple[float, float]] = field(default_factory=dict)
    flat: bool = False
    padding: int = 0
    stamp_msec: Callable[[int], float] = lambda ns: ns / 1e6
    picture: Callable[[int, int, int], NDArray[np.uint8]] = moving_square
    present: bool = True
    busy: bool = False
    lost: bool = False
    silent: bool = False
    empty: bool = False
    cut: int = 0
    wakes: int = 0
    camera_id: str = "mock serial 1"
    clock_ns: int = 1_000_000_000_000
    frames: int = 0
    captures: list[MockCapture] = field(default_factory=list)

    def resolve(self, device: str) -> str:
        if not self.present:
            raise CameraError(f"camera.device {device}: no such device")
        return "/dev/video7"

    def identity(self, node: str) -> str:
        return self.camera_id

    def open(self, node: str, timeout_s: float) -> MockCapture:
        self.captures.append(MockCapture(self))
        return self.captures[-1]

    def grab(self, capture: Any, timeout_s: float) -> bool:
        if self.lost:
            raise cv2.error("Error is reported for camera stream: 0")
        if self.silent or self.wakes > 0:
            self.clock_ns += round(timeout_s * 1e9) if self.silent else 1_000_000
            self.wakes = max(0, self.wakes - 1)
            return False
        self.clock_ns += round(1e9 / self.rate_hz)
        self.frames += 1
        return True

    def now_ns(self) -> int:
        return self.clock_ns + 3_000_000  # a frame is read 3 ms after its capture


class MockCapture:
    def __init__(self, device: MockV4l2Device) -> None:
        self._device = device
        self._format, self._size = device.formats[0], device.sizes[0]
        self._asked_size: dict[int, int] = {}
        self._raw = False
        self.released = False
        self.sets: list[tuple[int, float]] = []

    def isOpened(self) -> bool:
        return not self._device.busy and not self.released

    def set(self, prop: int, value: float, /) -> bool:
        d = self._device
        self.sets.append((prop, value))
        if prop == cv2.CAP_PROP_FOURCC:
            asked = int(value).to_bytes(4, "little").decode().strip()
            self._format = asked if asked in d.formats else d.formats[0]
        elif prop in (cv2.CAP_PROP_FRAME_WIDTH, cv2.CAP_PROP_FRAME_HEIGHT):
            self._asked_size[prop] = int(value)
            if len(self._asked_size) == 2:
                size = (self._asked_size[cv2.CAP_PROP_FRAME_WIDTH], self._asked_size[cv2.CAP_PROP_FRAME_HEIGHT])
                self._size = size if size in d.sizes else d.sizes[0]
        elif prop == cv2.CAP_PROP_CONVERT_RGB:
            self._raw = not value
        elif prop in d.controls:
            low, high = d.limits.get(prop, (value, value))
            d.controls[prop] = min(max(value, low), high)
        else:
            return prop in (cv2.CAP_PROP_FPS, cv2.CAP_PROP_BUFFERSIZE)
        return True

    def get(self, prop: int, /) -> float:
        d = self._device
        known = {
            cv2.CAP_PROP_FOURCC: float(fourcc(self._format)),
            cv2.CAP_PROP_FRAME_WIDTH: float(self._size[0]),
            cv2.CAP_PROP_FRAME_HEIGHT: float(self._size[1]),
            cv2.CAP_PROP_FPS: d.rate_hz if d.tells_rate else _WITHOUT_SUPPORT,
            cv2.CAP_PROP_POS_MSEC: d.stamp_msec(d.clock_ns) if d.frames else 0.0,
        }
        return known.get(prop, d.controls.get(prop, _WITHOUT_SUPPORT))

    def retrieve(self) -> tuple[bool, Any]:
        if self._device.empty:
            return False, None
        gray = self._device.picture(self._device.frames, *self._size)
        if not self._raw:
            return True, cv2.cvtColor(gray, cv2.COLOR_GRAY2BGR)
        return True, self._cut(self._layout(gray))

    def release(self) -> None:
        self.released = True

    def _layout(self, gray: NDArray[np.uint8]) -> NDArray[Any]:
        d = self._device
        if self._format == "MJPG":
            return np.asarray(cv2.imencode(".jpg", gray)[1], np.uint8).reshape(1, -1)
        image = _PICTURE[self._format](gray)
        if d.padding:
            lines = np.ascontiguousarray(image).reshape(len(gray), -1).view(np.uint8)
            return np.asarray(np.pad(lines, ((0, 0), (0, d.padding)), constant_values=9).reshape(1, -1), np.uint8)
        return image.view(np.uint8).reshape(1, -1) if d.flat else image

    def _cut(self, raw: NDArray[Any]) -> NDArray[Any]:
        return raw.reshape(1, -1)[:, : raw.size - self._device.cut] if self._device.cut else raw
