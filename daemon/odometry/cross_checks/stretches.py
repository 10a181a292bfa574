"""Stretches of the drive: the same piece of the way by wheels and by eye."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from ceilvo.daemon.odometry.cross_checks.paths import Paths, displacement
from ceilvo.types import Displacement


@dataclass(frozen=True, slots=True)
class Stretch:
    """Displacements (3,) of wheels and eye over the same time, each in its base at the start, and the wheels' variance
    of one coordinate."""

    wheels: Displacement
    eye: Displacement
    var_xy_m2: float

    @property
    def way_m(self) -> float:
        """By wheels."""
        return float(np.hypot(self.wheels[0], self.wheels[1]))

    @property
    def seen_m(self) -> float:
        """By eye."""
        return float(np.hypot(self.eye[0], self.eye[1]))

    @property
    def turned_rad(self) -> float:
        """By wheels."""
        return float(self.wheels[2])

    @property
    def bend_rad(self) -> float:
        """The larger turn of the two: where one is late without being known to be, only one of them has turned."""
        return max(abs(float(self.wheels[2])), abs(float(self.eye[2])))

    @property
    def angle_rad(self) -> float:
        """From the wheels' direction to the eye's, in [-pi, pi]."""
        (wx, wy), (ex, ey) = self.wheels[:2].tolist(), self.eye[:2].tolist()
        return math.atan2(wx * ey - wy * ex, wx * ex + wy * ey)


def stretch(paths: Paths, start_s: float | None, late_s: float) -> Stretch | None:
    """From the row at start_s until the last one; None where there is no such row, or vision's path broke since.

    Args:
        late_s: by how much the picture is known to lag behind the wheels.
    """
    times = paths.time_s
    if start_s is None or start_s - late_s < times[0]:
        return None
    row = int(np.searchsorted(times, start_s))
    if paths.piece[row] != paths.piece[-1]:
        return None
    from_s, to_s = float(times[row]) - late_s, float(times[-1]) - late_s
    wheels = displacement(paths.wheels_at(from_s), paths.wheels_at(to_s))
    return Stretch(wheels, displacement(paths.eye[row], paths.eye[-1]), paths.wheel_variance(from_s, to_s)[0])
