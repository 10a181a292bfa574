"""Every kind of board in pictures of known poses: all found, where they are; and what is said where one is not."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from ceilvo.calib.evaluate.coverage import coverage, light_of, lighter
from ceilvo.calib.practice.virtual_bench import VirtualBench
from ceilvo.calib.practice.virtual_board import BoardRenderer, board_poses
from ceilvo.calib.solve.intrinsics import Shot
from ceilvo.calib.targets.board import TAGS, Board
from ceilvo.calib.targets.finder import BoardFinder, other_board
from ceilvo.sim.rig import simulated_camera

Array = NDArray[np.float64]
Gray = NDArray[np.uint8]
Run = Callable[..., tuple[int, str, str]]

CAMERA = simulated_camera()
BOARDS = {
    "chessboard": (Board(), 0.12),
    "charuco": (Board("charuco", 9, 7, 0.03, 0.02), 0.12),
    "legacy": (Board("charuco", 9, 6, 0.03, 0.02, legacy=True), 0.12),
    "aprilgrid": (Board("aprilgrid", 6, 4, 0.04, 0.04 / 1.3, TAGS), 0.12),
    "circles": (Board("circles", 9, 6, 0.03, 0.015), 0.15),
    "acircles": (Board("acircles", 4, 11, 0.02, 0.016), 0.30),
}
"""With the median error in px that is allowed: a disc's middle in the picture is not the picture of its middle."""


def rendered(board: Board, count: int, seed: int = 1, farther: float = 1.0) -> list[tuple[Gray, Array]]:
    rng = np.random.default_rng(seed)
    draw = BoardRenderer(CAMERA, board)
    out = []
    for pose in board_poses(CAMERA, board, count, rng):
        pose[3:] *= farther
        out.append((draw(pose, rng), pose))
    return out


@pytest.mark.parametrize("name", BOARDS)
def test_corners_are_found_where_they_are(name: str) -> None:
    board, allowed = BOARDS[name]
    finder, off = BoardFinder(board), []
    for gray, pose in rendered(board, 6):
        seen = finder(gray)
        if not seen.ok:
            continue
        true = CAMERA.pixels(board.corners_m[seen.ids] @ cv2.Rodrigues(pose[:3])[0].T + pose[3:])
        away = np.hypot(*(seen.uv_px - true).T)
        if np.median(away) > 5 and not board.marked:  # turned by half it looks the same
            away = np.hypot(*(seen.uv_px[::-1] - true).T)
        off.append(float(np.median(away)))
    assert len(off) >= 5 and max(off) < allowed, (name, off)


def test_a_part_of_an_aprilgrid_is_enough() -> None:
    board, _ = BOARDS["aprilgrid"]
    gray, pose = rendered(board, 1)[0]
    true = CAMERA.pixels(board.corners_m @ cv2.Rodrigues(pose[:3])[0].T + pose[3:])
    gray = gray.copy()
    gray[:, : int(np.median(true[:, 0]))] = 90
    seen = BoardFinder(board)(gray)
    assert seen.ok and 8 <= len(seen.ids) <= 60
    assert float(np.median(np.hypot(*(seen.uv_px - true[seen.ids]).T))) < 0.12


