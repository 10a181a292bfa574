"""How well a view fits a known map at given poses."""

from __future__ import annotations

from math import comb

import numpy as np

from ceilvo.daemon.relocalisation.pose_search import OUTLIER, OUTLIER_DENSITY_PER_M2
from ceilvo.daemon.slam.spatial_index import KnownMap
from ceilvo.se2 import rotation, transform
from ceilvo.types import UNLABELLED, Array, Observations

CHANCE = 0.0228
"""What is less likely is a surprise: one side beyond 2 sigma."""


def shifted_scores(known: KnownMap, poses: Array, obs: Observations, reach_m: float, inflation: float) -> Array:
    """(M,) robust log-likelihood of a view at poses (M, 3), each with its own nearest landmarks of the kinds."""
    out = np.zeros(len(poses))
    if not len(obs):
        return out
    m, k = len(poses), len(obs)
    at = np.einsum("mij,kj->mki", np.array([rotation(float(t)) for t in poses[:, 2]]), obs.xy_base_m)
    at += poses[:, None, :2]
    label, distance = known.nearest(at.reshape(-1, 2), np.tile(obs.kind, m), reach_m)
    var = (
        np.tile(np.mean(obs.var_m2, axis=1) * inflation, m)
        + np.trace(known.landmarks.cov_m2[label], axis1=1, axis2=2) / 2
    )
    inlier = np.log1p(-OUTLIER) - 0.5 * distance**2 / var - np.log(2.0 * np.pi * var)
    inlier[label < 0] = -np.inf
    score = np.logaddexp(inlier, np.log(OUTLIER * OUTLIER_DENSITY_PER_M2))
    return np.asarray(np.sum(score.reshape(m, k), axis=1) / inflation, np.float64)


def unexplained(known: KnownMap, pose: Array, obs: Observations, reach_m: float) -> bool:
    """Whether of a kind more unlabelled features are without a landmark than outliers explain (2 sigma)."""
    free = np.flatnonzero(obs.label == UNLABELLED)
    label, _ = known.nearest(transform(pose, obs.xy_base_m[free]), obs.kind[free], reach_m)
    for kind in np.unique(obs.kind[free]):
        of = label[obs.kind[free] == kind]
        if at_least(int(np.count_nonzero(of < 0)), len(of), OUTLIER) < CHANCE:
            return True
    return False


def at_least(k: int, n: int, p: float) -> float:
    """Chance of k or more of n, each with chance p."""
    return 1.0 - sum(comb(n, i) * p**i * (1.0 - p) ** (n - i) for i in range(k))
