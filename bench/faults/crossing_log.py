"""What the camera of a driving robot saw, as crossings: rendered and detected once, driven as often as wanted.

A lap is periodic, so its frames can follow each other for hours. Several takes of the lap, each with its own noise,
keep one frame from coming back in every lap.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from ceilvo.calibration import Calibration
from ceilvo.config import Features
from ceilvo.daemon.vision.crossings import cross
from ceilvo.daemon.vision.finder.line_finder import LineFinder
from ceilvo.sim.ceiling.spec import CeilingSpec
from ceilvo.sim.motion import LapSpec
from ceilvo.sim.world import World, WorldSpec
from ceilvo.types import Array, Crossings

RATE_HZ = 10.0  # of the camera; chosen: a third of the usual 30 Hz, so that hours pass quickly
TAKES = 3  # laps with noise of their own; chosen, every one is rendered, which is what costs time
_WARM_FRAMES = 5  # before each take, not used: edge tracking settles in them; chosen


@dataclass(frozen=True)
class CrossingLog:
    """Crossings of every frame of every take, crossings[take][k], and the true pose at frame k, (K, 3)."""

    calibration: Calibration
    truth: Array
    crossings: tuple[tuple[Crossings | None, ...], ...]

    @property
    def frames(self) -> int:
        return len(self.truth)


def record(seed: int, room_m: float, features: Features) -> CrossingLog:
    """Drive the laps of one room; every frame is rendered and its crossings are found as in the daemon."""
    world = World(WorldSpec(seed=seed, lap=LapSpec(room_m=room_m), ceiling=replace(CeilingSpec(), room_m=room_m)))
    lap = world.path
    speed = lap.spec.speed_mps
    start_s = lap.spec.rest_s + lap.spec.ramp_s
    count = round(lap.lap_m / speed * RATE_HZ)
    step_s = lap.lap_m / speed / count
    takes = []
    for take in range(TAKES):
        finder = LineFinder(world.calibration, features)
        first_s = start_s + take * count * step_s
        found = [finder(world.frame_at(first_s + k * step_s), None) for k in range(-_WARM_FRAMES, count)]
        takes.append(tuple(None if n is None else cross(n, world.calibration, features) for n in found[_WARM_FRAMES:]))
    times = start_s + step_s * np.arange(count)
    return CrossingLog(world.calibration, world.truth_at(times), tuple(takes))
