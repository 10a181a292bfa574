"""`ceilvod map` as people type it."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from map_contents import content, same_content, same_landmarks

from ceilvo.daemon.cli import main
from ceilvo.daemon.editing import sources
from ceilvo.daemon.editing.looking import in_letters
from ceilvo.daemon.editing.picture import SIZE_PX
from ceilvo.daemon.map.database.copies import copy_of, open_map
from ceilvo.daemon.map.map_file import load_map, save_map

Capture = pytest.CaptureFixture[str]
WORDS = ("import", "export", "show", "stats", "diff", "history", "crop", "forget", "rotate", "align", "merge", "undo")
EDITS = {
    "crop": ["--box", "2,2,15,12"],
    "forget": ["--polygon", "2,2 15,2 8,12"],
    "rotate": ["--deg", "90", "--about", "10,10"],
    "align": ["--mark", "0,0=5,5", "--mark", "20,0=5,25.1"],
    "merge": ["other.json"],
}


def run(*words: str | Path) -> int:
    return main(["map", *map(str, words)])


@pytest.fixture
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with map.db, map.json and other.json, to work in."""
    whole, other = content(200), content(250, seed=2)
    sources.write(tmp_path / "map.db", whole, "begin")
    save_map(tmp_path / "map.json", whole.landmarks, whole.axis_rad)
    save_map(tmp_path / "other.json", other.landmarks, other.axis_rad)
    monkeypatch.chdir(tmp_path)
    return tmp_path


def is_picture(path: Path) -> bool:
    """Of the right size, with text on a ground and dots of several colours."""
    image = cv2.imread(str(path))
    colours = image.astype(np.int64) @ [1, 256, 65536]
    return image.shape == (SIZE_PX, SIZE_PX, 3) and len(np.unique(colours)) > 3


@pytest.mark.parametrize("word", ["", *WORDS])
def test_help_has_an_example(word: str, capsys: Capture) -> None:
    with pytest.raises(SystemExit) as end:
        run(*word.split(), "--help")
    assert end.value.code == 0 and f"example: ceilvod map {word or 'show'} " in capsys.readouterr().out


@pytest.mark.parametrize("name", EDITS)
def test_a_trial_changes_nothing_and_draws_it(here: Path, name: str, capsys: Capture) -> None:
    for file in ("map.db", "map.json"):
        before = Path(file).read_bytes()
        assert run(name, file, *EDITS[name], "--dry-run", "--png", "trial.png") == 0
        said = capsys.readouterr().out
        assert f"{file}: would remove " in said and is_picture(here / "trial.png")
        assert Path(file).read_bytes() == before and not copy_of(here / "map.db").exists()


@pytest.mark.parametrize("name", EDITS)
def test_an_edit_is_the_same_of_either_file_and_can_be_undone(here: Path, name: str, capsys: Capture) -> None:
    with open_map(here / "map.db") as db:
        before = db.hash
    assert run(name, "map.json", *EDITS[name], "--out", "edited.json") == 0
    assert run(name, "map.db", *EDITS[name], "--png", "edit.png") == 0
    assert is_picture(here / "edit.png") and copy_of(here / "map.db").exists()
    robot = load_map(here / "edited.json")
    with open_map(here / "map.db") as db:
        assert db.hash != before and robot is not None
        assert same_landmarks(db.content().landmarks, robot.landmarks) and db.content().axis_rad == robot.map_axis_rad
    assert run("history", "map.db") == 0
    assert f"  {name} " in capsys.readouterr().out
    assert run("undo", "map.db", "--dry-run", "--png", "undo.png") == 0
    assert is_picture(here / "undo.png") and f"would take back '{name} " in capsys.readouterr().out
    assert run("undo", "map.db") == 0
    with open_map(here / "map.db") as db:
        assert db.hash == before and same_content(db.content(), content(200))
    assert run("undo", "map.db") == 1
    assert "map.db: no edit to undo" in capsys.readouterr().err


