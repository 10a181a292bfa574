"""The fleet's map in the place of a robot's: what the robot found itself and the fleet does not have stays. Pure."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from ceilvo.crossing_types import quarter_turns
from ceilvo.daemon.editing.joining import GATE_CHI2, free_ids, in_axes_of, matches_by_place, renamed
from ceilvo.daemon.fleet.learnt import Told, joined_landmarks
from ceilvo.daemon.map.database.content import MapContent
from ceilvo.types import Array, Ints, Landmarks

SAME_M = 0.08
"""One of the robot's own that is so near to one of the fleet's, within its doubt, is that one; as in the service."""


@dataclass(frozen=True)
class Renewed:
    """
    Attributes:
        content: the robot's new map.
        told: of the robot's own landmarks, what it has told so far.
        own: how many of its own stay.
    """

    content: MapContent
    told: Told
    own: int


def taken_in(learnt: MapContent, before: Ints, told: Told, fleet: Landmarks, seen_s: Array, axis_rad: float) -> Renewed:
    """
    Args:
        learnt: the robot's map.
        before: ids on it that are the fleet's.
        told: what the robot told of since it took the fleet's map the last time.
        fleet: the fleet's landmarks, by ascending id, seen at (L, 2).

    Raises:
        CeilvoError: the maps' axes are too far apart for one frame.
    """
    turned = in_axes_of(learnt, axis_rad) if len(learnt.landmarks) else learnt.landmarks
    is_own = ~np.isin(turned.ids, before)
    own, own_s = turned.of(is_own), learnt.seen_s[is_own]
    same = matches_by_place(own, fleet, GATE_CHI2)
    near = np.hypot(*(own.xy_map_m[same.a] - fleet.xy_map_m[same.b]).T) <= SAME_M
    known = same.a[near]
    name = dict(zip(own.ids[known].tolist(), fleet.ids[same.b[near]].tolist(), strict=True))
    stays = np.setdiff1d(np.arange(len(own)), known)
    ids = free_ids(own.ids[stays], fleet.ids, int(np.max(learnt.landmarks.ids, initial=-1)))
    name |= dict(zip(own.ids[stays].tolist(), ids.tolist(), strict=True))
    name |= {i: i for i in np.intersect1d(before, fleet.ids).tolist()}
    both = joined_landmarks(fleet, replace(own.of(stays), ids=ids))
    order = np.argsort(both.ids, kind="stable")
    content = replace(
        learnt,
        landmarks=both.of(order),
        seen_s=np.concatenate([seen_s, own_s[stays]])[order],
        axis_rad=axis_rad,
        key_poses=tuple(renamed(k, name, quarter_turns(learnt.axis_rad, axis_rad)) for k in learnt.key_poses),
    )
    return Renewed(content, _still_told(told, own.ids[stays], ids), len(stays))


def _still_told(told: Told, ids: Ints, now: Ints) -> Told:
    """Of the robot's own landmarks, under their names of now."""
    _, i, j = np.intersect1d(told.landmarks.ids, ids, assume_unique=True, return_indices=True)
    landmarks = replace(told.landmarks.of(i), ids=now[j])
    order = np.argsort(landmarks.ids, kind="stable")
    return Told(landmarks.of(order), told.refs[i][order])
