"""Curve fit of eqs. 21-25 against exact arithmetic, redrawing and its fallbacks."""

from fractions import Fraction

import numpy as np
import pytest

from ceilvo.daemon.slam.paper import curve_fit
from ceilvo.daemon.slam.pose_filter import mean_and_cov, systematic

SEED = 20


def normal_equations(x, f, degree):
    """Eq. 25 solved by Gauss-Jordan elimination over the rationals: coefficients of 1, x, x^2, ..."""
    xs, fs, n = [Fraction(v) for v in x], [Fraction(v) for v in f], degree + 1
    rows = [
        [sum(v ** (j + k) for v in xs) for k in range(n)] + [sum(v**j * w for v, w in zip(xs, fs, strict=True))]
        for j in range(n)
    ]
    for j in range(n):
        rows[j] = [v / rows[j][j] for v in rows[j]]
        for i in range(n):
            if i != j:
                rows[i] = [a - rows[i][j] * b for a, b in zip(rows[i], rows[j], strict=True)]
    return [row[n] for row in rows]


@pytest.mark.parametrize("degree", [2, 4, 6])
@pytest.mark.parametrize(("centre", "spread"), [(0.0, 1.0), (4.5, 0.05)])
def test_fit_equals_the_normal_equations_in_exact_arithmetic(degree, centre, spread):
    rng = np.random.default_rng(SEED)
    x = centre + spread * rng.standard_normal(40)
    f = np.exp(-0.5 * ((x - centre) / spread - 0.4) ** 2) + 0.1 * rng.random(40)
    a = normal_equations(x, f, degree)
    at = np.linspace(x.min(), x.max(), 9)
    exact = [float(sum(c * Fraction(v) ** k for k, c in enumerate(a))) for v in at]
    np.testing.assert_allclose(curve_fit.evaluate(curve_fit.fit(x, f, degree), x, at), exact, rtol=0, atol=1e-10)


def test_degree_is_lowered_for_few_points():
    assert len(curve_fit.fit(np.array([0.0, 1.0, 2.0]), np.array([1.0, 0.0, 1.0]), 8)) == 3


def posterior(n, shift, width, heading):
    """Prior cloud, weights of a Gaussian likelihood `shift` prior sigmas off and `width` wide, along every axis."""
    rng = np.random.default_rng(SEED)
    u = rng.standard_normal((n, 3))
    w = np.exp(-0.5 * np.sum(((u - shift) / width) ** 2, axis=1))
    poses = np.array([4.5, -2.0, heading]) + u * [0.003, 0.002, 0.001]
    poses[:, 2] = (poses[:, 2] + np.pi) % (2 * np.pi) - np.pi
    return poses, w / w.sum()


@pytest.mark.parametrize("heading", [0.0, np.pi - 1e-4])
def test_redrawn_cloud_is_the_gaussian_posterior(heading):
    poses, w = posterior(4000, 0.5, 1.5, heading)
    new, residual = curve_fit.redraw(poses, w, 4, np.random.default_rng(1))
    precision = 1 + 1 / 1.5**2
    expected = np.array([0.003, 0.002, 0.001]) * 0.5 / 1.5**2 / precision
    mean, cov = mean_and_cov(new, np.full(len(new), 1 / len(new)))
    off = (mean - [4.5, -2.0, heading] + np.pi) % (2 * np.pi) - np.pi
    sigma = np.array([0.003, 0.002, 0.001]) / np.sqrt(precision)
    print(f"seed {SEED}: mean error {np.abs(off - expected) / sigma} sigma, std ratio {np.sqrt(np.diag(cov)) / sigma}")
    assert np.all(np.abs(off - expected) < 0.08 * sigma)
    np.testing.assert_allclose(np.sqrt(np.diag(cov)), sigma, rtol=0.08)
    assert 0.0 < residual < 2.0


def test_redrawn_particles_are_all_different_and_near_the_old_cloud():
    poses, w = posterior(100, 2.5, 0.3, 0.0)
    new, _ = curve_fit.redraw(poses, w, 4, np.random.default_rng(1))
    assert len(np.unique(new, axis=0)) == 100
    margin = 0.5 * poses.std(axis=0)
    assert np.all(new <= poses.max(axis=0) + margin)
    assert np.all(new >= poses.min(axis=0) - margin)


def test_an_axis_without_spread_stays_where_it_is():
    poses, w = posterior(50, 0.5, 1.0, 0.0)
    poses[:, 1] = 1.25
    new, residual = curve_fit.redraw(poses, w, 4, np.random.default_rng(1))
    assert np.all(new[:, 1] == 1.25)
    assert np.isfinite(residual)


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_no_curve_from_weights_that_are_not_finite(bad):
    poses, w = posterior(50, 0.0, 1.0, 0.0)
    w[3] = bad
    assert curve_fit.redraw(poses, w, 4, np.random.default_rng(1)) is None


def test_no_curve_from_a_point():
    assert curve_fit.redraw(np.zeros((20, 3)), np.full(20, 0.05), 4, np.random.default_rng(1)) is None


def test_no_draw_from_a_density_that_is_nowhere_positive():
    u = np.linspace(-1, 1, 20)
    assert curve_fit._draw(np.array([-1.0]), u, np.random.default_rng(1)) is None


def test_systematic_gives_each_its_share_to_within_one():
    rng = np.random.default_rng(SEED)
    for _ in range(50):
        w = rng.random(37) ** 4
        w /= w.sum()
        copies = np.bincount(systematic(w, rng), minlength=37)
        assert np.all(np.abs(copies - 37 * w) < 1 + 1e-9)


def test_nearest_wraps_the_heading_and_works_in_blocks():
    ancestors = np.array([[0, 0, 3.1], [0, 0, -2.0], [1, 0, 0.0]])
    poses = np.array([[0, 0, -3.1], [0.1, 0, -2.2], [0.8, 0, 0.1]])
    assert curve_fit.nearest(poses, ancestors, np.ones(3), block=2).tolist() == [0, 1, 2]
