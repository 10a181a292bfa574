"""The camera model against OpenCV's own projection, and the level view against plain geometry."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ceilvo.calibration import mount_rotation
from ceilvo.camera import CameraModel, LevelView

PINHOLES = (
    (),
    (-0.15, 0.03, 6e-4, -4e-4),
    (-0.15, 0.03, 6e-4, -4e-4, -0.002),
    (0.1, 0.02, 1e-3, 5e-4, 0.01, 0.2, 0.03, 0.01),
)
FISHEYES = ((), (-0.02, 0.004, -0.002, 0.0003))


def camera(kind: str, distortion: tuple[float, ...]) -> CameraModel:
    f = 410.3 if kind == "pinhole" else 205.2
    return CameraModel(kind, 640, 480, f, f * 0.997, 322.7, 236.4, distortion)


CAMERAS = [camera("pinhole", d) for d in PINHOLES] + [camera("fisheye", d) for d in FISHEYES]


def reference_pixels(c: CameraModel, rays: np.ndarray) -> np.ndarray:
    still = np.zeros(3)
    if c.kind == "fisheye":
        uv, _ = cv2.fisheye.projectPoints(rays[:, None], still, still, c.matrix, np.array(c.distortion or [0.0] * 4))
    else:
        uv, _ = cv2.projectPoints(rays[:, None], still, still, c.matrix, np.array(c.distortion or [0.0] * 5))
    return uv.reshape(-1, 2)


directions = st.lists(
    st.tuples(st.floats(0.0, np.radians(42.0)), st.floats(-np.pi, np.pi)), min_size=1, max_size=20
).map(lambda a: np.array([[np.sin(t) * np.cos(p), np.sin(t) * np.sin(p), np.cos(t)] for t, p in a]))


@pytest.mark.parametrize("c", CAMERAS, ids=lambda c: f"{c.kind}{len(c.distortion)}")
@given(rays=directions)
def test_pixels_are_opencvs(c: CameraModel, rays: np.ndarray) -> None:
    np.testing.assert_allclose(c.pixels(rays), reference_pixels(c, rays), atol=1e-6)


@pytest.mark.parametrize("c", CAMERAS, ids=lambda c: f"{c.kind}{len(c.distortion)}")
@given(rays=directions)
def test_rays_undo_opencvs_projection(c: CameraModel, rays: np.ndarray) -> None:
    np.testing.assert_allclose(c.rays(reference_pixels(c, rays)), rays, atol=2e-5)


@pytest.mark.parametrize("c", CAMERAS, ids=lambda c: f"{c.kind}{len(c.distortion)}")
def test_the_principal_point_looks_along_the_axis(c: CameraModel) -> None:
    np.testing.assert_allclose(c.rays(np.array([[c.cx_px, c.cy_px]])), [[0, 0, 1]], atol=1e-12)


def test_a_pinhole_cannot_image_what_is_behind_it() -> None:
    c = camera("pinhole", PINHOLES[2])
    uv = c.pixels(np.array([[0.1, 0, -1.0], [1.0, 0, 0.0], [0.1, 0, 1.0]]))
    assert np.isnan(uv[:2]).all()
    assert np.isfinite(uv[2]).all()


def test_a_fisheye_sees_beyond_a_right_angle() -> None:
    c = camera("fisheye", FISHEYES[1])
    ray = np.array([[np.sin(1.7), 0.0, np.cos(1.7)]])
    np.testing.assert_allclose(c.rays(c.pixels(ray)), ray, atol=1e-9)


angles = st.floats(np.radians(-25.0), np.radians(25.0))


@given(st.sampled_from(CAMERAS), st.floats(-np.pi, np.pi), angles, angles, directions)
def test_the_level_view_round_trips(c: CameraModel, yaw: float, roll: float, pitch: float, rays: np.ndarray) -> None:
    view = LevelView(c, mount_rotation(yaw, roll, pitch).T, 400.0)
    level = np.column_stack([400.0 * rays[:, :2] / rays[:, 2:], np.ones(len(rays))])[:, :2] + [c.cx_px, c.cy_px]
    raw = view.to_raw(level)
    in_front = (rays @ view.level_from_camera)[:, 2] > np.cos(np.radians(42.0))  # where the lens model is one to one
    np.testing.assert_allclose(view.from_raw(raw)[in_front], level[in_front], atol=0.05)


def test_level_lines_of_a_tilted_camera_are_straight_and_square() -> None:
    """The corners of a square on a level ceiling, imaged by a tilted fisheye, are a square in the level view."""
    c = camera("fisheye", FISHEYES[1])
    rot = mount_rotation(0.3, np.radians(15.0), np.radians(-10.0))
    square = np.array([[0.5, 0.5, 2.0], [-0.5, 0.5, 2.0], [-0.5, -0.5, 2.0], [0.5, -0.5, 2.0]])
    raw = reference_pixels(c, square @ rot.T)
    level = LevelView(c, rot.T, 400.0).from_raw(raw)
    np.testing.assert_allclose(level, square[:, :2] / 2.0 * 400.0 + [c.cx_px, c.cy_px], atol=1e-3)


def test_a_ray_at_the_horizon_has_no_level_pixel() -> None:
    c = camera("fisheye", ())
    view = LevelView(c, np.eye(3), 400.0)
    rays = np.array([[1.0, 0, 0], [np.sin(1.7), 0, np.cos(1.7)], [0.5, 0, 1.0]])
    assert np.isfinite(view.from_raw(c.pixels(rays))).all(axis=1).tolist() == [False, False, True]


@pytest.mark.parametrize("step_px", [1, 2, 7])
@pytest.mark.parametrize("c", [CAMERAS[2], CAMERAS[-1]], ids=lambda c: c.kind)
def test_the_lookup_is_the_level_view_and_reaches_every_pixel(c: CameraModel, step_px: int) -> None:
    view = LevelView(c, mount_rotation(0.1, 0.1, -0.05).T, 400.0)
    level = view.lookup(55.0, step_px)
    rows, columns = level.shape[:2]
    assert 0 <= (columns - 1) * step_px - 639 < step_px
    assert 0 <= (rows - 1) * step_px - 479 < step_px
    rng = np.random.default_rng(3)
    x, y = rng.integers(0, columns, 400), rng.integers(0, rows, 400)
    rel = view.from_raw(step_px * np.column_stack([x, y]).astype(float)) - [c.cx_px, c.cy_px]
    angle = np.degrees(np.arctan(np.hypot(*rel.T) / 400.0))
    seen = np.isfinite(level[y, x]).all(axis=1)
    clear = np.abs(angle - 55.0) > 0.5
    np.testing.assert_array_equal(seen[clear], (angle < 55.0)[clear])
    np.testing.assert_allclose(level[y, x][seen], rel[seen], rtol=1e-5, atol=1e-3)
