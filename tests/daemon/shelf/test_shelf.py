"""Maps beside the one in use: kept, chosen, taken at a start, never lost; refusals say why."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from map_contents import key_poses, landmarks

from ceilvo.daemon.editing.exchange import to_json
from ceilvo.daemon.map.database.content import MapContent, Session
from ceilvo.daemon.map.database.copies import open_map
from ceilvo.daemon.map.database.database import MapDatabase
from ceilvo.daemon.map.kept.store import MAP_NAME, STATE_NAME, Store
from ceilvo.daemon.map.map_file import save_map, save_state
from ceilvo.daemon.shelf.shelf import MOST_MAPS, Choice, Name, Shelf
from ceilvo.daemon.shelf.taking import in_use, take_chosen
from ceilvo.errors import CeilvoError
from ceilvo.types import State

HALL, YARD = Name("hall/1", "2"), Name("yard", "2024-05-01T10:00Z")


def content(seed: int, count: int = 40, first: int = 0) -> MapContent:
    """Ids begin at `first`."""
    made = landmarks(count, seed)
    return MapContent.of(replace(made, ids=made.ids + first), 0.25, 1000.0)


def whole() -> MapContent:
    """With key poses of a session."""
    made = content(5, 60)
    return replace(made, key_poses=(key_poses("r/a", 6, ids=50),), sessions=(Session("r/a", 10.0, 20.0, 3),))


def equal(a: MapContent, b: MapContent) -> bool:
    """To the last bit; sessions aside, for a database remembers all drives."""
    return to_json(replace(a, floor="", sessions=())) == to_json(replace(b, floor="", sessions=()))


def own_map(folder: Path, made: MapContent, *floors: str) -> None:
    for floor in floors or ("",):
        with open_map(folder / MAP_NAME, floor, create=True) as db:
            db.edit(replace(made, floor=floor), "learnt")


def held(folder: Path, floor: str | None = None) -> MapContent:
    with MapDatabase(folder / MAP_NAME, floor) as db:
        return db.content()


@pytest.fixture
def shelf(tmp_path: Path) -> Shelf:
    return Shelf(tmp_path)


def test_what_is_put_is_read_to_the_last_bit(shelf: Shelf) -> None:
    assert shelf.names() == () and shelf.choice() == Choice()
    shelf.put(HALL, whole())
    shelf.put(YARD, content(2))
    assert shelf.names() == (HALL, YARD)
    assert equal(shelf.read(HALL), whole()) and equal(shelf.read(YARD), content(2))
    shelf.put(YARD, content(3))
    assert equal(shelf.read(YARD), content(3)), "one of the same name is replaced"
    shelf.remove(HALL)
    assert shelf.names() == (YARD,)


@pytest.mark.parametrize("name", ["..", "../x", "a@b", "@", "ä b", "%2F", ".x", "choice.json", "a" * 60])
def test_names_stay_in_the_folder(shelf: Shelf, name: str) -> None:
    for one in (Name(name, ""), Name(name, name)):
        shelf.put(one, content(1))
        assert one in shelf.names() and equal(shelf.read(one), content(1))
    assert all(p.parent == shelf.folder for p in shelf.folder.parent.rglob("*.map.json"))


@pytest.mark.parametrize("name", [Name("", "1"), Name("a\nb", "1"), Name("a", "\x00"), Name("x" * 300, "1")])
def test_names_that_are_none(shelf: Shelf, name: Name) -> None:
    with pytest.raises(CeilvoError, match="expected a mapId and mapVersion"):
        shelf.put(name, content(1))
    assert shelf.names() == ()


def test_refusals_say_why(shelf: Shelf) -> None:
    shelf.put(HALL, content(1))
    with pytest.raises(CeilvoError, match=r"'yard .*is not here, expected one of: 'hall/1 2'; downloadMap brings it"):
        shelf.want(YARD)
    with pytest.raises(CeilvoError, match="is not here"):
        shelf.remove(YARD)
    shelf.want(HALL)
    with pytest.raises(CeilvoError, match="the next start takes it"):
        shelf.remove(HALL)
    for i in range(MOST_MAPS - 1):
        shelf.put(Name(f"m{i}", "1"), content(1, 2))
    with pytest.raises(CeilvoError, match=f"found {MOST_MAPS} maps, expected at most"):
        shelf.put(YARD, content(1))
    shelf.put(HALL, content(2))
    damaged = next(p for p in shelf.folder.iterdir() if p.name.startswith("m0"))
    damaged.write_text(damaged.read_text().replace("0.25", "0.26"))
    with pytest.raises(CeilvoError, match="checksum does not match"):
        shelf.want(Name("m0", "1"))
    assert shelf.choice() == Choice(next=HALL)


@pytest.mark.parametrize("text", ["", "{}", "nonsense", '{"format": "ceilvo-choice", "version": 1}', "[" * 9999])
def test_a_choice_that_cannot_be_read_chooses_nothing(shelf: Shelf, tmp_path: Path, text: str) -> None:
    own_map(tmp_path, content(1))
    shelf.put(HALL, content(2))
    shelf.want(HALL)
    (shelf.folder / "choice.json").write_text(text)
    assert shelf.choice() == Choice() and take_chosen(tmp_path, "", "map") is None
    assert equal(held(tmp_path), content(1))


def test_a_start_takes_the_chosen_map_and_keeps_the_one_before(shelf: Shelf, tmp_path: Path) -> None:
    own_map(tmp_path, content(1))
    save_state(tmp_path / STATE_NAME, np.zeros(3), 1e-4 * np.eye(3), State.TRACKING, 1)
    assert take_chosen(tmp_path, "", "home") is None
    assert in_use(tmp_path, shelf.choice(), "", "home").name == Name("home", "")
    shelf.put(HALL, whole())
    shelf.want(HALL)
    assert equal(held(tmp_path), content(1)), "nothing before the start"
    taken = take_chosen(tmp_path, "", "home")
    assert taken is not None and taken.ok and taken.said.startswith("map hall/1 2 taken")
    assert equal(held(tmp_path), whole())
    assert in_use(tmp_path, shelf.choice(), "", "home").name == HALL
    kept = Store(tmp_path).load()
    assert kept is not None and kept.state is None, "the robot is searched for on all of it"
    assert "searched for on all of it" in kept.said
    assert take_chosen(tmp_path, "", "home") is None, "once"

    with open_map(tmp_path / MAP_NAME) as db:  # the robot learns
        learnt = replace(whole(), landmarks=whole().landmarks.of(np.arange(50)), seen_s=whole().seen_s[:50])
        db.edit(learnt, "a drive")
    assert shelf.names() == (HALL, Name("home", ""))
    shelf.want(Name("home", ""))
    taken = take_chosen(tmp_path, "", "home")
    assert taken is not None and taken.ok
    assert equal(held(tmp_path), content(1)) and in_use(tmp_path, shelf.choice(), "", "home").name == Name("home", "")
    assert len(shelf.read(HALL).landmarks) == 50, "what was learnt on it stays"
    with open_map(tmp_path / MAP_NAME) as db:
        assert db.history()[0].what == "enableMap home"
        db.undo()
        assert len(db.content().landmarks) == 50


def test_a_map_without_a_common_landmark_is_in_a_frame_of_its_own(shelf: Shelf, tmp_path: Path) -> None:
    """A pose on the one before must not be taken for one on it, whoever put it there."""
    own_map(tmp_path, content(1))
    with open_map(tmp_path / MAP_NAME) as db:
        before = db.frame
        db.edit(content(2, first=10**6), "import --replace")
        assert db.frame != before
        db.undo()
        db.edit(replace(content(1), landmarks=content(1).landmarks.of(np.arange(30)), seen_s=np.zeros((30, 2))), "crop")
        assert db.frame.split(".")[0] != "" and len(db.content().landmarks) == 30


def test_a_map_that_somebody_replaced_meanwhile_is_not_the_chosen_one(shelf: Shelf, tmp_path: Path) -> None:
    shelf.put(HALL, content(2))
    shelf.want(HALL)
    taken = take_chosen(tmp_path, "", "home")
    assert taken is not None and taken.ok and in_use(tmp_path, shelf.choice(), "", "home").name == HALL
    file = tmp_path / MAP_NAME
    good = file.read_bytes()
    file.write_bytes(b"x" * len(good))
    assert in_use(tmp_path, shelf.choice(), "", "home").name == HALL, "the daemon will take its good copy"
    file.unlink()
    assert in_use(tmp_path, shelf.choice(), "", "home").name == Name("home", "")
    file.write_bytes(good)
    with open_map(tmp_path / MAP_NAME) as db:
        db.edit(content(7, first=10**6), "import --replace")
    assert in_use(tmp_path, shelf.choice(), "", "home").name == Name("home", "")


def test_only_the_robots_floor_is_changed(shelf: Shelf, tmp_path: Path) -> None:
    for floor, expected in (("", "ground"), ("first", "first")):
        own_map(tmp_path, content(1), "ground", "first")
        shelf.put(HALL, replace(content(2), floor="elsewhere"))
        shelf.want(HALL)
        taken = take_chosen(tmp_path, floor, "home")
        assert taken is not None and taken.ok, taken
        assert equal(held(tmp_path, expected), content(2))
        found = in_use(tmp_path, shelf.choice(), floor, "home")
        assert (found.name, found.floor, len(found.others)) == (HALL, expected, 1)
        assert Name(expected, "") in shelf.names(), "the one before is called by its floor"
        other = "first" if expected == "ground" else "ground"
        assert equal(held(tmp_path, other), content(1))
        (tmp_path / MAP_NAME).unlink()
        (tmp_path / f"{MAP_NAME}.good").unlink()


def test_what_cannot_be_taken_changes_nothing_and_is_said_once(shelf: Shelf, tmp_path: Path) -> None:
    own_map(tmp_path, content(1))
    shelf.put(HALL, content(2))
    shelf.want(HALL)
    [file] = shelf.folder.glob("*.map.json")
    file.write_text("{}")
    taken = take_chosen(tmp_path, "", "home")
    assert taken is not None and not taken.ok and "\n" not in taken.said
    assert "map hall/1 2 not taken" in taken.said and "the map in use stays" in taken.said
    assert shelf.choice().refused == taken.said and shelf.choice().next is None
    assert take_chosen(tmp_path, "", "home") is None and equal(held(tmp_path), content(1))


def test_an_older_ceilvos_map_is_imported_before_another_is_taken(shelf: Shelf, tmp_path: Path) -> None:
    save_map(tmp_path / "map.json", content(1).landmarks, 0.25)
    shelf.put(HALL, content(2))
    shelf.want(HALL)
    assert take_chosen(tmp_path, "", "home") is None
    store = Store(tmp_path)
    assert store.load() is not None
    store.close()
    taken = take_chosen(tmp_path, "", "home")
    assert taken is not None and taken.ok
    assert np.array_equal(shelf.read(Name("home", "")).landmarks.xy_map_m, content(1).landmarks.xy_map_m)


KILLED = """
import os, signal, sys
from pathlib import Path
from ceilvo.daemon.map.database.database import MapDatabase
from ceilvo.daemon.shelf import taking
name, left = sys.argv[2], int(sys.argv[3])
owner = {"edit": MapDatabase, "copy": taking}.get(name, taking.Shelf)
target, attribute = owner, {"copy": "keep_copy"}.get(name, name)
do = getattr(target, attribute)
def killed(*a, **k):
    if left:
        do(*a, **k)
    os.kill(os.getpid(), signal.SIGKILL)
setattr(target, attribute, killed)
taking.take_chosen(Path(sys.argv[1]), "", "home")
"""


@pytest.mark.parametrize("after", [0, 1])
@pytest.mark.parametrize("where", ["put", "edit", "copy", "choose"])
def test_killed_on_the_way_it_is_done_at_the_next_start(shelf: Shelf, tmp_path: Path, where: str, after: int) -> None:
    """SIGKILL before and after each step."""
    own_map(tmp_path, content(1))
    shelf.put(HALL, content(2))
    shelf.want(HALL)
    done = subprocess.run(
        [sys.executable, "-c", KILLED, str(tmp_path), where, str(after)],
        env=os.environ | {"OPENBLAS_NUM_THREADS": "1"},
        check=False,
    )
    assert done.returncode == -signal.SIGKILL
    taken = take_chosen(tmp_path, "", "home")
    assert (taken is None) is (where == "choose" and after == 1)
    assert equal(held(tmp_path), content(2)) and in_use(tmp_path, shelf.choice(), "", "home").name == HALL
    assert equal(shelf.read(Name("home", "")), content(1)), "the map before is not lost"
