"""The database of maps: what is saved is what is read, by difference, and another program is noticed."""

from __future__ import annotations

import contextlib
import sqlite3
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from map_contents import content, key_poses, landmarks, same_content, same_key_poses, same_landmarks

from ceilvo.daemon.map.database import schema
from ceilvo.daemon.map.database.copies import open_map
from ceilvo.daemon.map.database.database import MapDatabase
from ceilvo.daemon.map.database.key_pose_rows import MOST_IN_SPACE, SPACE_M, kept
from ceilvo.daemon.map.database.spatial import cells
from ceilvo.errors import FileFormatError
from ceilvo.se2 import compose
from ceilvo.types import Landmarks

SEED = 5


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "map.db"


def test_what_is_saved_is_what_is_read(path: Path) -> None:
    own = landmarks(300)
    with open_map(path, create=True) as db:
        assert db.load() is None and db.version == 0
        assert (db.save(own, 0.25, "a", 100.0).added, db.version) == (300, 1)
        there = db.hash
    with open_map(path) as db:
        stored = db.load()
        assert stored is not None and same_landmarks(stored.landmarks, own) and stored.map_axis_rad == 0.25
        assert (db.hash, db.content().sessions[0].name) == (there, "a")
    assert [p.name for p in path.parent.iterdir()] == ["map.db"], "a closed database is one file"


def test_a_save_writes_what_changed_and_dates_it(path: Path) -> None:
    own = landmarks(300)
    with open_map(path, create=True) as db:
        db.save(own, 0.25, "a", 100.0)
        assert not db.save(own, 0.25, "a", 150.0)
        xy, sightings = own.xy_map_m.copy(), own.sightings.copy()
        xy[7] += 1.0
        sightings[8] += 1
        other = replace(own, xy_map_m=xy, sightings=sightings, expected=np.maximum(own.expected, sightings))
        fewer = other.of(np.arange(300) != 5)
        more = Landmarks(
            *(np.concatenate([getattr(fewer, n), getattr(own, n)[:1]]) for n in Landmarks.__dataclass_fields__)
        )
        more.ids[-1] = 5000
        written = db.save(more, 0.25, "a", 200.0)
        assert (written.changed, written.added, written.removed) == (2, 1, 1)
    with open_map(path) as db:
        whole = db.content()
        assert same_landmarks(whole.landmarks, more)
        seen = dict(zip(whole.landmarks.ids.tolist(), whole.seen_s.tolist(), strict=True))
        assert seen[int(own.ids[7])] == [100.0, 100.0], "it moved, but was not seen"
        assert seen[int(own.ids[8])] == [100.0, 200.0] and seen[5000] == [200.0, 200.0]
        assert whole.sessions[0].saves == 3 and whole.sessions[0].last_s == 200.0


@pytest.mark.parametrize(
    ("name", "index", "value"),
    [
        ("xy_map_m", (7, 0), 3.0),
        ("xy_map_m", (7, 1), 3.0),
        ("cov_m2", (7, 0, 0), 1.0),
        ("cov_m2", (7, [0, 1], [1, 0]), 0.0),
        ("cov_m2", (7, 1, 1), 1.0),
        ("crossing_type", 7, 12),
        ("sightings", 7, 0),
        ("expected", 7, 10**6),
    ],
)
def test_a_single_value_is_written(path: Path, name: str, index: Any, value: float) -> None:
    own = landmarks(20)
    column = getattr(own, name).copy()
    column[index] = value
    other = replace(own, **{name: column})
    with open_map(path, create=True) as db:
        db.save(own, 0.25)
        assert db.save(other, 0.25).changed == 1
    with open_map(path) as db:
        assert same_landmarks(db.content().landmarks, other) and not same_landmarks(own, other)


maps = st.integers(0, 40).flatmap(
    lambda n: st.lists(st.integers(0, 2**62), min_size=n, max_size=n, unique=True).map(
        lambda ids: replace(landmarks(n, seed=n), ids=np.array(ids, np.int64))
    )
)


@given(st.lists(maps, min_size=1, max_size=4), st.floats(-10.0, 10.0))
@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], deadline=None, max_examples=20)
def test_any_maps_after_one_another_leave_the_last(tmp_path: Path, drawn: list[Landmarks], axis_rad: float) -> None:
    path = tmp_path / "map.db"
    path.unlink(missing_ok=True)
    with open_map(path, create=True) as db:
        for own in drawn:
            db.save(own, axis_rad)
    with open_map(path) as db:
        stored = db.load()
        assert stored is not None and stored.map_axis_rad == axis_rad
        assert same_landmarks(stored.landmarks, drawn[-1].of(np.argsort(drawn[-1].ids)))


