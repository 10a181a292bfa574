"""Recordings of real ceilings, which live outside the repository: CEILVO_DATA, else ../shared/data beside it."""

from __future__ import annotations

import re
from collections.abc import Sequence
from itertools import islice
from pathlib import Path

import cv2
import numpy as np
import pytest

from ceilvo import se2
from ceilvo.bench.data import data_path
from ceilvo.bench.real import command as real
from ceilvo.bench.real.marked.reading import HERE, read
from ceilvo.bench.real.marked.standing import SEED, stand
from ceilvo.bench.real.office import BARS, drive
from ceilvo.bench.real.recordings import recorded
from ceilvo.config import Config
from ceilvo.daemon.pipeline import Pipeline
from ceilvo.types import Frame, State

DATA = data_path("")
THERE_AND_BACK = [*range(0, 100, 2), *range(99, 0, -2)]
"""Every second frame out, the others back: one way twice, and no picture twice."""


def _folder(name: str) -> Path:
    if not (DATA / name).is_dir():
        pytest.skip(f"{DATA / name} is absent; set CEILVO_DATA to the folder that holds {name}")
    return DATA / name


def _frames(folder: Path, count: int) -> list[Frame]:
    return list(islice(recorded(folder), count))


@pytest.mark.parametrize(
    ("frames", "hz", "median_m"),
    [
        (range(50), 30.0, 0.1),
        (range(50, 100), 30.0, 0.1),
        (range(100), 30.0, real.LAMP_BARS["distance_median_m"]),
        (THERE_AND_BACK, 15.0, real.LAMP_BARS["distance_median_m"]),
    ],
    ids=["the half that was tuned on", "the other half", "both", "there and back"],
)
def test_car_under_lamps_is_where_the_other_tracker_says_by_default_settings(
    frames: Sequence[int], hz: float, median_m: float
) -> None:
    folder = _folder("ceiling_lamps")
    reference = real.reference_poses(folder / "reference.txt")[list(frames)]
    pictures = _frames(folder, 100)
    config, calibration = real.lamps_config(reference[0]), real.lamps_calibration()
    assert config.odometry == Config().odometry and config.features == Config().features
    pipeline = Pipeline(calibration, config, np.random.default_rng(1))
    estimates = [pipeline.step(Frame(k, round(k * 1e9 / hz), pictures[n].gray)) for k, n in enumerate(frames)]
    assert [e.motion.failure for e in estimates[1:]] == [None] * (len(frames) - 1)
    assert {e.state for e in estimates[11:]} <= {State.TRACKING, State.DEGRADED}
    poses = np.array([e.pose for e in estimates])
    off_m = np.hypot(*(poses - reference)[:, :2].T)
    off_deg = np.degrees(np.abs(se2.wrap_array(poses[:, 2] - reference[:, 2])))
    print(f"{np.median(off_m):.3f} m in the median, {off_m.max():.3f} m and {off_deg.max():.2f} deg at most")
    assert np.max(np.ptp(reference[:, :2], axis=0)) > 2.0, "the car drives"
    assert np.median(off_m) < median_m
    assert off_m.max() < 0.4
    assert off_deg.max() < 1.5


def test_lamps_that_jump_by_eight_metres_are_no_motion() -> None:
    """The car is put back to where it began: wherever it is said to be, that is not called good."""
    folder = _folder("ceiling_lamps")
    reference = real.reference_poses(folder / "reference.txt")
    pictures = _frames(folder, 100)
    pipeline = Pipeline(real.lamps_calibration(), real.lamps_config(reference[0]), np.random.default_rng(1))
    order = [*range(100), *range(40)]
    estimates = [pipeline.step(Frame(k, round(k * 1e9 / 30.0), pictures[n].gray)) for k, n in enumerate(order)]
    assert np.hypot(*(reference[99] - reference[0])[:2]) > 7.0
    after = estimates[100:]
    right = [np.hypot(*(np.asarray(e.pose) - reference[n])[:2]) < 0.3 for e, n in zip(after, order[100:], strict=True)]
    assert all(ok or e.state not in (State.TRACKING, State.DEGRADED) for e, ok in zip(after, right, strict=True))


