"""Which poses can a view be from? Pairs of features, or a single one, are laid onto landmarks of their types."""

from __future__ import annotations

import numpy as np

from ceilvo.daemon.slam.spatial_index import IndexedMap
from ceilvo.se2 import wrap_array
from ceilvo.types import Array, Ints, Observations

RING = 72
"""Headings tried around a single landmark; 5 deg apart."""
TRIED = 6000
"""Poses scored when seeding; chosen for time."""
PAIRS = 4
"""Pairs of features that seed poses; several, because one may be an outlier."""
PAIR_SIGMAS = 3.0
"""Landmarks are a pair if their distance is the features' within so many of its standard deviations."""
SHORTEST_SIGMAS = 4.0
"""Features nearer to each other, in standard deviations of their distance, say too little about the heading."""
CHUNK = 2_000_000
"""Distances computed at once; 16 MB."""


def poses_from_view(
    known: IndexedMap, region: Ints, obs: Observations, rng: np.random.Generator
) -> tuple[Array, Array]:
    """(M, 3) poses with cov (M, 3, 3) that put two features, or a single labelled one, on landmarks of their types.

    Args:
        known: the map.
        region: labels of the landmarks that may be seen.
        obs: the view.
        rng: picks some where there are too many.
    """
    mean, cov = _from_pairs(known, region, obs, rng)
    if not len(mean):
        mean, cov = _ring(known, region, obs, rng)
    if len(mean) > TRIED:
        pick = rng.permutation(len(mean))[:TRIED]
        mean, cov = mean[pick], cov[pick]
    return mean, cov


def _candidates(known: IndexedMap, region: Ints, obs: Observations, k: int) -> Ints:
    if obs.label[k] >= 0:
        return obs.label[k : k + 1]
    return np.asarray(region[known.landmarks.crossing_type[region] == obs.crossing_type[k]], np.int64)


def _ring(known: IndexedMap, region: Ints, obs: Observations, rng: np.random.Generator) -> tuple[Array, Array]:
    """All headings around the landmarks that one feature may be."""
    counts = [len(_candidates(known, region, obs, k)) for k in range(len(obs))]
    usable = [k for k in range(len(obs)) if counts[k]]
    if not usable:
        return np.empty((0, 3)), np.empty((0, 3, 3))
    k = min(usable, key=lambda i: (counts[i], float(np.sum(obs.var_m2[i]))))
    at = known.landmarks.xy_map_m[_candidates(known, region, obs, k)]
    theta = 2.0 * np.pi * (np.arange(RING) + rng.random()) / RING
    poses = np.empty((len(at), RING, 3))
    c, s = np.cos(theta), np.sin(theta)
    x, y = obs.xy_base_m[k]
    poses[:, :, 0] = at[:, :1] - (c * x - s * y)
    poses[:, :, 1] = at[:, 1:] - (s * x + c * y)
    poses[:, :, 2] = wrap_array(theta)
    flat: Array = poses.reshape(-1, 3)
    return flat, _seed_cov(flat, obs, k, (2.0 * np.pi / RING) ** 2)


def _seed_cov(poses: Array, obs: Observations, k: int, heading_var: float | Array) -> Array:
    """Of a pose that turns about the landmark at feature k."""
    c, s = np.cos(poses[:, 2]), np.sin(poses[:, 2])
    x, y = obs.xy_base_m[k]
    lever = np.column_stack([s * x + c * y, -(c * x - s * y), np.ones(len(poses))])
    cov = np.asarray(lever[:, :, None] * lever[:, None, :] * np.reshape(heading_var, (-1, 1, 1)), np.float64)
    cov[:, :2, :2] += 4.0 * float(np.max(obs.var_m2[k])) * np.eye(2)
    return cov


def _from_pairs(known: IndexedMap, region: Ints, obs: Observations, rng: np.random.Generator) -> tuple[Array, Array]:
    """Two features and two landmarks as far apart, of the same kinds."""
    counts = np.array([len(_candidates(known, region, obs, k)) for k in range(len(obs))])
    i, j = np.triu_indices(len(obs), 1)
    apart = np.hypot(*(obs.xy_base_m[i] - obs.xy_base_m[j]).T)
    var = np.sum(obs.var_m2[i] + obs.var_m2[j], axis=1)
    sigma = np.sqrt(var)
    good = (counts[i] > 0) & (counts[j] > 0) & (apart > SHORTEST_SIGMAS * sigma)
    i, j, apart, sigma = i[good], j[good], apart[good], sigma[good]
    cost = np.log(counts[i].astype(np.float64)) + np.log(counts[j]) - 2.0 * np.log(apart / sigma)
    chosen = np.argsort(cost, kind="stable")[:PAIRS]
    found = [_match(known, region, obs, rng, int(i[p]), int(j[p]), float(apart[p]), float(sigma[p])) for p in chosen]
    if not found:
        return np.empty((0, 3)), np.empty((0, 3, 3))
    return np.concatenate([f[0] for f in found]), np.concatenate([f[1] for f in found])


def _match(
    known: IndexedMap,
    region: Ints,
    obs: Observations,
    rng: np.random.Generator,
    i: int,
    j: int,
    apart: float,
    sigma: float,
) -> tuple[Array, Array]:
    first, second = _candidates(known, region, obs, i), _candidates(known, region, obs, j)
    if len(first) > TRIED // 8:
        first = rng.permutation(first)[: TRIED // 8]
    at = known.landmarks.xy_map_m
    a, b = _as_far(known, first, second, apart, PAIR_SIGMAS * sigma)
    apart_map, seen = at[b] - at[a], obs.xy_base_m[j] - obs.xy_base_m[i]
    theta = wrap_array(np.arctan2(apart_map[:, 1], apart_map[:, 0]) - np.arctan2(seen[1], seen[0]))
    c, s = np.cos(theta), np.sin(theta)
    x, y = obs.xy_base_m[i]
    poses = np.column_stack([at[a, 0] - (c * x - s * y), at[a, 1] - (s * x + c * y), theta])
    return poses, _seed_cov(poses, obs, i, (sigma / apart) ** 2)


def _as_far(known: IndexedMap, first: Ints, second: Ints, apart: float, tolerance: float) -> tuple[Ints, Ints]:
    """Pairs (P,), (P,) of landmarks whose distance is as seen."""
    at, out_a, out_b = known.landmarks.xy_map_m, [], []
    for part in np.array_split(first, max(len(first) * len(second) // CHUNK, 1)):
        d = np.hypot(at[part, None, 0] - at[None, second, 0], at[part, None, 1] - at[None, second, 1])
        a, b = np.nonzero(np.abs(d - apart) < tolerance)
        out_a.append(part[a])
        out_b.append(second[b])
    return np.concatenate(out_a), np.concatenate(out_b)
