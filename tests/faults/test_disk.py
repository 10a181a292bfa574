"""A real disk that is full, read-only or gone while the whole daemon runs: said once, nothing lost, saved later."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest
import small_disk
from map_writer import estimate, landmarks
from simulated_daemon import SimulatedDaemon
from small_disk import SmallDisk

from ceilvo.daemon.map.map_file import load_map, load_state
from ceilvo.daemon.map.store import MAP_NAME, STATE_NAME, Store
from ceilvo.drivers.host.ownership import owner_of_folder

WHY_NOT = small_disk.why_not()
pytestmark = pytest.mark.skipif(bool(WHY_NOT), reason=WHY_NOT)


@pytest.fixture
def disk(tmp_path: Path) -> Iterator[SmallDisk]:
    made = SmallDisk(tmp_path / "disk")
    yield made
    made.close()


def saved(folder: Path) -> tuple[int, int]:
    """Landmarks and stamp of what lies there; both files are whole, and nothing half-written lies beside them."""
    stored, state = load_map(folder / MAP_NAME), load_state(folder / STATE_NAME)
    assert stored is not None and state is not None
    return len(stored.landmarks), state.stamp_ns


def half_written(folder: Path) -> list[str]:
    return [p.name for p in folder.glob(".*.tmp")]


def test_full_read_only_and_gone_while_it_runs(tmp_path: Path, disk: SmallDisk) -> None:
    folder, aside = disk.path / "state", disk.path / "aside"
    folder.mkdir()
    troubles = {
        "No space left on device": (disk.fill, disk.free),
        "Read-only file system": (disk.make_read_only, disk.make_writable),
        "No such file or directory": (lambda: folder.rename(aside), lambda: aside.rename(folder)),
    }
    with SimulatedDaemon(folder, tmp_path) as daemon:
        daemon.until(lambda: (folder / STATE_NAME).exists() and saved(folder)[0] > 10, "a map")
        for error, (begin, end) in troubles.items():
            before = saved(folder)
            begin()
            daemon.until_saving(error)
            daemon.until_poses(5)
            if folder.exists():
                assert saved(folder) >= before and half_written(folder) == []
            end()
            daemon.until_saving("")
            daemon.until(lambda least=before[1]: saved(folder)[1] > least, "a later pose on disk")
        last = saved(folder)
        assert daemon.end() == 0
    log = daemon.said()
    assert log.count("map and pose not saved") == log.count("map and pose are saved again") == len(troubles)
    assert [log.count(f"cannot be written: {error}") for error in troubles] == [1, 1, 1]
    assert "Traceback" not in log
    kept = Store(folder).load()
    assert kept is not None and len(kept.map.landmarks) >= last[0] and kept.state is not None


def test_a_start_on_a_full_disk(disk: SmallDisk, caplog: pytest.LogCaptureFixture) -> None:
    """It ended with a traceback, again and again: the process id did not go into the lock file."""
    assert Store(disk.path).save(landmarks(300), 0.25, estimate(1))
    disk.fill()
    with owner_of_folder(disk.path):
        store = Store(disk.path)
        found = store.load()
        assert found is not None and len(found.map.landmarks) == 300
        for n in range(3):
            assert not store.save(landmarks(301), 0.25, estimate(2 + n))
        disk.free()
        assert store.save(landmarks(301), 0.25, estimate(5))
    assert [r.getMessage()[:22] for r in caplog.records if r.levelname == "ERROR"] == ["map and pose not saved"]
    assert saved(disk.path) == (301, 5)
