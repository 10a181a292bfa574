"""Where two maps of one place differ: who looked there last, and how often, says what is there."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from ceilvo.daemon.map.database.content import MapContent
from ceilvo.daemon.relocalisation.place_index.type_grid import GROUND_M
from ceilvo.types import Array, Ints

Bools = NDArray[np.bool_]
_AROUND = 4
"""Landmarks of the other map, the nearest, that say when and how often it looked at a place; chosen."""
_MISSED_BY_CHANCE = 0.01
"""A landmark that was not seen in so many looks as would happen by chance this rarely is gone; chosen."""


@dataclass(frozen=True)
class Differences:
    """Of each of a map's landmarks (L,): the other has it, too; the other never looked there; it is gone, for the other
    looked there later and often enough. What is none of these is in doubt, and kept."""

    shared: Bools
    beyond: Bools
    gone: Bools


def differences(own: MapContent, shared: Bools, other: MapContent, other_xy_m: Array) -> Differences:
    """What of a map the other one contradicts.

    Args:
        shared: (L,) own landmarks that the other has, too.
        other_xy_m: (N, 2) where the other's landmarks are in this map's frame.
    """
    xy = own.landmarks.xy_map_m
    count = min(_AROUND, len(other_xy_m))
    off, near = cKDTree(other_xy_m).query(xy, count)
    off, near = off.reshape(len(xy), -1), near.reshape(len(xy), -1)
    looked_at = off[:, 0] < GROUND_M
    last_s = np.max(other.seen_s[near, 1], axis=1)
    looks = np.median(other.landmarks.expected[near], axis=1)
    later = (own.seen_s[:, 1] > 0.0) & (last_s > own.seen_s[:, 1])
    by_chance = (1.0 - own.landmarks.visibility) ** looks
    gone = looked_at & ~shared & later & (by_chance < _MISSED_BY_CHANCE)
    return Differences(shared, ~looked_at & ~shared, gone)


def counted(which: Bools) -> int:
    return int(np.count_nonzero(which))


def of_pairs(length: int, which: Ints) -> Bools:
    """(length,) mask of indices."""
    out = np.zeros(length, bool)
    out[which] = True
    return out
