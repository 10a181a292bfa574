"""Honest scale: a wrong tile is caught by every second source, a right one passes, and without one it is said."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from ceilvo.calib.commands.calibration_file import describe
from ceilvo.calib.evaluate import scale
from ceilvo.calib.practice import virtual_bench
from ceilvo.calib.practice.virtual_bench import VirtualBench
from ceilvo.calib.solve.grid import from_grid
from ceilvo.calib.study import scale as study
from ceilvo.calib.targets.ceiling_view import CeilingReader, GridView
from ceilvo.calib.targets.sources import Picture
from ceilvo.calibration import Calibration
from ceilvo.calibration_check import scale_of
from ceilvo.calibration_file import parse_calibration, read_calibration, render_calibration
from ceilvo.sim.rig import simulated_calibration

Array = NDArray[np.float64]
Gray = NDArray[np.uint8]
Run = Callable[..., tuple[int, str, str]]
Stock = dict[str, list[Picture]]

RIGHT, WRONG = "0.6", ("0.625", "0.576", "0.5", "0.7", "0.3", "0.9")
"""Tiles of 0.6 m; 4 %, 17 % and 50 % off either way."""


@pytest.fixture(scope="module")
def views(bench: VirtualBench, stock: Stock) -> list[GridView]:
    reader = CeilingReader(bench.rig.camera)
    return [v for v in (reader(p.gray) for p in stock["places"]) if v.ok]


def pixels(rig: Calibration, xyz: Array) -> Array:
    """The rig's truth, independent of what calib finds."""
    eye = np.array([*rig.mount_xy_m, -rig.ceiling_height_m])
    return rig.camera.pixels((xyz - eye) @ rig.camera_from_base.T)


def scales_of(rig: Calibration, views: list[GridView], tile_m: float) -> dict[str, scale.Scale]:
    """All three sources without an error of their own."""
    found, _ = from_grid(rig.camera, views, tile_m, (0.0, 0.0))
    level = np.array([found.roll_rad, found.pitch_rad, found.height_m])
    marks = np.array([[0.3, 0.4, 0.0], [-0.3, -0.3, 0.0], [0.0, 0.1, 0.0]])
    by_marks = scale.by_marks(rig.camera, level, [(marks, pixels(rig, marks))], scale.CLICK_PX)
    assert by_marks is not None
    run_m = 2.4 * found.height_m / rig.ceiling_height_m
    return {
        "height": scale.by_height(found.height_m, float(found.sigma[2]), rig.ceiling_height_m),
        "marks": by_marks,
        "wheels": scale.by_wheels(run_m, run_m / 2.4, 0.001),
    }


def test_the_right_tile_is_confirmed_by_each_source(bench: VirtualBench, views: list[GridView]) -> None:
    for name, found in scales_of(bench.rig, views, 0.6).items():
        assert found.confirms and abs(found.ratio - 1) < 0.003, (name, found)
        assert scale.problem(found, 0.6) == ""


@pytest.mark.parametrize("tile", WRONG)
def test_a_wrong_tile_is_caught_by_each_source(bench: VirtualBench, views: list[GridView], tile: str) -> None:
    tile_m = float(tile)
    for name, found in scales_of(bench.rig, views, tile_m).items():
        assert not found.agrees and abs(found.ratio / (tile_m / 0.6) - 1) < 0.003, (name, found)
        text = scale.problem(found, tile_m)
        assert f"the tile of {tile_m:g} m" in text and found.source in text and "a tile has 0.6" in text, text


def test_sources_that_cannot_tell_do_not_confirm() -> None:
    """Marks a hand apart, and a ceiling so low that a centimetre is four percent."""
    rig = simulated_calibration()
    near = np.array([[0.1, 0.0, 0.0], [0.15, 0.0, 0.0]])
    level = np.array([0.0, 0.0, rig.ceiling_height_m])
    marks = scale.by_marks(rig.camera, level, [(near, pixels(rig, near))], scale.CLICK_PX)
    low = scale.by_height(0.5, 0.0001, 0.5)
    assert marks is not None
    for found in (marks, low):
        assert found.agrees and not found.confirms and "decides nothing" in found.text
        assert scale.summary([found])[0] == "unconfirmed"
    assert scale.by_marks(rig.camera, level, [(near[:1], pixels(rig, near[:1]))], 0.5) is None


def test_wheels_that_differ_are_the_wheels_matter_once_a_tape_has_agreed() -> None:
    wheels, tape = scale.by_wheels(2.4, 1.05, 0.001), scale.by_height(2.2, 0.001, 2.2)
    assert scale.summary([wheels])[0] == "contradicted"
    assert scale.summary([tape, wheels])[0] == "confirmed"
    assert scale.summary([scale.by_height(2.3, 0.001, 2.2), scale.by_wheels(2.4, 1.0, 0.001)])[0] == "contradicted"


