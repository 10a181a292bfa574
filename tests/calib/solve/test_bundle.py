"""Least squares with shared and own parameters, against closed forms and against the scatter of repetitions."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from ceilvo.calib.solve import bundle

Array = NDArray[np.float64]


def lines(rng: np.random.Generator, noise: float) -> tuple[Array, list[Array]]:
    """Several lines of one slope and their own offsets: y = slope x + offset."""
    x = np.linspace(-1, 1, 20)
    return x, [0.7 * x + c + rng.normal(0, noise, 20) for c in (0.2, -1.0, 3.0)]


def solve(x: Array, ys: list[Array], huber: float | None = None) -> bundle.BundleFit:
    return bundle.solve(lambda i, p, v: p[0] * x + v[0] - ys[i], np.zeros(1), np.zeros((3, 1)), huber=huber)


def test_it_solves_a_linear_problem_as_the_normal_equations_do() -> None:
    x, ys = lines(np.random.default_rng(1), 0.1)
    fit = solve(x, ys)
    slope = sum(float(x @ (y - y.mean())) for y in ys) / (3 * float(x @ x))
    assert fit.shared[0] == pytest.approx(slope, abs=1e-9)
    assert fit.cov[0, 0] == pytest.approx(fit.rms**2 / (3 * float(x @ x)), rel=1e-6)


def test_its_sigma_is_the_scatter_of_repetitions() -> None:
    fits = [solve(*lines(np.random.default_rng(s), 0.1)) for s in range(200)]
    scatter = np.std([f.shared[0] for f in fits])
    assert np.sqrt(np.mean([f.cov[0, 0] for f in fits])) == pytest.approx(scatter, rel=0.15)
    assert np.sqrt(np.mean([f.cluster_cov[0, 0] for f in fits])) == pytest.approx(scatter, rel=0.25)


@pytest.mark.parametrize("seed", [3, 4])
def test_a_few_views_that_each_tell_of_something_else_do_not_understate_the_scatter(seed: int) -> None:
    """Errors common to a view, seven parameters, twelve views."""
    rng = np.random.default_rng(seed)
    designs = [rng.normal(size=(20, 2)) @ rng.normal(size=(2, 7)) for _ in range(12)]

    def repeated() -> bundle.BundleFit:
        seen = [
            d @ rng.normal(0.0, 0.1, 7) + rng.normal(0.0, 0.01, 20) for d in designs
        ]  # the same wrong world in a view
        return bundle.solve(lambda i, p, _: designs[i] @ p - seen[i], np.zeros(7), np.zeros((12, 0)))

    fits = [repeated() for _ in range(150)]
    scatter = np.std([f.shared for f in fits], axis=0)
    sigma = np.sqrt(np.mean([np.diag(f.cluster_cov) for f in fits], axis=0))
    print(f"seed {seed}: sigma over scatter {sigma / scatter}")
    assert np.exp(np.mean(np.log(sigma / scatter))) == pytest.approx(1.0, abs=0.12)


def test_outliers_do_not_pull_when_they_count_linearly() -> None:
    x, ys = lines(np.random.default_rng(2), 0.01)
    ys[1][:4] += 5.0
    assert abs(solve(x, ys).shared[0] - 0.7) > 0.2
    assert abs(solve(x, ys, huber=2.0).shared[0] - 0.7) < 0.01


def test_a_curved_problem_converges_from_afar() -> None:
    t = np.linspace(0, 3, 30)
    y = 2.0 * np.exp(-0.7 * t)
    fit = bundle.solve(lambda _, p, __: p[0] * np.exp(-p[1] * t) - y, np.array([0.5, 3.0]), np.zeros((1, 0)))
    np.testing.assert_allclose(fit.shared, [2.0, 0.7], atol=1e-9)
