"""Eqs. 5-7 against rays that are intersected with the ceiling directly."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ceilvo.calibration import Calibration, NoiseCurves, mount_rotation, projection_matrix, sharp_part, visible_polygon
from ceilvo.camera import CameraModel
from ceilvo.errors import CalibrationError

NOISE = NoiseCurves((0.003, 0.0, 0.002), (0.003, 0.0, 0.002), 0.002, 0.0, 2.5)
LENSES = (
    CameraModel("pinhole", 640, 480, 410.3, 409.1, 322.7, 236.4, (-0.15, 0.03, 6e-4, -4e-4, -0.002)),
    CameraModel("fisheye", 640, 480, 205.2, 204.6, 322.7, 236.4, (-0.02, 0.004, -0.002, 0.0003)),
)
tilt = st.floats(np.radians(-22.0), np.radians(22.0))
offset = st.floats(-0.5, 0.5)
mountings = st.tuples(
    st.sampled_from(LENSES), st.floats(-np.pi, np.pi), tilt, tilt, offset, offset, st.floats(0.5, 10.0)
)


def calibration(
    lens: CameraModel, yaw: float, roll: float, pitch: float, x: float, y: float, height: float, scale: float = 1.0
) -> Calibration:
    m = projection_matrix(lens, mount_rotation(yaw, roll, pitch), (x, y), height)
    return Calibration(lens, scale * m, NOISE)


@given(mountings, st.sampled_from([1.0, 2.5, -0.3]))
def test_the_mounting_comes_back_out_of_the_projection(m: tuple, scale: float) -> None:
    """M is only known up to scale and sign."""
    c = calibration(*m, scale=scale)
    _, yaw, roll, pitch, x, y, height = m
    np.testing.assert_allclose(c.camera_from_base, mount_rotation(yaw, roll, pitch), atol=1e-9)
    np.testing.assert_allclose(c.mount_xy_m, [x, y], atol=1e-8)
    assert abs(c.ceiling_height_m - height) < 1e-8


@given(mountings)
def test_mount_rotation_is_a_rotation(m: tuple) -> None:
    r = mount_rotation(*m[1:4])
    np.testing.assert_allclose(r @ r.T, np.eye(3), atol=1e-12)
    assert abs(np.linalg.det(r) - 1.0) < 1e-12


def test_mount_rotation_by_hand() -> None:
    """A camera turned 90 deg to the left has its x axis along base y."""
    base_from_camera = mount_rotation(np.pi / 2).T
    np.testing.assert_allclose(base_from_camera @ [1, 0, 0], [0, 1, 0], atol=1e-12)
    np.testing.assert_allclose(base_from_camera @ [0, 0, 1], [0, 0, 1], atol=1e-12)
    rolled = mount_rotation(0.0, roll_rad=np.pi / 6).T
    np.testing.assert_allclose(rolled @ [0, 0, 1], [0, -0.5, np.sqrt(0.75)], atol=1e-12)
    pitched = mount_rotation(0.0, pitch_rad=np.pi / 6).T
    np.testing.assert_allclose(pitched @ [0, 0, 1], [0.5, 0, np.sqrt(0.75)], atol=1e-12)


@given(mountings, st.lists(st.tuples(st.floats(-2, 2), st.floats(-2, 2)), min_size=1, max_size=10).map(np.array))
def test_eq_5_is_what_a_pinhole_does(m: tuple, xy: np.ndarray) -> None:
    """Ceiling points in base, seen from the camera's position along the camera's axes."""
    c = calibration(*m)
    lens, yaw, roll, pitch, x, y, height = m
    from_camera = np.column_stack([xy - [x, y], np.full(len(xy), height)])
    rays = from_camera @ mount_rotation(yaw, roll, pitch).T
    ahead = rays[:, 2] > 0.1 * height
    expected = rays[:, :2] / rays[:, 2:] * [lens.fx_px, lens.fy_px] + [lens.cx_px, lens.cy_px]
    h = np.column_stack([xy, np.zeros(len(xy)), np.ones(len(xy))]) @ c.projection.T
    np.testing.assert_allclose((h[:, :2] / h[:, 2:])[ahead], expected[ahead], atol=1e-6)


@given(mountings, st.lists(st.tuples(st.floats(0, 639), st.floats(0, 479)), min_size=1, max_size=10).map(np.array))
def test_a_raw_pixel_lands_where_its_ray_meets_the_ceiling(m: tuple, uv: np.ndarray) -> None:
    """Lens, level view and m^-1 of eq. 7 together, against ray-plane intersection."""
    c = calibration(*m)
    lens, yaw, roll, pitch, x, y, height = m
    rays = lens.rays(uv) @ mount_rotation(yaw, roll, pitch)  # in base
    low = rays[:, 2] > 0.2
    expected = rays[low, :2] / rays[low, 2:] * height + [x, y]
    level = c.level_view.from_raw(uv[low])
    h = np.column_stack([level, np.ones(len(level))]) @ c.ceiling_from_level.T  # eq. 7
    np.testing.assert_allclose(h[:, :2] / h[:, 2:], expected, atol=1e-7 * height)


@given(mountings)
def test_eq_6_and_eq_7_are_inverse(m: tuple) -> None:
    c = calibration(*m)
    np.testing.assert_allclose(c.level_from_ceiling @ c.ceiling_from_level, np.eye(3), atol=1e-9)


def test_a_degenerate_projection_is_refused_with_what_to_do() -> None:
    m = np.zeros((3, 4))
    m[:, 0] = 1.0
    with pytest.raises(CalibrationError, match=r"projection: determinant.*expected non-zero.*again"):
        _ = Calibration(LENSES[0], m, NOISE).ceiling_height_m


def inside(polygon: np.ndarray, xy: np.ndarray) -> np.ndarray:
    """(N,) whether points (N, 2) are to the left of every side of a polygon."""
    side = np.roll(polygon, -1, axis=0) - polygon
    off = xy[:, None] - polygon[None]
    return np.all(side[:, 0] * off[..., 1] - side[:, 1] * off[..., 0] >= 0.0, axis=1)


def seen(c: Calibration, m: tuple, xy: np.ndarray, margin_px: float, max_view_deg: float) -> np.ndarray:
    """(N,) whether rays from the camera to points (N, 2) of the ceiling end in the picture, by the lens alone."""
    lens, yaw, roll, pitch, x, y, height = m
    from_camera = np.column_stack([xy - [x, y], np.full(len(xy), height)])
    uv = lens.pixels(from_camera @ mount_rotation(yaw, roll, pitch).T)
    low, high = margin_px, np.array([lens.width_px, lens.height_px]) - 1 - margin_px
    steep = np.hypot(*(xy - [x, y]).T) <= height * np.tan(np.radians(max_view_deg))
    return np.asarray(np.all((uv >= low) & (uv <= high), axis=1) & steep)


@given(mountings, st.floats(0.0, 60.0), st.sampled_from([40.0, 65.0]))
def test_what_is_in_the_visible_polygon_is_in_the_picture(m: tuple, margin_px: float, max_view_deg: float) -> None:
    c = calibration(*m)
    polygon = visible_polygon(c, margin_px, max_view_deg)
    reach = c.ceiling_height_m * np.tan(np.radians(max_view_deg))
    xy = c.mount_xy_m + np.random.default_rng(5).uniform(-reach, reach, (4000, 2))
    assert len(polygon) >= 3
    assert np.all(seen(c, m, xy[inside(polygon, xy)], margin_px - 0.5, max_view_deg))
    corners = polygon + 1e-6 * (np.mean(polygon, axis=0) - polygon)
    assert np.all(inside(polygon, corners)), "convex and counter-clockwise"


@pytest.mark.parametrize(("lens", "share"), [(LENSES[0], 0.9), (LENSES[1], 0.8)], ids=["pinhole", "fisheye"])
def test_the_visible_polygon_wastes_little_of_the_picture(lens: CameraModel, share: float) -> None:
    m = (lens, 0.3, np.radians(4.0), np.radians(-6.0), 0.1, -0.05, 2.2)
    c = calibration(*m)
    xy = np.random.default_rng(5).uniform(-6, 6, (40_000, 2))
    there = seen(c, m, xy, 12.0, 65.0)
    kept = np.count_nonzero(inside(visible_polygon(c, 12.0, 65.0), xy)) / np.count_nonzero(there)
    print(f"{lens.kind}: {kept:.3f} of what is seen")
    assert kept > share


@given(mountings, st.sampled_from([0.5, 0.7, 0.9]))
def test_what_is_in_the_sharp_part_is_shown_as_large_as_asked(m: tuple, share: float) -> None:
    c = calibration(*m)
    lens, yaw, roll, pitch, x, y, height = m
    whole = visible_polygon(c, 12.0, 60.0)
    sharp = sharp_part(c, whole, 60.0, share)
    around = np.random.default_rng(5).uniform(-2.0 * height, 2.0 * height, (2000, 2))
    xy = around + np.array([x, y])
    xy = np.vstack([[x, y], xy[inside(sharp, xy)]]) if len(sharp) else np.array([[x, y]])

    def shown(at: np.ndarray) -> np.ndarray:
        rays = np.column_stack([at - [x, y], np.full(len(at), height)])
        return lens.pixels(rays @ mount_rotation(yaw, roll, pitch).T)

    step = 1e-4 * height
    jacobian = np.stack([(shown(xy + step * e) - shown(xy - step * e)) / (2 * step) for e in np.eye(2)], axis=-1)
    least = np.linalg.svd(jacobian, compute_uv=False)[:, -1]
    assert np.all(least >= (share - 0.02) * least[0])
    assert np.all(inside(whole, sharp + 1e-6 * (np.mean(whole, axis=0) - sharp))), "a part of the whole"


def test_an_upright_camera_without_distortion_is_sharp_everywhere() -> None:
    c = calibration(CameraModel("pinhole", 640, 480, 400.0, 400.0, 320.0, 240.0, ()), 0.3, 0.0, 0.0, 0.1, -0.05, 2.2)
    polygon = visible_polygon(c, 12.0, 60.0)
    np.testing.assert_array_equal(sharp_part(c, polygon, 60.0, 0.99), polygon)


def test_a_picture_that_is_all_margin_shows_nothing() -> None:
    c = calibration(LENSES[0], 0.0, 0.0, 0.0, 0.0, 0.0, 2.0)
    assert visible_polygon(c, 240.0, 70.0).shape == (0, 2)
