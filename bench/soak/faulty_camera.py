"""The simulated camera with the faults of a plan."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from ceilvo.drivers.ports import Camera, CameraInfo
from ceilvo.errors import BadFrameError, CameraError
from ceilvo.types import Frame

READ_TIMEOUT_S = 1.0  # as camera.read_timeout_s
_LOOK_S = 0.02  # between two looks at the plan; chosen: less than a frame at 20 Hz
_JUMP_NS = 40_000_000  # 40 ms ahead; chosen: below the 50 ms that are taken (docs/faults.md)
_BACK_NS = 1_000_000_000  # 1 s; chosen: far older than the last frame


class FaultyCamera:
    """drivers.ports.Camera around another one; `fault` names what is wrong now (fault_plan), "" for nothing."""

    def __init__(self, camera: Camera, fault: Callable[[], str]) -> None:
        self._camera, self._fault = camera, fault
        self._last: Frame | None = None
        self._since_jump = 0

    def open(self) -> CameraInfo:
        if self._fault() == "unplugged":
            raise CameraError("camera: no such device; plug it in")
        if self._fault() == "stalled":
            self._wait_out("stalled")
        return self._camera.open()

    def read(self) -> Frame | None:
        fault = self._fault()
        if fault == "unplugged":
            raise CameraError("camera: lost while streaming; unplugged")
        if fault == "stalled":
            self._wait_out(fault)
        frame = self._camera.read()
        if frame is None:
            return None
        shown = self._spoilt(frame, fault)
        self._last = shown
        return shown

    def close(self) -> None:
        self._camera.close()

    def _wait_out(self, fault: str) -> None:
        """Block as a driver does that has no buffer."""
        until_s = time.monotonic() + READ_TIMEOUT_S
        while self._fault() == fault:
            if time.monotonic() >= until_s:
                raise CameraError(f"camera: no frame within {READ_TIMEOUT_S:g} s")
            time.sleep(_LOOK_S)

    def _spoilt(self, frame: Frame, fault: str) -> Frame:
        if fault == "corrupt frames":
            raise BadFrameError("camera: frame cut short")
        if fault == "frozen picture" and self._last is not None:
            return replace(frame, gray=self._last.gray)
        if fault in ("black picture", "white picture"):
            level = 0 if fault == "black picture" else 255
            return replace(frame, gray=np.full_like(frame.gray, level))
        if fault == "stamps run backwards":
            return replace(frame, stamp_ns=frame.stamp_ns - _BACK_NS)
        if fault == "stamps jump":
            self._since_jump += 1
            return replace(frame, stamp_ns=frame.stamp_ns + (_JUMP_NS if self._since_jump % 5 == 0 else 0))
        return frame
