"""The steps of calib as a person meets them: bad input, interruption, a full disk, resuming, force."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from ceilvo.bench.data import data_path
from ceilvo.calib.practice.virtual_bench import VirtualBench
from ceilvo.calib.practice.virtual_board import BoardRenderer, board_poses
from ceilvo.calib.session.session import Session
from ceilvo.calib.solve.intrinsics import Shot, calibrate
from ceilvo.calib.targets.board import Board
from ceilvo.calib.targets.finder import BoardFinder
from ceilvo.calibration_file import read_calibration
from ceilvo.camera import CameraModel
from ceilvo.errors import CalibrationError
from ceilvo.sim.rig import simulated_camera

Gray = NDArray[np.uint8]

CAMERA = simulated_camera(width_px=480, height_px=360)
BOARD = Board()


def draw(board: Board = BOARD, count: int = 12, camera: CameraModel = CAMERA) -> list[Gray]:
    rng = np.random.default_rng(3)
    renderer = BoardRenderer(camera, board)
    return [renderer(p, rng, 0.5) for p in board_poses(camera, board, count, rng)]


@pytest.fixture(scope="module")
def shots() -> list[Gray]:
    return draw(count=16)


Run = Callable[..., tuple[int, str, str]]


def folder(path: Path, images: list[Gray]) -> Path:
    path.mkdir(parents=True, exist_ok=True)
    for i, image in enumerate(images):
        cv2.imwrite(str(path / f"{i:03d}.png"), image)
    return path


def intrinsics(run: Run, images: Path, *more: str) -> tuple[int, str, str]:
    return run("intrinsics", "--images", str(images), "--model", "pinhole", *more)


def test_a_folder_of_pictures_gives_the_lens(run: Run, tmp_path: Path, shots: list[Gray]) -> None:
    code, out, _ = intrinsics(run, folder(tmp_path / "i", shots))
    result = json.loads((tmp_path / "s" / "intrinsics.json").read_text())
    assert (code, "PASS  next: calib projection" in out) == (0, True), out
    assert abs(result["camera"]["fx_px"] - CAMERA.fx_px) < 4 * result["sigma"][0] + 0.3
    assert (tmp_path / "s" / "intrinsics" / "coverage.png").exists()


def test_every_rejected_picture_has_its_reason(run: Run, tmp_path: Path, shots: list[Gray]) -> None:
    bright = np.asarray(cv2.convertScaleAbs(shots[0], alpha=4.0), np.uint8)
    soft = np.asarray(cv2.GaussianBlur(shots[1], (0, 0), 5), np.uint8)
    empty = np.full_like(shots[0], 120) + np.random.default_rng(1).integers(0, 9, shots[0].shape, np.uint8)
    small = np.asarray(cv2.resize(shots[2], (320, 240)), np.uint8)
    dark = np.asarray(shots[0] // 16, np.uint8)
    images = folder(tmp_path / "i", [*shots, bright, soft, empty, small, dark])
    (images / "099.png").write_bytes(b"no picture")
    code, _, err = intrinsics(run, images)
    assert code == 0, err
    for name, reason in (
        ("016", "saturated"),
        ("017", "blurred"),
        ("018", "board not seen"),
        ("019", "is 320 x 240 px, the others are 480 x 360"),
        ("020", "too dark"),
        ("099", "no image that OpenCV can read"),
    ):
        assert any(f"{name}.png: rejected" in line and reason in line for line in err.splitlines()), (name, reason, err)


def test_a_board_that_is_never_seen_is_said_so(run: Run, tmp_path: Path) -> None:
    plain = [np.full((360, 480), 100, np.uint8)] * 3
    code, _, err = intrinsics(run, folder(tmp_path / "i", plain))
    assert code == 78
    assert "in none of 3 pictures" in err and "whole board must be in the picture" in err


def test_a_board_of_another_size_is_recognised(run: Run, tmp_path: Path) -> None:
    code, _, err = intrinsics(
        run, folder(tmp_path / "i", draw(Board(columns=7, rows=5), 1, simulated_camera(width_px=240, height_px=180)))
    )
    assert code == 78
    assert "found a board of 7 x 5 inner corners, expected 9 x 6" in err


def test_too_few_pictures_are_kept_for_the_next_run(run: Run, tmp_path: Path, shots: list[Gray]) -> None:
    images = folder(tmp_path / "i", shots[:4])
    code, _, err = intrinsics(run, images)
    assert code == 78 and "found 4 usable pictures, expected at least 6" in err
    folder(images, shots)
    code, _, err = intrinsics(run, images)
    assert "going on with 4 pictures of the run before" in err
    assert code == 0, err


def test_no_camera_is_one_clear_line(run: Run) -> None:
    code, _, err = run("intrinsics", "--device", "/dev/video-none")
    assert code != 0 and "/dev/video-none" in err and len(err.strip().splitlines()) == 1


def test_no_source_is_one_clear_line(run: Run) -> None:
    code, _, err = run("intrinsics")
    assert code == 78 and "found none of --config, --device, --images and --simulate" in err


def test_a_missing_or_empty_folder_is_named(run: Run, tmp_path: Path) -> None:
    (tmp_path / "empty").mkdir()
    for name in ("none", "empty"):
        code, _, err = intrinsics(run, tmp_path / name)
        assert code != 0 and str(tmp_path / name) in err


def test_a_result_is_not_replaced_unasked_and_kept_when_it_is(run: Run, tmp_path: Path, shots: list[Gray]) -> None:
    images = folder(tmp_path / "i", shots)
    assert intrinsics(run, images)[0] == 0
    before = (tmp_path / "s" / "intrinsics.json").read_bytes()
    code, _, err = intrinsics(run, images)
    assert code == 78 and "pass --force" in err
    assert (tmp_path / "s" / "intrinsics.json").read_bytes() == before
    assert intrinsics(run, images, "--force", "--keep-all")[0] == 0
    assert (tmp_path / "s" / "intrinsics.json.bak").read_bytes() == before


def test_samples_of_another_board_are_not_mixed_in(run: Run, tmp_path: Path, shots: list[Gray]) -> None:
    images = folder(tmp_path / "i", shots[:4])
    intrinsics(run, images)
    code, _, err = intrinsics(run, images, "--square-mm", "30")
    assert code == 78 and "samples of another board" in err


def test_a_square_in_the_wrong_unit_is_asked_about(run: Run, tmp_path: Path, shots: list[Gray]) -> None:
    code, _, err = intrinsics(run, folder(tmp_path / "i", shots[:1]), "--square-mm", "25000")
    assert code == 78 and "is it in millimetres" in err


def test_a_step_that_comes_too_early_says_which_is_missing(run: Run) -> None:
    for step in ("projection", "mount"):
        code, _, err = run(step, "--simulate")
        assert code == 78 and "run 'calib intrinsics' first" in err
    code, _, err = run("report")
    assert code == 78 and "run 'calib intrinsics' first" in err


# -- a session in which the lens is known


@pytest.mark.usefixtures("known_lens", "short")
def test_from_lens_to_report_on_the_virtual_bench(run: Run, tmp_path: Path, bench: VirtualBench) -> None:
    for step in ("projection", "mount", "sigma", "survey", "check"):
        code, out, err = run(step, "--simulate")
        assert code == 0 and "PASS  next: calib" in out, f"{step}: {out} {err}"
    code, out, err = run("report")
    assert code == 0, out + err
    found, true = read_calibration(tmp_path / "s" / "calibration.yaml"), bench.rig
    assert abs(found.ceiling_height_m - true.ceiling_height_m) < 0.003
    assert np.abs(found.mount_xy_m - true.mount_xy_m).max() < 0.003
    assert np.abs(found.camera_from_base - true.camera_from_base).max() < np.radians(0.1)
    assert found.tile_m == 0.6
    page = (tmp_path / "s" / "report.html").read_text()
    assert page.count(">PASS</span>") == 6 + 1, "on top of each part, and the whole"
    assert page.count("<td>PASS</td>") == 6 and ">scale confirmed</span>" in page
    assert "data:image/jpeg;base64" in page and page.count("<svg") == 3  # of the mount, and two of the noise
    assert "src='http" not in page and "href='http" not in page
    assert page.count("by an earlier version") == 1  # the lens, which this test was given


@pytest.mark.usefixtures("short")
def test_a_knocked_camera_is_stale(run: Run, tmp_path: Path, projected: Path) -> None:
    """The calibration of a camera that leaned one degree differently."""
    shutil.copytree(projected, tmp_path / "s")
    result = json.loads((tmp_path / "s" / "projection.json").read_text())
    result["pitch_rad"] += np.radians(1.0)
    result["height_m"] *= 1.05
    (tmp_path / "s" / "projection.json").write_text(json.dumps(result))
    (tmp_path / "s" / "calibration.yaml").unlink()
    run("mount", "--simulate")
    code, out, _ = run("check", "--simulate")
    assert code == 1
    assert "stale, because the ceiling is" in out and "stale, because the camera leans" in out


@pytest.mark.usefixtures("known_lens", "short")
def test_an_edited_calibration_is_not_replaced_unasked(run: Run, tmp_path: Path) -> None:
    file = tmp_path / "s" / "calibration.yaml"
    file.write_text("mine\n")
    code, _, err = run("projection", "--simulate")
    assert code == 78 and "the result is kept, pass --force" in err
    assert file.read_text() == "mine\n"
    assert run("projection", "--simulate", "--force")[0] == 0
    assert (tmp_path / "s" / "calibration.yaml.bak").read_text() == "mine\n"


@pytest.mark.usefixtures("known_lens")
@pytest.mark.parametrize(
    ("tile", "reason"),
    [("600", "looks like millimetres; expected 0.6"), ("0.01", "expected 0.05 to 10"), ("", "--tile-m")],
)
def test_a_wrong_tile_is_refused(run: Run, tmp_path: Path, tile: str, reason: str) -> None:
    images = folder(tmp_path / "i", [np.zeros((360, 480), np.uint8)])
    code, _, err = run("projection", "--images", str(images), *(["--tile-m", tile] if tile else []))
    assert code == 78 and reason in err


@pytest.mark.usefixtures("known_lens")
def test_pictures_of_another_size_than_the_lens_are_rejected(run: Run, tmp_path: Path) -> None:
    images = folder(tmp_path / "i", [np.full((240, 320), 100, np.uint8)])
    code, _, err = run("projection", "--images", str(images), "--tile-m", "0.6")
    assert code == 78 and "is 320 x 240 px, the lens has 480 x 360" in err


@pytest.mark.usefixtures("known_lens")
def test_a_blank_ceiling_is_said_so(run: Run, tmp_path: Path) -> None:
    rng = np.random.default_rng(1)
    images = folder(tmp_path / "i", [rng.integers(90, 110, (360, 480), np.uint8)])
    code, _, err = run("projection", "--images", str(images), "--tile-m", "0.6")
    assert code == 78 and "found no usable picture" in err


def test_a_sample_that_was_cut_short_is_left_out(tmp_path: Path) -> None:
    session = Session(tmp_path)
    session.samples("x", {"of": 1})
    session.add_sample("x", {"n": 1})
    with (tmp_path / "x.samples.jsonl").open("a") as f:
        f.write('{"n": 2, "uv')
    session.add_sample("x", {"n": 3})
    assert Session(tmp_path).samples("x", {"of": 1}) == [{"n": 1}, {"n": 3}]


def test_a_damaged_result_is_named(tmp_path: Path) -> None:
    (tmp_path / "mount.json").write_text("{")
    with pytest.raises(CalibrationError, match=r"mount\.json: cannot be read"):
        Session(tmp_path).result("mount")


CHESSBOARD = data_path("chessboard")


@pytest.mark.skipif(not CHESSBOARD.is_dir(), reason="CEILVO_DATA does not name the recordings")
def test_the_published_chessboard_is_reproduced(run: Run, tmp_path: Path) -> None:
    """OpenCV's left_intrinsics.yml was made with windows of 11 px, which reach the next corners."""
    _, _, err = intrinsics(run, CHESSBOARD, "--window-px", "11", "--keep-all")
    assert "13 pictures used" in err
    r = json.loads((tmp_path / "s" / "intrinsics.json").read_text())
    c = r["camera"]
    assert abs(c["fx_px"] - 535.9157) < 0.3 and abs(c["fy_px"] - 535.9157) < 0.3
    assert abs(c["cx_px"] - 342.2832) < 0.3 and abs(c["cy_px"] - 235.5708) < 0.3
    assert r["rms_px"] <= 0.42
    print(r["problems"])
    assert all("is known to" in p for p in r["problems"]), "the corners that ran away tell in sigma"


