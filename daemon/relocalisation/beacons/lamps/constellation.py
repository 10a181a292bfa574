"""Where several lights of a drive lie like lamps of the file, and nowhere else: that says where the robot is."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ceilvo import se2
from ceilvo.types import Array, Ints

Place = tuple[Array, list[tuple[int, int]]]

FEWEST = 4
"""Two lamps lie in two ways, and three lights like some lamps too often (one in five was wrong); chosen."""
APART_M = 0.8
"""Lights nearer to each other tell no direction; chosen."""
DRIFT = 0.004
"""Share of the way between two lights by which that errs; chosen: .2 deg, of an eye or of wheels that are learnt."""
SIGMAS = 3.5
ELSEWHERE_M, ELSEWHERE_RAD = 0.5, float(np.radians(10.0))
"""Places that differ by more are two."""
MOST_LAMPS, _MOST = 150, 2000
"""Lamps of the file, and places that are looked at, for time: of more lights lie like some anyway; chosen, 0.2 s."""
_LEAST_AREA_M2 = 10.0
_STRAY = 0.02
"""Share of the lights that are no lamps of the file although the robot is among these; chosen."""


@dataclass(frozen=True, slots=True)
class Constellation:
    """
    Attributes:
        map_from_odom: (3,); cov: (3, 3) of the robot's pose in map.
        lamps: rows of the lamps that were seen.
        chance: that the robot is elsewhere: where it sees none of these lamps, or others of them.
    """

    map_from_odom: Array
    cov: Array
    lamps: Ints
    chance: float


def find(lights: Array, lamps: Array, nearer: Array, sigma_m: float, odom: Array) -> Constellation | None:
    """The only place from which lights are lamps; None where there is none, or more than one.

    Args:
        lights: (N, 4) in odom: where the camera was, and how far off they lie at the ceiling.
        lamps: (L, 2) in map; nearer: (L,) by which share of that they are off the camera's foot.
        sigma_m: of a light against a lamp, but for drift.
        odom: (3,) where the robot is.
    """
    if len(lights) < FEWEST or not FEWEST <= len(lamps) <= MOST_LAMPS:
        return None
    at = lights[:, None, :2] + nearer[None, :, None] * lights[:, None, 2:]  # (N, L, 2) if it is that lamp
    starts = _starts(lights[:, :2], at, lamps, sigma_m)
    if not len(starts):
        return None
    tolerance_m = SIGMAS * (sigma_m + DRIFT * float(np.max(np.ptp(lights[:, :2], axis=0))))
    fitted = [_fit(t, at, lamps, tolerance_m) for t in starts]
    counts = np.array([len(which) for _, which, _ in fitted])
    most = int(np.max(counts))
    if most < FEWEST or most < len(lights) - len(lights) // 4:
        return None
    best = min((k for k in np.flatnonzero(counts == most).tolist()), key=lambda k: fitted[k][2])
    pose = fitted[best][0]
    rivals = [fitted[k][0] for k in np.flatnonzero(counts == most).tolist()]
    if any(_elsewhere(np.asarray(r), pose, odom) for r in rivals):
        return None
    light, lamp = np.array(fitted[best][1]).T
    found_m = np.sqrt(fitted[best][2] * most / (2.0 * most - 3.0))  # of each axis; three numbers were fitted
    places = {frozenset(pairs): (pose, pairs) for pose, pairs, _ in fitted if pairs}
    chance = _chance(pose, list(places.values()), at, lights[:, :2], lamps, sigma_m, odom)
    return Constellation(pose, _cov(at[light, lamp], odom, pose, max(sigma_m, float(found_m))), lamp, chance)


def _chance(
    pose: Array, places: list[Place], at: Array, foot: Array, lamps: Array, sigma_m: float, odom: Array
) -> float:
    """That the robot is not where a pose has it, before anything else is known: lights that are strewn over the lamps'
    ground, with no robot among them, are as likely beforehand as all its places there together."""
    area_m2 = max(float(np.prod(np.ptp(lamps, axis=0))), _LEAST_AREA_M2)
    here, elsewhere = 0.0, 1.0
    for other, pairs in places:
        light, lamp = np.array(pairs).T
        middle = foot[light].mean(axis=0)
        var = sigma_m**2 + DRIFT**2 * np.sum((foot - middle) ** 2, axis=1)  # (N,)
        off = at @ se2.rotation(float(other[2])).T + other[:2] - lamps  # (N, L, 2)
        near = np.exp(-0.5 * np.sum(off**2, axis=-1) / var[:, None]) / (2.0 * np.pi * var[:, None])
        ratio = _STRAY + (1.0 - _STRAY) * area_m2 * near.mean(axis=1)  # of each light, against one that is strewn
        arm = at[light, lamp] - at[light, lamp].mean(axis=0)
        turn_var = 1.0 / float(np.sum(np.sum(arm**2, axis=1) / var[light]))
        sure = (2.0 * np.pi) ** 1.5 * np.sqrt(turn_var) / np.sum(1.0 / var[light]) / (area_m2 * 2.0 * np.pi)
        weight = float(np.prod(ratio) * min(1.0, sure))
        if _elsewhere(other, pose, odom):
            elsewhere += weight
        else:
            here = max(here, weight)
    return elsewhere / (here + elsewhere)


def _starts(foot: Array, at: Array, lamps: Array, sigma_m: float) -> Array:
    """(K, 3) map_from_odom that lay two lights on two lamps."""
    out = [np.zeros((0, 3))]
    first, second = np.divmod(np.arange(len(lamps) ** 2), len(lamps))
    first, second = first[first != second], second[first != second]
    way = lamps[second] - lamps[first]
    for a in range(len(at)):
        for b in range(a + 1, len(at)):
            seen = at[b, second] - at[a, first]
            drift_m = DRIFT * float(np.hypot(*(foot[b] - foot[a])))
            size = np.hypot(*seen.T)
            near = np.abs(size - np.hypot(*way.T)) < SIGMAS * np.sqrt(2.0) * (sigma_m + drift_m)
            k = np.flatnonzero(near & (size > APART_M))
            turn = np.arctan2(way[k, 1], way[k, 0]) - np.arctan2(seen[k, 1], seen[k, 0])
            middle, there = 0.5 * (at[a, first[k]] + at[b, second[k]]), 0.5 * (lamps[first[k]] + lamps[second[k]])
            c, s = np.cos(turn), np.sin(turn)
            x = there[:, 0] - c * middle[:, 0] + s * middle[:, 1]
            y = there[:, 1] - s * middle[:, 0] - c * middle[:, 1]
            out.append(np.column_stack([x, y, turn]))
    found = np.concatenate(out)
    return found if len(found) <= _MOST else np.zeros((0, 3))


def _fit(start: Array, at: Array, lamps: Array, tolerance_m: float) -> tuple[Array, list[tuple[int, int]], float]:
    """map_from_odom fitted to all that match, pairs of light and lamp, and the mean square of what is left, m^2."""
    pose, pairs, left = start, list[tuple[int, int]](), np.inf
    for _ in range(2):
        r = se2.rotation(float(pose[2]))
        off = np.hypot(*np.moveaxis(at @ r.T + pose[:2] - lamps, -1, 0))
        lamp, light = np.argmin(off, axis=1), np.argmin(off, axis=0)
        pairs = [(i, k) for i, k in enumerate(lamp.tolist()) if off[i, k] < tolerance_m and light[k] == i]
        if len(pairs) < 2:
            return pose, [], np.inf
        i, k = np.array(pairs).T
        pose = _laid(at[i, k], lamps[k])
        left = float(np.mean(off[i, k] ** 2))
    return pose, pairs, left


def _laid(points: Array, on: Array) -> Array:
    """(3,) rigid motion that lays points (N, 2) on others, least squares."""
    a, b = points - points.mean(axis=0), on - on.mean(axis=0)
    turn = float(np.arctan2(np.sum(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]), np.sum(a * b)))
    shift = on.mean(axis=0) - se2.rotation(turn) @ points.mean(axis=0)
    return np.array([*shift, turn])


def _elsewhere(one: Array, other: Array, odom: Array) -> bool:
    """Whether two map_from_odom put the robot at two places."""
    off = se2.between(se2.compose(one, odom), se2.compose(other, odom))
    return bool(np.hypot(off[0], off[1]) > ELSEWHERE_M or abs(se2.wrap(float(off[2]))) > ELSEWHERE_RAD)


def _cov(points: Array, odom: Array, map_from_odom: Array, sigma_m: float) -> Array:
    """(3, 3) of the robot's pose, from points (N, 2) in odom that are each off by sigma_m."""
    arm = se2.rotation(float(map_from_odom[2])) @ (odom[:2] - points.mean(axis=0))
    turn_var = sigma_m**2 / float(np.sum((points - points.mean(axis=0)) ** 2))
    g = np.array([-arm[1], arm[0], 1.0])
    return np.asarray(np.diag([sigma_m**2 / len(points)] * 2 + [0.0]) + turn_var * np.outer(g, g))
