"""Homography least squares (eqs. 1-4) and outlier rejection."""

import cv2
import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from ceilvo.daemon.odometry.kernel import homography_residuals
from ceilvo.daemon.odometry.kernel.reference import homography
from ceilvo.daemon.odometry.matching import consistent


@given(st.integers(0, 10_000))
def test_recovers_a_random_homography(seed: int) -> None:
    rng = np.random.default_rng(seed)
    h = np.array([[1.0, 0.1, 20.0], [-0.1, 0.9, -30.0], [0.0, 0.0, 1.0]])
    h[:2] += rng.normal(0, 0.05, (2, 3)) * [1, 1, 100]
    h[2, :2] = rng.normal(0, 1e-4, 2)
    xy = rng.uniform(0, 640, (12, 2))
    uv = cv2.perspectiveTransform(xy.reshape(-1, 1, 2), h).reshape(-1, 2)
    assert np.abs(homography(xy, uv) - h / h[2, 2]).max() < 1e-6 * np.abs(h).max()


def test_agrees_with_opencv_on_noisy_points() -> None:
    rng = np.random.default_rng(3)
    xy = rng.uniform(0, 640, (40, 2))
    h = np.array([[0.99, -0.05, 4.0], [0.05, 0.99, -2.0], [0.0, 0.0, 1.0]])
    uv = cv2.perspectiveTransform(xy.reshape(-1, 1, 2), h).reshape(-1, 2) + rng.normal(0, 0.2, xy.shape)
    theirs, _ = cv2.findHomography(xy, uv, 0)
    theirs_px = np.hypot(*(cv2.perspectiveTransform(xy.reshape(-1, 1, 2), theirs).reshape(-1, 2) - uv).T)
    assert abs(homography_residuals(xy, uv, np.ones(40, bool)).mean() - theirs_px.mean()) < 0.01


def test_outliers_are_named() -> None:
    rng = np.random.default_rng(4)
    xy = rng.uniform(0, 640, (30, 2))
    uv = xy + np.array([7.0, -3.0]) + rng.normal(0, 0.1, xy.shape)
    uv[:6] += rng.uniform(8, 30, (6, 2))
    good = consistent(xy, uv, 2.0)
    assert not good[:6].any() and good[6:].all()


def test_too_few_points_are_all_kept() -> None:
    xy = np.arange(8.0).reshape(4, 2)
    assert consistent(xy, xy, 2.0).all()


def test_collinear_points_do_not_raise() -> None:
    xy = np.column_stack([np.arange(10.0), 2.0 * np.arange(10.0)])
    assert consistent(xy, xy + 1.0, 2.0).shape == (10,)
