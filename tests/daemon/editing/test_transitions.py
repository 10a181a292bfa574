"""`ceilvod map transition`: lifts and ramps go with their floors, through edits, undos, exports and damage."""

from __future__ import annotations

import contextlib
import sqlite3
from pathlib import Path

import numpy as np
import pytest
from map_contents import content

from ceilvo.daemon import cli
from ceilvo.daemon.editing.exchange import from_json, to_json
from ceilvo.daemon.editing.sources import read
from ceilvo.daemon.map.checks import Damage
from ceilvo.daemon.map.database.copies import copy_of, open_map
from ceilvo.daemon.map.database.faults import DamagedError
from ceilvo.daemon.map.document import content_of
from ceilvo.daemon.map.transitions import Side

FLOORS = ("ground", "first", "second")


@pytest.fixture
def path(tmp_path: Path) -> Path:
    out = tmp_path / "map.db"
    for n, floor in enumerate(FLOORS):
        with open_map(out, floor, create=True) as db:
            db.edit(content(40, n + 1, floor), "begin")
    return out


def sides(path: Path) -> dict[str, tuple[Side, ...]]:
    return {floor: read(path, floor).sides for floor in FLOORS}


def did(*words: object) -> int:
    return cli.main(["map", "transition", *map(str, words)])


def test_a_lift_is_added_listed_and_removed(path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert did("add", path, "east", "--at", "ground=3.2,4.1,90", "--at", "first=3.2,4.1,-270") == 0
    listed = "lift  east  on first: 3.200, 4.100 m, 90.0 deg\nlift  east  on ground: 3.200, 4.100 m, 90.0 deg\n"
    assert capsys.readouterr().out == listed
    assert did("add", path, "east", "--at", "second=1,2,0") == 0, "one more floor of a lift that is there"
    assert [len(s) for s in sides(path).values()] == [1, 1, 1]
    assert did("add", path, "a ramp", "--kind", "ramp", "--at", "ground=1,1,0", "--at", "first=5,1,0") == 0
    assert [s.name for s in sides(path)["ground"]] == ["a ramp", "east"]
    assert did("remove", path, "east") == 0
    capsys.readouterr()
    assert did("list", path) == 0
    assert capsys.readouterr().out.count("ramp  a ramp") == 2


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("--at", "ground=1,2,0"), "would be on one floor, expected two or more"),
        (("--at", "ground=1,2,0", "--at", "cellar=1,2,0"), "has no floor 'cellar', expected 'ground' or 'first' or"),
        (("--at", "ground=1,2,0", "--at", "ground=1,2,0"), "given twice for one floor"),
    ],
)
def test_what_cannot_be_is_one_clear_line(
    path: Path, words: tuple[str, ...], said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert did("add", path, "east", *words) != 0
    assert said in capsys.readouterr().err
    assert not any(sides(path).values())


def test_a_transition_turns_with_its_floor_and_an_undo_takes_both_back(path: Path) -> None:
    did("add", path, "east", "--at", "ground=3,4,90", "--at", "first=3,4,90")
    assert cli.main(["map", "rotate", str(path), "--floor", "first", "--deg", "90"]) == 0
    (turned,), (other,) = sides(path)["first"], sides(path)["ground"]
    assert np.allclose(turned.pose, (-4.0, 3.0, -np.pi)) or np.allclose(turned.pose, (-4.0, 3.0, np.pi))
    assert np.allclose(other.pose, (3.0, 4.0, 0.5 * np.pi))
    for left in (1, 0):
        assert cli.main(["map", "undo", str(path), "--floor", "first"]) == 0
        assert len(sides(path)["first"]) == left


def test_a_drive_leaves_it_and_a_map_begun_anew_has_none(path: Path) -> None:
    did("add", path, "east", "--at", "ground=3,4,90", "--at", "first=3,4,90")
    with open_map(path, "first") as db:
        frame, m = db.frame, db.content().landmarks
        db.save(m, 0.25, "drive")
        assert len(db.content().sides) == 1 and db.frame == frame
        db.save(m, 0.25, "drive", anew=True)
        assert not db.content().sides and db.frame != frame
    assert len(sides(path)["ground"]) == 1


def test_it_is_in_the_json_and_older_exports_have_none(path: Path) -> None:
    did("add", path, "east", "--at", "ground=3,4,90", "--at", "first=3,4,90")
    own = read(path, "ground")
    body, version = content_of(to_json(own).encode(), "ceilvo-map-content", 1, 10**8)
    assert from_json(body, version).sides == own.sides
    del body["transitions"]
    assert from_json(body, version).sides == ()
    for bad in ({"kind": "stairs"}, {"name": ""}, {"x_m": "3"}):
        body["transitions"] = [{"name": "e", "kind": "lift", "x_m": 1.0, "y_m": 2.0, "theta_rad": 0.0} | bad]
        with pytest.raises(Damage):
            from_json(body, version)


def test_damage_is_noticed(path: Path) -> None:
    did("add", path, "east", "--at", "ground=3,4,90", "--at", "first=3,4,90")
    copy_of(path).unlink()
    with contextlib.closing(sqlite3.connect(path)) as db:
        db.execute("UPDATE transitions SET x = 3.5 WHERE map = 1")
        db.commit()
    with pytest.raises(DamagedError, match="transition 'east' is not what was written"):
        open_map(path, "ground")
