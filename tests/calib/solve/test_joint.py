"""The lens refined on the ceiling's grid: nearer to the truth, its sigma true, a grid that contradicts not believed."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from ceilvo import se2
from ceilvo.calib.practice.virtual_board import board_poses
from ceilvo.calib.session.assemble import update_file
from ceilvo.calib.session.session import Session
from ceilvo.calib.solve.grid import from_grid
from ceilvo.calib.solve.intrinsics import Intrinsics, Shot, calibrate
from ceilvo.calib.solve.joint import Joint
from ceilvo.calib.solve.lens import parameters_of
from ceilvo.calib.solve.projection import Mounting
from ceilvo.calib.targets.board import Board
from ceilvo.calib.targets.ceiling_view import GridView
from ceilvo.calibration import mount_rotation
from ceilvo.calibration_file import read_calibration
from ceilvo.camera import CameraModel
from ceilvo.sim.rig import simulated_camera

Array = NDArray[np.float64]
Run = Callable[..., tuple[int, str, str]]

TRUE = simulated_camera()
BOARD = Board()
TILE_M, HEIGHT_M, ROLL_RAD, PITCH_RAD = 0.6, 2.2, 0.02, -0.03
SEEDS = range(8)


def board_lens(seed: int, noise_px: float = 0.15) -> Intrinsics:
    """From exact corners of 12 boards with noise."""
    rng = np.random.default_rng([seed, 1])
    shots = []
    for i, pose in enumerate(board_poses(TRUE, BOARD, 12, rng)):
        uv = TRUE.pixels(BOARD.corners_m @ cv2.Rodrigues(pose[:3])[0].T + pose[3:])
        shots.append(Shot(f"shot {i}", BOARD.corners_m, uv + rng.normal(0, noise_px, uv.shape)))
    return calibrate(shots, (640, 480), "pinhole", keep_all=True)


def looks(camera: CameraModel, seed: int, count: int = 16, joint_px: float = 0.03) -> list[GridView]:
    """Crossings of joints as this camera sees them; each joint is off as a whole, as lines that were fitted are."""
    rng = np.random.default_rng([seed, 2])
    k = np.arange(-6, 7)
    index = np.stack(np.meshgrid(k, k), axis=-1).reshape(-1, 2)
    out = []
    for _ in range(count):
        pose = np.array([*rng.uniform(-0.5, 0.5, 2), rng.uniform(-np.pi, np.pi)])
        off = rng.normal(0, joint_px * HEIGHT_M / camera.fx_px, (2, len(k)))
        xy = index * TILE_M + np.column_stack([off[0][index[:, 0] + 6], off[1][index[:, 1] + 6]])
        level = np.column_stack([se2.transform(se2.inverse(pose), xy), np.full(len(xy), HEIGHT_M)])
        uv = camera.pixels(level @ mount_rotation(0.0, ROLL_RAD, PITCH_RAD).T)
        seen = (uv > 0).all(axis=1) & (uv < [639, 479]).all(axis=1)
        psi = float(np.angle(np.exp(-4j * pose[2]))) / 4.0
        out.append(GridView(uv[seen], level[seen, :2] / HEIGHT_M, psi, 1e-4))
    return out


def on_ceiling(camera: CameraModel, level: Array) -> Array:
    """Where pixels all over the picture are on the ceiling, m."""
    uv = np.stack(np.meshgrid(np.linspace(20, 620, 9), np.linspace(20, 460, 7)), axis=-1).reshape(-1, 2)
    rays = camera.rays(uv) @ mount_rotation(0.0, level[0], level[1])
    return np.asarray(level[2] * rays[:, :2] / rays[:, 2:])


def level_of(m: Mounting) -> Array:
    return np.array([m.roll_rad, m.pitch_rad, m.height_m])


@cache
def both(seed: int) -> tuple[Intrinsics, Mounting, Mounting, Joint]:
    """The board's lens, the mounting with it as it is, and with it refined."""
    lens = board_lens(seed)
    views = looks(TRUE, seed)
    alone, _ = from_grid(lens.camera, views, TILE_M, (ROLL_RAD, PITCH_RAD))
    found, _ = from_grid(lens.camera, views, TILE_M, (ROLL_RAD, PITCH_RAD), lens.cov)
    assert found.joint is not None
    return lens, alone, found, found.joint


