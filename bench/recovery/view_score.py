"""How well a map explains a view: every place that asks does so here."""

from __future__ import annotations

from math import comb

import numpy as np

from ceilvo.bench.recovery.pose_hypotheses import OUTLIER
from ceilvo.daemon.slam.association import OUTLIER_DENSITY_PER_M2
from ceilvo.daemon.slam.spatial_index import IndexedMap
from ceilvo.se2 import rotation
from ceilvo.types import UNLABELLED, Array, Ints, Observations

CHANCE = 0.0228
"""What is less likely is no chance: one side beyond 2 sigma."""


def nearest_landmarks(known: IndexedMap, poses: Array, obs: Observations, reach_m: float) -> tuple[Ints, Array]:
    """For each pose (M, 3) and feature the nearest landmark of its type, (M, K) labels or -1, and distances (M, K)."""
    m, k = len(poses), len(obs)
    at = np.einsum("mij,kj->mki", np.array([rotation(float(t)) for t in poses[:, 2]]), obs.xy_base_m)
    at += poses[:, None, :2]
    label, distance = known.nearest(at.reshape(-1, 2), np.tile(obs.crossing_type, m), reach_m)
    return label.reshape(m, k), distance.reshape(m, k)


def explained(known: IndexedMap, poses: Array, obs: Observations, reach_m: float) -> Array:
    """(M,) how many features have a landmark of their type within reach, seen from poses (M, 3)."""
    return np.asarray(np.count_nonzero(nearest_landmarks(known, poses, obs, reach_m)[0] >= 0, axis=1), np.float64)


def log_likelihood(known: IndexedMap, poses: Array, obs: Observations, reach_m: float, inflation: float) -> Array:
    """(M,) robust log-likelihood of a view at poses (M, 3), each with its own nearest landmarks of the types."""
    if not len(obs):
        return np.zeros(len(poses))
    label, distance = nearest_landmarks(known, poses, obs, reach_m)
    var = np.mean(obs.var_m2, axis=1) * inflation + np.trace(known.landmarks.cov_m2[label], axis1=2, axis2=3) / 2
    inlier = np.log1p(-OUTLIER) - 0.5 * distance**2 / var - np.log(2.0 * np.pi * var)
    inlier[label < 0] = -np.inf
    score = np.logaddexp(inlier, np.log(OUTLIER * OUTLIER_DENSITY_PER_M2))
    return np.asarray(np.sum(score, axis=1) / inflation, np.float64)


def unexplained(known: IndexedMap, pose: Array, obs: Observations, reach_m: float) -> bool:
    """Whether of a type more unlabelled features are without a landmark than outliers explain (2 sigma)."""
    free = obs.label == UNLABELLED
    label = nearest_landmarks(known, pose[None], obs, reach_m)[0][0]
    for kind in np.unique(obs.crossing_type[free]):
        of = label[free & (obs.crossing_type == kind)]
        if at_least(int(np.count_nonzero(of < 0)), len(of), OUTLIER) < CHANCE:
            return True
    return False


def at_least(k: int, n: int, p: float) -> float:
    """Chance of k or more of n, each with chance p."""
    return 1.0 - sum(comb(n, i) * p**i * (1.0 - p) ** (n - i) for i in range(k))
