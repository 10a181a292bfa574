"""What a map is made from: where a robot stood, how it got there, and what it saw there."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ceilvo.se2 import compose
from ceilvo.types import Array, Ints


@dataclass(frozen=True, slots=True)
class KeyPoses:
    """Views of one session, one every so far of driving.

    Attributes:
        session: names the drive: robot and start, such as `hall-3/2026-05-04T08:00:00Z`.
        stamp_ns: (K,) of the frames, CLOCK_MONOTONIC of that drive.
        pose: (K, 3) map_from_base [m, m, rad], as the robot believed.
        motion: (K, 3) prev_from_curr [m, m, rad] since the key pose before, by odometry; the first says nothing.
        motion_cov: (K, 3, 3) of it; infinite on the diagonal where nothing is known.
        direction_rad: (K,) of the ceiling's axis 0 in base, modulo a quarter turn.
        direction_sigma_rad: (K,) of it, NO_DIRECTION_RAD where no lines were seen.
        view: (O,) index of the key pose that a feature was seen from, ascending.
        xy_base_m: (O, 2) of the feature on the ceiling, by the calibration in use then.
        cov_base_m2: (O, 2, 2).
        crossing_type: (O,) by the axes of the map, as landmarks have it.
        landmark: (O,) id of the landmark that it was taken for, -1 for none.
    """

    session: str
    stamp_ns: Ints
    pose: Array
    motion: Array
    motion_cov: Array
    direction_rad: Array
    direction_sigma_rad: Array
    view: Ints
    xy_base_m: Array
    cov_base_m2: Array
    crossing_type: Ints
    landmark: Ints

    def __len__(self) -> int:
        return len(self.stamp_ns)

    @property
    def features(self) -> int:
        """O, of all views."""
        return len(self.view)

    @property
    def xy_map_m(self) -> Array:
        """(O, 2) where the features of all views are."""
        base = np.column_stack([self.xy_base_m, np.zeros(self.features)])
        return np.asarray(compose(self.pose[self.view], base)[:, :2])

    def __post_init__(self) -> None:
        k, o = len(self.stamp_ns), len(self.view)
        shapes = {
            "pose": (k, 3),
            "motion": (k, 3),
            "motion_cov": (k, 3, 3),
            "direction_rad": (k,),
            "direction_sigma_rad": (k,),
            "xy_base_m": (o, 2),
            "cov_base_m2": (o, 2, 2),
            "crossing_type": (o,),
            "landmark": (o,),
        }
        for name, shape in shapes.items():
            found = np.shape(getattr(self, name))
            if found != shape:
                raise ValueError(f"{name} has shape {found}, expected {shape}")
