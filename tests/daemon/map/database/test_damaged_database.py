"""A database that is damaged, of another kind or of a newer ceilvo: one line, the last good copy, never another map."""

from __future__ import annotations

import contextlib
import os
import random
import shutil
import sqlite3
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from kept_maps import as_version_1
from map_contents import content, landmarks, same_content

from ceilvo.daemon.map.database import schema
from ceilvo.daemon.map.database.copies import copy_of, keep_copy, open_map
from ceilvo.daemon.map.database.database import MapDatabase
from ceilvo.daemon.map.database.faults import DamagedError
from ceilvo.errors import FileFormatError

SEED = 23
DAMAGES = int(os.environ.get("DAMAGES_OF_DATABASE", "60"))
"""Random ones of one file."""


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A database with a good copy of the same."""
    path = tmp_path_factory.mktemp("whole") / "map.db"
    with open_map(path, create=True) as db:
        db.edit(content(200), "begin")
        keep_copy(db)
    return path


@pytest.fixture
def path(whole: Path, tmp_path: Path) -> Path:
    for p in (whole, copy_of(whole)):
        shutil.copy(p, tmp_path)
    return tmp_path / whole.name


def raw(path: Path, *statements: str) -> None:
    with contextlib.closing(sqlite3.connect(path)) as db:
        for statement in statements:
            db.execute(statement)
        db.commit()


NOT_OURS: dict[str, tuple[Callable[[Path], object], str]] = {
    "text": (
        lambda p: p.write_text("<!DOCTYPE html>\n"),
        "begins with b'<!DOCTYPE html>.n', expected a database of maps",
    ),
    "empty": (lambda p: p.write_bytes(b""), "begins with b'', expected a database"),
    "folder": (lambda p: (p.unlink(), p.mkdir()), "a folder, a pipe or a device, expected a file"),
    "pipe": (lambda p: (p.unlink(), os.mkfifo(p)), "a folder, a pipe or a device, expected a file"),
    "gone": (lambda p: p.unlink(), "no such file, expected a database of maps"),
    "link to nothing": (lambda p: (p.unlink(), p.symlink_to("nothing")), "a link to nothing, which is not there"),
    "cut": (lambda p: os.truncate(p, 3 * p.stat().st_size // 4), "damaged: "),
    "another program's": (lambda p: raw(p, "PRAGMA application_id = 7"), "application_id is 7, expected"),
    "no version": (lambda p: raw(p, "PRAGMA user_version = 0"), "user_version is 0, expected a whole number from 1 to"),
    "a trigger": (
        lambda p: raw(p, "CREATE TRIGGER t AFTER UPDATE ON maps BEGIN DELETE FROM landmarks; END"),
        "tables are not those of version 2: t",
    ),
    "a table less": (lambda p: raw(p, "DROP TABLE edits"), "tables are not those of version 2: edits"),
    "a place": (
        lambda p: raw(p, "UPDATE landmarks SET x = x + 1e-9 WHERE key = 5"),
        "landmarks of map '' are not what",
    ),
    "a text": (
        lambda p: raw(p, "UPDATE landmarks SET x = 'a' WHERE key = 5"),
        "landmarks.x holds 'a', expected a number",
    ),
    "a landmark less": (
        lambda p: raw(p, "DELETE FROM landmarks WHERE key = 9"),
        "landmarks of map '' are not what was",
    ),
    "an axis": (lambda p: raw(p, "UPDATE maps SET axis = 0.5"), "hash of map '' is "),
    "a floor": (lambda p: raw(p, "UPDATE maps SET floor = '7'"), "hash of map '7' is "),
    "no hash": (lambda p: raw(p, "UPDATE maps SET hash = ''"), "expected ''"),
    "a key pose": (lambda p: raw(p, "DELETE FROM key_poses WHERE key = 3"), "key poses of map '' are not what was"),
}


@pytest.mark.parametrize("name", NOT_OURS)
def test_what_is_no_map_is_one_clear_line_and_the_good_copy_is_used(
    path: Path, name: str, caplog: pytest.LogCaptureFixture
) -> None:
    spoil, said = NOT_OURS[name]
    spoil(path)
    with pytest.raises(DamagedError, match=f"^.*map.db: .*{said}.*; restore a backup") as caught:
        MapDatabase(path)
    assert "\n" not in str(caught.value) and len(str(caught.value)) < 500
    with open_map(path) as db:
        assert same_content(db.content(), content(200))
    first, second = (r.getMessage() for r in caplog.records)
    assert first.startswith(str(caught.value)), "what is wrong"
    assert ("set aside as map.db.rejected" in first) == (name != "gone")
    assert "the last good copy, map.db.good of " in second and "is used: 200 landmarks, version 1" in second
    with open_map(path) as db:
        assert db.save(landmarks(100), 0.25), "it can be written, too"
    assert len(caplog.records) == 2


def test_a_view_that_was_changed_is_noticed_when_it_is_read(path: Path) -> None:
    raw(path, "UPDATE key_poses SET views = zeroblob(length(views)) WHERE length(views) > 0")
    with MapDatabase(path) as db, pytest.raises(DamagedError, match=r"key pose .* is not what was written"):
        db.content()
    with open_map(path, views=False) as db:
        stored = db.load()
        assert stored is not None and len(stored.landmarks) == 200
    with open_map(path) as db:
        assert same_content(db.content(), content(200)), "of the good copy"


def test_a_session_that_was_changed_is_noticed(path: Path) -> None:
    raw(path, "UPDATE sessions SET last_s = last_s + 1 WHERE name = 'hall-3/b'")
    with MapDatabase(path) as db, pytest.raises(DamagedError, match="session 'hall-3/b' is not what was written"):
        db.content()


def test_an_undo_log_that_was_changed_changes_nothing(path: Path) -> None:
    with open_map(path) as db:
        whole = db.content()
        db.edit(whole.of(whole.landmarks.of(slice(0, 9)), 0.25), "crop")
        after = db.hash
    raw(path, "UPDATE landmarks_before SET x = x + 1.0 WHERE key = 77")
    with open_map(path) as db:
        with pytest.raises(FileFormatError, match="not written, it holds what it held: the undo log leads to"):
            db.undo()
        assert db.hash == after and len(db.history()) == 1


def test_a_newer_ceilvos_is_refused_and_left_alone(path: Path) -> None:
    raw(path, f"PRAGMA user_version = {schema.SCHEMA_VERSION + 1}")
    before = path.read_bytes()
    with pytest.raises(
        FileFormatError, match=r"tables of version 3 were written by a newer ceilvo, .* up to 2; update it"
    ):
        open_map(path)
    assert path.read_bytes() == before


@pytest.mark.skipif(not schema.has_rtree(), reason="this SQLite was compiled without R*Tree")
def test_an_rtree_that_this_sqlite_cannot_read_is_said_and_left_alone(
    path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(schema, "has_rtree", lambda: False)
    before = path.read_bytes()
    with pytest.raises(FileFormatError, match=r"map\.db: has an R\*Tree, which this SQLite cannot read; export it on"):
        open_map(path)
    assert path.read_bytes() == before
    with open_map(path.with_name("grid.db"), create=True) as db:
        db.edit(content(200), "begin")
        assert same_content(db.content(), content(200)), "a new one has a grid"


def test_without_a_good_copy_it_is_left_where_it_is(path: Path) -> None:
    copy_of(path).unlink()
    path.write_text("hello")
    with pytest.raises(DamagedError, match=r"map.db: begins with b'hello'"):
        open_map(path)
    copy_of(path).write_text("hello, too")
    with pytest.raises(
        DamagedError, match=r"the last good copy map.db.good is of no use, either: .*begins with b'hello, too"
    ):
        open_map(path)
    assert sorted(p.name for p in path.parent.iterdir()) == ["map.db", "map.db.good"]
    assert path.read_text() == "hello"


def test_the_log_of_what_is_set_aside_goes_with_it(path: Path) -> None:
    """Applied to the copy it would spoil that, too."""
    busy = open_map(path)
    busy.save(landmarks(150), 0.25)
    log = path.with_name("map.db-wal").read_bytes()
    shutil.copy(path, path.with_name("torn"))
    busy.close()
    path.unlink()
    path.with_name("torn").rename(path)
    path.with_name("map.db-wal").write_bytes(log)
    with path.open("r+b") as f:
        f.write(b"not SQLite any more")
    with open_map(path) as db:
        assert same_content(db.content(), content(200))
    assert path.with_name("map.db.rejected-wal").read_bytes() == log


def test_bytes_changed_anywhere_give_the_same_map_the_copy_or_an_error(whole: Path, tmp_path: Path) -> None:
    """Flipped, set, zeroed and cut: never another map, never another exception."""
    rng = random.Random(SEED)
    good = whole.read_bytes()
    found = {"same": 0, "copy": 0, "refused": 0}
    for n in range(DAMAGES):
        folder = tmp_path / str(n)
        folder.mkdir()
        path = folder / "map.db"
        spoilt = bytearray(good)
        for _ in range(rng.randint(1, 4)):
            at, how = rng.randrange(len(spoilt)), rng.choice(["flip", "set", "zero", "cut"])
            if how == "cut":
                del spoilt[max(at, 100) :]
            elif how == "zero":
                spoilt[at : at + 512] = bytes(len(spoilt[at : at + 512]))
            else:
                spoilt[at] = spoilt[at] ^ 1 << rng.randrange(8) if how == "flip" else rng.randrange(256)
        path.write_bytes(spoilt)
        shutil.copy(copy_of(whole), copy_of(path))
        try:
            with open_map(path) as db:
                assert same_content(db.content(), content(200)), f"damage {n} (seed {SEED})"
            found["copy" if list(folder.glob("*.rejected")) else "same"] += 1
        except FileFormatError as e:
            assert "\n" not in str(e), f"damage {n} (seed {SEED}): {e}"
            found["refused"] += 1
        shutil.rmtree(folder)
    print(f"\n{DAMAGES} damages: {found}")
    assert found["copy"] > DAMAGES // 4
    assert found["refused"] < DAMAGES // 20, "of a version that a newer ceilvo may have written"


@pytest.mark.parametrize(
    ("statement", "said"),
    [
        (
            "INSERT INTO landmarks (key, map, id, x) VALUES (9999, 7, 1, 'text')",
            "a row of 'landmarks' belongs to nothing",
        ),
        (
            "INSERT INTO key_poses (key, map, session, stamp_ns) VALUES (9999, 1, 77, 1)",
            "a row of 'key_poses' belongs to",
        ),
        ("UPDATE key_poses SET stamp_ns = char(27) || '[2J' WHERE key = 1", "of session 'hall-3/a' is not what was"),
        ("UPDATE maps SET frame = ''", "frame of map '' is '', expected a name"),
        ("UPDATE sessions SET faded = 3", "session 'hall-3/a' is not what was written"),
    ],
)
def test_rows_that_nobody_wrote(path: Path, statement: str, said: str) -> None:
    copy_of(path).unlink()
    with contextlib.closing(sqlite3.connect(path)) as db:
        db.execute(statement)
        db.commit()
    with pytest.raises(DamagedError, match=said) as caught:
        open_map(path)
    assert str(caught.value).isprintable()


def test_an_index_of_places_that_holds_text_is_made_anew(tmp_path: Path) -> None:
    path = tmp_path / "map.db"
    schema.create(path, rtree=False)
    with MapDatabase(path, "") as db:
        db.edit(content(50), "begin")
    raw(path, "UPDATE landmark_cells SET cell = '' WHERE key = 3")
    with MapDatabase(path) as db:
        assert len(db.within(np.array([-1e3, -1e3]), np.array([1e3, 1e3]))) == 50


def test_a_database_of_version_1_is_brought_up_to_date(path: Path) -> None:
    as_version_1(path)
    with open_map(path) as db:
        assert same_content(db.content(), content(200))
        assert db.frame == db.hash
        assert [(s.added, s.faded, s.refused) for s in db.content().sessions] == [(0, 0, 0)] * 2
        db.save(landmarks(201), 0.25, "hall-3/b", 1.9e9)
    with open_map(path) as db:
        assert db.content().sessions[1].added == 1


def test_what_is_damaged_in_version_1_stays_so(path: Path) -> None:
    copy_of(path).unlink()
    as_version_1(path)
    raw(path, "UPDATE sessions SET saves = 99")
    with pytest.raises(DamagedError, match="session 'hall-3/a' is not what was written"):
        open_map(path)