def test_the_ceiling_bends_less_than_with_the_boards_lens() -> None:
    true = on_ceiling(TRUE, np.array([ROLL_RAD, PITCH_RAD, HEIGHT_M]))
    before, after = [], []
    for seed in SEEDS:
        lens, alone, found, joint = both(seed)
        before.append(on_ceiling(lens.camera, level_of(alone)) - true)
        after.append(on_ceiling(joint.camera, level_of(found)) - true)
    ratio = np.sqrt(np.mean(np.square(after)) / np.mean(np.square(before)))
    assert ratio < 0.5, ratio


def test_sigma_is_that_of_the_errors() -> None:
    z = []
    for seed in SEEDS:
        _, _, found, joint = both(seed)
        assert joint.agrees
        off = np.concatenate(
            [
                (parameters_of(joint.camera) - parameters_of(TRUE)) / np.sqrt(np.diag(joint.lens_cov)),
                (level_of(found) - [ROLL_RAD, PITCH_RAD, HEIGHT_M]) / found.sigma,
            ]
        )
        z.append(off)
    assert np.mean(np.abs(z) < 3.0) >= 0.95
    assert 0.6 < np.sqrt(np.mean(np.square(z))) < 1.4


def test_a_grid_that_contradicts_the_board_is_not_believed() -> None:
    """The lens was turned after the board: 1 % of focal length and some distortion."""
    lens = board_lens(0)
    k1, *rest = TRUE.distortion
    other = replace(TRUE, fx_px=1.01 * TRUE.fx_px, fy_px=1.01 * TRUE.fy_px, distortion=(k1 + 0.03, *rest))
    found, _ = from_grid(lens.camera, looks(other, 0), TILE_M, (ROLL_RAD, PITCH_RAD), lens.cov)
    assert found.joint is not None and not found.joint.agrees
    unrefined, _ = from_grid(lens.camera, looks(other, 0), TILE_M, (ROLL_RAD, PITCH_RAD))
    np.testing.assert_allclose(level_of(found), level_of(unrefined), atol=1e-12)


@pytest.mark.usefixtures("short")
def test_the_refined_lens_is_the_calibrations_until_the_board_is_measured_anew(
    run: Run, known_lens: Session, tmp_path: Path
) -> None:
    lens = known_lens.result("intrinsics")
    assert lens is not None
    sigma = np.array([0.1, 0.1, 0.1, 0.1, 1e-3, 2e-3, 5e-5, 5e-5, 2e-3])
    lens["camera"]["fx_px"] += 0.1
    Session(known_lens.folder, force=True).save("intrinsics", lens | {"cov": np.diag(sigma**2)})
    code, out, err = run("projection", "--simulate")
    assert code == 0 and "refined on the grid" in out, out + err
    refined = json.loads((known_lens.folder / "projection.json").read_text())["lens"]
    file = known_lens.folder / "calibration.yaml"
    assert read_calibration(file).camera.fx_px == refined["camera"]["fx_px"] != lens["camera"]["fx_px"]
    assert read_calibration(file).meta["intrinsics"]["sigma"] == refined["sigma"]
    assert run("mount", "--simulate")[0] == 0
    lens["camera"]["fx_px"] += 0.1
    Session(known_lens.folder, force=True).save("intrinsics", lens)
    assert "the lens was measured anew since: 'calib projection --force'" in update_file(known_lens)
    assert read_calibration(file).camera.fx_px == lens["camera"]["fx_px"]