@pytest.mark.parametrize("turn", range(4))
@pytest.mark.parametrize("border", [1, 2])
def test_tags_of_other_printers_are_understood(turn: int, border: int) -> None:
    """Printed with another border, turned in their cells, and numbered from the top: whatever programs do."""
    words = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11)
    columns, rows, side, gap = 4, 3, 100, 30
    picture = np.full((rows * (side + gap) + 200, columns * (side + gap) + 200), 255, np.uint8)
    for tag in range(columns * rows):
        j, i = divmod(tag, columns)
        x, y = 100 + i * (side + gap), 100 + j * (side + gap)
        drawn = np.rot90(words.generateImageMarker(tag, side, borderBits=border), turn)
        picture[y : y + side, x : x + side] = drawn
    board = Board("aprilgrid", columns, rows, 0.013, 0.010, TAGS)
    seen = BoardFinder(board)(np.asarray(cv2.GaussianBlur(picture, (0, 0), 0.7) // 5 * 4, np.uint8))
    assert seen.ok and len(seen.ids) == 4 * columns * rows
    h, _ = cv2.findHomography(board.corners_m[seen.ids, :2], seen.uv_px)
    p = np.column_stack([board.corners_m[seen.ids, :2], np.ones(len(seen.ids))]) @ h.T
    assert np.hypot(*(p[:, :2] / p[:, 2:] - seen.uv_px).T).max() < 1.0


def test_no_visible_chessboard_is_dropped() -> None:
    """Farther off than a careful person holds it; OpenCV's quick check alone misses some of them."""
    board = BOARDS["chessboard"][0]
    pictures = [g for far in (1.0, 1.6, 2.2) for g, _ in rendered(board, 8, 7, far)]
    finder = BoardFinder(board)
    passed = sum(bool(cv2.checkChessboard(g, (9, 6))) for g in pictures)
    found = sum(finder(g).ok for g in pictures)
    assert found == len(pictures) > passed, (found, passed)


@pytest.mark.parametrize(
    ("said", "hint"),
    [
        (Board("charuco", 7, 9, 0.03, 0.02), "9 x 7 squares, expected 7 x 9; give --columns 9 --rows 7"),
        (Board("charuco", 9, 6, 0.03, 0.02), "9 x 6 squares, legacy pattern, expected 9 x 6; give --columns 9"),
    ],
    ids=["swapped", "legacy"],
)  # fmt: skip
def test_another_charuco_is_named_as_another_chessboard_is(said: Board, hint: str) -> None:
    true = BOARDS["charuco" if said.rows == 9 else "legacy"][0]
    gray, _ = rendered(true, 1)[0]
    assert hint in other_board(said, gray)
    reason = BoardFinder(said)(gray).reason
    assert "markers" in reason or "corners seen" in reason, reason


def test_a_swapped_charuco_is_named_by_the_command(run: Run, tmp_path: Path) -> None:
    for i, (gray, _) in enumerate(rendered(BOARDS["charuco"][0], 3)):
        (tmp_path / "i").mkdir(exist_ok=True)
        cv2.imwrite(str(tmp_path / "i" / f"{i}.png"), gray)
    options = ["--board", "charuco", "--columns", "7", "--rows", "9", "--square-mm", "30", "--marker-mm", "20"]
    code, _, err = run("intrinsics", "--images", str(tmp_path / "i"), *options)
    assert code == 78 and "found a board of 9 x 7 squares, expected 7 x 9; give --columns 9 --rows 7" in err, err


def test_a_sharp_picture_without_a_board_is_not_called_blurred() -> None:
    finder = BoardFinder(Board())
    ceiling = next(iter(VirtualBench().places(1))).gray
    faint = np.full((480, 640), 60, np.uint8)
    faint[:, 200:] = 110  # one sharp step, and light that falls off over the whole picture
    faint = np.asarray(np.clip(faint + np.linspace(0, 120, 640)[None], 0, 255), np.uint8)
    for gray in (ceiling, faint):
        assert finder(gray).reason == "board not seen as a whole"
    soft = np.asarray(cv2.GaussianBlur(faint, (0, 0), 6.0), np.uint8)
    assert "blurred" in finder(soft).reason


def test_neighbours_of_a_film_are_left_out(run: Run, tmp_path: Path) -> None:
    """A video of eight poses, each held for five frames."""
    board = Board()
    film = cv2.VideoWriter(str(tmp_path / "v.avi"), cv2.VideoWriter_fourcc(*"MJPG"), 10.0, (640, 480))
    rng = np.random.default_rng(3)
    draw = BoardRenderer(CAMERA, board)
    for pose in board_poses(CAMERA, board, 8, rng):
        for _ in range(5):
            film.write(cv2.cvtColor(draw(pose, rng), cv2.COLOR_GRAY2BGR))
    film.release()
    _, _, err = run("intrinsics", "--images", str(tmp_path / "v.avi"), "--model", "pinhole")
    assert "8 pictures used, 0 rejected, 32 left out that are like others" in err, err


def test_the_black_rim_of_a_fisheye_is_not_missing() -> None:
    """A circle of 460 px in a picture of 640 x 480: corners only inside of it."""
    size, rng = (640, 480), np.random.default_rng(2)
    v, u = np.mgrid[:480, :640]
    inside = np.hypot(u - 320, v - 240) < 230
    gray = np.asarray(np.where(inside, rng.integers(60, 120, inside.shape), 3), np.uint8)
    board = Board()
    shots = []
    camera = replace(simulated_camera(), fx_px=200.0, fy_px=200.0, distortion=(0.0,) * 5)
    for k, (i, j) in enumerate((i, j) for i in (-1, 0, 1) for j in (-1, 0, 1)):
        rot = cv2.Rodrigues(np.array([0.4 * (k % 3 - 1), 0.4 * (k % 2), 0.0]))[0]
        at = np.array([0.115 * i - 0.1, 0.115 * j - 0.06, 0.22 + 0.01 * k])
        uv = camera.pixels(board.corners_m @ rot.T + at)
        keep = np.hypot(*(uv - [320, 240]).T) < 225
        shots.append(Shot(str(k), board.corners_m[keep], uv[keep]))
    light = lighter(None, light_of(gray))
    assert coverage(shots, size).missing(), "with the rim counted it can never pass"
    covered = coverage(shots, size, light)
    assert covered.missing() == [] and 0.4 < covered.lit.mean() < 0.9, covered.text
    left = [Shot(s.name, s.xyz_m[m], s.uv_px[m]) for s in shots if (m := s.uv_px[:, 0] < 330).sum() > 8]
    assert any("right" in line for line in coverage(left, size, light).missing())


def test_a_dark_wall_inside_the_picture_still_counts() -> None:
    gray = np.full((480, 640), 100, np.uint8)
    gray[160:320, 240:480] = 2
    assert coverage([], (640, 480), light_of(gray)).lit.all()
