"""Observation model: sigma(r), kinds in the map's quadrant, association."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ceilvo.calibration import NoiseCurves
from ceilvo.config import Filter
from ceilvo.daemon.slam.association import associate, sigma
from ceilvo.daemon.slam.spatial_index import IndexedMap
from ceilvo.se2 import inverse, transform, wrap
from ceilvo.types import Crossings, Landmarks

CURVES = NoiseCurves((0.002, 0.0, 0.001), (0.003, 0.002), 0.001, 0.2, 1.5)


def crossings(xy, kind, psi=0.0, psi_sigma=0.001, cov=0.0, common=0.0):
    xy = np.asarray(xy, float).reshape(-1, 2)
    return Crossings(
        uv_px=np.zeros_like(xy),
        xy_base_m=xy,
        cov_base_m2=np.tile(np.eye(2) * cov, (len(xy), 1, 1)),
        crossing_type=np.asarray(kind, np.int64),
        psi_rad=psi,
        psi_sigma_rad=psi_sigma,
        tilt_rad=np.zeros(2),
        tilt_sigma_rad=np.zeros(2),
        common_cov_m2=np.eye(2) * common,
    )


def landmarks(xy, kind):
    xy = np.asarray(xy, float).reshape(-1, 2)
    n = len(xy)
    return Landmarks(np.arange(n), xy, np.tile(np.eye(2) * 1e-6, (n, 1, 1)), np.asarray(kind), np.full(n, 3))


def label_of(xy, kind, known, pose=(0.0, 0.0, 0.0), axis=0.0, psi=0.0):
    pose = np.asarray(pose, float)
    near = IndexedMap(known).landmarks_near
    return associate(crossings(xy, kind, psi), CURVES, np.zeros(2), pose, near, Filter(), axis)


def test_sigma_is_the_polynomial_inside_the_measured_radius():
    r = np.linspace(0.2, 1.5, 40)
    x, y = sigma(CURVES, r)
    np.testing.assert_allclose(x, 0.002 + 0.001 * r**2, atol=2e-8)
    np.testing.assert_allclose(y, 0.003 + 0.002 * r, atol=2e-8)


def test_sigma_outside_the_measured_radius_holds_below_and_grows_above():
    x, _ = sigma(CURVES, np.array([0.0, 0.2, 1.5, 3.0]))
    assert x[0] == x[1]
    assert x[3] == pytest.approx(2 * x[2])


@given(st.lists(st.floats(-0.01, 0.01), min_size=1, max_size=5), st.floats(0.0, 0.5), st.floats(0.6, 3.0))
def test_sigma_never_shrinks_with_r_and_is_positive(coefficients, low, high):
    x, _ = sigma(NoiseCurves(tuple(coefficients), (0.003,), 0.001, low, high), np.linspace(0.0, 5.0, 400))
    assert np.all(np.diff(x) >= -1e-15)
    assert np.all(x > 0)


def test_variance_is_sigma_squared_from_below_the_camera_plus_the_crossing_s_own():
    seen = crossings([[1.0, 0.5]], [4], cov=1e-6, common=4e-7)
    near, visible = IndexedMap(landmarks([], [])).landmarks_near, np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]])
    obs = associate(seen, CURVES, np.array([0.1, 0.5]), np.zeros(3), near, Filter(), 0.0, visible)
    r = 0.9
    np.testing.assert_allclose(
        obs.var_m2[0], [(0.002 + 0.001 * r**2) ** 2 + 1e-6, (0.003 + 0.002 * r) ** 2 + 1e-6], 1e-4
    )
    assert obs.common_var_m2 == pytest.approx(4e-7)
    assert obs.heading_var_rad2 == pytest.approx(2e-6)
    assert obs.visible_m is visible


def test_association_needs_equal_kind_and_the_gate():
    known = landmarks([[1.0, 1.0]], [3])
    assert label_of([[1.05, 1.0]], [3], known).label.tolist() == [0]
    assert label_of([[1.05, 1.0]], [5], known).label.tolist() == [-1]
    assert label_of([[1.21, 1.0]], [3], known).label.tolist() == [-1]


def test_association_is_mutual():
    known = landmarks([[1.0, 1.0], [2.0, 1.0]], [3, 3])
    assert label_of([[1.04, 1.0], [1.10, 1.0], [2.0, 1.1]], [3, 3, 3], known).label.tolist() == [0, -1, 1]


def test_empty_frame_and_empty_map():
    assert len(label_of(np.empty((0, 2)), [], landmarks([[0, 0]], [1]))) == 0
    assert label_of([[0.0, 0.0]], [1], landmarks([], [])).label.tolist() == [-1]


@pytest.mark.parametrize("axis_rad", [0.0, 0.3])
@pytest.mark.parametrize("theta_deg", [-180, -135.5, -91, -44, 0, 46, 89, 133, 179.9])
def test_a_feature_keeps_its_kind_and_gives_the_heading_whatever_way_the_robot_looks(theta_deg, axis_rad):
    # A corner whose two edges rise along the map's axes: seen by lines of base, its kind depends on the heading.
    pose = np.array([0.4, -0.2, np.radians(theta_deg)])
    psi = (wrap(axis_rad - pose[2]) + np.pi / 4) % (np.pi / 2) - np.pi / 4
    normals = [psi, psi + np.pi / 2]
    kinds = []
    for n in normals:  # rising along map axis 0 and falling along map axis 1, by projection on the lines' normals
        along = np.array([np.cos(n + pose[2] - axis_rad), np.sin(n + pose[2] - axis_rad)])
        kinds.append(round(along[0] - along[1]))
    kind = 3 * (kinds[0] + 1) + kinds[1] + 1
    at = transform(inverse(pose), np.array([[1.0, 1.0]]))
    obs = label_of(at, [kind], landmarks([[1.01, 1.0]], [6]), pose, axis_rad, psi)
    assert obs.crossing_type.tolist() == [6]
    assert obs.label.tolist() == [0]
    assert abs(wrap(obs.heading_rad - pose[2])) < 1e-9