@pytest.mark.parametrize("rtree", [False, True])
def test_a_region_holds_what_is_in_it(path: Path, rtree: bool) -> None:
    if rtree and not schema.has_rtree():
        pytest.skip("this SQLite was compiled without R*Tree")
    schema.create(path, rtree)
    rng = np.random.default_rng(SEED)
    own = landmarks(500)
    with MapDatabase(path) as db:
        for _ in range(4):
            own = replace(own, xy_map_m=own.xy_map_m + rng.normal(0.0, 0.4, (len(own), 2)))
            own = own.of(rng.random(len(own)) < 0.9)
            db.save(own, 0.0)
            for _ in range(20):
                low = rng.uniform(-3.0, 20.0, 2)
                high = low + rng.uniform(0.0, 12.0, 2)
                inside = np.all((own.xy_map_m >= low) & (own.xy_map_m <= high), axis=1)
                assert same_landmarks(db.within(low, high), own.of(inside)), f"seed {SEED}"
        assert len(db.within(np.full(2, -1e6), np.full(2, 1e6))) == len(own)
        assert not db.mend_index()


@pytest.mark.parametrize("rtree", [False, True])
def test_an_index_that_is_wrong_is_made_anew(path: Path, rtree: bool, caplog: pytest.LogCaptureFixture) -> None:
    if rtree and not schema.has_rtree():
        pytest.skip("this SQLite was compiled without R*Tree")
    schema.create(path, rtree)
    with MapDatabase(path) as db:
        db.save(landmarks(50), 0.0)
    with contextlib.closing(sqlite3.connect(path)) as raw:
        raw.execute(f"DELETE FROM {'landmark_boxes' if rtree else 'landmark_cells'} WHERE key < 20")
        raw.commit()
    with MapDatabase(path) as db:
        assert len(db.within(np.zeros(2), np.full(2, 20.0))) == 50
    assert "made anew" in caplog.text


def test_several_floors(path: Path) -> None:
    with open_map(path, "1", create=True) as first, open_map(path, "2") as second:
        first.save(landmarks(30, 1), 0.1)
        second.save(landmarks(40, 2), 0.2)
        first.save(landmarks(31, 1), 0.1)
    with open_map(path, "1") as first, open_map(path, "2") as second:
        a, b = first.load(), second.load()
        assert a is not None and b is not None and (len(a.landmarks), len(b.landmarks)) == (31, 40)
        assert len(second.within(np.zeros(2), np.full(2, 99.0))) == 40
    with pytest.raises(FileFormatError, match="holds the floors 1, 2; say which with --floor"):
        open_map(path)


def test_what_another_program_wrote_is_followed(path: Path) -> None:
    with open_map(path, create=True) as db, open_map(path) as other:
        db.save(landmarks(30), 0.1)
        other.save(landmarks(20), 0.1)
        assert len(db.content().landmarks) == 20
        assert db.save(landmarks(30), 0.1).added == 10
    with open_map(path) as db:
        assert len(db.content().landmarks) == 30


def test_an_edit_of_a_map_that_was_written_meanwhile_is_refused(path: Path) -> None:
    with open_map(path, create=True) as db, open_map(path) as robot:
        db.save(landmarks(30), 0.1)
        before, found = db.content(), db.hash
        robot.save(landmarks(31), 0.1)
        with pytest.raises(FileFormatError, match="another program has written to it since it was read"):
            db.edit(before, "nothing", found)
        assert len(db.content().landmarks) == 31


def test_a_file_that_was_replaced_is_not_written(path: Path) -> None:
    with open_map(path, create=True) as db:
        db.save(landmarks(30), 0.1)
        path.rename(path.with_name("elsewhere.db"))
        with pytest.raises(FileFormatError, match="replaced or removed while it was open"):
            db.save(landmarks(31), 0.1)


BAD = {
    "two of one id": (replace(landmarks(3), ids=np.array([1, 2, 2])), "landmarks.id has duplicates"),
    "no place": (replace(landmarks(3), xy_map_m=np.full((3, 2), np.nan)), "landmarks.xy_map_m has a value that is not"),
    "no covariance": (replace(landmarks(3), cov_m2=-np.tile(np.eye(2), (3, 1, 1))), "an eigenvalue is negative"),
    "no type": (replace(landmarks(3), crossing_type=np.array([1, 2, 13])), "landmarks.kind"),
}


@pytest.mark.parametrize("name", BAD)
def test_nonsense_is_not_saved_and_the_map_stays(path: Path, name: str) -> None:
    own, said = BAD[name]
    with open_map(path, create=True) as db:
        db.save(landmarks(30), 0.1)
        with pytest.raises(FileFormatError, match=f"map.db: not written, it holds what it held: .*{said}"):
            db.save(own, 0.1)
        with pytest.raises(FileFormatError, match="map_axis_rad"):
            db.save(landmarks(3), np.nan)
        assert db.save(landmarks(31), 0.1).added == 1
    with open_map(path) as db:
        assert len(db.content().landmarks) == 31


