"""What V4l2Camera needs of the machine, small enough to be faked: device nodes, their identity, cv2.VideoCapture."""

from __future__ import annotations

import math
import os
import stat
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import cv2

from ceilvo.errors import CameraError

_LOG_LEVEL_ERROR = 2
"""cv2.utils.logging.LOG_LEVEL_ERROR, which some builds lack."""


class Capture(Protocol):
    """The part of cv2.VideoCapture that is used."""

    def isOpened(self) -> bool: ...
    def set(self, prop: int, value: float, /) -> bool: ...
    def get(self, prop: int, /) -> float: ...
    def retrieve(self) -> tuple[bool, Any]: ...
    def release(self) -> None: ...


class Device(Protocol):
    """Everything that touches the machine."""

    def resolve(self, device: str) -> str:
        """The node that a path or stable name stands for now; CameraError when there is none."""

    def identity(self, node: str) -> str:
        """What identifies the camera behind a node, the same after replugging; "" when nothing does."""

    def open(self, node: str, timeout_s: float) -> Capture:
        """A capture that may or may not be opened; waits for frames inside it last at most timeout_s, rounded up."""

    def grab(self, capture: Capture, timeout_s: float) -> bool:
        """Dequeue the next buffer; False when none came in time. cv2.error when the device is gone."""

    def now_ns(self) -> int:
        """CLOCK_MONOTONIC, which drivers stamp buffers with."""


@dataclass(frozen=True)
class LinuxDevice:
    """The real one; `dev` and `sys` are elsewhere only in tests."""

    dev: Path = Path("/dev")
    sys: Path = Path("/sys")

    def resolve(self, device: str) -> str:
        path = Path(device)
        if not path.exists():
            dangling = f" (it points to {path.readlink()}, which is gone)" if path.is_symlink() else ""
            raise CameraError(
                f"camera.device {device}: no such device{dangling}; present: {self._present()}; "
                "plug the camera in or correct camera.device"
            )
        node = path.resolve()
        if not stat.S_ISCHR(node.stat().st_mode):
            raise CameraError(f"camera.device {device}: {node} is no device node; present: {self._present()}")
        if not os.access(node, os.R_OK | os.W_OK):
            raise CameraError(
                f"camera.device {device}: no permission to read and write {node}; "
                "add the user that runs this to the group 'video'"
            )
        return str(node)

    def identity(self, node: str) -> str:
        for link in sorted((self.dev / "v4l" / "by-id").glob("*")):
            if link.resolve() == Path(node):
                return link.name
        entry = self.sys / "class" / "video4linux" / Path(node).name
        parts = [_text(entry / "name"), self._usb_serial(entry)]
        return " ".join(p for p in parts if p)

    def open(self, node: str, timeout_s: float) -> Capture:
        # Whole seconds, and OpenCV looks at it once in the life of the process: the first camera decides.
        os.environ.setdefault("OPENCV_VIDEOIO_V4L_SELECT_TIMEOUT", str(math.ceil(timeout_s)))
        if "OPENCV_LOG_LEVEL" not in os.environ:
            _only_errors_from_opencv()
        return cv2.VideoCapture(node, cv2.CAP_V4L2)

    def grab(self, capture: Capture, timeout_s: float) -> bool:
        # VideoCapture.read() cannot wait for less than a second; waitAny() polls in milliseconds and then dequeues.
        ready: tuple[bool, Any] = cv2.VideoCapture.waitAny([capture], max(1, round(timeout_s * 1e9)))  # type: ignore[list-item]
        return bool(ready[0])

    def now_ns(self) -> int:
        return time.monotonic_ns()

    def _present(self) -> str:
        by_id = sorted(str(p) for p in (self.dev / "v4l" / "by-id").glob("*"))
        names = by_id or sorted(str(p) for p in self.dev.glob("video*"))
        return ", ".join(names) or "no camera at all"

    def _usb_serial(self, entry: Path) -> str:
        device = (entry / "device").resolve()  # the USB interface; the serial number belongs to the device above it
        return _text(device.parent / "serial") or _text(device / "serial")


def _only_errors_from_opencv() -> None:
    """It warns at every attempt to reopen; our own errors say it once."""
    set_level = getattr(cv2, "setLogLevel", None) or cv2.utils.logging.setLogLevel  # OpenCV 4 and 5
    set_level(_LOG_LEVEL_ERROR)


def _text(path: Path) -> str:
    try:
        return path.read_text(errors="replace").strip()
    except OSError:
        return ""
