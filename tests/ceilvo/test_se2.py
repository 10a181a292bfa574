"""Planar motions against 3 x 3 homogeneous matrices."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ceilvo import se2

coordinate = st.floats(-100.0, 100.0)
angle = st.floats(-np.pi, np.pi, exclude_max=True)
pose = st.tuples(coordinate, coordinate, angle).map(np.array)


def matrix(p: np.ndarray) -> np.ndarray:
    c, s = np.cos(p[2]), np.sin(p[2])
    return np.array([[c, -s, p[0]], [s, c, p[1]], [0, 0, 1.0]])


def assert_same(a: np.ndarray, b: np.ndarray) -> None:
    np.testing.assert_allclose(matrix(a), matrix(b), atol=1e-9)


@given(st.floats(-1e4, 1e4))
def test_wrap_keeps_the_direction_and_stays_in_range(a: float) -> None:
    w = se2.wrap(a)
    assert -np.pi <= w < np.pi
    assert abs(np.exp(1j * w) - np.exp(1j * a)) < 1e-9
    assert se2.wrap_array(np.array([a]))[0] == w


def test_wrap_at_the_seam() -> None:
    assert se2.wrap(np.pi) == -np.pi
    assert se2.wrap(-np.pi) == -np.pi
    assert se2.wrap(3 * np.pi) == -np.pi


@given(pose, pose)
def test_compose_is_the_product_of_matrices(a: np.ndarray, b: np.ndarray) -> None:
    np.testing.assert_allclose(matrix(se2.compose(a, b)), matrix(a) @ matrix(b), atol=1e-9)


@given(pose)
def test_inverse_is_the_inverse_matrix(a: np.ndarray) -> None:
    np.testing.assert_allclose(matrix(se2.inverse(a)), np.linalg.inv(matrix(a)), atol=1e-9)
    assert_same(se2.compose(a, se2.inverse(a)), np.zeros(3))


@given(pose, pose, pose)
def test_compose_is_associative(a: np.ndarray, b: np.ndarray, c: np.ndarray) -> None:
    assert_same(se2.compose(se2.compose(a, b), c), se2.compose(a, se2.compose(b, c)))


@given(pose, pose)
def test_between_undoes_compose(a: np.ndarray, b: np.ndarray) -> None:
    assert_same(se2.between(a, se2.compose(a, b)), b)
    assert_same(se2.compose(a, se2.between(a, b)), b)


@given(pose, st.lists(st.tuples(coordinate, coordinate), min_size=1, max_size=5).map(np.array))
def test_transform_maps_points_as_the_matrix_does(a: np.ndarray, xy: np.ndarray) -> None:
    expected = (matrix(a) @ np.column_stack([xy, np.ones(len(xy))]).T).T[:, :2]
    np.testing.assert_allclose(se2.transform(a, xy), expected, atol=1e-9)


@given(pose, st.lists(pose, min_size=1, max_size=4).map(np.array))
def test_compose_broadcasts(a: np.ndarray, many: np.ndarray) -> None:
    np.testing.assert_array_equal(se2.compose(a, many), [se2.compose(a, m) for m in many])
    np.testing.assert_array_equal(se2.compose(many, a), [se2.compose(m, a) for m in many])


def test_a_quarter_turn_by_hand() -> None:
    """Standing at (1, 2) facing +y, one metre ahead is (1, 3) and half a metre to the left is (0.5, 2)."""
    map_from_base = np.array([1.0, 2.0, np.pi / 2])
    np.testing.assert_allclose(se2.transform(map_from_base, np.array([[1.0, 0], [0, 0.5]])), [[1, 3], [0.5, 2]])


@pytest.mark.parametrize(
    ("before", "now", "prev_from_curr"),
    [([1.0, 0.0], [0.9, 0.0], [0.1, 0.0, 0.0]), ([1.0, 0.0], [0.0, -1.0], [0.0, 0.0, np.pi / 2])],
    ids=["forward", "left turn"],
)
def test_the_sign_of_motion_by_hand(before: list[float], now: list[float], prev_from_curr: list[float]) -> None:
    """docs/coordinates.md: driving forward moves the scene backward; prev_from_curr is the robot's motion."""
    motion = np.array(prev_from_curr)
    np.testing.assert_allclose(se2.transform(motion, np.array([now])), [before], atol=1e-12)
    np.testing.assert_allclose(se2.compose(np.zeros(3), motion), motion, atol=1e-12)
    scene = se2.inverse(motion)  # R, T of eq. 8
    np.testing.assert_allclose(se2.transform(scene, np.array([before])), [now], atol=1e-12)


@given(pose, pose)
def test_compose_cov_is_the_spread_of_perturbed_poses(a: np.ndarray, b: np.ndarray) -> None:
    """Against a numerical Jacobian, where the wrap of angles does not matter to a small step."""
    rng = np.random.default_rng(5)
    roots = rng.normal(size=(2, 3, 3)) * 0.1
    cov_a, cov_b = roots[0] @ roots[0].T, roots[1] @ roots[1].T
    h = 1e-6

    def jacobian(of_a: bool) -> np.ndarray:
        columns = []
        for e in np.eye(3) * h:
            plus = se2.compose(a + e, b) if of_a else se2.compose(a, b + e)
            minus = se2.compose(a - e, b) if of_a else se2.compose(a, b - e)
            d = plus - minus
            columns.append(np.array([d[0], d[1], se2.wrap(d[2])]) / (2 * h))
        return np.column_stack(columns)

    f, g = jacobian(True), jacobian(False)
    expected = f @ cov_a @ f.T + g @ cov_b @ g.T
    np.testing.assert_allclose(se2.compose_cov(a, cov_a, b, cov_b), expected, atol=1e-4, rtol=1e-5)


@given(st.tuples(st.floats(-2, 2), st.floats(-2, 2), st.floats(-3, 3)).map(np.array), st.floats(0.01, 1.0))
def test_a_constant_twist_is_many_small_steps(twist: np.ndarray, duration_s: float) -> None:
    whole = se2.driven(twist, np.array([duration_s, -duration_s]))
    steps, one = 2000, np.zeros(3)
    for _ in range(steps):
        one = se2.compose(one, twist * duration_s / steps)
    np.testing.assert_allclose(whole[0], one, atol=2e-3)
    np.testing.assert_allclose(se2.compose(whole[0], whole[1]), 0.0, atol=1e-9)
    np.testing.assert_allclose(se2.mean_twist(whole[0], duration_s), twist, atol=1e-9)
