"""Planar motion against constructed truth (eqs. 8-16)."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ceilvo import se2
from ceilvo.daemon.odometry.rigid import median_translation, rigid_motion, robust_rigid_motion

SEED = 20
angles = st.floats(-3.1, 3.1)
shifts = st.floats(-5.0, 5.0)


@given(angles, shifts, shifts, st.integers(2, 30))
def test_exact_without_noise(theta: float, x: float, y: float, n: int) -> None:
    points = np.random.default_rng(n).uniform(-2, 2, (n, 2))
    truth = np.array([x, y, theta])
    found = rigid_motion(points, se2.transform(truth, points))
    assert np.max(np.abs(se2.between(truth, found))) < 1e-9


def test_hand_made_quarter_turn() -> None:
    a = np.array([[1.0, 0.0], [0.0, 1.0]])
    b = np.array([[2.0, 1.0], [1.0, 0.0]])  # x -> y, y -> -x, then (2, 0)
    assert np.abs(rigid_motion(a, b) - [2.0, 0.0, np.pi / 2]).max() < 1e-12


def test_gross_outliers_are_rejected_and_the_rest_refitted() -> None:
    rng = np.random.default_rng(SEED)
    a = rng.uniform(-1, 1, (30, 2))
    truth = np.array([0.02, -0.01, 0.03])
    b = se2.transform(truth, a) + rng.normal(0, 2e-4, (30, 2))
    b[:8] += rng.uniform(0.05, 0.14, (8, 2))
    fit = robust_rigid_motion(a, b, 4.0, 0.01, 3)
    assert fit is not None
    assert not fit.used[:8].any() and fit.used[8:].all()
    assert np.abs(se2.between(truth, fit.b_from_a)).max() < 3e-4


def test_too_few_points_is_no_fit() -> None:
    a = np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]])
    b = a + np.array([[0.0, 0.0], [0.3, 0.0], [-0.3, 0.2]])
    assert robust_rigid_motion(a, b, 4.0, 0.01, 3) is None


def test_covariance_matches_the_spread() -> None:
    rng = np.random.default_rng(SEED)
    a = rng.uniform(-1, 1, (20, 2))
    truth = np.array([0.01, 0.02, -0.01])
    errors, covs = [], []
    for _ in range(400):
        fit = robust_rigid_motion(a, se2.transform(truth, a) + rng.normal(0, 1e-3, a.shape), 6.0, 0.1, 3)
        assert fit is not None
        errors.append(se2.between(truth, fit.b_from_a))
        covs.append(fit.cov)
    nees = np.mean([e @ np.linalg.solve(c, e) for e, c in zip(errors, covs, strict=True)])
    print(f"seed {SEED}: mean NEES {nees:.2f}, expected 3")
    assert nees == pytest.approx(3.0, abs=0.6)


def test_lines_taken_for_their_neighbours_do_not_pull_the_motion() -> None:
    """On four of ten lines along y all crossings are 9 mm off across the line; the fit to everything would follow."""
    rng = np.random.default_rng(SEED)
    grid = np.array([(0.3 * i - 1.5, 0.3 * j - 0.9) for i in range(10) for j in range(6)])
    truth = np.array([0.011, -0.004, 0.012])
    b = se2.transform(truth, grid) + rng.normal(0, 1e-4, grid.shape)
    wrong = np.isin(np.arange(10), [1, 4, 6, 8]).repeat(6)
    b[wrong] += 0.009 * np.array([np.cos(truth[2]), np.sin(truth[2])])
    start = median_translation(grid, b, float(truth[2]), float(truth[2]))
    fit = robust_rigid_motion(grid, b, 4.0, 0.01, 3, [start])
    assert fit is not None
    assert not fit.used[wrong].any() and fit.used[~wrong].all()
    assert np.abs(se2.between(truth, fit.b_from_a)).max() < 1e-4
