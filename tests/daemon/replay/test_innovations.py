"""Innovations in the picture against the pinhole's own arithmetic."""

from __future__ import annotations

import numpy as np
import pytest

from ceilvo import se2
from ceilvo.calibration import Calibration, NoiseCurves, mount_rotation, projection_matrix, to_ceiling
from ceilvo.camera import CameraModel
from ceilvo.daemon.replay.drawing.innovations import ENLARGED, draw_innovations, innovations_px
from ceilvo.types import Crossings, Landmarks

CAMERA = CameraModel("pinhole", 320, 240, 200.0, 200.0, 160.0, 120.0, ())
HEIGHT_M = 2.0
POSE = np.array([3.0, 4.0, 0.5])


def level_camera() -> Calibration:
    rotation = mount_rotation(0.0, 0.0, 0.0)
    noise = NoiseCurves((0.01,), (0.01,), 0.01, 0.0, 2.0)
    return Calibration(CAMERA, projection_matrix(CAMERA, rotation, (0.0, 0.0), HEIGHT_M), noise)


def seen(calibration: Calibration, xy_base_m: np.ndarray, kind: int = 4) -> Crossings:
    n = len(xy_base_m)
    uv = to_ceiling(calibration.level_from_ceiling, xy_base_m)
    cov = np.tile(1e-6 * np.eye(2), (n, 1, 1))
    return Crossings(uv, xy_base_m, cov, np.full(n, kind), 0.0, 0.01, np.zeros(2), np.zeros(2), np.zeros((2, 2)))


def landmarks(xy_map_m: np.ndarray, kind: int = 4) -> Landmarks:
    n = len(xy_map_m)
    return Landmarks(np.arange(n), xy_map_m, np.tile(1e-6 * np.eye(2), (n, 1, 1)), np.full(n, kind), np.full(n, 9))


def test_a_pose_that_is_off_shifts_all_of_them_by_focal_length_over_height() -> None:
    calibration = level_camera()
    base = np.array([[0.0, 0.0], [0.6, 0.0], [-0.6, 0.6]])
    truth = landmarks(se2.transform(POSE, base))
    wrong = se2.compose(POSE, np.array([0.01, 0.0, 0.0]))  # 10 mm further on: all is seen that much before it
    off = innovations_px(seen(calibration, base), truth, wrong, calibration)
    assert np.hypot(*off.T) == pytest.approx(200.0 * 0.01 / HEIGHT_M, rel=1e-6)
    along = to_ceiling(calibration.level_from_ceiling, np.array([[1.0, 0.0], [0.0, 0.0]]))
    assert np.all(off @ (along[0] - along[1]) > 0)
    assert innovations_px(seen(calibration, base), truth, POSE, calibration) == pytest.approx(0.0, abs=1e-9)


def test_what_the_map_does_not_have_has_none() -> None:
    calibration, base = level_camera(), np.array([[0.0, 0.0], [0.6, 0.0]])
    one = landmarks(se2.transform(POSE, base[:1]))
    off = innovations_px(seen(calibration, base), one, POSE, calibration)
    assert np.isfinite(off[0]).all() and np.isnan(off[1]).all()
    assert np.isnan(innovations_px(seen(calibration, base, kind=8), one, POSE, calibration)).all(), "another type"
    assert np.isnan(innovations_px(seen(calibration, base), landmarks(np.empty((0, 2))), POSE, calibration)).all()


def test_they_are_drawn_enlarged() -> None:
    calibration, base = level_camera(), np.array([[0.0, 0.0]])
    image = np.zeros((240, 320, 3), np.uint8)
    wrong = se2.compose(POSE, np.array([0.01, 0.0, 0.0]))
    draw_innovations(image, seen(calibration, base), landmarks(se2.transform(POSE, base)), wrong, calibration)
    drawn = np.argwhere(image[..., 2].astype(int) > image[..., 0].astype(int) + 60)
    reach = np.hypot(*(drawn - [120, 160]).T).max()
    assert reach == pytest.approx(ENLARGED * 1.0, abs=3.0)
