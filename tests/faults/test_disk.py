"""A real disk that is full, read-only or gone while the whole daemon runs: said once, nothing lost, saved later."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path

import database_on_disk
import numpy as np
import pytest
import small_disk
from simulated_daemon import SimulatedDaemon
from small_disk import SmallDisk

from ceilvo.daemon.map.kept.store import MAP_NAME, STATE_NAME
from ceilvo.daemon.map.map_file import load_state
from ceilvo.daemon.slam.upkeep import SAME_M

WHY_NOT = small_disk.why_not()
CHILD = Path(database_on_disk.__file__)
pytestmark = pytest.mark.skipif(bool(WHY_NOT), reason=WHY_NOT)


@pytest.fixture
def disk(tmp_path: Path) -> Iterator[SmallDisk]:
    made = SmallDisk(tmp_path / "disk", size="16m")
    yield made
    made.close()


def landmarks_on(disk: SmallDisk, folder: Path) -> np.ndarray:
    """(N, 2) m, of a map that is whole."""
    done = disk.inside(sys.executable, "-W", "error", CHILD, "places", folder)
    assert done.returncode == 0, done.stderr
    return np.array(done.stdout.split(), np.float64).reshape(-1, 2)


def stamp_in(folder: Path) -> int:
    """Of the last pose; 0 where there is none."""
    state = load_state(folder / STATE_NAME)
    return 0 if state is None else state.stamp_ns


def half_written(folder: Path) -> list[str]:
    return [p.name for p in folder.glob(".*.tmp")]


def test_full_read_only_and_gone_while_it_runs(tmp_path: Path, disk: SmallDisk) -> None:
    seen, folder, aside = disk.folder / "state", disk.path / "state", disk.path / "aside"
    folder.mkdir()
    troubles = {
        f"{MAP_NAME}: cannot be written: database or disk is full": (disk.fill, disk.free),
        f"{STATE_NAME}: cannot be written: Read-only file system": (disk.make_read_only, disk.make_writable),
        f"{seen}: no such folder": (lambda: folder.rename(aside), lambda: aside.rename(folder)),
    }
    with SimulatedDaemon(seen, tmp_path, enter=disk.enter) as daemon:
        daemon.until(lambda: (folder / STATE_NAME).exists() and len(landmarks_on(disk, seen)) > 10, "a map")
        for error, (begin, end) in troubles.items():
            before_ns = stamp_in(folder)
            begin()
            daemon.until_saving(error)
            daemon.until_poses(5)
            if folder.exists():
                assert stamp_in(folder) >= before_ns and half_written(folder) == []
            end()
            daemon.until_saving("")
            daemon.until(lambda least=before_ns: stamp_in(folder) > least, "a later pose on disk")
        last = landmarks_on(disk, seen)
        assert daemon.end() == 0
    log = daemon.said()
    assert log.count("map and pose not saved") == log.count("map and pose are saved again") == len(troubles)
    assert [log.count(error) for error in troubles] == [1, 1, 1]
    assert "Traceback" not in log
    off = np.hypot(*(last[:, None] - landmarks_on(disk, seen)[None]).transpose(2, 0, 1))
    # two that are nearer than places are told apart may be one by two names, and become one
    lost = last[np.min(off, axis=1) >= SAME_M]
    assert not len(lost), f"no landmark is there any more at {lost.tolist()}"


def test_a_start_on_a_full_disk(disk: SmallDisk) -> None:
    """It ended with a traceback, again and again: the process id did not go into the lock file."""
    done = disk.inside(sys.executable, "-W", "error", CHILD, "start when full", disk.folder)
    assert done.returncode == 0, done.stderr
    *said, count = done.stdout.splitlines()
    assert count == "301"
    assert [line[:28] for line in said if line.startswith("ERROR")] == ["ERROR map and pose not saved"]
    assert stamp_in(disk.path) == 5
