"""Databases of maps as a robot with a slightly wrong calibration leaves them: small halls, all truth known."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache

import numpy as np

from ceilvo.bench.refine.building import Drive, Hall, floor, views
from ceilvo.daemon.map.database.content import MapContent, Session
from ceilvo.se2 import compose, transform

HALL = Hall(0.0, 0.0, 12.0, 9.0)


@lru_cache
def driven(seed: int, robot: str = "robot") -> tuple[Drive, MapContent]:
    """What bench.refine drives; the sessions are named by the robot."""
    drive = floor((HALL,), 0.6, seed, 2)
    sessions, landmarks = views(drive, seed + 100)
    named = tuple(replace(s, session=f"{robot}/{k}") for k, s in enumerate(sessions))
    seen_s = 1.7e9 + np.arange(2 * len(landmarks), dtype=np.float64).reshape(-1, 2)
    known = tuple(Session(s.session, 1.7e9, 1.7e9 + 60.0, 6) for s in named)
    return drive, MapContent(landmarks, seen_s, 0.0, named, known)


def turned(content: MapContent, by: np.ndarray, name: str) -> MapContent:
    """The same map in another frame, b_from_a (3,), as another floor."""
    poses = tuple(replace(k, pose=np.asarray(compose(by, k.pose))) for k in content.key_poses)
    landmarks = replace(content.landmarks, xy_map_m=transform(by, content.landmarks.xy_map_m))
    return replace(content, landmarks=landmarks, key_poses=poses, axis_rad=content.axis_rad + by[2], floor=name)
