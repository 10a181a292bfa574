"""What editing does to a map: regions kept or forgotten, the whole turned and moved. Nothing is changed in place."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from ceilvo.daemon.editing.regions import Mark
from ceilvo.daemon.map.database.content import MapContent
from ceilvo.daemon.map.database.key_pose_rows import kept
from ceilvo.daemon.map.key_poses import KeyPoses
from ceilvo.daemon.map.transitions import Side
from ceilvo.errors import CeilvoError
from ceilvo.se2 import compose, rotation, transform, wrap
from ceilvo.types import NO_LANDMARK, Array

Holds = Callable[[Array], NDArray[np.bool_]]
"""Which points (N, 2) are in a region."""
SHORTEST_M = 0.5
"""Between two marks, for a direction; chosen: 1 cm of error is 1 deg then."""


def only(content: MapContent, holds: Holds) -> MapContent:
    """What is in a region: landmarks, key poses that stood there, and of what those saw that which is in it."""
    keep = holds(content.landmarks.xy_map_m)
    landmarks = content.landmarks.of(keep)
    sessions = (_within(k, holds, landmarks.ids) for k in content.key_poses)
    poses = tuple(k for k in sessions if len(k))
    return replace(content, landmarks=landmarks, seen_s=content.seen_s[keep], key_poses=poses)


def without(content: MapContent, holds: Holds) -> MapContent:
    """As only(), of what is not in the region."""
    return only(content, lambda xy_m: ~holds(xy_m))


def _within(k: KeyPoses, holds: Holds, ids: NDArray[np.int64]) -> KeyPoses:
    k = kept(k, holds(k.pose[:, :2]))
    seen = holds(k.xy_map_m)
    there = np.isin(k.landmark[seen], ids)
    return replace(
        k,
        view=k.view[seen],
        xy_base_m=k.xy_base_m[seen],
        cov_base_m2=k.cov_base_m2[seen],
        crossing_type=k.crossing_type[seen],
        landmark=np.where(there, k.landmark[seen], NO_LANDMARK),
    )


def moved(content: MapContent, there_from_here: Array) -> MapContent:
    """The whole map turned and shifted by (3,) [m, m, rad].

    Types stay: they are named by the axes, whose direction turns with the map.
    """
    r = rotation(float(there_from_here[2]))
    cov = r @ content.landmarks.cov_m2 @ r.T
    landmarks = replace(
        content.landmarks,
        xy_map_m=transform(there_from_here, content.landmarks.xy_map_m),
        cov_m2=0.5 * (cov + np.swapaxes(cov, 1, 2)),
    )
    poses = tuple(replace(k, pose=np.asarray(compose(there_from_here, k.pose))) for k in content.key_poses)
    axis = wrap(content.axis_rad + float(there_from_here[2]))
    sides = tuple(Side.at(s.name, s.kind, compose(there_from_here, np.array(s.pose))) for s in content.sides)
    return replace(content, landmarks=landmarks, axis_rad=axis, key_poses=poses, sides=sides)


def turn_about(centre_m: Array, angle_rad: float) -> Array:
    """(3,) motion that turns a map about a point (2,)."""
    return np.append(centre_m - rotation(angle_rad) @ centre_m, wrap(angle_rad))


def alignment(first: Mark, second: Mark) -> tuple[Array, float]:
    """The rigid motion that brings two marks nearest to where they should be, each half of what their distance is off.

    Returns:
        (3,) there_from_here, and how much longer the distance should be than it is, m.

    Raises:
        CeilvoError: two marks are too near to each other for a direction.
    """
    here, there = second.here_m - first.here_m, second.there_m - first.there_m
    lengths = float(np.hypot(*here)), float(np.hypot(*there))
    if min(lengths) < SHORTEST_M:
        raise CeilvoError(
            f"--mark: the marks are {lengths[0]:.3f} m apart in the map and {lengths[1]:.3f} m on the plan, expected "
            f"{SHORTEST_M:g} m or more; take two at opposite ends of the floor"
        )
    angle = wrap(float(np.arctan2(there[1], there[0]) - np.arctan2(here[1], here[0])))
    middle = 0.5 * (first.here_m + second.here_m)
    shift = 0.5 * (first.there_m + second.there_m) - rotation(angle) @ middle
    return np.append(shift, angle), lengths[1] - lengths[0]
