"""A map that another program changed while a robot was on it: what is written then, and that neither loses anything."""

from __future__ import annotations

import sqlite3
from collections.abc import Callable
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from kept_maps import load_database
from map_contents import key_poses
from map_writer import estimate, landmarks

from ceilvo.daemon.map.database.database import MapDatabase
from ceilvo.daemon.map.kept.change import Change
from ceilvo.daemon.map.kept.store import MAP_NAME, STATE_NAME, Store
from ceilvo.daemon.map.map_file import StoredMap, load_state
from ceilvo.errors import FileFormatError
from ceilvo.se2 import rotation, transform
from ceilvo.types import Landmarks, Pose

AXIS_RAD = 0.25
MOVED = np.array([0.004, -0.002, np.radians(0.05)])
"""m, m, rad: how the other program moved the map as a whole."""
SEED = 3


def bend(xy_m: np.ndarray) -> np.ndarray:
    """What a refinement does besides: millimetres that change over metres."""
    return 0.003 * np.sin(xy_m[:, ::-1] / 4.0)


def changed(m: Landmarks, moved: np.ndarray = MOVED) -> Landmarks:
    """The map as the other program has it."""
    turn = rotation(float(moved[2]))
    return replace(m, xy_map_m=transform(Pose(moved), m.xy_map_m + bend(m.xy_map_m)), cov_m2=turn @ m.cov_m2 @ turn.T)


def other_program(folder: Path, make: Callable[[Landmarks], Landmarks], turned_rad: float = MOVED[2]) -> None:
    with MapDatabase(folder / MAP_NAME) as db:
        content = db.content()
        after = replace(content, landmarks=make(content.landmarks), axis_rad=content.axis_rad + turned_rad)
        db.edit(replace(after, seen_s=np.zeros((len(after.landmarks), 2))), "another program")


def stored(folder: Path) -> Landmarks:
    found = load_database(folder / MAP_NAME)
    assert found is not None
    return found.landmarks


@pytest.fixture
def store(tmp_path: Path) -> Store:
    """A robot on a map of 100 landmarks that is saved."""
    out = Store(tmp_path)
    assert out.save(landmarks(100), AXIS_RAD, estimate(1))
    return out


@pytest.mark.parametrize("moved", [MOVED, np.array([30.0, -4.0, 2.0])])
def test_points_and_poses_go_where_the_map_around_them_went(moved: np.ndarray) -> None:
    """Also where the map was aligned to a floor plan far off."""
    here = landmarks(400)
    change = Change.between(StoredMap(here, AXIS_RAD), StoredMap(changed(here, moved), AXIS_RAD + moved[2]))
    assert change is not None
    rng = np.random.default_rng(SEED)
    at = rng.uniform([1.0, 1.0], [10.0, 10.0], (20, 2))
    want = transform(Pose(moved), at + bend(at))
    assert np.max(np.hypot(*(change.points(at) - want).T)) < 0.001, f"seed {SEED}"
    pose = change.pose(np.array([*at[0], 0.7]))
    assert np.hypot(*(pose[:2] - want[0])) < 0.001
    assert abs(np.angle(np.exp(1j * (pose[2] - 0.7 - moved[2])))) < 0.002


@pytest.mark.parametrize("other", ["elsewhere", "other ids", "another axis", "few"])
def test_another_map_is_no_change(other: str) -> None:
    m, rng = landmarks(100), np.random.default_rng(SEED)
    there = {
        "elsewhere": replace(m, xy_map_m=rng.permutation(m.xy_map_m)),
        "other ids": replace(m, ids=m.ids + 1000),
        "another axis": m,
        "few": m.of(np.arange(7)),
    }[other]
    axis = AXIS_RAD + 0.2 * (other == "another axis")
    assert Change.between(StoredMap(m, AXIS_RAD), StoredMap(there, axis)) is None


