"""calib intrinsics on exact corners with noise: models, sigma, outliers, coverage."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from ceilvo.calib.evaluate.coverage import coverage
from ceilvo.calib.practice.virtual_board import board_poses
from ceilvo.calib.solve.intrinsics import Shot, calibrate, choose_model, fit_best, problems
from ceilvo.calib.solve.lens import parameters_of
from ceilvo.calib.targets.board import Board
from ceilvo.calibration import mount_rotation, projection_matrix
from ceilvo.calibration_check import value_problems
from ceilvo.camera import CameraModel
from ceilvo.errors import CalibrationError
from ceilvo.sim.rig import simulated_calibration, simulated_camera

Array = NDArray[np.float64]

SIZE = (640, 480)
BOARD = Board()
LAMPS = CameraModel("fisheye", 640, 480, 188.89, 188.89, 316.05, 227.16, (0.015, 0.0, 0.0, 0.0))
"""The lens of a public recording of a robot car under ceiling lamps."""


def shots(camera: CameraModel, seed: int, count: int = 18, noise_px: float = 0.05) -> list[Shot]:
    """Corners of boards by Rodrigues' formula and the camera model, no picture drawn."""
    rng = np.random.default_rng(seed)
    out = []
    for i, pose in enumerate(board_poses(camera, BOARD, count, rng)):
        uv = camera.pixels(BOARD.corners_m @ cv2.Rodrigues(pose[:3])[0].T + pose[3:])
        out.append(Shot(f"shot {i}", BOARD.corners_m, uv + rng.normal(0, noise_px, uv.shape)))
    return out


@pytest.mark.parametrize(
    "camera", [simulated_camera(), simulated_camera("fisheye"), LAMPS], ids=["pin", "fish", "lamps"]
)
def test_without_noise_the_lens_comes_back(camera: CameraModel) -> None:
    fit = calibrate(shots(camera, 1, 10, 0.0), SIZE, "fisheye" if camera.kind == "fisheye" else "pinhole")
    np.testing.assert_allclose(parameters_of(fit.camera)[:4], parameters_of(camera)[:4], atol=1e-4)
    np.testing.assert_allclose(fit.camera.distortion, camera.distortion, atol=1e-4)
    assert fit.rms_px < 1e-4


def test_the_model_is_chosen_by_what_it_predicts() -> None:
    assert choose_model(shots(simulated_camera(), 2, 9), SIZE, ("pinhole", "fisheye"))[0] == "pinhole"
    chosen, scores = choose_model(shots(LAMPS, 3, 9), SIZE, ("pinhole", "fisheye"))
    assert chosen == "fisheye" and scores["fisheye"] < 0.1 < scores["pinhole"]


@pytest.mark.parametrize("count", [6, 7])
def test_few_pictures_of_a_pinhole_are_a_pinhole(count: int) -> None:
    chosen = [choose_model(shots(simulated_camera(), seed, count), SIZE)[0] for seed in (1, 2)]
    assert chosen == ["pinhole"] * 2


def test_a_fisheye_is_no_pinhole_of_eight_coefficients() -> None:
    """Eight follow it as well to within three percent."""
    assert choose_model(shots(LAMPS, 1, 12), SIZE)[0] == "fisheye"


def test_sigma_counts_pictures_whose_corners_err_together() -> None:
    """A board that bends: each picture's corners are off by a smooth field of its own, 0.2 px."""
    camera, z = simulated_camera(), []
    for seed in range(8):
        rng = np.random.default_rng([seed, 9])
        bent = []
        for s in shots(camera, seed, 16, 0.03):
            x, y = s.xyz_m[:, :2].T / 0.2
            waves = np.column_stack([x * y, x * x, y * y, x, y]) @ rng.normal(0, 0.4, (5, 2))
            bent.append(Shot(s.name, s.xyz_m, s.uv_px + 0.2 * (waves - waves.mean(axis=0))))
        fit = calibrate(bent, SIZE, "pinhole", keep_all=True)
        z.append((parameters_of(fit.camera) - parameters_of(camera))[:4] / fit.sigma[:4])
    assert 0.6 < np.sqrt(np.mean(np.square(z))) < 1.6, z


def test_sigma_is_the_scatter_of_repetitions() -> None:
    camera = simulated_camera()
    z = []
    for seed in range(10):
        fit = calibrate(shots(camera, seed, 12, 0.2), SIZE, "pinhole")
        z.append((parameters_of(fit.camera) - parameters_of(camera)) / fit.sigma)
    assert 0.75 < np.sqrt(np.mean(np.square(z))) < 1.25
    assert np.mean(np.abs(z) < 3) >= 0.95


def test_a_picture_that_does_not_fit_is_dropped_with_its_residual() -> None:
    good = shots(simulated_camera(), 4, 12)
    moved = good[5].uv_px + np.random.default_rng(1).normal(0, 3, good[5].uv_px.shape)
    good[5] = Shot("bent", good[5].xyz_m, moved)
    fit, _ = fit_best(good, SIZE, "pinhole")
    assert [name for name, _ in fit.dropped] == ["bent"]
    assert "the others have" in fit.dropped[0][1]
    kept, _ = fit_best(good, SIZE, "pinhole", keep_all=True)
    assert kept.dropped == () and kept.rms_px > 5 * fit.rms_px


def test_too_few_pictures_are_refused() -> None:
    with pytest.raises(CalibrationError, match="found 3 usable pictures, expected at least 6"):
        calibrate(shots(simulated_camera(), 1, 3), SIZE, "pinhole")


def test_coverage_tells_what_is_missing() -> None:
    camera = simulated_camera()
    every = shots(camera, 1, 20)
    assert coverage(every, SIZE).missing() == []
    left = [s for s in every if s.uv_px[:, 0].max() < 400]
    lacking = " ".join(coverage(left, SIZE).missing())
    assert "right" in lacking and "left" not in lacking.split("empty:")[1].replace("top left", "").replace(
        "bottom left", ""
    )
    flat = [
        Shot("", BOARD.corners_m, camera.pixels(np.add(BOARD.corners_m, [-0.1, -0.06, z])))
        for z in (0.25, 0.26, 0.27) * 3
    ]
    assert any("lean the board" in m for m in coverage(flat, SIZE).missing())
    fit = calibrate(every, SIZE, "pinhole")
    assert problems(fit) == []


def test_the_lens_of_the_lamps_recording_is_representable() -> None:
    """Fisheye, 22 deg off the vertical: accepted by the calibration file's own checks, and invertible everywhere."""
    rotation = mount_rotation(0.0, 0.0, np.radians(22.0))
    calibration = simulated_calibration(LAMPS)
    tilted = type(calibration)(LAMPS, projection_matrix(LAMPS, rotation, (0.0, 0.0), 2.2), calibration.noise)
    assert list(value_problems(tilted)) == []
    grid = np.stack(np.meshgrid(np.linspace(0, 639, 9), np.linspace(0, 479, 7)), axis=-1).reshape(-1, 2)
    np.testing.assert_allclose(LAMPS.pixels(LAMPS.rays(grid)), grid, atol=1e-6)
