"""State files through kills, full disks and other people's hands: always readable, never half-written."""

from __future__ import annotations

import contextlib
import json
import logging
import os
import random
import sqlite3
from dataclasses import replace
from pathlib import Path

import map_writer
import numpy as np
import pytest
from kept_maps import count, load_database
from map_writer import estimate, landmarks
from patience import PATIENCE_S
from writers import started

from ceilvo.daemon.map.database import schema
from ceilvo.daemon.map.database.database import MapDatabase
from ceilvo.daemon.map.document import document_of
from ceilvo.daemon.map.kept.store import MAP_NAME, STATE_NAME, Store
from ceilvo.daemon.map.map_file import load_map, load_state, save_map, save_state
from ceilvo.errors import FileFormatError
from ceilvo.files import MOST_REJECTED, REJECTED, write_atomic
from ceilvo.types import Pose, State

KILLS = int(os.environ.get("KILLS", "12"))
"""`make kill-test` sets 200."""
SEED = 6


def test_killed_at_random_moments_while_it_saves(tmp_path: Path) -> None:
    """kill -9 in the middle of writing: what is on disk is whole, at most one save old, and nothing is left over."""
    rng = random.Random(SEED)
    reached = 0
    for kill in range(KILLS):
        process, said = started(map_writer.write, tmp_path)
        with said:
            found, files = said.recv()
            assert found >= reached, f"kill {kill}: an older state came back (seed {SEED})"
            assert files <= 6, f"kill {kill}: half-written files were not swept away (seed {SEED})"
            # saves follow each other without a pause, so any moment is one within a save
            for _ in range(1 + rng.randrange(3)):
                said.recv()
            process.kill()
            process.join(PATIENCE_S)
        process.close()
        stored, state = load_database(tmp_path / MAP_NAME), load_state(tmp_path / STATE_NAME)
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
    store.close()
    path = tmp_path / name
    if damage == "newer" and name == MAP_NAME:
        with contextlib.closing(sqlite3.connect(path)) as db:
            db.execute("PRAGMA user_version = 99")
    raw = path.read_bytes()
    spoilt = {
        "cut": raw[: len(raw) // 2],
        "changed": raw.replace(b"2.0", b"3.0", 1) if name == STATE_NAME else raw.replace(b"edge", b"egde", 1),
        "newer": raw if name == MAP_NAME else json.dumps(json.loads(raw) | {"version": 99}).encode(),
        "empty": b"",
        "other": b"\x89PNG\r\n",
    }[damage]
    if name == MAP_NAME and damage == "changed":
        at = raw.index(np.array([0.6 * 7], ">f8").tobytes())
        spoilt = raw[: at + 7] + bytes([raw[at + 7] ^ 1]) + raw[at + 8 :]
    path.write_bytes(spoilt)
    with caplog.at_level(logging.WARNING):
        kept = Store(tmp_path).load()
    assert kept is not None and len(kept.map.landmarks) == 30, "a map needs no pose, and has a good copy"
    assert (kept.state is None) == (name == STATE_NAME)
    assert name in caplog.text and ("the last good copy" in caplog.text) == (name == MAP_NAME)
    assert (tmp_path / (name + REJECTED)).read_bytes() == spoilt
    again = Store(tmp_path)
    again.load()
    assert again.save(landmarks(30), 0.25, estimate(8))
    assert (tmp_path / (name + REJECTED)).read_bytes() == spoilt


def test_a_map_of_an_older_ceilvo_is_imported_once_and_stays_as_it_was(tmp_path: Path) -> None:
    save_map(tmp_path / "map.json", landmarks(300), 0.25)
    state = {"pose_map_from_base": {"x_m": 1.0, "y_m": 2.0, "theta_rad": 0.5}, "cov": (1e-4 * np.eye(3)).tolist()}
    content = state | {"state": "TRACKING", "stamp_ns": 7, "elsewhere": 0.1}
    (tmp_path / STATE_NAME).write_text(document_of("ceilvo-state", 2, content))
    before = (tmp_path / "map.json").read_bytes()
    store = Store(tmp_path)
    found = store.load()
    assert found is not None and found.state is not None and found.state.stamp_ns == 7
    assert found.said.startswith("map.json imported into map.db, it stays as it was, 300 landmarks; ")
    assert count(tmp_path / MAP_NAME) == 300
    assert store.save(landmarks(310), 0.25, estimate(8))
    store.close()
    assert (tmp_path / "map.json").read_bytes() == before
    save_map(tmp_path / "map.json", landmarks(200), 0.25)
    again = Store(tmp_path).load()
    assert again is not None and len(again.map.landmarks) == 310 and again.said.startswith("stored map loaded")


def test_a_damaged_map_of_an_older_ceilvo_gives_way_to_its_generation(tmp_path: Path) -> None:
    (tmp_path / "map.json").write_text("half a fi")
    save_map(tmp_path / "map.json.1", landmarks(290), 0.25)
    found = Store(tmp_path).load()
    assert found is not None and found.said.startswith("map.json.1 imported into map.db, it stays as it was, 290 ")
    assert (tmp_path / ("map.json" + REJECTED)).read_text() == "half a fi"


def test_an_import_that_was_killed_before_it_was_done_is_done_again(tmp_path: Path) -> None:
    save_map(tmp_path / "map.json", landmarks(300), 0.25)
    schema.create(tmp_path / MAP_NAME)
    found = Store(tmp_path).load()
    assert found is not None and count(tmp_path / MAP_NAME) == 300


@pytest.mark.parametrize("change", ["turned", "forgotten", "begun anew"])
def test_a_pose_goes_with_its_map_only(tmp_path: Path, change: str) -> None:
    store = Store(tmp_path)
    for n in range(2):
        assert store.save(landmarks(300 + n), 0.25, estimate(n))
    store.close()
    with MapDatabase(tmp_path / MAP_NAME) as db:
        was = db.content()
        if change == "turned":
            db.edit(replace(was, axis_rad=0.3), "rotate")
        elif change == "forgotten":
            db.edit(replace(was, landmarks=was.landmarks.of(was.landmarks.ids < 250), seen_s=was.seen_s[:250]), "crop")
        else:
            db.save(landmarks(300), 0.25, anew=True)
    found = Store(tmp_path).load()
    assert found is not None and (found.state is not None) == (change == "forgotten")
    assert ("its last pose was on another map" in found.said) == (change != "forgotten")


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
    assert loaded.state is not None and loaded.state.stamp_ns == 1
    assert not list(tmp_path.glob(".*"))
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
        assert "cannot be written" in store.error
    finally:
        tmp_path.chmod(0o700)


def kept(store: Store) -> tuple[int, bool]:
    """Landmarks of the map that is loaded, and whether a pose is."""
    found = store.load()
    assert found is not None
    return len(found.map.landmarks), found.state is not None


@pytest.mark.parametrize("damage", [b"", b"{}", b"\x00" * 900, b'{"format": "ceilvo-state", "version": 1}'])
def test_a_damaged_pose_does_not_cost_the_map(tmp_path: Path, damage: bytes) -> None:
    """It did: the daemon began without the map and wrote 3 landmarks over 300."""
    assert Store(tmp_path).save(landmarks(300), 0.25, estimate(7))
    (tmp_path / STATE_NAME).write_bytes(damage)
    again = Store(tmp_path)
    assert kept(again) == (300, False)
    assert not again.save(landmarks(3), 0.25, estimate(8))
    assert kept(Store(tmp_path)) == (300, False)


def test_a_much_smaller_map_goes_beside_and_says_so(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    assert Store(tmp_path).save(landmarks(300), 0.25, estimate(7))
    store = Store(tmp_path)
    store.load()
    for n in range(10, 60, 10):
        assert not store.save(landmarks(n), 0.25, estimate(n))
    assert [r.getMessage() for r in caplog.records if "300 landmarks is kept" in r.getMessage()] != []
    assert len([r for r in caplog.records if r.levelno == logging.ERROR]) == 1, "said once"
    assert "map.smaller.json" in store.error
    beside = load_map(tmp_path / "map.smaller.json")
    assert beside is not None and len(beside.landmarks) == 50
    assert kept(Store(tmp_path)) == (300, True)
    assert store.save(landmarks(200), 0.25, estimate(70)) and store.error == ""
    assert kept(Store(tmp_path)) == (200, True)


def test_a_state_directory_that_is_a_file(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    (tmp_path / "state").write_text("mine")
    store = Store(tmp_path / "state")
    assert store.load() is None and not store.save(landmarks(3), 0.25, estimate(1))
    assert "no such folder" in store.error and (tmp_path / "state").read_text() == "mine"
    assert not store.begin_anew()


def saved_at(folder: Path) -> tuple[int, ...]:
    return tuple((folder / f"{MAP_NAME}{end}").stat().st_mtime_ns for end in ("", "-wal"))


def stored_stamp(folder: Path) -> int | None:
    state = load_state(folder / STATE_NAME)
    return None if state is None else state.stamp_ns


def test_a_pose_alone_is_written_beside_the_map_in_use_only(tmp_path: Path) -> None:
    store = Store(tmp_path)
    assert not store.save_pose(estimate(1)) and not list(tmp_path.iterdir())
    assert store.save(landmarks(300), 0.25, estimate(2))
    untouched = saved_at(tmp_path)
    assert store.save_pose(estimate(3), 0.2) and stored_stamp(tmp_path) == 3
    assert saved_at(tmp_path) == untouched, "the map is not written again"
    again = Store(tmp_path)
    found = again.load()
    assert found is not None and found.state is not None and found.state.elsewhere == 0.2
    assert again.save_pose(estimate(4)) and stored_stamp(tmp_path) == 4
    assert not again.save(landmarks(3), 0.25, estimate(5))
    assert not again.save_pose(estimate(6)), "the smaller map beside is the one in use"
    again.begin_anew()
    assert not again.save_pose(estimate(7)) and stored_stamp(tmp_path) == 4, "a pose in another map"
    assert again.save(landmarks(3), 0.25, estimate(8)) and again.save_pose(estimate(9))
    assert stored_stamp(tmp_path) == 9
    assert not Store(None).save_pose(estimate(9))


def test_a_pose_that_cannot_be_written_waits_for_the_map_and_is_said_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    store = Store(tmp_path)
    assert store.save(landmarks(30), 0.25, estimate(1))

    def full(fd: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    assert not any(store.save_pose(estimate(n)) for n in range(2, 6))
    assert not store.save(landmarks(30), 0.25, estimate(6))
    assert len([r for r in caplog.records if "No space left" in r.getMessage()]) == 1
    monkeypatch.undo()
    assert not store.save_pose(estimate(7)) and stored_stamp(tmp_path) == 1
    assert store.save(landmarks(30), 0.25, estimate(8)) and store.save_pose(estimate(9))
    assert store.error == "" and stored_stamp(tmp_path) == 9


def test_a_state_without_its_map_is_not_used(tmp_path: Path) -> None:
    save_state(tmp_path / STATE_NAME, np.zeros(3), np.eye(3), State.TRACKING, 1)
    assert Store(tmp_path).load() is None
    assert (tmp_path / STATE_NAME).exists()


def test_a_smaller_map_that_is_kept_does_not_give_way_to_a_still_smaller_one(tmp_path: Path) -> None:
    assert Store(tmp_path).save(landmarks(300), 0.25, estimate(1))
    for size, stays in ((140, 140), (10, 140), (90, 90)):
        store = Store(tmp_path)
        store.load()
        assert not store.save(landmarks(size), 0.25, estimate(2))
        assert ("stays" in store.error) == (size == 10)
        beside = load_map(tmp_path / "map.smaller.json")
        assert beside is not None and len(beside.landmarks) == stays


def test_what_was_set_aside_before_is_not_replaced(tmp_path: Path) -> None:
    for n in range(MOST_REJECTED + 2):
        (tmp_path / MAP_NAME).write_text(f"spoilt {n}")
        assert Store(tmp_path).load() is None
    aside = sorted(tmp_path.glob(f"*{REJECTED}*"))
    assert len(aside) == MOST_REJECTED
    assert {p.read_text() for p in aside} == {f"spoilt {n}" for n in (*range(MOST_REJECTED - 1), MOST_REJECTED + 1)}


@pytest.mark.parametrize("variance", [1e5, 1e12, 1e14])
def test_a_pose_that_may_be_anywhere_is_stored_as_such(tmp_path: Path, variance: float) -> None:
    """Of hours in the dark: the filter found no digits in it at the next start, which ended, and so did every other.
    Beyond 1e12 m^2 it was not saved, and the map said so for ever."""
    vague = replace(estimate(1), cov=np.diag([variance, variance, 0.1]))
    store = Store(tmp_path)
    assert store.save(landmarks(30), 0.25, vague), store.error
    found = Store(tmp_path).load()
    assert found is not None and found.state is None and "searched for on all of it" in found.said


def test_a_pose_far_off_the_map_is_none(tmp_path: Path) -> None:
    """At the limit of what a file may say the robot drove beyond it, and nothing was saved any more."""
    store = Store(tmp_path)
    assert store.save(landmarks(30), 0.25, replace(estimate(1), pose=Pose(np.array([1e6, 0.0, 0.0]))))
    found = Store(tmp_path).load()
    assert found is not None and found.state is None and "searched for on all of it" in found.said


def test_what_cannot_be_written_is_said_by_its_own_name(tmp_path: Path) -> None:
    (tmp_path / "taken").mkdir()
    with pytest.raises(IsADirectoryError) as found:
        write_atomic(tmp_path / "taken", "x")
    assert found.value.filename == str(tmp_path / "taken")


def test_landmarks_that_may_be_anywhere_are_read_as_a_building_wide(tmp_path: Path) -> None:
    vague = replace(landmarks(3), cov_m2=np.stack([1e12 * np.eye(2), np.diag([1e6, 1e2]), 1e-4 * np.eye(2)]))
    assert Store(tmp_path).save(vague, 0.25, estimate(1))
    found = Store(tmp_path).load()
    assert found is not None
    assert np.allclose(found.map.landmarks.cov_m2, [1e4 * np.eye(2), np.diag([1e4, 1.0]), 1e-4 * np.eye(2)])
