"""Recordings of drives become one map: by one process, several, or a cluster, the same to the bit."""

from __future__ import annotations

import contextlib
import importlib.util
import io
import re
import shutil
from pathlib import Path

import numpy as np
import pytest
from dask_cluster import cluster
from map_contents import same_content
from recorded_rooms import recorded

from ceilvo import se2
from ceilvo.bench.refine.study import Room, error_of
from ceilvo.daemon.building import frames
from ceilvo.daemon.cli import main
from ceilvo.daemon.editing import sources
from ceilvo.daemon.editing.changes import moved
from ceilvo.daemon.map.database.copies import open_map

Capture = pytest.CaptureFixture[str]
Drives = tuple[Room, list[Path]]
SEED = 7
GRID = 4
"""Where joints of tiles cross."""


def run(*words: str | Path) -> int:
    return main(["map", "build", *map(str, words)])


@pytest.fixture(scope="module")
def drives(tmp_path_factory: pytest.TempPathFactory) -> Drives:
    """Two drives of 16 m through one room; each robot believes to begin at the origin."""
    return recorded(tmp_path_factory.mktemp("drives"), SEED, 2, 16.0)


@pytest.fixture
def little_is_enough(monkeypatch: pytest.MonkeyPatch) -> None:
    """The room has five lamps, so that the tests take seconds: too few for the chance that is asked for."""
    monkeypatch.setattr(frames, "ALARM", 0.5)


@pytest.fixture(scope="module")
def built(drives: Drives, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, str]:
    """The map of both drives by one process, to be copied, and what was said."""
    one, said = tmp_path_factory.mktemp("built") / "map.db", io.StringIO()
    with pytest.MonkeyPatch.context() as patch, contextlib.redirect_stdout(said):
        patch.setattr(frames, "ALARM", 0.5)
        assert run(*drives[1], "--into", one, "--png", one.with_suffix(".png")) == 0
    return one, said.getvalue()


@pytest.mark.usefixtures("little_is_enough")
def test_drives_that_each_believe_to_begin_at_the_origin_become_one_map(
    drives: Drives, built: tuple[Path, str], tmp_path: Path, capsys: Capture
) -> None:
    hall, paths = drives
    one, said = Path(shutil.copy(built[0], tmp_path)), built[1]
    whole = sources.read(one)
    first = 0 if "drive-1.mcap: lies at" in said else 1
    there = moved(whole, hall.ways[first][0])
    crossings = there.landmarks.crossing_type == GRID
    error, alone = error_of(there.landmarks.of(crossings), hall.features.xy_map_m)
    print(said, error, alone)
    assert min(len(k) for k in whole.key_poses) > 10 and len(whole.key_poses) == len(whole.sessions) == 2
    assert f"holds {len(whole.landmarks)} landmarks and {sum(map(len, whole.key_poses))} key poses" in said
    assert alone == 0 and error.rms_mm < 12.0  # nobody measured a length
    alone_each = [int(n) for n in re.findall(r"key poses of (\d+) landmarks", said)]
    assert len(whole.landmarks) < 1.05 * max(alone_each)  # both drives saw the same ceiling
    assert whole.seen_s[:, 1].max() - whole.seen_s[:, 0].min() > 3600.0
    with open_map(one) as db:
        assert [e.what.split()[0] for e in db.history()] in ([], ["build"])
    assert run(*paths, "--into", one, "--calibration", _calibration(tmp_path, paths[0])) == 1
    assert "nothing new: 2 drives" in capsys.readouterr().err


def _calibration(folder: Path, recording: Path) -> Path:
    from ceilvo.drivers.recording.mcap_file import CALIBRATION
    from ceilvo.drivers.recording.mcap_reader import open_recording

    path = folder / "calibration.yaml"
    path.write_text(open_recording(recording).text(CALIBRATION))
    return path


def test_a_drive_that_could_lie_elsewhere_is_refused_and_said(drives: Drives, tmp_path: Path, capsys: Capture) -> None:
    assert run(*drives[1], "--into", tmp_path / "map.db") == 0
    assert "not joined: a wrong place looks as good with a chance of" in capsys.readouterr().out
    assert len(sources.read(tmp_path / "map.db").sessions) == 1


@pytest.mark.skipif(importlib.util.find_spec("distributed") is None, reason="Dask is not installed")
@pytest.mark.usefixtures("little_is_enough")
def test_whoever_replays_the_map_is_the_same_to_the_bit(
    drives: Drives, built: tuple[Path, str], tmp_path: Path
) -> None:
    with cluster(tmp_path) as address:
        for name, workers in (("two", ("--jobs", "2")), ("dask", ("--scheduler", address))):
            assert run(*drives[1], "--into", tmp_path / f"{name}.db", *workers) == 0
    one = sources.read(built[0])
    for name in ("two", "dask"):
        assert same_content(one, sources.read(tmp_path / f"{name}.db"))


@pytest.mark.parametrize(
    ("words", "said"), [(("gone.mcap",), "gone.mcap: no such recording"), ((".",), "no recording in it")]
)
def test_what_is_no_recording_is_said(
    words: tuple[str, ...], said: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Capture
) -> None:
    monkeypatch.chdir(tmp_path)
    assert run(*words, "--into", "map.db") == 1
    assert said in capsys.readouterr().err and not Path("map.db").exists()


def test_the_start_of_a_drive_is_where_its_frame_lies(drives: Drives) -> None:
    hall, _ = drives
    assert not np.allclose(se2.between(hall.ways[0][0], hall.ways[1][0]), 0.0, atol=0.1)
