"""A robot on one floor of a database of several: it keeps that one, and the others stay as they are."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from kept_maps import write_database
from map_contents import content, same_content
from map_writer import estimate, landmarks

from ceilvo.daemon.editing.sources import read
from ceilvo.daemon.map.database.content import MapContent
from ceilvo.daemon.map.database.copies import copy_of, floors_in, open_map
from ceilvo.daemon.map.kept.store import MAP_NAME, Store
from ceilvo.daemon.map.transitions import Side


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    for floor, count in (("ground", 300), ("first", 200)):
        with open_map(tmp_path / MAP_NAME, floor, create=True) as db:
            db.edit(MapContent.of(landmarks(count), 0.25), "begin")
    return tmp_path


@pytest.mark.parametrize(
    ("floor", "count", "other"), [("", 300, "first"), ("ground", 300, "first"), ("first", 200, "ground")]
)
def test_a_drive_is_saved_on_its_floor(folder: Path, floor: str, count: int, other: str) -> None:
    path, mine = folder / MAP_NAME, floor or "ground"
    before = read(path, other)
    store = Store(folder, floor=floor)
    found = store.load()
    assert found is not None and len(found.map.landmarks) == count
    assert store.save(landmarks(count + 5), 0.25, estimate(1)), store.error
    store.close()
    assert len(read(path, mine).landmarks) == count + 5
    assert same_content(read(path, other), before)
    again = Store(folder, floor=floor).load()
    assert again is not None and again.state is not None
    elsewhere = Store(folder, floor=other).load()
    assert elsewhere is not None and elsewhere.state is None, "the stored pose is on another floor"


def test_a_damaged_database_of_two_floors_gives_way_to_its_copy(folder: Path) -> None:
    store = Store(folder, floor="first")
    store.load()
    assert store.save(landmarks(210), 0.25, estimate(1))
    store.close()
    (folder / MAP_NAME).write_text("gone")
    found = Store(folder, floor="first").load()
    assert found is not None and len(found.map.landmarks) == 210 and found.state is not None
    for path in (folder / MAP_NAME, copy_of(folder / MAP_NAME)):
        path.write_text("gone, too")
    write_database(folder / f"{MAP_NAME}.1", landmarks(100))
    earlier = Store(folder).load()
    assert earlier is not None and len(earlier.map.landmarks) == 100


def test_a_floor_that_is_not_there_yet_is_begun_beside_the_others(folder: Path) -> None:
    path = folder / MAP_NAME
    before = {floor: read(path, floor) for floor in floors_in(path)}
    store = Store(folder, floor="second")
    assert store.load() is None, "nothing of it is known"
    assert store.save(landmarks(20), 0.25, estimate(1)), store.error
    store.close()
    assert floors_in(path) == ("ground", "first", "second") and len(read(path, "second").landmarks) == 20
    assert all(same_content(read(path, floor), was) for floor, was in before.items())
    assert not (folder / f"{MAP_NAME}.rejected").exists()


def test_giving_up_one_floor_leaves_the_others(folder: Path) -> None:
    path = folder / MAP_NAME
    with open_map(path, "first") as db:
        db.edit(content(50, 3, "first"), "again")
    before = read(path, "first")
    store = Store(folder, floor="ground")
    store.load()
    assert store.begin_anew()
    assert store.save(landmarks(3), 0.25, estimate(1))
    store.close()
    assert len(read(path, "ground").landmarks) == 3 and same_content(read(path, "first"), before)
    assert len(read(folder / f"{MAP_NAME}.1", "ground").landmarks) == 300


LIFT = (Side("north", "lift", 1.0, 2.0, 0.5), Side("north", "lift", -4.0, 7.0, 2.0))


@pytest.fixture
def joined(folder: Path) -> Path:
    """Both floors, joined by a lift, and one that nothing leads to."""
    for floor, side in zip(("ground", "first"), LIFT, strict=True):
        with open_map(folder / MAP_NAME, floor) as db:
            db.edit(replace(db.content(), sides=(side,)), "lift")
    with open_map(folder / MAP_NAME, "shed", create=True) as db:
        db.edit(MapContent.of(landmarks(40), 0.25), "begin")
    return folder


def test_floors_that_a_lift_joins_are_known_together(joined: Path) -> None:
    found = Store(joined).load()
    assert found is not None and [f.floor for f in found.floors] == ["ground", "first"]
    assert [len(f.map.landmarks) for f in found.floors] == [300, 200]
    assert [f.sides for f in found.floors] == [(LIFT[0],), (LIFT[1],)]
    assert "2 floors" in found.said and "'first'" in found.said
    alone = Store(joined, floor="shed").load()
    assert alone is not None and not alone.floors


def test_what_is_learnt_upstairs_is_kept_upstairs_and_the_pose_comes_back_there(joined: Path) -> None:
    path = joined / MAP_NAME
    ground, shed = read(path, "ground"), read(path, "shed")
    store = Store(joined)
    store.load()
    assert store.map_of("") == ("ground", 2)
    upstairs = replace(estimate(1), floor="first")
    assert store.save(landmarks(210), 0.25, upstairs), store.error
    assert store.map_of("first") == ("first", 3)
    store.close()
    assert same_content(read(path, "ground"), ground) and same_content(read(path, "shed"), shed)
    assert len(read(path, "first").landmarks) == 210
    again = Store(joined).load()
    assert again is not None and again.state is not None and again.floor == "first"
    assert np.array_equal(again.state.pose, upstairs.pose)


def test_the_floor_that_the_robot_left_is_kept_without_a_pose(joined: Path) -> None:
    store = Store(joined)
    store.load()
    assert store.save_left("ground", landmarks(310), 0.25, None), store.error
    assert store.save(landmarks(205), 0.25, replace(estimate(1), floor="first")), store.error
    store.close()
    assert len(read(joined / MAP_NAME, "ground").landmarks) == 310
    again = Store(joined).load()
    assert again is not None and again.floor == "first"


def test_a_map_begun_anew_upstairs_leaves_the_ground_floor_alone(joined: Path) -> None:
    path = joined / MAP_NAME
    ground = read(path, "ground")
    store = Store(joined)
    store.load()
    assert store.save(landmarks(200), 0.25, replace(estimate(1), floor="first"))
    store.begin_anew("first")
    assert store.save(landmarks(5), 0.1, estimate(2)), store.error
    store.close()
    assert same_content(read(path, "ground"), ground)
    assert len(read(path, "first").landmarks) == 5