def test_align_says_what_the_marks_leave(here: Path, capsys: Capture) -> None:
    assert run("align", "map.db", *EDITS["align"], "--dry-run") == 0
    said = capsys.readouterr().out
    assert "turn by 90.000 deg" in said
    assert "residual +0.100 m: the marks are 20.000 m apart in the map, 20.100 m on the plan" in said


def test_import_and_export_go_round(here: Path, capsys: Capture) -> None:
    files = ["--json", "e.json", "--geojson", "e.geojson", "--png", "e.png", "--map-json", "robot.json"]
    assert run("export", "map.db", *files) == 0 and is_picture(here / "e.png")
    assert capsys.readouterr().out.count("written, ") == 4
    assert run("import", "e.json", "--into", "new.db", "--dry-run") == 0 and not (here / "new.db").exists()
    for file, key_poses in (("e.json", 30), ("e.geojson", 0), ("robot.json", 0), ("map.db", 30)):
        for old in (here / "new.db", copy_of(here / "new.db")):
            old.unlink(missing_ok=True)
        assert run("import", file, "--into", "new.db", "--png", "i.png") == 0
        assert f"new.db: holds 200 landmarks and {key_poses} key poses of {file}" in capsys.readouterr().out
        assert same_landmarks(sources.read(here / "new.db").landmarks, content(200).landmarks)
    assert same_content(sources.read(here / "new.db"), content(200))


def test_an_import_does_not_replace_a_map_unless_told(here: Path, capsys: Capture) -> None:
    assert run("import", "other.json", "--into", "map.db") == 1
    assert "map.db: holds a map of 200 landmarks; --replace takes its place" in capsys.readouterr().err
    assert run("import", "other.json", "--into", "map.db", "--floor", "2") == 0
    assert run("import", "other.json", "--into", "map.db", "--floor", "", "--replace") == 0
    assert len(sources.read(here / "map.db", "").landmarks) == len(sources.read(here / "map.db", "2").landmarks) == 250
    assert run("show", "map.db") == 1 and "say which with --floor" in capsys.readouterr().err
    assert run("undo", "map.db", "--floor", "") == 0
    assert same_content(sources.read(here / "map.db", ""), content(200))


def test_show_and_stats(here: Path, capsys: Capture) -> None:
    assert run("show", "map.db", "--png", "s.png", "--box", "0,0,20,10") == 0 and is_picture(here / "s.png")
    shown = capsys.readouterr().out.splitlines()
    inside = int(np.sum(content(200).landmarks.xy_map_m[:, 1] <= 10.0))
    assert shown[0].startswith(f"map.db: {inside} landmarks, x ") and len(shown) > 8
    assert run("stats", "map.db") == 0
    said = capsys.readouterr().out
    for part in (
        "landmarks    200, ",
        " lamp, ",
        "key poses    30 with ",
        "session      hall-3/a: ",
        ", 6 saves",
        "version ",
    ):
        assert part in said
    for file in ("map.db", "map.json"):
        assert run("stats", file, "--json") == 0
        s = json.loads(capsys.readouterr().out)
        m = content(200).landmarks
        assert s["landmarks"] == sum(s["types"].values()) == 200 and s["sightings"] == int(m.sightings.sum())
        assert s["x_m"] == [m.xy_map_m[:, 0].min(), m.xy_map_m[:, 0].max()]
        assert s["area_m2"] == len({(int(x), int(y)) for x, y in m.xy_map_m})
        assert s["key_poses"] == (30 if file == "map.db" else 0)


def test_letters_show_where_landmarks_are() -> None:
    at = np.array([[0.0, 0.0], [60.0, 0.0], [60.0, 0.0], [60.0, 20.0]])
    lines = in_letters(at)
    assert lines[-1][0] == "*" or lines[-1][0] == "+", "half as many as where most are"
    assert lines[-1][-1] == "#" and lines[0].endswith(lines[-1][0]) and lines[0].strip() == lines[-1][0]
    assert len(lines) <= 25 and in_letters(np.empty((0, 2))) == [] and len(in_letters(at[:1])) == 1


