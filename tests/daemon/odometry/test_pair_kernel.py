"""The loops over matched points and followed lines: the compiled kernel does what NumPy's does."""

from __future__ import annotations

import os
import subprocess
import sys
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ceilvo import se2
from ceilvo.daemon.odometry import kernel
from ceilvo.daemon.odometry.kernel import reference
from ceilvo.daemon.odometry.kernel.arguments import Gate, Limits, RatioNoise

pytestmark = pytest.mark.skipif(not kernel.COMPILED, reason="ceilvo was installed without a compiler")
BOTH = pytest.mark.parametrize("k", [reference, kernel], ids=["numpy", "compiled"])
SEEDS = st.integers(0, 2**32 - 1)
GATE = Gate(4.0, 0.01, 0.001, 3)
NOISE = RatioNoise(0.004, 0.0004, 0.002, 8.0)
LIMITS = Limits(4.0, 0.003, 4, 3)


def test_without_the_compiled_one_numpy_takes_over() -> None:
    code = (
        "import sys; sys.modules['ceilvo.daemon.odometry.kernel.views'] = None\n"
        "from ceilvo.daemon.odometry import kernel\n"
        "from ceilvo.daemon.odometry.kernel import reference\n"
        "assert not kernel.COMPILED and kernel.refined is reference.refined"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, env=dict(os.environ))
    assert done.returncode == 0, done.stderr


@given(SEEDS)
@settings(max_examples=60, deadline=None)
def test_mutual_nearest_are_the_same(seed: int) -> None:
    rng = np.random.default_rng(seed)
    n, m = rng.integers(0, 40, 2)
    a, b = (np.round(rng.uniform(0, 1, (k, 2)), int(rng.integers(1, 4))) for k in (n, m))  # also equally near ones
    arguments = (a, rng.integers(0, 3, n), b, rng.integers(0, 3, m), 0.2)
    for x, y in zip(reference.mutual_nearest(*arguments), kernel.mutual_nearest(*arguments), strict=True):
        np.testing.assert_array_equal(y, x)


