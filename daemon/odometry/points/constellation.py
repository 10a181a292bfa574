"""Points of two views laid on each other without a guess of where: by pairs that are as far apart in both.

Lines of tiles repeat, so how a robot drives has to say which of them is which. Lamps a few metres apart do not: within
what anything can move between two frames, one lamp can only be itself. So where points meet in one way and in no other,
that is the motion, however it was driven.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ceilvo import se2
from ceilvo.config import Odometry
from ceilvo.crossing_types import LINE_CROSSINGS
from ceilvo.types import Array, Crossings, Ints

FASTEST_MPS, FASTEST_RADPS = 10.0, 10.0
"""Nothing that looks at a ceiling moves faster, driven or carried; chosen, as for robots that are carried
(alternatives.py)."""
FEWEST = 3
"""Points that must meet for a motion that nothing else bears out: two tell one distance only; chosen."""
_ONE_M = 0.06
"""Points nearer to each other count as one: corners of a sprinkler, or it and its spot, move and are mistaken together;
chosen, twice what points may be off by."""
_RIVAL = 0.5
"""A displacement that lays so many points elsewhere, of those that meet at the best one, puts that in doubt; chosen."""
_MOST_LIKE = 128
"""Pairs of points that may be one, beyond which so many are alike that nothing stands alone; chosen for time: 13 lamps
3 m apart and 0.13 s without a motion have 120, which took 7 ms on a busy computer."""
LEANS = 3.0
"""Times what points may be off by in a steady drive: a robot that starts or brakes that hard leans by half a degree
more in one view than in the other; chosen: the car on which the recorded lamps were seen, at 2.4 m/s."""
_BASELINES = 4.0
"""Tolerances that two points must be apart to tell a rotation; chosen."""


@dataclass(frozen=True, slots=True)
class Points:
    """Points (N, 2) m of a view, (N,) their types, and (N,) standard deviations, m."""

    xy: Array
    kind: Ints
    sigma_m: Array


@dataclass(frozen=True, slots=True)
class Laid:
    """Where points meet.

    Attributes:
        ref_from_curr: (3,) under which most do.
        met: how many things do.
        alone: no other displacement within reach does nearly as well.
    """

    ref_from_curr: Array
    met: int
    alone: bool


def has_points(crossings: Crossings) -> bool:
    """Whether there are other features than crossings of lines."""
    return int(crossings.crossing_type.max(initial=0)) >= LINE_CROSSINGS


def has_lines(crossings: Crossings) -> bool:
    """Whether lines cross there, which tell the tilt: else the robot was taken to be as level as it was."""
    return bool(np.any(crossings.crossing_type < LINE_CROSSINGS))


def laid(ref: Points, curr: Points, guess: Array, elapsed_s: float, config: Odometry) -> Laid | None:
    """The displacement at which most points of both views meet, of all that anything can make in elapsed_s; None where
    no two do.

    Args:
        guess: (3,) ref_from_curr, around which those are.
    """
    far_m, far_rad = FASTEST_MPS * elapsed_s, FASTEST_RADPS * elapsed_s
    i, j, near_m = _alike(ref, curr, guess, far_m, far_rad, config)
    if len(i) < 2 or len(i) > _MOST_LIKE:
        return None
    a, b = curr.xy, ref.xy
    ways = _by_pairs(a, b, i, j, near_m)
    ways = ways[np.hypot(*(ways[:, :2] - guess[:2]).T) <= far_m]
    ways = ways[np.abs(se2.wrap_array(ways[:, 2] - guess[2])) <= far_rad]
    if not len(ways):
        return None
    off = _moved(ways, a[None])[:, i] - b[j]
    off_m = np.hypot(off[..., 0], off[..., 1])
    meets = off_m <= near_m
    thing = _things(a)[i]
    met = _distinct(meets, thing)
    best = int(np.argmax(met - np.sum(np.where(meets, off_m / near_m, 0.0), axis=1) / (len(i) + 1)))
    elsewhere = int(np.max(_distinct(meets & ~meets[best], thing)))
    return Laid(ways[best], int(met[best]), met[best] >= FEWEST and elsewhere < _RIVAL * met[best])


def _alike(
    ref: Points, curr: Points, guess: Array, far_m: float, far_rad: float, config: Odometry
) -> tuple[Ints, Ints, Array]:
    """(C,) numbers of the points of both views that may be one, those of curr in order; and (C,) how near such two must
    come to each other, m."""
    off = se2.transform(guess, curr.xy)[:, None] - ref.xy[None]
    reach = far_m + far_rad * np.hypot(curr.xy[:, 0], curr.xy[:, 1])
    same = curr.kind[:, None] == ref.kind[None]
    i, j = np.nonzero(same & (np.hypot(off[..., 0], off[..., 1]) <= reach[:, None]))
    sigma = np.hypot(curr.sigma_m[i], ref.sigma_m[j])
    return i, j, LEANS * np.maximum(config.residual_max_m, config.residual_sigmas * sigma)


def _by_pairs(a: Array, b: Array, i: Ints, j: Ints, near_m: Array) -> Array:
    """(K, 3) b_from_a by which two points meet two others, where they are as far apart."""
    one, two = np.triu_indices(len(i), 1)
    fit = (i[one] != i[two]) & (j[one] != j[two])
    one, two = one[fit], two[fit]
    apart_a, apart_b = a[i[two]] - a[i[one]], b[j[two]] - b[j[one]]
    length = np.hypot(*apart_a.T)
    slack = near_m[one] + near_m[two]
    fit = (np.abs(length - np.hypot(*apart_b.T)) <= slack) & (length >= _BASELINES * slack)
    one, two, apart_a, apart_b = one[fit], two[fit], apart_a[fit], apart_b[fit]
    theta = se2.wrap_array(np.arctan2(apart_b[:, 1], apart_b[:, 0]) - np.arctan2(apart_a[:, 1], apart_a[:, 0]))
    turned = _moved(np.column_stack([np.zeros((len(theta), 2)), theta]), 0.5 * (a[i[one]] + a[i[two]])[:, None])
    return np.column_stack([0.5 * (b[j[one]] + b[j[two]]) - turned[:, 0], theta])


def _moved(ways: Array, points: Array) -> Array:
    """(K, N, 2) points (N, 2), or of each its own (K, N, 2), moved by ways (K, 3)."""
    c, s = np.cos(ways[:, 2])[:, None], np.sin(ways[:, 2])[:, None]
    x, y = points[..., 0], points[..., 1]
    return np.stack([c * x - s * y, s * x + c * y], axis=-1) + ways[:, None, :2]


def _things(xy: Array) -> Ints:
    """(N,) the first of the points (N, 2) that are one with each."""
    near = np.hypot(*(xy[:, None] - xy[None]).transpose(2, 0, 1)) < _ONE_M
    return np.asarray(np.argmax(near, axis=1))


def _distinct(meets: NDArray[np.bool_], thing: Ints) -> Ints:
    """(K,) how many things meet another, of pairs (K, C) of points of things (C,)."""
    each = thing[:, None] == np.unique(thing)
    return np.asarray(np.count_nonzero(meets.astype(np.int64) @ each > 0, axis=1))
