"""A CaptureLoop under test: a mock camera that delivers one frame a permit, and what the loop said."""

from __future__ import annotations

import queue
import threading
from collections.abc import Callable

from patience import PATIENCE_S

from ceilvo import config
from ceilvo.drivers.camera.capture import CaptureEvent, CaptureLoop
from ceilvo.drivers.ports import Camera
from ceilvo.types import Frame

FAST = config.Camera(reopen_min_s=0.001, reopen_max_s=0.004)


class Gate:
    """Lets a mock camera deliver one frame a permit."""

    def __init__(self) -> None:
        self._permits = threading.Semaphore(0)
        self.opened = threading.Event()

    def __call__(self, _seconds: float) -> None:
        while not self.opened.is_set() and not self._permits.acquire(timeout=0.2):
            pass

    def allow(self, count: int = 1) -> None:
        self._permits.release(count)


class Rig:
    """A loop under test with its events and crashes."""

    def __init__(self, camera: Camera, settings: config.Camera = FAST, clock: Callable[[], int] = lambda: 0) -> None:
        self.events: queue.Queue[CaptureEvent] = queue.Queue()
        self.crashes: queue.Queue[Exception] = queue.Queue()
        self.seen: list[CaptureEvent] = []
        self.loop = CaptureLoop(camera, settings, clock, self.events.put, self.crashes.put)

    def until(self, kind: str) -> CaptureEvent:
        while True:
            event = self.events.get(timeout=PATIENCE_S)
            self.seen.append(event)
            if event.kind == kind:
                return event

    def take(self) -> Frame:
        frame = self.loop.take(PATIENCE_S)
        assert frame is not None
        return frame


def collect(rig: Rig, gate: Gate, count: int) -> list[Frame]:
    frames = []
    for _ in range(count):
        gate.allow()
        frames.append(rig.take())
    return frames