@given(SEEDS, st.booleans(), st.booleans())
@settings(max_examples=100, deadline=None)
def test_refined_motions_are_the_same(seed: int, guessed: bool, unlike: bool) -> None:
    rng = np.random.default_rng(seed)
    n = int(rng.integers(0, 40))
    true = np.array([*rng.uniform(-0.1, 0.1, 2), rng.uniform(-3, 3)])
    a = rng.uniform(-1, 1, (n, 2))
    b = se2.transform(true, a) + rng.normal(0, 0.001, (n, 2))
    b[: int(rng.integers(0, n // 2 + 1))] += rng.normal(0, 0.05, 2)
    own = rng.uniform(0.0002, 0.003, n) if unlike else None
    start = true + rng.normal(0, 0.002, 3) if guessed or n < 2 else None
    if n < 2:
        assert kernel.refined(a, b, start, GATE, own) is None
        return
    one, other = (k.refined(a, b, start, GATE, own) for k in (reference, kernel))
    assert (one is None) == (other is None)
    if one is None or other is None:
        return
    np.testing.assert_array_equal(other[1], one[1])
    assert other[1].dtype == bool
    for x, y in zip(one, other, strict=True):
        np.testing.assert_allclose(y, x, rtol=1e-7, atol=1e-13)


@BOTH
def test_points_in_one_place_turn_anyhow(k: ModuleType) -> None:
    a = np.zeros((4, 2))
    found = k.refined(a, a, None, GATE, None)
    assert found is not None and np.isfinite(found[3]).all()


@given(SEEDS, st.floats(-3.0, 3.0), st.floats(-3.0, 3.0))
@settings(max_examples=30, deadline=None)
def test_medians_are_the_same(seed: int, theta: float, axis: float) -> None:
    rng = np.random.default_rng(seed)
    a, b = rng.normal(0, 1, (2, int(rng.integers(1, 30)), 2))
    np.testing.assert_allclose(
        kernel.median_translation(a, b, theta, axis), reference.median_translation(a, b, theta, axis), atol=1e-13
    )
    assert abs(kernel.median_radius(a) - reference.median_radius(a)) < 1e-13


@given(SEEDS)
@settings(max_examples=40, deadline=None)
def test_residuals_of_a_homography_are_the_same(seed: int) -> None:
    rng = np.random.default_rng(seed)
    n = int(rng.integers(8, 60))
    xy = rng.uniform(0, 640, (n, 2))
    uv = xy @ np.array([[0.99, -0.05], [0.05, 0.98]]) + [4.0, -2.0] + rng.normal(0, 0.3, (n, 2))
    kept = rng.random(n) < 0.9
    kept[:6] = True
    a, b = (k.homography_residuals(xy, uv, kept) for k in (reference, kernel))
    np.testing.assert_allclose(b, a, atol=1e-6)
    exact = kernel.homography_residuals(xy, xy + 3.0, kept)
    assert np.abs(exact).max() < 1e-6


@BOTH
def test_points_that_do_not_determine_a_homography_are_told(k: ModuleType) -> None:
    with pytest.raises(np.linalg.LinAlgError):
        k.homography_residuals(np.zeros((8, 2)), np.zeros((8, 2)), np.ones(8, bool))


@given(SEEDS)
@settings(max_examples=30, deadline=None)
def test_samples_that_are_alike_are_counted_alike(seed: int) -> None:
    rng = np.random.default_rng(seed)
    new, before = rng.integers(0, 256, 64).astype(np.uint8), rng.integers(0, 256, (5, 64)).astype(np.uint8)
    before[1] = new
    most = float(rng.uniform(0, 60))
    np.testing.assert_array_equal(kernel.alike(new, before, most, 2, 253), reference.alike(new, before, most, 2, 253))
    assert kernel.alike(new, before, 0.0, 2, 253)[1] == 64
    for share in (0.0, 0.75, 1.0):
        one, other = (k.calm_difference(new, before[0], share, 2, 253) for k in (reference, kernel))
        assert one == other
    assert kernel.calm_difference(new, before[1], 0.75, 2, 253)[1] == 0.0


@given(SEEDS, st.integers(-5, 5))
@settings(max_examples=40, deadline=None)
def test_seen_lines_are_the_same(seed: int, quarters: int) -> None:
    rng = np.random.default_rng(seed)
    n = int(rng.integers(0, 50))
    at, kind = np.round(rng.uniform(-1, 1, (n, 2)), 2), rng.integers(0, 9, n)
    one, other = (k.lines_seen(at, kind, quarters, 0.015) for k in (reference, kernel))
    for a, b in zip(one, other, strict=True):
        np.testing.assert_array_equal(b, a)
    if n:  # every crossing lies on its two lines, but for what counts as one
        axis, _, apparent, of = other
        assert np.all(axis[of[:, 0]] != axis[of[:, 1]])
        assert np.all(np.abs(np.abs(apparent[of]) - np.abs(at)) <= 0.015 * n)


@given(SEEDS)
@settings(max_examples=60, deadline=None)
def test_followed_lines_are_the_same(seed: int) -> None:
    rng = np.random.default_rng(seed)
    n, m = rng.integers(0, 30, 2)
    axes, kinds = [rng.integers(0, 2, k) for k in (n, m)], [rng.integers(-1, 2, k) for k in (n, m)]
    at, to = (np.round(rng.uniform(0, 1, k), int(rng.integers(1, 4))) for k in (n, m))  # also equally near ones
    arguments = (axes[0], kinds[0], at, axes[1], kinds[1], to, 0.05)
    np.testing.assert_array_equal(kernel.lines_followed(*arguments), reference.lines_followed(*arguments))


@given(SEEDS)
@settings(max_examples=60, deadline=None)
def test_lines_are_measured_alike(seed: int) -> None:
    rng = np.random.default_rng(seed)
    lines = 12
    strange = [rng.integers(0, 3, lines)] * 2
    measured, sums = [np.full(lines, np.nan)] * 2, [np.zeros((lines, 6))] * 2
    strange, measured, sums = ([v.copy() for v in both] for both in (strange, measured, sums))
    camera, others = np.zeros(lines), [0, 0]
    for _ in range(12):
        row = rng.permutation(lines)[: int(rng.integers(0, lines + 1))]
        camera = camera + rng.uniform(0.0, 0.02, lines)
        apparent = 0.5 - camera + rng.normal(0, 0.0004, lines) + 0.1 * (rng.random(lines) < 0.2)
        for i, k in enumerate((reference, kernel)):
            anew = k.lines_measured(row, camera, apparent, measured[i], sums[i], strange[i], NOISE, LIMITS)
            others[i] += int(anew.sum())
        np.testing.assert_array_equal(strange[1], strange[0])
        np.testing.assert_array_equal(measured[1], measured[0])
        np.testing.assert_allclose(sums[1], sums[0], rtol=1e-12)
    assert others[0] == others[1]


@given(SEEDS)
@settings(max_examples=40, deadline=None)
def test_ratios_of_lines_are_the_same_and_right(seed: int) -> None:
    rng = np.random.default_rng(seed)
    true = rng.uniform(0.7, 1.5, 12)
    camera = np.cumsum(rng.uniform(0.0, 0.02, (12, 10)), axis=1)
    apparent = 0.5 - true[:, None] * camera + rng.normal(0, 0.0004, camera.shape)
    sums = np.stack([np.ones_like(camera), camera, apparent, camera**2, camera * apparent, apparent**2], axis=2).sum(
        axis=1
    )
    sums[0] = 0.0
    one, other = reference.line_ratios(sums, NOISE), kernel.line_ratios(sums, NOISE)
    for a, b in zip(one, other, strict=True):
        np.testing.assert_allclose(b, a, rtol=1e-9, atol=1e-12)
    assert one[1][0] == np.inf
    assert np.all(np.abs(other[0] - true)[1:] < 6.0 * other[1][1:])


def calls() -> dict[str, tuple[Any, ...]]:
    rng = np.random.default_rng(0)
    a, kind = rng.normal(0, 1, (8, 2)), np.zeros(8, np.int64)
    return {
        "mutual_nearest": (a, kind, a, kind, 0.2),
        "median_translation": (a, a, 0.1, 0.2),
        "median_radius": (a,),
        "refined": (a, a, np.zeros(3), GATE, np.ones(8)),
        "homography_residuals": (a, a, np.ones(8, bool)),
        "alike": (np.zeros(8, np.uint8), np.zeros((2, 8), np.uint8), 1.0, 2, 253),
        "calm_difference": (np.zeros(8, np.uint8), np.zeros(8, np.uint8), 0.75, 2, 253),
        "lines_seen": (a, kind, 1, 0.1),
        "lines_followed": (kind, kind, a[:, 0].copy(), kind, kind, a[:, 0].copy(), 0.1),
        "lines_measured": (kind, *rng.normal(0, 1, (3, 8)), np.zeros((8, 6)), kind.copy(), NOISE, LIMITS),
        "line_ratios": (rng.normal(0, 1, (4, 6)), NOISE),
    }


ANY_LENGTH = {("mutual_nearest", 0), ("median_radius", 0), ("line_ratios", 0), ("alike", 1), ("lines_measured", 0)}


@pytest.mark.parametrize("name", calls())
def test_an_array_of_another_shape_or_type_is_refused(name: str) -> None:
    loop, good = getattr(kernel, name), calls()[name]
    loop(*good)
    for i, argument in enumerate(good):
        if not isinstance(argument, np.ndarray):
            continue
        wrong = [argument.astype(np.complex64), argument[None]]
        if (name, i) not in ANY_LENGTH:
            wrong.append(argument[:-1])
        if argument.ndim == 2:
            wrong.append(np.ascontiguousarray(argument[:, :1]))
        for bad in wrong:
            with pytest.raises(ValueError):
                loop(*good[:i], bad, *good[i + 1 :])
