"""Two daemons at one folder or by one name: the second one ends, and says who the first one is."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from ceilvo.drivers.host.ownership import LOCK_NAME, owner_of_folder, owner_of_name
from ceilvo.errors import CeilvoError
from ceilvo.files import REJECTED

NAME = f"test/{os.getpid()}"
HOLD = """
import sys, time
from pathlib import Path
from ceilvo.drivers.host.ownership import owner_of_folder, owner_of_name
with owner_of_folder(Path(sys.argv[1])), owner_of_name(sys.argv[2]):
    print("held", flush=True)
    time.sleep(60.0)
"""


def test_another_process_is_named_and_its_death_frees_what_it_held(tmp_path: Path) -> None:
    other = subprocess.Popen([sys.executable, "-c", HOLD, str(tmp_path), NAME], stdout=subprocess.PIPE, text=True)
    assert other.stdout is not None
    assert other.stdout.readline() == "held\n"
    try:
        with pytest.raises(CeilvoError, match=f"state_dir: .* in use by process {other.pid} .*python"):
            owner_of_folder(tmp_path).__enter__()
        with pytest.raises(CeilvoError, match=f"robot.name: .* in use by process {other.pid} .*python"):
            owner_of_name(NAME).__enter__()
    finally:
        other.kill()
        other.communicate()
    with owner_of_folder(tmp_path), owner_of_name(NAME):
        assert (tmp_path / LOCK_NAME).read_text() == f"{os.getpid()}\n"


def test_what_is_left_is_free_again_at_once(tmp_path: Path) -> None:
    for _ in range(3):
        with owner_of_folder(tmp_path), owner_of_name(NAME):
            pass


def test_a_lock_file_that_says_nonsense_still_locks(tmp_path: Path) -> None:
    with owner_of_folder(tmp_path):
        (tmp_path / LOCK_NAME).write_bytes(b"\xff\xfe")
        with pytest.raises(CeilvoError, match="in use by another process"):
            owner_of_folder(tmp_path).__enter__()


def a_folder(path: Path) -> None:
    path.mkdir()


def a_link(path: Path) -> None:
    (path.parent / "map.json").write_text("a map")
    path.symlink_to("map.json")


def a_map(path: Path) -> None:
    path.write_text("a map that lies here by mistake")


@pytest.mark.parametrize("put", [a_folder, a_link, a_map, os.mkfifo])
def test_what_is_no_lock_makes_way_and_is_not_written_to(
    tmp_path: Path, put: Callable[[Path], None], caplog: pytest.LogCaptureFixture
) -> None:
    """A map under the lock's name was cut to nothing; a folder or a link there left the directory unlocked, unsaid."""
    path = tmp_path / LOCK_NAME
    put(path)
    before = path.read_text() if path.is_file() else ""
    with owner_of_folder(tmp_path):
        assert path.read_text() == f"{os.getpid()}\n"
        with pytest.raises(CeilvoError, match="in use by process"):
            owner_of_folder(tmp_path).__enter__()
    aside = tmp_path / (LOCK_NAME + REJECTED)
    assert (aside.read_text() if aside.is_file() else "") == before and os.path.lexists(aside)
    assert [r.getMessage().split(": ")[0] for r in caplog.records] == [str(path)]


@pytest.mark.skipif(os.geteuid() == 0, reason="root may open every file")
def test_a_lock_that_may_not_be_opened_is_said(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    """As after a start by root, once."""
    (tmp_path / LOCK_NAME).touch(0o000)
    with owner_of_folder(tmp_path):
        assert "cannot be locked: Permission denied" in caplog.text


def test_a_folder_that_is_not_there_is_no_reason_to_end(tmp_path: Path) -> None:
    with owner_of_folder(tmp_path / "none"):
        pass


def test_a_held_lock_is_held_whatever_somebody_wrote_into_it(tmp_path: Path) -> None:
    """It was set aside as something else, and a second daemon began."""
    with owner_of_folder(tmp_path):
        (tmp_path / LOCK_NAME).write_bytes(b"x" * 5000)
        with pytest.raises(CeilvoError, match="in use by another process"), owner_of_folder(tmp_path):
            pass
    assert [p.name for p in tmp_path.iterdir()] == [LOCK_NAME], "nothing was set aside"
