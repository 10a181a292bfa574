"""An estimate moved on to a later moment: a pose is as old as its picture, and a base that steers needs one of now."""

from __future__ import annotations

import numpy as np

from ceilvo import se2
from ceilvo.types import Array, Estimate, Pose, WheelMotion

MAX_AHEAD_S = 0.5
"""Nothing is predicted further, whatever is asked for; chosen: a robot may stop within it."""
_ACCEL_MPS2, _TURN_ACCEL_RADPS2 = 1.0, 2.0
"""Standard deviation of what a robot may do meanwhile, where no wheels tell; as drivers/base/wheel_track.py."""
_NS = 1e-9
"""Seconds in a nanosecond."""


def predicted(estimate: Estimate, to_ns: int, wheels: WheelMotion | None = None) -> tuple[Pose, Array, float]:
    """Pose (3,) and cov (3, 3) at to_ns of the estimate's clock, and by how many seconds it was moved on.

    Args:
        wheels: what they did from the estimate's stamp to to_ns; None: its twist goes on.
    """
    ahead_s = (to_ns - estimate.stamp_ns) * _NS
    if ahead_s <= 0.0:
        return estimate.pose, estimate.cov, 0.0
    if wheels is not None and ahead_s <= MAX_AHEAD_S:
        moved, cov = np.asarray(wheels.prev_from_curr), wheels.cov
    else:
        ahead_s = min(ahead_s, MAX_AHEAD_S)
        moved = se2.driven(estimate.twist, np.array([ahead_s]))[0]
        off_m, off_rad = 0.5 * _ACCEL_MPS2 * ahead_s**2, 0.5 * _TURN_ACCEL_RADPS2 * ahead_s**2
        cov = np.diag([off_m**2, off_m**2, off_rad**2])
    pose = Pose(se2.compose(estimate.pose, moved))
    return pose, se2.compose_cov(estimate.pose, estimate.cov, moved, cov), ahead_s