def test_what_both_did_is_in_the_database(store: Store, tmp_path: Path) -> None:
    """The other program moves all, forgets 5 and adds one under an id that the robot gives to one of its own."""
    here = landmarks(103)  # the robot has learnt 3 more ...
    more = here.sightings + np.where(here.ids == 7, 10, 0)  # ... and seen one again, which it has not lost
    surer = np.where((here.ids == 7)[:, None, None], 0.5 * here.cov_m2, here.cov_m2)
    ours = replace(here, sightings=more, expected=more, cov_m2=surer).of(here.ids != 20)  # one is gone

    def make(m: Landmarks) -> Landmarks:
        there = landmarks(101).of(np.array([100]))
        out = changed(m.of(m.ids >= 5))
        columns = ("ids", "xy_map_m", "cov_m2", "crossing_type", "sightings", "expected")
        far = replace(there, xy_map_m=np.array([[50.0, 50.0]]))
        return Landmarks(*(np.concatenate([getattr(out, n), getattr(far, n)]) for n in columns))

    other_program(tmp_path, make)
    assert store.change is None
    assert store.save(ours, AXIS_RAD, estimate(2))
    for again in range(2):
        found = stored(tmp_path)
        assert set(found.ids.tolist()) == {*range(5, 101), 101, 102, 103} - {20}
        want = dict(zip(here.ids.tolist(), changed(here).xy_map_m, strict=True)) | {103: changed(here).xy_map_m[100]}
        off = [np.hypot(*(xy - want[i])) for i, xy in zip(found.ids.tolist(), found.xy_map_m, strict=True) if i != 100]
        assert max(off) < 0.002
        (seen,) = np.flatnonzero(found.ids == 7)
        assert found.sightings[seen] == landmarks(8).sightings[7] + 10
        assert np.allclose(found.cov_m2[seen], 0.5 * landmarks(8).cov_m2[7], rtol=1e-6)
        assert store.save(ours, AXIS_RAD, estimate(3 + again)), "and stays so, save after save"
    assert store.change is not None
    state = load_state(tmp_path / STATE_NAME)
    assert state is not None and np.allclose(state.pose, store.change.pose(estimate(4).pose))
    before = stored(tmp_path)
    whole, pose = store.moved(StoredMap(ours, AXIS_RAD), estimate(4).pose)
    assert store.change is None and np.array_equal(np.sort(whole.landmarks.ids), before.ids)
    assert np.allclose(pose, state.pose)
    assert store.save(whole.landmarks, whole.map_axis_rad, estimate(5))
    assert np.array_equal(stored(tmp_path).xy_map_m, before.xy_map_m), "nothing was learnt since"
    with MapDatabase(tmp_path / MAP_NAME) as db:
        assert db.history()[0].what == "another program"


