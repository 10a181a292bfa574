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
"""Of the board's picture."""
_FINE = 4
"""Texels drawn for one, along each axis: cells of markers end anywhere."""
_SUPER = 2
"""Rays a pixel along each axis, averaged."""


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
    x0, y0, x1, y1 = board.extent_m
    fine = drawn(board, _FINE * k)
    size = (round((x1 - x0) * k), round((y1 - y0) * k))
    inner = cv2.resize(fine, size, interpolation=cv2.INTER_AREA)
    whole = cv2.copyMakeBorder(np.asarray(inner, np.uint8), n, n, n, n, cv2.BORDER_CONSTANT, value=255)
    picture = 25.0 + whole.astype(np.float32) * (185.0 / 255.0)
    kx, ky = size[0] / (x1 - x0), size[1] / (y1 - y0)
    texel_from_board = np.array([[kx, 0, n - 0.5 - kx * x0], [0, ky, n - 0.5 - ky * y0], [0, 0, 1.0]])
    return np.asarray(picture, np.float32), texel_from_board


def drawn(board: Board, texels_per_m: float) -> Gray:
    """All that is black on the board, from its upper left to its lower right, to a whole texel."""
    x0, y0, x1, y1 = board.extent_m
    k = texels_per_m
    out = np.full((round((y1 - y0) * k), round((x1 - x0) * k)), 255, np.uint8)
    rects, discs = board.shapes
    for r in rects:
        a, b = round((r.x - x0) * k), round((r.y - y0) * k)
        out[b : round((r.y + r.height - y0) * k), a : round((r.x + r.width - x0) * k)] = 0
    shift = 4  # of fixed point; a texel's middle is at half a texel
    for d in discs:
        at = tuple(round(((v - o) * k - 0.5) * 2**shift) for v, o in ((d.x, x0), (d.y, y0)))
        cv2.circle(out, at, round(d.radius * k * 2**shift), 0, -1, cv2.LINE_8, shift)
    return out


def board_poses(camera: CameraModel, board: Board, count: int, rng: np.random.Generator) -> Iterator[Array]:
    """Poses that a careful person would hold the board in: everywhere, leaning every way, near and far."""
    xyz = whole = board.corners_m
    if board.kind in ("circles", "acircles"):  # a disc must be in the picture as a whole, its middle is not enough
        x0, y0, x1, y1 = board.extent_m
        whole = np.vstack([xyz, [[x0, y0, 0.0], [x1, y0, 0.0], [x0, y1, 0.0], [x1, y1, 0.0]]])
    centre = np.append(np.mean(np.reshape(board.extent_m, (2, 2)), axis=0), 0.0)
    tall = float(np.ptp(xyz[:, 1])) * camera.width_px / camera.height_px
    width = max(float(np.ptp(xyz[:, 0])), tall) + 2 * board.square_m
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
        uv = camera.pixels(whole @ rot.T + t)
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
