"""What is learnt while the place is in doubt: a map of its own, in the frame of the pose as it is tracked.

Its landmarks have the ids from a number on. They lie right to each other and to the robot, but not to the rest of the
map, so they say nothing of the place. When the place is found they are joined to the rest, moved as the robot is.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ceilvo.crossing_types import quarter_turns, turned_type
from ceilvo.daemon.slam.spatial_index import landmarks_near
from ceilvo.se2 import compose, inverse, rotation, transform
from ceilvo.types import Array, Landmarks, Pose

SAME_M = 0.1
"""A joined landmark so near one of its type is that one; chosen: as far as places are told apart."""


def first_id_after(landmarks: Landmarks) -> int:
    """The least id that no landmark has reached."""
    return int(np.max(landmarks.ids, initial=-1)) + 1


def rest_of(landmarks: Landmarks, first_id: int | None) -> Landmarks:
    """The landmarks that are not the submap's; all of them where there is none."""
    return landmarks if first_id is None else landmarks.of(landmarks.ids < first_id)


def joined(landmarks: Landmarks, first_id: int, tracked: Array, found: Array) -> Landmarks | None:
    """All landmarks, those of the submap moved as the robot is from the tracked pose (3,) to the one found (3,).

    Where that turns them their types are named by the map's axes again.
    Of what both know the rest's is kept. None where the submap is empty.
    """
    own = landmarks.ids >= first_id
    if not np.any(own):
        return None
    there_from_here = np.asarray(compose(found, inverse(tracked)))
    turn = rotation(float(there_from_here[2]))
    new, old = landmarks.of(own), landmarks.of(~own)
    xy = transform(Pose(there_from_here), new.xy_map_m)
    kind = turned_type(new.crossing_type, -quarter_turns(0.0, float(there_from_here[2])))
    new = replace(new, xy_map_m=xy, cov_m2=turn @ new.cov_m2 @ turn.T, crossing_type=kind)
    near = landmarks_near(old, xy, SAME_M)[1]
    close = np.hypot(*(xy[:, None] - near.xy_map_m).transpose(2, 0, 1)) < SAME_M
    known = np.any(close & (new.crossing_type[:, None] == near.crossing_type), axis=1)
    parts = (old, new.of(~known))
    columns = ("ids", "xy_map_m", "cov_m2", "crossing_type", "sightings", "expected")
    return Landmarks(*(np.concatenate([getattr(p, name) for p in parts]) for name in columns))


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
