"""A world whose pictures are drawn beforehand: where a daemon is starved, the renderer must not starve it."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ceilvo.sim.motion import LapPath, LapSpec
from ceilvo.sim.world import Gray, World, WorldSpec

LAP_S = 20
"""Of a lap; chosen: a whole number of frames at every rate, 600 MB of pictures at 90 Hz."""
_ROOM_M = 4.2
"""Side of the room: seven tiles; chosen, 0.4 m/s for such a lap."""


class DrawnLap(World):
    """Laps of LAP_S seconds; their pictures are in a file that draw() wrote, the same ones in each lap."""

    def __init__(self, seed: int, rate_hz: int, folder: Path) -> None:
        still = LapSpec(room_m=_ROOM_M)
        lap = LapSpec(room_m=_ROOM_M, speed_mps=LapPath(still).lap_m / LAP_S)
        super().__init__(WorldSpec(seed=seed, lap=lap))
        self._rate_hz, self._file = rate_hz, folder / f"starved-lap-{rate_hz}.npy"
        self._begins = round(rate_hz * (lap.rest_s + lap.ramp_s))
        self._pictures: np.ndarray | None = None

    def draw(self) -> None:
        """Write the file: the start from rest, and one lap at full speed."""
        lens, count = self.calibration.camera, self._begins + self._rate_hz * LAP_S
        shape = (count, lens.height_px, lens.width_px)
        pictures = np.lib.format.open_memmap(self._file, "w+", np.uint8, shape)
        for k in range(count):
            pictures[k] = super().frame_at(k / self._rate_hz)

    def forget(self) -> None:
        """Remove the file."""
        self._file.unlink(missing_ok=True)

    def frame_at(self, t_s: float) -> Gray:
        """(H, W) uint8 at a multiple of the frame period."""
        if self._pictures is None:
            self._pictures = np.load(self._file, mmap_mode="r")
        k = max(round(t_s * self._rate_hz), 0)
        if k >= self._begins:
            k = self._begins + (k - self._begins) % (self._rate_hz * LAP_S)
        return np.array(self._pictures[k])
