"""A camera that does what a script says, faults included: for tests, and for trying what the robot does about them.

    MockCamera([Good(10), Loss(failed_opens=2), Good(5), BadStamp(-1_000_000), BadPicture(), Good(1)])

After its script a live mock goes on with good frames for ever; one that is not live ends.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ceilvo.drivers.ports import CameraInfo, Clock
from ceilvo.errors import BadFrameError, CameraError
from ceilvo.types import Frame


@dataclass(frozen=True)
class Good:
    """Frames as they should be."""

    count: int = 1


@dataclass(frozen=True)
class Loss:
    """Unplugged: the read fails, then so do that many openings; what is plugged in then may be another camera."""

    failed_opens: int = 0
    width_px: int | None = None
    height_px: int | None = None
    camera_id: str | None = None


@dataclass(frozen=True)
class Timeout:
    """Silent for that long, then the read fails as a timeout."""

    after_s: float = 0.0


@dataclass(frozen=True)
class Stall:
    """No frame for that long, then a good one: late, but not lost."""

    for_s: float


@dataclass(frozen=True)
class BadStamp:
    """One frame stamped that much after the frame before it: 0 is a duplicate, negative jumps back."""

    offset_ns: int


@dataclass(frozen=True)
class BadPicture:
    """One frame that cannot be used, as after a transfer that was cut short."""


@dataclass(frozen=True)
class WrongSize:
    """One frame of another size than the opened one."""

    width_px: int
    height_px: int


@dataclass(frozen=True)
class Crash:
    """A programming error in the driver."""

    error: Exception


Step = Good | Loss | Timeout | Stall | BadStamp | BadPicture | WrongSize | Crash


class MockCamera:
    """Camera of drivers.ports that follows a script.

    Args:
        failed_opens: openings that fail before the first that does not.
        wait: called with the seconds before each frame and while silent; time.sleep gives real time.
        clock: where stamps come from; None counts frame periods from the first, so that runs repeat exactly.
        picture: (height_px, width_px) uint8 of a frame number; default a grey field with a bright square that moves.
    """

    def __init__(
        self,
        script: Sequence[Step] = (),
        *,
        width_px: int = 64,
        height_px: int = 48,
        rate_hz: float = 30.0,
        live: bool = True,
        camera_id: str = "mock",
        failed_opens: int = 0,
        wait: Callable[[float], object] = time.sleep,
        clock: Clock | None = None,
        picture: Callable[[int, int, int], NDArray[np.uint8]] | None = None,
    ) -> None:
        self._script = tuple(script)
        self._size = (width_px, height_px)
        self._period_s = 1.0 / rate_hz
        self._rate_hz, self._live, self._camera_id = rate_hz, live, camera_id
        self._wait, self._clock, self._picture = wait, clock, picture or moving_square
        self._steps = self._play()
        self._failed_opens = failed_opens
        self._open = False
        self._seq = 0
        self._stamp_ns = 0
        self.opens = 0
        self.closes = 0

    def open(self) -> CameraInfo:
        self.opens += 1
        if self._failed_opens > 0:
            self._failed_opens -= 1
            raise CameraError("mock camera: no such device; its script says so")
        if not self._live:
            self._steps, self._seq, self._stamp_ns = self._play(), 0, 0
        self._open = True
        return CameraInfo("mock camera", self._camera_id, *self._size, self._rate_hz, self._live)

    def read(self) -> Frame | None:
        if not self._open:
            raise CameraError("mock camera: not open")
        step = next(self._steps, None)
        return None if step is None else self._do(step)

    def close(self) -> None:
        self._open = False
        self.closes += 1

    def _play(self) -> Iterator[Step]:
        for step in self._script:
            if isinstance(step, Good):
                yield from (Good() for _ in range(step.count))
            else:
                yield step
        while self._live:
            yield Good()

    def _do(self, step: Step) -> Frame:
        if isinstance(step, Loss):
            self._failed_opens = step.failed_opens
            self._size = (step.width_px or self._size[0], step.height_px or self._size[1])
            self._camera_id = step.camera_id or self._camera_id
            self._open = False
            raise CameraError("mock camera: lost while streaming; its script says so")
        if isinstance(step, Timeout):
            self._wait(step.after_s)
            raise CameraError(f"mock camera: no frame within {step.after_s:g} s")
        if isinstance(step, Crash):
            raise step.error
        self._wait(step.for_s if isinstance(step, Stall) else self._period_s)
        if isinstance(step, BadPicture):
            raise BadFrameError("mock camera: frame cut short; its script says so")
        if isinstance(step, BadStamp):
            return self._frame(self._stamp_ns + step.offset_ns, *self._size)
        self._stamp_ns = self._clock() if self._clock else self._stamp_ns + round(self._period_s * 1e9)
        w, h = (step.width_px, step.height_px) if isinstance(step, WrongSize) else self._size
        return self._frame(self._stamp_ns, w, h)

    def _frame(self, stamp_ns: int, width_px: int, height_px: int) -> Frame:
        frame = Frame(self._seq, stamp_ns, self._picture(self._seq, width_px, height_px))
        self._seq += 1
        return frame


def moving_square(number: int, width_px: int, height_px: int) -> NDArray[np.uint8]:
    """(height_px, width_px) grey 60 with a bright square whose place tells the frame's number."""
    image = np.full((height_px, width_px), 60, np.uint8)
    side = max(2, min(width_px, height_px) // 4)
    x, y = number % max(1, width_px - side), (number // max(1, width_px - side)) % max(1, height_px - side)
    image[y : y + side, x : x + side] = 220
    return image
