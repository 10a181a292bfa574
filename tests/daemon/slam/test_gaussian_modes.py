"""Where a mode is Gaussian, particles and curve give the Kalman update, worked out here in information form."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from ceilvo.config import Filter
from ceilvo.daemon.relocalisation.filters import make_filter
from ceilvo.daemon.slam.modes import merged
from ceilvo.se2 import inverse, transform, wrap
from ceilvo.types import NO_LANDMARK, Array, Displacement, Landmarks, Motion, Observations

SEED = 41
SIGMA_M = 0.05
NO_GATE = replace(Filter(), feature_independence=1.0, gate_chi2=900.0, slip_per_m=0.0)
"""A likelihood without outliers."""


def posterior(mean: Array, cov: Array, h: Array, off: Array, noise: Array) -> tuple[Array, Array]:
    """Of a prior and of innovations `off` with Jacobian h and covariance `noise`."""
    information = np.linalg.inv(cov) + h.T @ np.linalg.solve(noise, h)
    new = np.linalg.inv(information)
    return mean + new @ h.T @ np.linalg.solve(noise, off), new


def levers(pose: Array, z: Array) -> Array:
    """(2 K, 3) of features in map by the pose."""
    arm = transform(pose, z) - pose[:2]
    h = np.zeros((2 * len(z), 3))
    h[0::2, 0] = h[1::2, 1] = 1.0
    h[0::2, 2], h[1::2, 2] = -arm[:, 1], arm[:, 0]
    return h


@pytest.mark.parametrize("features", [1, 2, 6, 20])
@pytest.mark.parametrize("heading", [False, True])
def test_on_a_known_map_pose_and_particles_are_the_kalman_update(features: int, heading: bool) -> None:
    rng = np.random.default_rng([SEED, features])
    at = rng.uniform(-1.5, 1.5, (features, 2))
    cov = np.array([[1e-3, 2e-4, 1e-4], [2e-4, 2e-3, -1e-4], [1e-4, -1e-4, 4e-4]])
    mean, n = np.array([0.3, -0.2, 0.5]), np.arange(features)
    truth = mean + 0.5 * np.linalg.cholesky(cov) @ rng.standard_normal(3)
    z = transform(inverse(truth), at) + SIGMA_M * rng.standard_normal((features, 2))
    f = make_filter(replace(NO_GATE, particles=100), np.random.default_rng(SEED))
    known = Landmarks(n, at, np.tile(1e-8 * np.eye(2), (features, 1, 1)), n, np.full(features, 9))
    f.reset(mean, cov, known, known=True)
    f.state.rule.model_var_m2 = 0.0
    measured = (truth[2], 1e-4) if heading else (float("nan"), 0.0)
    f.update(Observations(z, np.full((features, 2), SIGMA_M**2), n, n, *measured))
    pose, found, _ = f.estimate()
    expected, spread = mean, cov
    for _ in range(5):  # linearised where the posterior is
        h = levers(expected, z)
        off = (at - transform(expected, z)).ravel() + h @ (expected - mean)
        noise = SIGMA_M**2 * np.eye(len(h))
        if heading:
            h, off = np.vstack([h, [0.0, 0.0, 1.0]]), np.append(off, truth[2] - mean[2])
            noise = np.diag(np.append(np.diag(noise), 1e-4))
        expected, spread = posterior(mean, cov, h, off, noise)
    sigma = np.sqrt(np.diag(spread))
    print(
        f"seed {SEED}: off by {(pose - expected) / sigma} sigma, sigmas {np.sqrt(np.diag(found)) / sigma} of Kalman's"
    )
    assert np.all(np.abs(pose - expected) < 0.05 * sigma)
    np.testing.assert_allclose(np.sqrt(np.diag(found)), sigma, rtol=0.05)
    poses, weights = f.particles()
    np.testing.assert_allclose(weights @ poses, pose, atol=0.02 * np.max(sigma))


def test_in_mapping_each_mode_is_the_kalman_update_of_pose_and_map() -> None:
    """One landmark seen from two places; the second view against pose and landmark as they were."""
    f = make_filter(replace(NO_GATE, birth_sightings=1), np.random.default_rng(SEED))
    f.reset(np.zeros(3), np.diag([1e-3, 1e-3, 1e-6]))
    f.state.rule.model_var_m2 = 0.0
    z = np.array([[1.0, 0.4], [-0.8, 0.9]])
    var = np.full((2, 2), SIGMA_M**2)
    f.update(Observations(z, var, np.arange(2), np.full(2, NO_LANDMARK)))
    before = f.state.joint.mean.copy(), f.state.joint.cov.copy()
    seen = z + np.array([[0.03, -0.02], [0.01, 0.02]])
    f.update(Observations(seen, var, np.arange(2), np.arange(2)))
    h = np.hstack([levers(before[0][:3], z), -np.eye(4)])
    off = -(transform(before[0][:3], seen) - before[0][3:].reshape(-1, 2)).ravel()
    mean, cov = posterior(before[0], before[1] + 1e-15 * np.eye(7), h, off, SIGMA_M**2 * np.eye(4))
    np.testing.assert_allclose(f.state.joint.mean, mean, atol=1e-5)
    np.testing.assert_allclose(f.state.joint.cov, cov, rtol=1e-3, atol=1e-7)  # turned with the heading's correction


def test_modes_that_are_told_together_have_the_moments_of_all_particles() -> None:
    """A slip that one view leaves open: the modes' particles against what is reported."""
    rng = np.random.default_rng(SEED)
    at = np.array([[1.2, 0.5], [1.0, -0.7]])
    n = np.arange(2)
    f = make_filter(replace(Filter(), feature_independence=1.0, particles=4000), rng)
    f.reset(
        np.zeros(3), np.diag([1e-4, 1e-4, 1e-4]), Landmarks(n, at, np.tile(1e-6 * np.eye(2), (2, 1, 1)), n, n + 9), True
    )
    f.predict(Motion(Displacement(np.array([0.25, 0.0, 0.0])), np.diag([1e-4, 1e-4, 1e-5]), 9, 0.0))
    z = transform(inverse(np.array([0.12, 0.0, 0.0])), at)
    f.update(Observations(z, np.full((2, 2), 0.05**2), n, n))
    modes = f.state.rule.modes
    assert len(modes) >= 2
    assert 0.05 < modes[1].weight < 0.5
    together, (poses, weights) = merged(modes), f.particles()
    pose, cov, health = f.estimate()
    assert health.mode_weight == pytest.approx(1.0)
    np.testing.assert_allclose(pose, together.mean, atol=1e-9)
    np.testing.assert_allclose(weights @ poses, pose, atol=4e-3)
    off = poses - weights @ poses
    np.testing.assert_allclose(np.sqrt(np.diag(off.T @ off / len(off))), np.sqrt(np.diag(cov)), rtol=0.1)
    assert abs(wrap(pose[2])) < 0.05
