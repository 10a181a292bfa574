"""Which height the lines of a view are at, by where the map has landmarks.

A robot that starts again below a part of the ceiling that hangs lower sees all of it farther apart than it is. Nothing
in one view tells that; the map does, for what is there was put where it is.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from itertools import product
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from ceilvo.crossing_types import quarter_turns, turned_type
from ceilvo.daemon.odometry.heights.tracks import UNKNOWN
from ceilvo.daemon.odometry.matching import Near, mutual_nearest
from ceilvo.se2 import compose, greatest_variance, rotation, transform
from ceilvo.types import Array, Crossings, Ints, Landmarks, Motion, Pose

_SURE_M = 0.1
"""Standard deviation of the pose's position up to which the map is asked: a fifth of what a step of 0.4 m moves the
side of a view by; chosen."""
_REACH_M = 0.05
"""A crossing is at a landmark within this; chosen, as under several heights landmarks are matched."""
_FEWEST = 2
"""Crossings of a line at landmarks that tell its height; chosen: one is there by chance."""
_SHARE = 0.5
"""Of a line's crossings, so many at least; chosen: half of what is in view was seen before."""
_ALIKE = 1.5
"""What a crossing of two lines of one height says, over one of two heights; chosen: joints cross joints."""
_CLEARLY = 2.0
"""Times as many as at any other height; chosen: near the middle of the view all heights look alike."""


@dataclass(frozen=True, slots=True)
class MapHere:
    """The map about the robot: its pose (3,) there as it is believed, the direction of axis 0 of types, landmarks."""

    pose: Array
    axis_rad: float
    near: Near


AskMap = Callable[[Array | None], MapHere | None]
"""The map where the robot should be after a motion (3,); None where that is not known well enough."""


def no_map(expected: Array | None) -> MapHere | None:
    """There is none, or nobody knows where the robot is on it."""
    return None


class Mapped(Protocol):
    """What is asked of a PoseFilter."""

    def estimate(self) -> tuple[Array, Array, Any]: ...

    def landmarks_near(self, xy_m: Array, reach_m: float) -> tuple[Ints, Landmarks]: ...


def map_here(filter_: Mapped, axis_rad: float | None, gap: Motion | None, expected: Array | None) -> MapHere | None:
    """The map where the robot should be by now; None where nobody knows that well enough, or there is no map.

    Args:
        axis_rad: direction in the map of axis 0 of the types.
        gap: predicted since the filter's pose.
        expected: (3,) motion since then.
    """
    pose, cov, _ = filter_.estimate()
    if axis_rad is None or math.sqrt(max(greatest_variance(cov[:2, :2]), 0.0)) > _SURE_M:
        return None
    for moved in (None if gap is None else gap.prev_from_curr, expected):
        pose = pose if moved is None else compose(pose, moved)
    return MapHere(np.asarray(pose), axis_rad, filter_.landmarks_near)


def levels_by_map(crossings: Crossings, of_crossing: Ints, mount: Array, here: MapHere, ratio: Array) -> Ints:
    """(L,) the level of each line, UNKNOWN where the map does not tell.

    Args:
        crossings: (M,) of lines, as if all were at the calibrated height.
        of_crossing: (M, 2) the lines of each, on axis 0 and axis 1 of the frame.
        mount: (2,) the camera's place in base.
        ratio: (N,) of the levels, calibrated over true height.
    """
    normals = rotation(crossings.psi_rad).T
    from_camera = (crossings.xy_base_m - mount) @ normals.T
    turns = quarter_turns(crossings.psi_rad + float(here.pose[2]), here.axis_rad)
    kinds = turned_type(crossings.crossing_type, turns)
    pairs = list(product(range(len(ratio)), repeat=2))
    seen = [transform(Pose(here.pose), mount + (from_camera / ratio[list(pair)]) @ normals) for pair in pairs]
    _, known = here.near(np.concatenate(seen), _REACH_M)
    there = np.zeros((len(ratio), len(ratio), len(kinds)), np.bool_)
    for (a, b), xy in zip(pairs, seen, strict=True):
        hit, _ = mutual_nearest(xy, kinds, known.xy_map_m, known.crossing_type, _REACH_M)
        there[a, b, hit] = True
    return _with_crossed(_clear(there, of_crossing), there, of_crossing)


def _clear(there: NDArray[np.bool_], of_crossing: Ints) -> Ints:
    """(L,) levels of lines that the map tells by themselves; there: (N, N, M) landmarks at crossings of two levels."""
    lines = int(of_crossing.max()) + 1
    at = np.zeros((lines, len(there)), np.int64)
    for pair in np.ndindex(there.shape[:2]):
        hit = of_crossing[there[pair]]
        for axis, level in enumerate(pair):
            at[:, level] = np.maximum(at[:, level], np.bincount(hit[:, axis], minlength=lines))
    total = np.bincount(of_crossing.ravel(), minlength=lines)
    best, most, second = _best(at.astype(np.float64))
    clear = (most >= _FEWEST) & (most >= _SHARE * total) & (most >= _CLEARLY * second)
    return np.where(clear, best, UNKNOWN)


def _with_crossed(level: Ints, there: NDArray[np.bool_], of_crossing: Ints) -> Ints:
    """The same with those that cross such lines at landmarks, at the height of these where it makes no difference."""
    votes = np.zeros((len(level), len(there)))
    every = np.arange(len(of_crossing))
    for axis in (0, 1):
        line, other = of_crossing[:, axis], level[of_crossing[:, 1 - axis]]
        for a in range(len(there)):
            of = there[a, other, every] if axis == 0 else there[other, a, every]
            np.add.at(votes[:, a], line, np.where(of & (other != UNKNOWN), np.where(other == a, _ALIKE, 1.0), 0.0))
    best, most, second = _best(votes)
    return np.where((level == UNKNOWN) & (most > second), best, level)


def _best(votes: Array) -> tuple[Ints, Array, Array]:
    """Of votes (L, N): which are most, how many, and the next most; all (L,)."""
    order, every = np.argsort(-votes, axis=1, kind="stable"), np.arange(len(votes))
    return order[:, 0], votes[every, order[:, 0]], votes[every, order[:, 1]]
