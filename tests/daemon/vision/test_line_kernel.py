"""The sums over the points of lines: the compiled kernel does what NumPy's does, and both what geometry says."""

from __future__ import annotations

from types import ModuleType
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ceilvo.daemon.vision import kernel
from ceilvo.daemon.vision.kernel import reference
from ceilvo.daemon.vision.kernel.arguments import Arm, Step, Widths
from ceilvo.types import LineKind

pytestmark = pytest.mark.skipif(not kernel.COMPILED, reason="ceilvo was installed without a compiler")
BOTH = pytest.mark.parametrize("k", [reference, kernel], ids=["numpy", "compiled"])
SEEDS = st.integers(0, 2**32 - 1)
FOCAL_PX = 400.0


def seen(seed: int, psi: float, tilt: Any, noise_px: float = 0.2, points: int = 150) -> tuple[Any, ...]:
    """What a robot that tilts sees of eight lines, four an axis: rays x, y, their lines, points of axis 0, offsets."""
    rng = np.random.default_rng(seed)
    offset = np.concatenate([np.sort(rng.uniform(-250, 250, 4)) for _ in range(2)])
    line = np.repeat(np.arange(8), points).astype(np.int32)
    across = (offset[line] + rng.normal(0, noise_px, len(line))) / FOCAL_PX
    along = rng.uniform(-0.6, 0.6, len(line))
    angle = psi + 0.5 * np.pi * (line // 4)
    x, y = across * np.cos(angle) - along * np.sin(angle), across * np.sin(angle) + along * np.cos(angle)
    turned = np.column_stack([x, y, np.ones(len(x))]) - np.cross(
        np.broadcast_to([*tilt, 0.0], (len(x), 3)), np.column_stack([x, y, np.ones(len(x))])
    )
    x, y = (turned[:, :2] / turned[:, 2:]).T.astype(np.float32)
    return np.ascontiguousarray(x), np.ascontiguousarray(y), line, 4 * points, offset


@given(SEEDS, st.floats(-0.7, 0.7))
@settings(max_examples=30, deadline=None)
def test_a_step_finds_direction_and_tilt(seed: int, psi: float) -> None:
    tilt = np.random.default_rng(seed).normal(0, 0.004, 2)
    x, y, line, half, _ = seen(seed, psi + 0.002, tilt)
    step = Step(FOCAL_PX, 28.0, 0.02, 1e-3, 300.0, False)
    found = []
    for k in (reference, kernel):
        rho, tangent = k.project(x, y, half, psi, np.zeros(2))
        support, noise_px, moved, covariance = k.fit(rho, tangent, line, half, 9, psi, np.zeros(2), step)
        assert support.tolist() == [150] * 8 + [0]
        sigma = np.sqrt(np.diag(covariance)) / np.sqrt(28.0)  # these points err on their own
        assert np.all(np.abs(moved - [0.002, *tilt]) < 5.0 * sigma + 2e-4)  # one step of Gauss and Newton
        found.append((noise_px, moved, covariance))
    for a, b in zip(*found, strict=True):
        np.testing.assert_allclose(b, a, rtol=1e-8, atol=1e-13)


@BOTH
def test_a_held_tilt_stays(k: ModuleType) -> None:
    x, y, line, half, _ = seen(1, 0.2, (0.01, 0.0))
    rho, tangent = k.project(x, y, half, 0.2, np.zeros(2))
    moved, covariance = k.fit(
        rho, tangent, line, half, 8, 0.2, np.array([0.3, 0.3]), Step(FOCAL_PX, 28.0, 0.02, 1e-3, 1e16, True)
    )[2:]
    assert np.abs(moved[1:]).max() < 1e-6
    assert np.all(np.diag(covariance)[1:] < 2e-16)


@given(SEEDS, st.floats(-0.7, 0.7))
@settings(max_examples=30, deadline=None)
def test_a_shift_turn_and_tilt_that_most_points_share_are_found(seed: int, psi: float) -> None:
    rng = np.random.default_rng(seed)
    tilt, shift, turn = rng.normal(0, 0.002, 2), rng.uniform(-5, 5, 2), rng.normal(0, 0.002)
    x, y, line, half, offset = seen(seed, psi + turn, tilt, 0.1)
    line = np.where(rng.random(len(line)) < 0.1, rng.integers(0, 4, len(line)) + 4 * (line // 4), line).astype(np.int32)
    expected = offset - shift[np.repeat([0, 1], 4)]
    likely = np.exp(-0.5 * (np.arange(-12.0, 13.0) / 5.0) ** 2)
    info, gates = np.array([1e-6, 1e-6, 2500.0, 2500.0, 2500.0]), np.array([4.0, 2.5, 1.5])
    found = []
    for k in (reference, kernel):
        rho, tangent = k.project(x, y, half, psi, np.zeros(2))
        found.append(k.align(rho, tangent, line, half, expected, psi, FOCAL_PX, info, gates, likely))
        assert np.abs(found[-1][:2] - shift).max() < 0.5
        assert np.abs(found[-1][2:] - [turn, *tilt]).max() < 0.001
    np.testing.assert_allclose(found[1], found[0], rtol=1e-8, atol=1e-11)


def test_without_points_nothing_is_shifted() -> None:
    none, line = np.zeros(0, np.float32), np.zeros(0, np.int32)
    for k in (reference, kernel):
        found = k.align(none, none, line, 0, np.zeros(3), 0.1, FOCAL_PX, np.ones(5), np.ones(2), np.ones(25))
        np.testing.assert_array_equal(found, np.zeros(5))


@given(SEEDS)
@settings(max_examples=30, deadline=None)
def test_pictures_are_the_same_and_leave_out_lines(seed: int) -> None:
    x, y, line, half, _ = seen(seed, 0.3, (0.0, 0.0))
    new = np.array([0, -1, 1, 2, -1, 3, 4, 5])
    for k in (reference, kernel):
        rho, tangent = k.project(x, y, half, 0.3, np.zeros(2))
        uv, number = k.picture(rho, tangent, line, half, 0.3, FOCAL_PX, new)
        left = new[line] >= 0
        np.testing.assert_array_equal(number, new[line][left])
        np.testing.assert_allclose(uv, FOCAL_PX * np.column_stack([x, y])[left], atol=1e-3)


@given(SEEDS, st.integers(0, 40))
@settings(max_examples=80, deadline=None)
def test_edges_are_joined_alike(seed: int, count: int) -> None:
    rng = np.random.default_rng(seed)
    offset = np.round(rng.uniform(-60, 60, count), int(rng.integers(0, 3)))  # also equal ones
    group, support = rng.integers(0, 4, count), rng.integers(0, 90, count)
    start = rng.uniform(-200.0, 200.0, count)
    end = start + rng.uniform(0.0, 300.0, count)
    widths = Widths(3.0, 7.0, 1.0)
    arguments = (offset, rng.uniform(0.02, 0.1, count), group, support, start, end, 20.0, widths)
    for a, b in zip(reference.join(*arguments), kernel.join(*arguments), strict=True):
        np.testing.assert_array_equal(b, a)


@BOTH
def test_two_sides_are_one_groove_and_twins_one_edge(k: ModuleType) -> None:
    offset = np.array([50.0, -10.0, 0.0, 4.0, 52.0, 90.0])
    group = np.array([1, 0, 0, 1, 1, 3])
    support = np.array([40, 30, 60, 70, 90, 50])
    ends, widths = (np.zeros(6), np.full(6, 100.0)), Widths(3.0, 7.0, 1.0)
    order, new, axis, at, sigma, kind, points = k.join(offset, np.full(6, 0.1), group, support, *ends, 35.0, widths)
    assert order.tolist() == [2, 3, 4, 5]  # -10 has too few points, 50 is beside a stronger one
    assert new.tolist() == [-1, -1, 0, 0, 1, 2]
    assert (axis.tolist(), at.tolist(), points.tolist()) == ([0, 0, 1], [2.0, 52.0, 90.0], [130, 90, 50])
    assert kind.tolist() == [LineKind.GROOVE, LineKind.RISING, LineKind.RISING]
    np.testing.assert_allclose(sigma, [0.1 / np.sqrt(2.0), 0.1, 0.1])
    one = (offset[:1], offset[:1], group[:1], support[:1], *(e[:1] for e in ends))
    assert not len(k.join(*one, 1.0, widths)[0])


@BOTH
@pytest.mark.parametrize(("begins", "groove"), [(0.0, True), (99.0, True), (101.0, False), (300.0, False)])
def test_the_sides_of_a_groove_lie_beside_each_other(k: ModuleType, begins: float, groove: bool) -> None:
    """A falling edge of 200 px and 4 px from it a rising one of 60, as of a lamp and of a grille further on."""
    start, end = np.array([-100.0, begins]), np.array([100.0, begins + 60.0])
    found = k.join(
        np.array([0.0, 4.0]),
        np.full(2, 0.1),
        np.array([0, 1]),
        np.array([200, 60]),
        start,
        end,
        20.0,
        Widths(3.0, 7.0, 1.0),
    )
    assert found[5].tolist() == ([LineKind.GROOVE] if groove else [LineKind.FALLING, LineKind.RISING])


@given(SEEDS)
@settings(max_examples=40, deadline=None)
def test_arms_are_the_same(seed: int) -> None:
    rng = np.random.default_rng(seed)
    points = rng.uniform(-100, 100, (400, 2)).astype(np.float32)
    line, row = rng.integers(0, 6, 400), np.array([0, -1, 1, 2, -1, 3], np.int32)
    angle, at = rng.uniform(-np.pi, np.pi), rng.uniform(-90, 90, 15)
    arguments = (points, line, row, np.array([np.cos(angle), np.sin(angle)]), at, Arm(12.0, 2.0, 2.0, 3.0))
    a, b = reference.arms(*arguments), kernel.arms(*arguments)
    assert a.shape == b.shape == (4, 15)
    assert np.count_nonzero(a != b) <= 1  # a point on a bin's edge
    assert kernel.arms(*arguments[:4], at[:0], arguments[5]).shape == (4, 0)


@BOTH
def test_one_arm_is_enough(k: ModuleType) -> None:
    points = np.column_stack([np.arange(0.0, 40.0), np.zeros(40)]).astype(np.float32)
    line, row = np.zeros(40, np.int64), np.zeros(1, np.int32)
    arm = Arm(10.0, 2.0, 2.0, 3.0)
    covered = k.arms(points, line, row, np.array([1.0, 0.0]), np.array([-30.0, 0.0, 20.0, 39.0, 60.0]), arm)
    assert covered.tolist() == [[False, True, True, True, False]]
