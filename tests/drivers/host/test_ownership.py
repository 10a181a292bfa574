"""Two daemons at one folder or by one name: the second one ends, and says who the first one is."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from ceilvo.drivers.host.ownership import LOCK_NAME, owner_of_folder, owner_of_name
from ceilvo.errors import CeilvoError

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


def test_a_folder_that_is_not_there_is_no_reason_to_end(tmp_path: Path) -> None:
    with owner_of_folder(tmp_path / "none"):
        pass
