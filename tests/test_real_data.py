"""Recordings of real ceilings, which live outside the repository: CEILVO_DATA, else ../shared/data beside it."""

from __future__ import annotations

import os
from pathlib import Path

import cv2
import numpy as np
import pytest

from ceilvo import se2
from ceilvo.bench import real
from ceilvo.daemon.pipeline import Pipeline
from ceilvo.drivers.cameras import source_camera
from ceilvo.types import Frame

DATA = Path(os.environ.get("CEILVO_DATA", Path(__file__).parents[2] / "shared" / "data"))
SHORT = 45


def _folder(name: str) -> Path:
    if not (DATA / name).is_dir():
        pytest.skip(f"{DATA / name} is absent; set CEILVO_DATA to the folder that holds {name}")
    return DATA / name


def _frames(folder: Path, count: int) -> list[Frame]:
    camera = source_camera(folder, 640, 480)
    camera.open()
    frames = []
    while len(frames) < count and (frame := camera.read()) is not None:
        frames.append(frame)
    camera.close()
    return frames


def test_car_under_lamps_is_where_the_other_tracker_says() -> None:
    folder = _folder("ceiling_lamps")
    reference = real.reference_poses(folder / "reference.txt")[:SHORT]
    config, calibration = real.lamps_config(reference[0]), real.lamps_calibration()
    pipeline = Pipeline(calibration, config, np.random.default_rng(1))
    estimates = [pipeline.step(frame) for frame in _frames(folder, SHORT)]
    assert [e.motion.failure for e in estimates[1:]] == [None] * (SHORT - 1)
    poses = np.array([e.pose for e in estimates])
    off_m = np.hypot(*(poses - reference)[:, :2].T)
    assert np.hypot(*(reference[-1] - reference[0])[:2]) > 2.0, "the car drives"
    assert np.median(off_m) < 0.15
    assert off_m.max() < 0.4
    assert np.degrees(np.abs(se2.wrap_array(poses[:, 2] - reference[:, 2]))).max() < 2.0


def test_photo_of_a_tiled_ceiling_shows_the_tiles_direction(tmp_path: Path) -> None:
    folder = _folder("ceiling_still")
    figures = real.still(folder, tmp_path)
    # measured by hand on the photo: the seams lean 12 to 14 deg from the picture's axes
    assert -15.0 < figures["direction_deg"] < -11.0
    assert figures["lines_axis_0"] > 5
    assert figures["lines_axis_1"] > 5
    assert cv2.imread(str(tmp_path / "ceiling_still.png")).shape == (960, 1280, 3)


def test_whole_bench_writes_its_files(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    _folder("ceiling_lamps"), _folder("ceiling_still")
    assert real.main([str(DATA), "--out", str(tmp_path), "--json", str(tmp_path / "real.json")]) == 0
    assert "MISS" not in capsys.readouterr().out
    work = tmp_path / "ceiling_lamps"
    for name in ("calibration.yaml", "config.yaml", "reference.tum", "estimated.tum", "trajectories.png"):
        assert (work / name).stat().st_size > 0, name


def test_absent_data_is_left_out_with_a_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert real.main([str(tmp_path), "--out", str(tmp_path / "o"), "--json", str(tmp_path / "j.json")]) == 0
    said = capsys.readouterr().out
    assert "ceiling_lamps: left out" in said
    assert "ceiling_still: left out" in said
