"""A recording in place of a camera: its frames come when their time comes, stamped on today's clock."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace

from ceilvo.drivers.ports import Camera, CameraInfo, Clock
from ceilvo.types import Frame


class PacedCamera:
    """Wraps a recorded camera; the first frame is now, the others follow at their recorded distances."""

    def __init__(
        self, camera: Camera, clock: Clock = time.monotonic_ns, sleep: Callable[[float], None] = time.sleep
    ) -> None:
        self._camera, self._clock, self._sleep = camera, clock, sleep
        self._offset_ns: int | None = None

    def open(self) -> CameraInfo:
        self._offset_ns = None
        return self._camera.open()

    def read(self) -> Frame | None:
        frame = self._camera.read()
        if frame is None:
            return None
        if self._offset_ns is None:
            self._offset_ns = self._clock() - frame.stamp_ns
        stamp_ns = frame.stamp_ns + self._offset_ns
        wait_ns = stamp_ns - self._clock()
        if wait_ns > 0:
            self._sleep(1e-9 * wait_ns)
        return replace(frame, stamp_ns=stamp_ns)

    def close(self) -> None:
        self._camera.close()
