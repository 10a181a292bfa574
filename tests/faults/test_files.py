"""State files through kills, full disks and other people's hands: always readable, never half-written."""

from __future__ import annotations

import json
import logging
import os
import random
from pathlib import Path

import map_writer
import numpy as np
import pytest
from map_writer import estimate, landmarks
from patience import PATIENCE_S

from ceilvo.daemon.map.map_file import load_map, load_state, save_map, save_state
from ceilvo.daemon.map.store import MAP_NAME, REJECTED, STATE_NAME, Store
from ceilvo.errors import FileFormatError
from ceilvo.files import write_atomic
from ceilvo.types import State

KILLS = int(os.environ.get("KILLS", "20"))
"""`make kill-test` sets 200."""
SEED = 6


def test_killed_at_random_moments_while_it_saves(tmp_path: Path) -> None:
    """kill -9 in the middle of writing: what is on disk is whole, at most one save old, and nothing is left over."""
    rng = random.Random(SEED)
    reached = 0
    for kill in range(KILLS):
        process, said = map_writer.start(tmp_path)
        with said:
            found, files = said.recv()
            assert found >= reached, f"kill {kill}: an older state came back (seed {SEED})"
            assert files <= 2, f"kill {kill}: half-written files were not swept away (seed {SEED})"
            # saves follow each other without a pause, so any moment is one within a save
            for _ in range(1 + rng.randrange(3)):
                said.recv()
            process.kill()
            process.join(PATIENCE_S)
        process.close()
        stored, state = load_map(tmp_path / MAP_NAME), load_state(tmp_path / STATE_NAME)
        assert stored is not None and state is not None
        assert len(stored.landmarks) == map_writer.LANDMARKS
        assert abs(state.pose[0] - 0.001 * state.stamp_ns) < 1e-12
        reached = state.stamp_ns
    assert reached >= map_writer.SAVES_A_WORD * KILLS


@pytest.mark.parametrize("name", [MAP_NAME, STATE_NAME])
@pytest.mark.parametrize("damage", ["cut", "changed", "newer", "empty", "other"])
def test_a_file_that_cannot_be_used_is_set_aside_and_not_overwritten(
    tmp_path: Path, name: str, damage: str, caplog: pytest.LogCaptureFixture
) -> None:
    store = Store(tmp_path)
    assert store.save(landmarks(30), 0.25, estimate(7))
    path = tmp_path / name
    raw = path.read_bytes()
    spoilt = {
        "cut": raw[: len(raw) // 2],
        "changed": raw.replace(b"2.0", b"3.0", 1) if name == STATE_NAME else raw.replace(b"0.25", b"0.35", 1),
        "newer": json.dumps(json.loads(raw) | {"version": 99}).encode(),
        "empty": b"",
        "other": b"\x89PNG\r\n",
    }[damage]
    assert spoilt != raw
    path.write_bytes(spoilt)
    with caplog.at_level(logging.WARNING):
        assert Store(tmp_path).load() is None
    assert name in caplog.text
    assert (tmp_path / (name + REJECTED)).read_bytes() == spoilt
    assert store.save(landmarks(30), 0.25, estimate(8))
    assert (tmp_path / (name + REJECTED)).read_bytes() == spoilt
    assert Store(tmp_path).load() is not None


def test_a_disk_that_is_full_leaves_the_old_files(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    store = Store(tmp_path)
    assert store.save(landmarks(30), 0.25, estimate(1))

    def full(fd: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    assert not store.save(landmarks(31), 0.25, estimate(2))
    assert "No space left on device" in store.error
    monkeypatch.undo()
    loaded = Store(tmp_path).load()
    assert loaded is not None
    assert loaded[1].stamp_ns == 1
    assert sorted(p.name for p in tmp_path.iterdir()) == [MAP_NAME, STATE_NAME]
    assert store.save(landmarks(31), 0.25, estimate(3))
    assert store.error == ""


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="no /dev/full on this system")
def test_a_real_full_device_is_an_os_error_and_nothing_else(tmp_path: Path) -> None:
    """The kernel's own answer, not a stand-in's."""
    with pytest.raises(OSError, match="No space left"), Path("/dev/full").open("w") as f:
        f.write("x")
        f.flush()
    with pytest.raises(FileFormatError, match="cannot be written"):
        save_map(Path("/proc/nothing/map.json"), landmarks(3), 0.0)
    with pytest.raises(OSError):
        write_atomic(tmp_path / "no" / "folder", "x")


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write anywhere; the virtual robot has this case as a service")
def test_a_read_only_state_directory(tmp_path: Path) -> None:
    tmp_path.chmod(0o500)
    try:
        store = Store(tmp_path)
        assert store.load() is None
        assert not store.save(landmarks(3), 0.25, estimate(1))
        assert "Permission denied" in store.error
    finally:
        tmp_path.chmod(0o700)


def test_a_state_without_its_map_is_not_used(tmp_path: Path) -> None:
    save_state(tmp_path / STATE_NAME, np.zeros(3), np.eye(3), State.TRACKING, 1)
    assert Store(tmp_path).load() is None
    assert (tmp_path / STATE_NAME).exists()
