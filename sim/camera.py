"""The simulator as a camera."""

from __future__ import annotations

import time
from collections.abc import Callable

from ceilvo.drivers.ports import CameraInfo, Clock
from ceilvo.errors import CameraError, ConfigError
from ceilvo.sim.world import World
from ceilvo.types import Frame

SYNTHETIC_T0_NS = 1_000_000_000
"""Stamp of the first frame without a clock; not 0, which would read as unset."""


class SimCamera:
    """Frames of a world at a fixed rate; the stamp is the start of the exposure, of the middle row if rows differ.

    In real time it is paced by the clock and, as a real camera would, leaves out exposures that nobody came for in
    time: seq jumps. Otherwise it is a recording: every frame, as fast as they are drawn, the same bytes each time.
    """

    def __init__(
        self,
        world: World,
        rate_hz: float = 30.0,
        realtime: bool = True,
        duration_s: float | None = None,
        clock: Clock = time.monotonic_ns,
        sleep: Callable[[float], None] = time.sleep,
    ) -> None:
        """duration_s ends the frames at that world time; clock and sleep are replaced in tests."""
        if not rate_hz > 0:
            raise ConfigError(f"simulated camera: rate_hz is {rate_hz}, expected more than 0")
        self._world, self._rate_hz, self._realtime = world, rate_hz, realtime
        self._duration_s = duration_s
        self._clock, self._sleep = clock, sleep
        last_row_s = 0.5 * abs(world.calibration.camera.readout_s)
        self._exposure_ns = round((world.spec.render.exposure_s + last_row_s) * 1e9)
        self._open = False
        self._t0_ns = 0
        self._next = 0
        self._seq_of_index = 0
        self._next_seq = 0

    def open(self) -> CameraInfo:
        _ = self._world.renderer  # draw the ceiling now, not in the first frame's time
        self._t0_ns = self._world.start(self._clock() if self._realtime else SYNTHETIC_T0_NS)
        if self._realtime:
            self._next = max(0, self._started())
            self._seq_of_index = self._next_seq - self._next
        else:
            self._next, self._seq_of_index = 0, 0
        self._open = True
        cam = self._world.calibration.camera
        return CameraInfo(
            name="simulated camera",
            camera_id=self._world.calibration.camera_id,
            width_px=cam.width_px,
            height_px=cam.height_px,
            rate_hz=self._rate_hz,
            live=self._realtime,
        )

    def read(self) -> Frame | None:
        if not self._open:
            raise CameraError("simulated camera: read before open or after close; call open() first")
        index = self._wait() if self._realtime else self._next
        stamp_ns = self._stamp_ns(index)
        t_s = self._world.seconds(stamp_ns)
        if self._duration_s is not None and t_s >= self._duration_s - 1e-9:
            return None
        self._next = index + 1
        seq = index + self._seq_of_index
        self._next_seq = seq + 1
        return Frame(seq, stamp_ns, self._world.frame_at(t_s))

    def close(self) -> None:
        self._open = False

    def _stamp_ns(self, index: int) -> int:
        return self._t0_ns + round(index * 1e9 / self._rate_hz)

    def _started(self) -> int:
        """Index of the first exposure that has not begun yet."""
        return -int(-(self._clock() - self._t0_ns) * self._rate_hz // 1e9)

    def _wait(self) -> int:
        """Index of the exposure to deliver, once it is over: the next one, or the newest when that has been missed."""
        newest = int((self._clock() - self._exposure_ns - self._t0_ns) * self._rate_hz // 1e9)
        index = max(self._next, newest)
        remaining_ns = self._stamp_ns(index) + self._exposure_ns - self._clock()
        if remaining_ns > 0:
            self._sleep(remaining_ns / 1e9)
        return index
