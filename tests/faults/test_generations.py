"""Maps of earlier runs: which are kept, what replaces which, and that no trouble of the disk costs one."""

from __future__ import annotations

import contextlib
import os
import sqlite3
from pathlib import Path

import numpy as np
import pytest
from kept_maps import count, write_database
from map_writer import estimate, landmarks

from ceilvo.daemon.map.database.copies import copy_of
from ceilvo.daemon.map.database.database import MapDatabase
from ceilvo.daemon.map.kept.store import MAP_NAME, STATE_NAME, Store
from ceilvo.files import REJECTED

FIRST, SECOND, THIRD = (f"{MAP_NAME}.{n}" for n in (1, 2, 3))


def run(folder: Path, size: int, n: int, generations: int = 5) -> Store:
    """A run that saves once."""
    store = Store(folder, generations)
    store.load()
    assert store.save(landmarks(size), 0.25, estimate(n)), store.error
    store.close()
    return store


def test_a_damaged_map_gives_way_to_the_one_before(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    for n, size in enumerate([300, 290, 280, 270, 260]):
        run(tmp_path, size, n, generations=3)
        if n:
            os.utime(tmp_path / FIRST, (1e9 + 7200.0 * n,) * 2)
    assert sorted(p.name for p in tmp_path.glob("map.db.?")) == [FIRST, SECOND, THIRD]
    for name in (MAP_NAME, "map.db.good", FIRST):
        (tmp_path / name).unlink()  # the copy and a generation may be one file
        (tmp_path / name).write_text(f"{name} is gone")
    found = Store(tmp_path).load()
    assert found is not None and len(found.map.landmarks) == 280 and found.state is not None
    assert "an earlier map loaded, map.db.2, 280 landmarks" in found.said
    first, second = (r.getMessage() for r in caplog.records)
    assert first.startswith(f"{tmp_path}/map.db: ") and "map.db.good" in first
    assert first.endswith("set aside as map.db.rejected and map.db.good.rejected")
    assert second.startswith(f"{tmp_path}/map.db.1: ") and second.endswith("set aside as map.db.1.rejected")
    for name in (MAP_NAME, "map.db.good", FIRST):
        assert (tmp_path / (name + REJECTED)).read_text() == f"{name} is gone"
    assert count(tmp_path / MAP_NAME) == 280, "it is the map again"


def test_the_good_copy_comes_before_generations(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    for n, size in enumerate([300, 290, 280]):
        run(tmp_path, size, n)
    (tmp_path / MAP_NAME).write_text("gone")
    found = Store(tmp_path).load()
    assert found is not None and len(found.map.landmarks) == 280 and found.state is not None
    what, which = (r.getMessage() for r in caplog.records)
    assert what.endswith("set aside as map.db.rejected")
    assert "the last good copy, map.db.good of " in which and "is used: 280 landmarks" in which


def test_restarts_without_end_do_not_push_all_generations_out(tmp_path: Path) -> None:
    run(tmp_path, 300, 0)
    run(tmp_path, 301, 1)
    os.utime(tmp_path / FIRST, (1e9, 1e9))
    for n in range(20):
        run(tmp_path, 302 + n, n)
    assert count(tmp_path / SECOND) == 300
    assert not (tmp_path / THIRD).exists()


def test_a_map_that_does_not_change_pushes_no_other_out(tmp_path: Path) -> None:
    """As on a map of another building: nothing is learnt, and the right one must not go by and by."""
    write_database(tmp_path / FIRST, landmarks(200))
    write_database(tmp_path / MAP_NAME, landmarks(300))
    for n in range(8):
        for path in (tmp_path / FIRST, tmp_path / SECOND):
            if path.exists():
                os.utime(path, (1e9 + 7200.0 * n,) * 2)
        run(tmp_path, 300, n, generations=3)
    assert [count(path) for path in places(tmp_path)] == [300, 300, 200, 0]


def test_a_map_that_its_owner_gave_up_stays_as_a_generation(tmp_path: Path) -> None:
    store = Store(tmp_path)
    assert store.save(landmarks(300), 0.25, estimate(1))
    store.begin_anew()
    assert store.save(landmarks(3), 0.25, estimate(2))
    assert (count(tmp_path / MAP_NAME), count(tmp_path / FIRST)) == (3, 300)
    assert count(copy_of(tmp_path / MAP_NAME)) == 3, "the good copy is of the new map, whose poses are others"
    again = Store(tmp_path).load()
    assert again is not None and again.state is not None


def test_a_map_that_was_given_up_is_kept_before_it_is_replaced_however_late(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A reset on a disk that refuses: the generations before are a minute old, so none would be made."""
    store = Store(tmp_path)
    for n in range(2):
        assert store.save(landmarks(300), 0.25, estimate(n))
    write_database(tmp_path / FIRST, landmarks(299))

    def refused(*_: object) -> None:
        raise OSError(30, "Read-only file system")

    monkeypatch.setattr(os, "link", refused)
    monkeypatch.setattr(os, "fsync", refused)
    assert not store.begin_anew()
    monkeypatch.undo()
    assert store.save(landmarks(3), 0.25, estimate(2))
    assert [count(tmp_path / name) for name in (FIRST, SECOND)] == [300, 299]


def test_no_generations_where_none_are_wanted(tmp_path: Path) -> None:
    for n in range(3):
        store = Store(tmp_path, generations=0)
        store.load()
        assert store.save(landmarks(30), 0.25, estimate(n))
        store.begin_anew()
        store.close()
    assert sorted(p.name for p in tmp_path.iterdir()) == [MAP_NAME, "map.db.good", STATE_NAME]


def test_a_map_on_a_disk_that_is_mounted_late_is_not_overwritten(tmp_path: Path) -> None:
    """The daemon had found no map, so nothing was too small to replace the one that came."""
    store, folder = Store(tmp_path / "state"), tmp_path / "state"
    assert store.load() is None
    assert not store.save(landmarks(2), 0.25, estimate(1))
    run(tmp_path, 300, 2)
    folder.mkdir()
    (tmp_path / MAP_NAME).rename(folder / MAP_NAME)
    assert not store.save(landmarks(3), 0.25, estimate(3))
    assert "map.db with 300 landmarks is kept" in store.error
    assert store.save(landmarks(200), 0.25, estimate(4)), "one that is not much smaller replaces it"
    assert count(folder / FIRST) == 300, "and it is kept all the same"


def test_a_map_that_somebody_puts_there_meanwhile_becomes_a_generation(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    store = Store(tmp_path)
    for n in range(2):
        assert store.save(landmarks(300), 0.25, estimate(n))
    write_database(tmp_path / "other.db", landmarks(299))
    (tmp_path / "other.db").replace(tmp_path / MAP_NAME)
    assert store.save(landmarks(301), 0.25, estimate(2))
    assert (count(tmp_path / FIRST), count(tmp_path / MAP_NAME)) == (299, 300), "without what that one has not"
    store.close()
    (tmp_path / MAP_NAME).write_bytes(b"spoilt while it runs")
    assert store.save(landmarks(302), 0.25, estimate(3))
    assert count(tmp_path / MAP_NAME) == 301
    assert (tmp_path / (MAP_NAME + REJECTED)).read_bytes() == b"spoilt while it runs"
    assert "set aside as map.db.rejected" in caplog.text and "the last good copy" in caplog.text


def test_an_edit_while_it_runs_becomes_a_generation(tmp_path: Path) -> None:
    """`ceilvod map` on the database of a daemon that runs: what is learnt is added to what it made."""
    store = Store(tmp_path)
    assert store.save(landmarks(300), 0.25, estimate(1))
    with MapDatabase(tmp_path / MAP_NAME) as db:
        db.save(landmarks(280), 0.25)
    assert not store.save_pose(estimate(2)), "a pose on another map"
    assert store.save(landmarks(301), 0.25, estimate(3))
    assert (count(tmp_path / FIRST), count(tmp_path / MAP_NAME)) == (280, 281)


def test_a_page_that_is_damaged_while_it_runs_is_noticed_within_an_hour(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """The hourly copy is read back: what is damaged does not become it."""
    store = Store(tmp_path)
    for n in range(3):
        assert store.save(landmarks(300), 0.25, estimate(n))
    with contextlib.closing(sqlite3.connect(tmp_path / MAP_NAME)) as db:
        db.execute("PRAGMA wal_checkpoint(TRUNCATE)")
        raw = bytearray((tmp_path / MAP_NAME).read_bytes())
        page = raw.index(np.array([0.6 * 7], ">f8").tobytes())
    with (tmp_path / MAP_NAME).open("r+b") as f:
        f.seek(page + 2)
        f.write(b"\xff\xff")
    store.keep_copy()
    assert count(copy_of(tmp_path / MAP_NAME)) == 300
    assert store.save(landmarks(301), 0.25, estimate(4)), store.error
    assert count(tmp_path / MAP_NAME) == 301
    assert "are not what was written" in caplog.text and "is used: 300 landmarks" in caplog.text


def places(folder: Path) -> list[Path]:
    """The map and three generations."""
    return [folder / MAP_NAME, *(folder / f"{MAP_NAME}.{n}" for n in (1, 2, 3))]


def with_generations(folder: Path) -> None:
    """300 landmarks in the last map, and 1 less in each before."""
    for n, path in enumerate(places(folder)):
        write_database(path, landmarks(300 - n))
        os.utime(path, (1e9 - 7200.0 * n,) * 2)


def test_a_disk_without_room_for_a_copy_costs_no_generation(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Each attempt to save moved them on by one before the copy failed: five attempts, and all were gone. The map is
    saved by difference all the same: that needs less room."""
    with_generations(tmp_path)

    def refused(*_: object) -> None:
        raise OSError(28, "No space left on device")

    store = Store(tmp_path, generations=3)
    store.load()
    monkeypatch.setattr(os, "link", refused)
    monkeypatch.setattr(os, "fsync", refused)
    for n in range(6):
        assert not store.save(landmarks(301), 0.25, estimate(n)), "the pose cannot be written"
    monkeypatch.undo()
    assert [count(path) for path in places(tmp_path)] == [301, 299, 298, 297]
    store.close()
    store = Store(tmp_path, generations=3)
    store.load()
    monkeypatch.setattr(os, "link", refused)
    assert store.save(landmarks(302), 0.25, estimate(7))
    assert [count(path) for path in places(tmp_path)] == [302, 301, 299, 298]
    made_at = [(tmp_path / name).stat().st_mtime for name in ("map.db.good", FIRST)]
    assert made_at[0] == made_at[1], "a copy is as old as what was copied"


@pytest.mark.parametrize("place", [FIRST, SECOND, THIRD])
def test_a_folder_in_the_place_of_a_generation_is_in_nobodys_way(
    tmp_path: Path, place: str, caplog: pytest.LogCaptureFixture
) -> None:
    """No map was saved any more: the generations could not be moved on."""
    with_generations(tmp_path)
    (tmp_path / place).unlink()
    (tmp_path / place).mkdir()
    (tmp_path / place / "notes.txt").write_text("mine")
    store = Store(tmp_path, generations=3)
    store.load()
    assert store.save(landmarks(301), 0.25, estimate(1)), store.error
    assert (tmp_path / (place + REJECTED) / "notes.txt").read_text() == "mine"
    assert [place in r.getMessage() for r in caplog.records] == [True]