def _mean_direction_deg(folder: Path) -> float:
    """Mean direction, weighted by length, of the segments that OpenCV's detector finds along the seams."""
    gray = cv2.imread(str(folder / "ceiling3-6-02.jpg"), cv2.IMREAD_GRAYSCALE)
    fx, fy, cx, cy, *lens = (
        float(w) for w in (folder / "pg_3_6mm.txt").read_text("ascii").split("\n")[0].split() if w[-1].isdigit()
    )
    found = cv2.createLineSegmentDetector().detect(gray)[0].reshape(-1, 1, 2).astype(np.float64)
    camera = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
    along = np.diff(cv2.undistortPoints(found, camera, np.array(lens)).reshape(-1, 2, 2), axis=1)[:, 0]
    length_px = np.hypot(*np.diff(found.reshape(-1, 2, 2), axis=1)[:, 0].T)
    folded = np.exp(4j * np.arctan2(along[:, 1], along[:, 0]))
    mean = np.sum((length_px * folded)[length_px > 30])
    for _ in range(20):
        near = (length_px > 30) & (np.abs(np.angle(folded / mean)) < 4 * np.radians(7))
        mean = np.sum((length_px * folded)[near])
    return float(np.degrees(np.angle(mean)) / 4)


def test_photo_of_a_tiled_ceiling_shows_the_tiles_direction(tmp_path: Path) -> None:
    folder = _folder("ceiling_still")
    figures = real.still(folder, tmp_path)
    # beams at several heights and a camera held askew: the seams lean -11 to -17 deg, -14.1 in the mean
    assert abs(figures["direction_deg"] - _mean_direction_deg(folder)) < 2.0
    assert figures["lines_axis_0"] > 5
    assert figures["lines_axis_1"] > 5
    assert cv2.imread(str(tmp_path / "ceiling_still.png")).shape == (960, 1280, 3)


def test_whole_bench_writes_its_files(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    _folder("ceiling_lamps"), _folder("ceiling_still")
    where = ["--out", str(tmp_path), "--json", str(tmp_path / "real.json")]
    assert real.main([str(DATA), *where, "--stand", "1"]) == 0
    assert "MISS" not in re.split("office_rendered|photograph ", capsys.readouterr().out)[0]
    work = tmp_path / "ceiling_lamps"
    for name in ("calibration.yaml", "config.yaml", "reference.tum", "estimated.tum", "trajectories.png"):
        assert (work / name).stat().st_size > 0, name


@pytest.mark.parametrize(
    "name", ["ceiling_still", "industrial_430", "industrial_470", "industrial_560", "industrial_807"]
)
def test_robot_that_stands_under_a_photograph_knows_its_place(name: str) -> None:
    marked = read(HERE / f"{name}.yaml")
    _folder(marked.picture.parts[0])
    gray = marked.gray(DATA)
    assert gray is not None
    stood = stand(gray, marked.calibration, frames=16)
    print(f"seed {SEED}: {stood}")
    assert stood.good >= 10
    assert stood.spread_m < 0.02


def test_absent_data_is_left_out_with_a_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert real.main([str(tmp_path), "--out", str(tmp_path / "o"), "--json", str(tmp_path / "j.json")]) == 0
    said = capsys.readouterr().out
    assert "ceiling_lamps: left out" in said
    assert "ceiling_still: left out" in said


def test_a_drive_that_another_renderer_path_traced_is_followed_to_millimetres() -> None:
    figures = drive(_folder("office_rendered"))
    print(figures)
    assert figures["path_m"] > 7.0 and figures["frames_ok"] == figures["frames"]
    assert figures["worst_mm"] < 10.0
    assert figures["tracking_pct"] > 90.0, "a ceiling of twice as many odd features as usual is no other place"
    assert figures["heading_worst_deg"] < BARS["heading_worst_deg"]