@pytest.mark.skipif(not CHESSBOARD.is_dir(), reason="CEILVO_DATA does not name the recordings")
def test_the_published_chessboard_differs_by_corners_that_ran_away(run: Run, tmp_path: Path) -> None:
    """Windows of 11 px move 15 of 702 corners by up to 6 px; without those corners they give the default's lens."""
    code, _, err = intrinsics(run, CHESSBOARD)
    assert code == 0, err
    default = json.loads((tmp_path / "s" / "intrinsics.json").read_text())
    assert default["rms_px"] <= 0.18 and not default["dropped"]
    narrow, wide = BoardFinder(BOARD), BoardFinder(BOARD, 11)
    shots, away = [], 0
    for path in sorted(CHESSBOARD.glob("*.jpg")):
        gray = np.asarray(cv2.imread(str(path), cv2.IMREAD_GRAYSCALE), np.uint8)
        a, b = narrow(gray), wide(gray)
        same = np.hypot(*(a.uv_px - b.uv_px).T) < 0.5
        away += int(np.sum(~same))
        shots.append(Shot(path.name, BOARD.corners_m[b.ids[same]], b.uv_px[same]))
    assert away == 15
    c = calibrate(shots, (640, 480), "pinhole", keep_all=True).camera
    found = default["camera"]
    for name in ("fx_px", "fy_px", "cx_px", "cy_px"):
        assert abs(getattr(c, name) - found[name]) < 0.3, name


@pytest.mark.parametrize("kind", ["chessboard", "charuco"])
def test_corners_are_found_where_they_are(kind: str) -> None:
    board = Board() if kind == "chessboard" else Board("charuco", 9, 7, 0.03, 0.02)
    rng = np.random.default_rng(1)
    camera = simulated_camera()
    finder, renderer = BoardFinder(board), BoardRenderer(camera, board)
    off = []
    for pose in board_poses(camera, board, 4, rng):
        seen = finder(renderer(pose, rng))
        if not seen.ok:
            continue
        points = board.corners_m[seen.ids] @ cv2.Rodrigues(pose[:3])[0].T + pose[3:]
        away = seen.uv_px - camera.pixels(points)
        if np.median(np.hypot(*away.T)) > 5:  # a chessboard turned by half looks the same
            away = seen.uv_px[::-1] - camera.pixels(points)
        off.append(np.median(np.hypot(*away.T)))
    assert len(off) >= 3 and max(off) < 0.15