@pytest.mark.parametrize("seed", [3])
def test_right_tiles_are_seldom_refused_and_wrong_ones_caught(seed: int) -> None:
    """One rig, 200 draws of the hand's and the wheels' errors; `make bench-calib` takes forty rigs."""
    found = study.figures(virtual_bench.random_rig(seed), seed, draws=200)["by_tile"]
    for tile, counts in found.items():
        for source, refused in counts.items():
            assert refused <= 4 if tile == RIGHT else refused >= 190, (seed, tile, source, refused)


# -- as a person meets it


@pytest.mark.usefixtures("known_lens", "short")
def test_without_a_second_source_it_is_said_everywhere(run: Run, tmp_path: Path) -> None:
    code, out, err = run("projection", "--simulate")
    assert code == 0 and "scale unconfirmed: it comes from the tile of 0.6 m alone" in out, out + err
    found = read_calibration(tmp_path / "s" / "calibration.yaml")
    assert found.meta["scale"] == {"state": "unconfirmed", "sources": []}
    assert any("scale unconfirmed" in line for line in found.meta["to_do"])
    assert "scale unconfirmed" in describe(found)
    _, out, _ = run("report")
    assert "scale unconfirmed" in out and "scale unconfirmed" in (tmp_path / "s" / "report.html").read_text()


@pytest.mark.usefixtures("known_lens", "short")
def test_a_tape_confirms(run: Run, tmp_path: Path) -> None:
    code, out, _ = run("projection", "--simulate", "--height-m", "2.205")
    assert code == 0 and "unconfirmed" not in out and "2.205 m by tape" in out
    found = read_calibration(tmp_path / "s" / "calibration.yaml")
    assert found.meta["scale"]["state"] == "confirmed"
    state, said = scale_of(found)
    assert state == "confirmed" and "height by tape" in said
    run("report")
    assert ">scale confirmed</span>" in (tmp_path / "s" / "report.html").read_text()


@pytest.mark.usefixtures("known_lens", "short")
@pytest.mark.parametrize("tile", WRONG)
def test_a_tape_refuses_a_wrong_tile_with_both_figures(run: Run, tile: str) -> None:
    code, out, err = run("projection", "--simulate", "--tile-m", tile, "--height-m", "2.2")
    said = " ".join((out + err).split())
    assert code in (1, 78) and "PASS" not in out
    assert f"the tile of {tile} m and the height by tape disagree" in said and "2.20" in said and "0.60" in said, said
    assert f"{2.2 * float(tile) / 0.6:.2f}"[:3] in said, said


@pytest.mark.usefixtures("known_lens", "short")
def test_the_wheels_confirm_the_right_tile(run: Run, tmp_path: Path) -> None:
    run("projection", "--simulate")
    code, out, err = run("mount", "--simulate")
    assert code == 0 and "unconfirmed" not in out and "by the wheels" in out, out + err
    assert read_calibration(tmp_path / "s" / "calibration.yaml").meta["scale"]["state"] == "confirmed"


@pytest.mark.usefixtures("known_lens", "short")
@pytest.mark.parametrize("tile", WRONG[::4])
def test_wheels_and_a_wrong_tile_are_an_error_that_names_both(run: Run, tmp_path: Path, tile: str) -> None:
    assert run("projection", "--simulate", "--tile-m", tile)[0] == 0, "without a second source nothing is wrong"
    code, out, err = run("mount", "--simulate")
    assert code == 1 and f"the tile of {tile} m and the wheels disagree: the run is" in out, out + err
    found = read_calibration(tmp_path / "s" / "calibration.yaml")
    state, said = scale_of(found)
    assert state == "contradicted" and "by the wheels" in said
    run("report")
    assert ">scale contradicted</span>" in (tmp_path / "s" / "report.html").read_text()


@pytest.mark.usefixtures("short")
def test_wheels_that_ran_under_another_tile_do_not_count(run: Run, tmp_path: Path, projected: Path) -> None:
    shutil.copytree(projected, tmp_path / "s")
    run("mount", "--simulate")
    run("projection", "--simulate", "--force", "--tile-m", "0.625")
    found = read_calibration(tmp_path / "s" / "calibration.yaml")
    assert found.meta["scale"]["state"] == "unconfirmed"
    assert any("'calib mount --force'" in line for line in found.meta["to_do"])


@pytest.mark.parametrize("height", ["0", "-2.2", "nan", "2200", "99"])
def test_a_height_that_no_ceiling_has_is_refused(run: Run, height: str) -> None:
    code, _, err = run("projection", "--simulate", "--height-m", height)
    assert code == 78 and f"--height-m: found {float(height):g}" in err