def test_a_map_that_is_none_of_the_robots_stays_as_a_generation(
    store: Store, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    other_program(tmp_path, lambda m: replace(m, xy_map_m=m.xy_map_m[::-1]))
    for n in range(2):
        assert store.save(landmarks(101), AXIS_RAD, estimate(2 + n))
    (line,) = [r.message for r in caplog.records if "another program" in r.message]
    assert "\n" not in line and "map.db.1" in line and store.change is None
    assert np.array_equal(stored(tmp_path).xy_map_m, landmarks(101).xy_map_m)
    kept = load_database(tmp_path / f"{MAP_NAME}.1")
    assert kept is not None and np.array_equal(kept.landmarks.xy_map_m, landmarks(100).xy_map_m[::-1])


def test_a_robot_that_goes_back_to_its_own_map_keeps_the_other(store: Store, tmp_path: Path) -> None:
    other_program(tmp_path, changed)
    assert store.save(landmarks(100), AXIS_RAD, estimate(2))
    _, _ = store.moved(StoredMap(landmarks(100), AXIS_RAD), estimate(2).pose)
    store.stay()
    assert store.save(landmarks(100), AXIS_RAD, estimate(3))
    assert np.array_equal(stored(tmp_path).xy_map_m, landmarks(100).xy_map_m)
    kept = load_database(tmp_path / f"{MAP_NAME}.1")
    assert kept is not None and np.allclose(kept.landmarks.xy_map_m, changed(landmarks(100)).xy_map_m)


def test_who_writes_between_the_look_and_the_writing_loses_nothing(
    store: Store, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    onto, times = store._apart.onto, [0]

    def late(*args: object) -> StoredMap:
        out = onto(*args)  # type: ignore[arg-type]
        if not times[0]:
            times[0] = 1
            other_program(tmp_path, changed)
        return out

    monkeypatch.setattr(store._apart, "onto", late)
    assert store.save(landmarks(101), AXIS_RAD, estimate(2))
    found = stored(tmp_path)
    assert len(found) == 101 and np.allclose(found.xy_map_m, changed(landmarks(101)).xy_map_m, atol=0.001)


def test_what_a_robot_goes_on_learning_keeps_apart_from_names_that_were_given(store: Store, tmp_path: Path) -> None:
    """The name given to a landmark whose id was taken is the next id that the robot itself gives."""
    added = landmarks(102).of(np.array([100, 101]))
    far = replace(added, xy_map_m=np.array([[50.0, 50.0], [51.0, 50.0]]))
    columns = ("ids", "xy_map_m", "cov_m2", "crossing_type", "sightings", "expected")

    def make(m: Landmarks) -> Landmarks:
        return Landmarks(*(np.concatenate([getattr(changed(m), n), getattr(far, n)]) for n in columns))

    other_program(tmp_path, make)
    for n, count in enumerate((103, 104, 130, 131)):
        assert store.save(landmarks(count), AXIS_RAD, estimate(2 + n))
        found = stored(tmp_path)
        assert len(found) == count + 2
        assert len(np.unique(found.ids)) == len(found)
        want = np.vstack([changed(landmarks(count)).xy_map_m, far.xy_map_m])
        apart = np.hypot(*(found.xy_map_m[:, None] - want).transpose(2, 0, 1))
        assert np.max(np.min(apart, axis=0)) < 0.003, "all that the robot knows is there once, where it belongs"
        assert np.max(np.min(apart, axis=1)) < 0.003


def test_a_save_that_fails_half_way_is_no_other_program(
    store: Store, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """As of a folder that is taken away between the landmarks and the key poses; the landmarks are this robot's own."""
    add, fails = MapDatabase.add_key_poses, [True]

    def add_or_fail(db: MapDatabase, *args: object) -> int:
        if fails[0]:
            raise FileFormatError(f"{db.path}: disk I/O error")
        return add(db, *args)  # type: ignore[arg-type]

    views = key_poses("robot", 5)
    monkeypatch.setattr(MapDatabase, "add_key_poses", add_or_fail)
    assert not store.save(landmarks(110), AXIS_RAD, estimate(2), key_poses=views)
    assert "disk I/O error" in store.error
    fails[0] = False
    for n, count in enumerate((112, 113)):
        assert store.save(landmarks(count), AXIS_RAD, estimate(3 + n), key_poses=views)
        assert store.change is None
        assert np.array_equal(stored(tmp_path).ids, np.arange(count))
        assert np.array_equal(stored(tmp_path).xy_map_m, landmarks(count).xy_map_m)
    with MapDatabase(tmp_path / MAP_NAME) as db:
        assert sum(map(len, db.content().key_poses)) == 5
    assert not any("another program" in r.message for r in caplog.records)


def test_a_damaged_database_costs_nothing_that_the_robot_knows(store: Store, tmp_path: Path) -> None:
    """Its good copy has less, and is no other program's map."""
    store.keep_copy()
    assert store.save(landmarks(110), AXIS_RAD, estimate(2))
    with closing(sqlite3.connect(tmp_path / MAP_NAME)) as db:
        db.execute("UPDATE landmarks SET x = x + 1 WHERE id = 5")
        db.commit()
    for n, count in enumerate((112, 114)):
        assert store.save(landmarks(count), AXIS_RAD, estimate(3 + n))
        assert store.change is None
        assert np.array_equal(stored(tmp_path).xy_map_m, landmarks(count).xy_map_m)