def test_key_poses_are_bounded_by_space_and_the_newest_stay(path: Path) -> None:
    with open_map(path, create=True) as db:
        with pytest.raises(FileFormatError, match="key poses come before their map"):
            db.add_key_poses(key_poses("a", 3))
        db.save(landmarks(30), 0.1, "a")
        for session in range(12):
            db.add_key_poses(key_poses(f"{session:02}", 20, seed=session, side_m=2.0))
    with open_map(path) as db:
        stored = db.content().key_poses
    at = np.vstack([k.pose for k in stored])
    _, count = np.unique(cells(at[:, :2], SPACE_M), return_counts=True)
    assert count.max() == MOST_IN_SPACE and len(at) == MOST_IN_SPACE * len(count), "four squares, all full"
    assert {k.session for k in stored} <= {"09", "10", "11"}
    last = next(k for k in stored if k.session == "11")
    original = key_poses("11", 20, seed=11, side_m=2.0)
    assert set(last.stamp_ns.tolist()) <= set(original.stamp_ns.tolist())


def test_key_poses_come_back_to_the_bit(path: Path) -> None:
    whole = content()
    with open_map(path, create=True) as db:
        db.edit(whole, "all of it")
    with open_map(path) as db:
        assert same_content(db.content(), whole)
        assert db.add_key_poses(whole.key_poses[0]) == 0, "they are there"
        more = replace(key_poses("hall-3/a", 5, seed=9, side_m=500.0), stamp_ns=10**12 + np.arange(5))
        assert db.add_key_poses(more) == 5
        assert len(db.content().key_poses[0]) == 35


def test_the_motion_over_a_key_pose_that_goes_is_added_up() -> None:
    k = key_poses("a", 6)
    fewer = kept(k, np.array([True, True, False, False, True, False]))
    over = compose(compose(k.motion[2], k.motion[3]), k.motion[4])
    assert fewer.stamp_ns.tolist() == [k.stamp_ns[i] for i in (0, 1, 4)]
    assert np.allclose(fewer.motion[2], over, rtol=0.0, atol=1e-12) and same_key_poses(kept(k, np.full(6, True)), k)
    assert np.trace(fewer.motion_cov[2]) > np.trace(k.motion_cov[4]) and np.array_equal(fewer.motion[1], k.motion[1])
    first = kept(k, np.array([False, True, True, True, True, True]))
    assert np.all(np.isinf(np.diag(first.motion_cov[0]))), "the first says nothing"
    assert first.features == int(np.sum(k.view != 0)) and first.view.max() <= 4


def test_edits_are_undone_to_the_bit(path: Path) -> None:
    rng = np.random.default_rng(SEED)
    with open_map(path, create=True) as db:
        db.edit(content(300), "begin")
        assert db.history() == ()
        states = [(db.hash, db.content())]
        for n in range(6):
            now = db.content()
            keep = rng.random(len(now.landmarks)) < 0.8
            own = now.landmarks.of(keep)
            own = replace(own, xy_map_m=own.xy_map_m + rng.normal(0.0, 1.0, (len(own), 2)))
            poses = tuple(kept(k, rng.random(len(k)) < 0.7) for k in now.key_poses) if n % 2 else now.key_poses
            db.edit(
                replace(now, landmarks=own, seen_s=now.seen_s[keep], axis_rad=0.1 * n, key_poses=poses), f"edit {n}"
            )
            states.append((db.hash, db.content()))
        assert len({h for h, _ in states}) == 7
    with open_map(path) as db:
        assert [e.what for e in db.history()] == [f"edit {n}" for n in reversed(range(6))]
        for before, whole in reversed(states[:-1]):
            db.undo()
            assert db.hash == before and same_content(db.content(), whole), f"seed {SEED}"
            assert not db.mend_index()
        with pytest.raises(FileFormatError, match="no edit to undo"):
            db.undo()


def test_a_robot_that_saved_since_is_not_mixed_up_by_undoing(path: Path) -> None:
    with open_map(path, create=True) as db:
        db.save(landmarks(30), 0.1)
        now = db.content()
        db.edit(replace(now, axis_rad=0.2), "turn the axis")
        db.save(landmarks(31), 0.2)
        with pytest.raises(FileFormatError, match="changed since 'turn the axis': its hash is"):
            db.undo()
        assert len(db.content().landmarks) == 31


def test_the_undo_log_is_bounded(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("ceilvo.daemon.map.database.edits.MOST_EDITS", 3)
    with open_map(path, create=True) as db:
        db.save(landmarks(30), 0.0)
        for n in range(1, 6):
            db.edit(replace(db.content(), axis_rad=0.1 * n), f"{n}")
        assert [e.what for e in db.history()] == ["5", "4", "3"]
        for _ in range(3):
            db.undo()
        assert db.content().axis_rad == 0.2