def test_old_files_are_read_and_say_that_nothing_confirmed_them() -> None:
    old = parse_calibration(render_calibration(simulated_calibration(), "old"), "old")
    state, said = scale_of(old)
    assert state == "unconfirmed" and "tile of 0.6 m" in said


@pytest.mark.parametrize("meta", [{"scale": "yes"}, {"scale": {"state": 7}}, {"scale": {"state": "confirmed?"}}])
def test_what_is_not_as_calib_wrote_it_confirms_nothing(meta: dict[str, object]) -> None:
    rig = simulated_calibration()
    assert scale_of(Calibration(rig.camera, rig.projection, rig.noise, meta=meta))[0] == "unconfirmed"


# -- marks on the ceiling, found in the pictures of the robot's places


def with_markers(rig: Calibration, pose: Array, gray: Gray, at: Array, side_m: float = 0.3) -> Gray:
    """The picture with ArUco markers of the room's places (N, 2) pasted into it, by the rig's true projection."""
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_5X5_100)
    out = gray.copy()
    c, s = np.cos(pose[2]), np.sin(pose[2])
    for i, xy in enumerate(at):
        marker = cv2.copyMakeBorder(
            dictionary.generateImageMarker(i, 140), 20, 20, 20, 20, cv2.BORDER_CONSTANT, value=255
        )
        half = 0.5 * side_m
        corners = xy + np.array([[-half, -half], [half, -half], [half, half], [-half, half]])
        base = (corners - pose[:2]) @ np.array([[c, -s], [s, c]])
        uv = pixels(rig, np.column_stack([base, np.zeros(4)])).astype(np.float32)
        if not np.isfinite(uv).all() or (uv < 0).any() or (uv > [gray.shape[1], gray.shape[0]]).any():
            continue
        n = np.float32(marker.shape[0])
        # seen from below the ceiling's axes are mirrored in the picture, the marker is not
        flat = np.array([[0, 0], [n, 0], [n, n], [0, n]], np.float32) - np.float32(0.5)
        turn = cv2.getPerspectiveTransform(flat if _clockwise(uv) else flat[::-1].copy(), uv)
        size = (gray.shape[1], gray.shape[0])
        mask = cv2.warpPerspective(np.full_like(marker, 255), turn, size)
        drawn = cv2.warpPerspective(marker, turn, size, flags=cv2.INTER_AREA)
        out = np.where(mask > 127, drawn, out)
    return np.asarray(out, np.uint8)


def _clockwise(uv: Array) -> bool:
    a, b = uv[1] - uv[0], uv[2] - uv[1]
    return bool(a[0] * b[1] - a[1] * b[0] > 0)


@pytest.mark.usefixtures("known_lens")
def test_two_markers_confirm_or_refuse_the_tile(run: Run, tmp_path: Path) -> None:
    """Lens without distortion, so that a marker's picture is its plane's homography."""
    camera = simulated_calibration().camera
    plain = type(camera)("pinhole", 640, 480, 410.3, 409.1, 321.0, 238.0, (0.0,) * 5)
    rig = simulated_calibration(plain)
    bench = VirtualBench(rig)
    rng = np.random.default_rng(5)
    (tmp_path / "i").mkdir()
    marks = np.array([[2.1, 2.5], [3.0, 2.6]])
    poses = [np.array([*rng.uniform(2.2, 2.8, 2), rng.uniform(-3, 3)]) for _ in range(7)]
    for i, pose in enumerate(poses):
        gray = bench.world.renderer.render(pose, rng, t_s=0.0)
        cv2.imwrite(str(tmp_path / "i" / f"{i}.png"), with_markers(rig, pose, gray, marks))
    lens = json.loads((tmp_path / "s" / "intrinsics.json").read_text())
    lens["camera"] |= {k: getattr(plain, k) for k in ("width_px", "height_px", "fx_px", "fy_px", "cx_px", "cy_px")}
    lens["camera"]["distortion"] = [0.0] * 5
    (tmp_path / "s" / "intrinsics.json").write_text(json.dumps(lens))
    csv = tmp_path / "marks.csv"
    csv.write_text("x_m,y_m,id\n" + "".join(f"{x - 1},{y - 1},{i}\n" for i, (x, y) in enumerate(marks)))
    more = ["--images", str(tmp_path / "i"), "--marks", str(csv)]
    code, out, err = run("projection", *more, "--tile-m", "0.6")
    assert code == 0 and "two marks are 0.9" in out and "unconfirmed" not in out, out + err
    for tile in ("0.625", "0.5", "0.9"):
        code, out, err = run("projection", *more, "--tile-m", tile, "--force")
        assert code == 1 and f"the tile of {tile} m and the two marks disagree" in out, out + err
    csv.write_text("x_m,y_m,id\n0,0,0\n0.9,0,17\n")
    code, _, err = run("projection", *more, "--tile-m", "0.6", "--force")
    assert code == 78 and "found at most 1 of the markers" in err
