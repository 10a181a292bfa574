"""What is learnt while the place is in doubt: a map of its own, in the frame of the pose as it is tracked.

Its landmarks have the ids from a number on. They lie right to each other and to the robot, but not to the rest of the
map, so they say nothing of the place. When the place is found they are carried along with the robot
(PoseFilter.carry), and are the map's.
"""

from __future__ import annotations

import numpy as np

from ceilvo.types import Array, Landmarks


def rest_of(landmarks: Landmarks, first_id: int | None) -> Landmarks:
    """The landmarks that are not the submap's; all of them where there is none."""
    return landmarks if first_id is None else landmarks.of(landmarks.ids < first_id)


def turned_cov(cov: Array, way_m: Array) -> Array:
    """(3, 3) m and rad of a pose that was known by `cov` (3, 3) before it went a way (2,) in map.

    The moments of a turn of the way by the error of heading, a Gaussian's, which may be a quarter turn or more: to
    first order (se2.lever) a pose that is turned by 90 deg would lie 40 sigma off.
    """
    var = float(cov[2, 2])
    cos, cos2 = np.exp(-0.5 * var), np.exp(-2.0 * var)
    across = np.array([-way_m[1], way_m[0]])
    along = 0.5 * (1.0 + cos2) - 2.0 * cos + 1.0
    both: Array = cov.copy()
    both[:2, :2] += along * np.outer(way_m, way_m) + 0.5 * (1.0 - cos2) * np.outer(across, across)
    both[:2, :2] += cos * (np.outer(cov[:2, 2], across) + np.outer(across, cov[:2, 2]))
    both[:2, 2] += var * cos * across
    both[2, :2] = both[:2, 2]
    return both
