"""The rivals, by the names of the tables."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ceilvo.bench.paper.ekf import EkfNearestNeighbour
from ceilvo.bench.paper.world import Setting
from ceilvo.bench.recovery.filters import make_recovering_filter as make_filter
from ceilvo.config import Filter
from ceilvo.daemon.slam.paper.fastslam import FastSlam
from ceilvo.daemon.slam.pose_filter import PoseFilter, mean_and_cov, spread
from ceilvo.errors import ConfigError
from ceilvo.se2 import wrap_array
from ceilvo.types import Array

ABOUT = {
    "ukf": "unscented Kalman filter, joint pose and landmarks, no gate",
    "ukf_gated": "the same with the chi-square gate",
    "pf": "FastSLAM 1.0, systematic resampling",
    "control": "the same, redrawn from a Gaussian of the weighted mean and covariance: no curve",
    "pfcf_paper": "the same, redrawn along the curves of eqs. 21-25",
    "joint": "the daemon's filter",
    "ekf_nn": "extended Kalman filter, nearest neighbour within a gate (bench only)",
}
WITHOUT_PARTICLES = ("ukf", "ukf_gated", "ekf_nn")


def settings(name: str, particles: int, world: Setting, unlabelled: bool) -> Filter:
    """The defaults, but for what the world's stated noise says, and features that err independently here."""
    return replace(
        Filter(),
        method={"ukf_gated": "ukf", "control": "pfcf_paper", "ekf_nn": "ukf"}.get(name, name),
        ukf_gate=name != "ukf",
        particles=max(particles, 10),
        feature_independence=1.0,
        outlier_floor=0.02,
        association_gate_m=0.28 if unlabelled else 1.0,
    )


def make(name: str, particles: int, world: Setting, rng: np.random.Generator, unlabelled: bool = False) -> PoseFilter:
    """A filter of ABOUT."""
    if name not in ABOUT:
        raise ConfigError(f"filter: no '{name}'; known are {', '.join(ABOUT)}")
    chosen = settings(name, particles, world, unlabelled)
    if name == "ekf_nn":
        return EkfNearestNeighbour()
    if name == "control":
        return FastSlam(chosen, rng, redraw_without_curve)
    return make_filter(chosen, rng)


def redraw_without_curve(
    poses: Array, weights: Array, degree: int, rng: np.random.Generator
) -> tuple[Array, float] | None:
    """The control: new poses from the Gaussian that has the weighted mean and covariance; nothing is fitted."""
    del degree
    if not np.all(np.isfinite(weights)):
        return None
    new = spread(*mean_and_cov(poses, weights), len(poses), rng)
    new[:, 2] = wrap_array(new[:, 2])
    return new, float("nan")
