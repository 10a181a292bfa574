"""Maps of earlier runs: which are kept, what replaces which, and that no trouble of the disk costs one."""

from __future__ import annotations

import os
from pathlib import Path

import pytest
from map_writer import estimate, landmarks

from ceilvo.daemon.map.map_file import load_map, save_map
from ceilvo.daemon.map.store import MAP_NAME, STATE_NAME, Store
from ceilvo.files import REJECTED


def count(path: Path) -> int:
    """Landmarks of a map file; 0 where there is none."""
    stored = load_map(path)
    return 0 if stored is None else len(stored.landmarks)


def test_a_damaged_map_gives_way_to_the_one_before(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    runs = [300, 290, 280, 270]
    for run, size in enumerate(runs):
        store = Store(tmp_path, generations=3)
        store.load()
        assert store.save(landmarks(size), 0.25, estimate(run))
        os.utime(tmp_path / MAP_NAME, (1e9 + 7200.0 * run,) * 2)
    assert sorted(p.name for p in tmp_path.glob("map.json.*")) == ["map.json.1", "map.json.2", "map.json.3"]
    (tmp_path / MAP_NAME).write_bytes(b"gone")
    (tmp_path / "map.json.1").write_bytes(b"gone, too")
    found = Store(tmp_path).load()
    assert found is not None and len(found.map.landmarks) == 290 and found.state is not None
    assert "an earlier map loaded, map.json.2, 290 landmarks" in found.said
    assert [r.getMessage().split(": ")[0] for r in caplog.records] == [f"{tmp_path}/map.json", f"{tmp_path}/map.json.1"]
    assert (tmp_path / ("map.json" + REJECTED)).read_bytes() == b"gone"


def test_restarts_without_end_do_not_push_all_generations_out(tmp_path: Path) -> None:
    old = Store(tmp_path)
    assert old.save(landmarks(300), 0.25, estimate(1))
    os.utime(tmp_path / MAP_NAME, (1e9, 1e9))
    for n in range(20):
        store = Store(tmp_path)
        store.load()
        assert store.save(landmarks(301 + n), 0.25, estimate(n))
    assert count(tmp_path / "map.json.2") == 300
    assert not (tmp_path / "map.json.3").exists()


def test_a_map_that_does_not_change_pushes_no_other_out(tmp_path: Path) -> None:
    """As on a map of another building: nothing is learnt, and the right one must not go by and by."""
    save_map(tmp_path / "map.json.1", landmarks(200), 0.25)
    save_map(tmp_path / MAP_NAME, landmarks(300), 0.25)
    for n in range(8):
        os.utime(tmp_path / MAP_NAME, (1e9 + 7200.0 * n,) * 2)
        store = Store(tmp_path, generations=3)
        store.load()
        assert store.save(landmarks(300), 0.25, estimate(n))
    assert [count(path) for path in places(tmp_path)] == [300, 300, 200, 0]


def test_a_map_that_its_owner_gave_up_stays_as_a_generation(tmp_path: Path) -> None:
    store = Store(tmp_path)
    assert store.save(landmarks(300), 0.25, estimate(1))
    store.begin_anew()
    assert store.save(landmarks(3), 0.25, estimate(2))
    assert (count(tmp_path / MAP_NAME), count(tmp_path / "map.json.1")) == (3, 300)


def test_a_map_that_was_given_up_is_kept_before_it_is_replaced_however_late(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A reset on a disk that refuses: the generations before are a minute old, so none would be made."""
    store = Store(tmp_path)
    for n in range(2):
        assert store.save(landmarks(300), 0.25, estimate(n))
    save_map(tmp_path / "map.json.1", landmarks(299), 0.25)

    def refused(*_: object) -> None:
        raise OSError(30, "Read-only file system")

    monkeypatch.setattr(os, "link", refused)
    monkeypatch.setattr(os, "fsync", refused)
    assert not store.begin_anew()
    monkeypatch.undo()
    assert store.save(landmarks(3), 0.25, estimate(2))
    assert [count(tmp_path / f"map.json.{n}") for n in (1, 2)] == [300, 299]


def test_no_generations_where_none_are_wanted(tmp_path: Path) -> None:
    for n in range(3):
        store = Store(tmp_path, generations=0)
        store.load()
        assert store.save(landmarks(30), 0.25, estimate(n))
        store.begin_anew()
    assert sorted(p.name for p in tmp_path.iterdir()) == [MAP_NAME, STATE_NAME]


def test_a_map_on_a_disk_that_is_mounted_late_is_not_overwritten(tmp_path: Path) -> None:
    """The daemon had found no map, so nothing was too small to replace the one that came."""
    store, folder = Store(tmp_path / "state"), tmp_path / "state"
    assert store.load() is None
    assert not store.save(landmarks(2), 0.25, estimate(1))
    assert Store(tmp_path).save(landmarks(300), 0.25, estimate(2))
    folder.mkdir()
    (tmp_path / MAP_NAME).rename(folder / MAP_NAME)
    assert not store.save(landmarks(3), 0.25, estimate(3))
    assert "map.json with 300 landmarks is kept" in store.error
    assert store.save(landmarks(200), 0.25, estimate(4)), "one that is not much smaller replaces it"
    assert count(folder / "map.json.1") == 300, "and it is kept all the same"


def test_a_map_that_somebody_puts_there_meanwhile_becomes_a_generation(tmp_path: Path) -> None:
    store = Store(tmp_path)
    for n in range(2):
        assert store.save(landmarks(300), 0.25, estimate(n))
    save_map(tmp_path / MAP_NAME, landmarks(299), 0.25)
    assert store.save(landmarks(301), 0.25, estimate(2))
    assert count(tmp_path / "map.json.1") == 299
    (tmp_path / MAP_NAME).write_bytes(b"spoilt while it runs")
    assert store.save(landmarks(301), 0.25, estimate(3))
    assert count(tmp_path / MAP_NAME) == 301
    assert (tmp_path / (MAP_NAME + REJECTED)).read_bytes() == b"spoilt while it runs"


def places(folder: Path) -> list[Path]:
    """map.json and three generations."""
    return [folder / MAP_NAME, *(folder / f"{MAP_NAME}.{n}" for n in (1, 2, 3))]


def with_generations(folder: Path) -> None:
    """300 landmarks in the last map, and 1 less in each before."""
    for n, path in enumerate(places(folder)):
        save_map(path, landmarks(300 - n), 0.25)
        os.utime(path, (1e9 - 7200.0 * n,) * 2)


def test_a_full_disk_without_second_names_costs_no_generation(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Each attempt to save moved them on by one before the copy failed: five attempts, and all were gone."""
    with_generations(tmp_path)

    def refused(*_: object) -> None:
        raise OSError(28, "No space left on device")

    store = Store(tmp_path, generations=3)
    store.load()
    monkeypatch.setattr(os, "link", refused)
    monkeypatch.setattr(os, "fsync", refused)
    for n in range(6):
        assert not store.save(landmarks(301), 0.25, estimate(n))
    monkeypatch.undo()
    assert [count(path) for path in places(tmp_path)] == [300, 299, 298, 297]
    monkeypatch.setattr(os, "link", refused)
    assert store.save(landmarks(301), 0.25, estimate(7))
    assert [count(path) for path in places(tmp_path)] == [301, 300, 299, 298]
    assert (tmp_path / "map.json.1").stat().st_mtime == 1e9, "a copy is as old as what was copied"


@pytest.mark.parametrize("place", ["map.json.1", "map.json.2", "map.json.3"])
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
