"""Shots of a calibration board as a simulated camera would take them, for practice and for tests."""

from __future__ import annotations

from collections.abc import Iterator

import cv2
import numpy as np
from numpy.typing import NDArray

from ceilvo.calib.targets.board import Board
from ceilvo.calib.targets.sources import Picture
from ceilvo.camera import CameraModel

Array = NDArray[np.float64]
Gray = NDArray[np.uint8]

_SQUARE_TEXELS = 64
_SUPER = 2


class BoardRenderer:
    """Draws one board through one lens."""

    def __init__(self, camera: CameraModel, board: Board) -> None:
        self._camera, self._board = camera, board
        self._picture, self._texel_from_board = _texture(board)
        n, w, h = _SUPER, camera.width_px, camera.height_px
        x = (np.arange(w * n) + 0.5) / n - 0.5
        y = (np.arange(h * n) + 0.5) / n - 0.5
        grid = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
        self._rays = camera.rays(grid).astype(np.float32)

    def __call__(self, pose: Array, rng: np.random.Generator, blur_px: float = 0.5, noise: float = 1.5) -> Gray:
        """A (H, W) picture; pose (6,) camera_from_board rotation vector and translation, m."""
        rot = cv2.Rodrigues(pose[:3])[0]
        board_from_ray = np.linalg.inv(np.column_stack([rot[:, 0], rot[:, 1], pose[3:]]))
        p = self._rays @ (self._texel_from_board @ board_from_ray).T.astype(np.float32)
        at = np.where(p[:, 2:] > 1e-9, p[:, :2] / np.where(p[:, 2:] > 1e-9, p[:, 2:], 1.0), -1e3).astype(np.float32)
        w, h = self._camera.width_px, self._camera.height_px
        at = at.reshape(h * _SUPER, w * _SUPER, 2)
        fine = cv2.remap(self._picture, at[..., 0], at[..., 1], cv2.INTER_LINEAR, borderValue=90.0)
        image = cv2.resize(fine, (w, h), interpolation=cv2.INTER_AREA)
        if blur_px > 0:
            image = cv2.GaussianBlur(image, (0, 0), blur_px)
        return np.asarray(np.clip(image + rng.normal(0.0, noise, image.shape), 0, 255), np.uint8)


def _texture(board: Board) -> tuple[NDArray[np.float32], Array]:
    """Picture of the board with a white margin of a square, and texel_from_board for homogeneous board metres."""
    n = _SQUARE_TEXELS
    k = n / board.square_m
    if board.kind == "charuco":
        size = (board.columns * n, board.rows * n)
        inner = board.charuco.generateImage(size)
        first = 0
    else:
        c, r = board.columns + 1, board.rows + 1
        inner = np.kron(np.indices((r, c)).sum(axis=0) % 2, np.ones((n, n))).astype(np.uint8) * 255
        first = n  # corner (0, 0) is one square in
    whole = cv2.copyMakeBorder(np.asarray(inner, np.uint8), n, n, n, n, cv2.BORDER_CONSTANT, value=255)
    picture = 25.0 + whole.astype(np.float32) * (185.0 / 255.0)
    o = n + first - 0.5
    return np.asarray(picture, np.float32), np.array([[k, 0, o], [0, k, o], [0, 0, 1.0]])


def board_poses(camera: CameraModel, board: Board, count: int, rng: np.random.Generator) -> Iterator[Array]:
    """Poses that a careful person would hold the board in: everywhere, leaning every way, near and far."""
    xyz = board.corners_m
    centre = xyz.mean(axis=0)
    width = float(np.ptp(xyz[:, 0])) + 2 * board.square_m
    spots = np.array([[0, 0], [-1, -1], [1, -1], [-1, 1], [1, 1], [0, -1], [0, 1], [-1, 0], [1, 0]])
    made = 0
    for _ in range(200 * count):
        if made >= count:
            return
        lean = np.radians(rng.uniform(10, 38)) * (made % 4 != 0)
        axis = rng.uniform(0, 2 * np.pi)
        rot = cv2.Rodrigues(lean * np.array([np.cos(axis), np.sin(axis), 0.0]))[0]
        rot = rot @ cv2.Rodrigues(np.array([0, 0, rng.uniform(-0.5, 0.5)]))[0]
        filled = rng.uniform(0.42, 0.75)
        spot = spots[made % 9] * rng.uniform(0.35, 0.8, 2)
        mid = np.array([camera.width_px - 1.0, camera.height_px - 1.0]) / 2
        ray = camera.rays((mid + spot * mid)[None])[0]
        distance = width * camera.fx_px / (filled * camera.width_px)
        where = ray / max(ray[2], 0.2) * distance
        t = where - rot @ centre
        uv = camera.pixels(xyz @ rot.T + t)
        room = 6.0
        if (
            np.isfinite(uv).all()
            and (uv > room).all()
            and (uv < [camera.width_px - room, camera.height_px - room]).all()
        ):
            made += 1
            yield np.concatenate([np.ravel(cv2.Rodrigues(rot)[0]), t])


def board_shots(camera: CameraModel, board: Board, count: int, seed: int, mishaps: bool = True) -> Iterator[Picture]:
    """Pictures; with mishaps a blurred, an empty and a saturated one are among them, as in real life."""
    rng = np.random.default_rng([seed, 0xB0A2D])
    draw = BoardRenderer(camera, board)
    for i, pose in enumerate(board_poses(camera, board, count, rng)):
        if mishaps and i == 3:
            yield Picture("shot 3 moved", i, draw(pose, rng, blur_px=4.5))
        if mishaps and i == 7:
            yield Picture("shot 7 elsewhere", i, draw(pose + np.array([0, 0, 0, 9.0, 0, 0]), rng))
        if mishaps and i == 11:
            bright = cv2.convertScaleAbs(draw(pose, rng), alpha=3.0)
            yield Picture("shot 11 bright", i, np.asarray(bright, np.uint8))
        yield Picture(f"shot {i}", i, draw(pose, rng))