def test_diff_counts(here: Path, capsys: Capture) -> None:
    assert run("forget", "map.db", "--box", "0,0,5,5") == 0
    gone = 200 - len(sources.read(here / "map.db").landmarks)
    capsys.readouterr()
    assert run("diff", "map.json", "map.db", "--png", "d.png") == 0 and is_picture(here / "d.png")
    said = capsys.readouterr().out
    assert "200 and " in said and "compared by their ids" in said
    assert f"removed      {gone}\n" in said and "added        0\n" in said and f"the same     {200 - gone}\n" in said
    assert gone > 3
    assert run("diff", "map.json", "map.db", "--by", "place") == 0
    assert "compared by their places and types" in capsys.readouterr().out


WRONG = {
    "an edit that nobody could undo": (
        ["crop", "map.json", "--box", "0,0,1,1"],
        "map.json: no database, so nothing could",
    ),
    "a file that is there": (["crop", "map.db", "--box", "0,0,9,9", "--out", "map.json"], "map.json: is there already"),
    "a file of no kind": (["crop", "map.db", "--box", "0,0,9,9", "--out", "x.txt"], "x.txt: ends in '.txt', expected"),
    "one mark": (["align", "map.db", "--mark", "0,0=1,1"], "--mark: given 1 times, expected twice"),
    "nothing to export": (["export", "map.db"], "nothing to export: give --json"),
    "no such file": (["show", "nothing.db"], "nothing.db: no such file, expected a database of maps"),
    "a folder": (["show", "folder"], "folder: a folder, a pipe or a device, expected a file"),
    "a text": (["stats", "notes.txt"], "notes.txt: damaged or cut short"),
    "a text for a database": (["history", "notes.txt"], "notes.txt: begins with b'hello'"),
    "a text to import into": (["import", "map.json", "--into", "notes.txt"], "notes.txt: begins with b'hello'"),
    "no folder": (["show", "map.db", "--png", "no/where.png"], "no/where.png: cannot be written: No such file"),
    "no such floor": (["show", "map.db", "--floor", "9"], "map.db: holds no map of floor '9'; import one first"),
    "undo without a database": (["undo", "map.json"], "map.json: no database of maps, so no edit is known"),
}


@pytest.mark.parametrize("name", WRONG)
def test_what_cannot_be_done_is_one_clear_line(here: Path, name: str, capsys: Capture) -> None:
    words, said = WRONG[name]
    (here / "folder").mkdir()
    (here / "notes.txt").write_text("hello")
    before = {p.name: p.read_bytes() for p in here.iterdir() if p.is_file()}
    assert run(*words) == 1
    err = capsys.readouterr().err
    assert err.startswith("ceilvod: ") and said in err and err.count("\n") == 1
    assert {p.name: p.read_bytes() for p in here.iterdir() if p.is_file()} == before


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["crop", "map.db"], "one of the arguments --box --polygon is required"),
        (["crop", "map.db", "--box", "1,2"], "argument --box: 1,2: 2 numbers, expected x0,y0,x1,y1"),
        (["rotate", "map.db", "--deg", "nan"], "argument --deg: 'nan': expected a number"),
        (["rotate", "map.db", "--deg", "400"], "argument --deg: 400: expected degrees from -360 to 360"),
        (["diff", "a", "b", "--sigmas", "0"], "argument --sigmas: 0: expected sigmas above 0"),
    ],
)
def test_wrong_use_names_the_option(words: list[str], said: str, capsys: Capture) -> None:
    with pytest.raises(SystemExit) as end:
        run(*words)
    assert end.value.code == 2 and said in capsys.readouterr().err


def test_a_damaged_database_says_so_and_shows_its_good_copy(here: Path, capsys: Capture) -> None:
    assert run("rotate", "map.db", "--deg", "0") == 0, "an edit keeps a copy of what was before"
    with (here / "map.db").open("r+b") as f:
        f.seek(4096)
        f.write(bytes(4096))
    capsys.readouterr()
    assert run("stats", "map.db") == 0
    out, err = capsys.readouterr()
    assert "landmarks    200" in out and err.count("\n") == 2
    assert "set aside as map.db.rejected" in err and "the last good copy, map.db.good of " in err
