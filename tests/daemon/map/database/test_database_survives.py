"""kill -9, full and read-only disks: at most the save in hand is lost."""

from __future__ import annotations

import os
import random
import subprocess
import sys
from pathlib import Path

import database_on_disk
import database_writer
import pytest
import small_disk
from map_contents import same_landmarks
from small_disk import SmallDisk
from writers import killed

from ceilvo.daemon.map.database.copies import floors_in, open_map
from ceilvo.daemon.map.database.database import MapDatabase

KILLS = int(os.environ.get("KILLS", "12"))
"""`make kill-test` sets 200."""
MOST_KILLS = 10 * KILLS
"""On a slow computer a kill may come before a save; chosen."""
SEED = 31
LONGEST_S = 0.15
"""From a word of the writer to its end; chosen: some saves."""
WHY_NOT = small_disk.why_not()
CHILD = Path(database_on_disk.__file__)


def test_killed_at_random_moments_while_it_saves(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    rng, path = random.Random(SEED), tmp_path / "map.db"
    reached, torn, copying = 0, 0, 0
    for kill in range(MOST_KILLS):
        if kill >= KILLS and reached >= KILLS:
            break
        about = f"kill {kill} (seed {SEED})"
        reached = killed(database_writer.write, path, rng.uniform(0.0, LONGEST_S), reached, about)
        log, half_written = path.with_name("map.db-wal"), list(tmp_path.glob(".*.tmp"))
        torn += log.exists()
        with open_map(path, create=True) as db:
            stored = db.load()
            now = 0 if stored is None else int(stored.landmarks.expected[0]) - 10**9
            assert now in (reached, reached + 1), f"kill {kill}: {now} of {reached} saves are there (seed {SEED})"
            assert stored is None or same_landmarks(stored.landmarks, database_writer.of_save(now))
            db.content()
        copying += len(half_written)
        assert not list(tmp_path.glob(".*")), f"kill {kill}: a half-written copy was not swept away (seed {SEED})"
        reached = now
    print(f"\n{kill} kills, {torn} of them left a log, {copying} half a copy; {reached} saves, none lost")
    assert reached >= KILLS and torn > KILLS // 2
    assert not caplog.records, "nothing was damaged"


def test_a_second_look_in_one_process_does_not_let_another_remove_the_log(tmp_path: Path) -> None:
    """What was written after another program closed the file went into a log without a name."""
    path = tmp_path / "map.db"
    other = f"from ceilvo.daemon.map.database.database import MapDatabase as M; from pathlib import Path; " \
            f"M(Path({str(path)!r})).close()"  # fmt: skip
    with open_map(path, create=True) as db:
        for n in range(3):
            db.save(database_writer.of_save(n), 0.25, "a drive")
            assert floors_in(path) == ("",)
            subprocess.run([sys.executable, "-c", other], check=True)
            assert path.with_name("map.db-wal").exists(), f"after {n + 1} saves"
        with MapDatabase(path) as reader:
            assert reader.hash == db.hash


@pytest.mark.skipif(bool(WHY_NOT), reason=WHY_NOT)
def test_a_full_and_a_read_only_disk_are_one_line_and_the_map_stays(tmp_path: Path) -> None:
    disk = SmallDisk(tmp_path / "disk")
    try:
        done = disk.inside(sys.executable, "-W", "error", CHILD, "full", disk.folder)
        assert done.returncode == 0, done.stderr
        path = str(disk.folder / "map.db")
        *saving, copying = done.stdout.splitlines()
        assert len(saving) == 3 and copying.startswith(path)
        for line in saving:
            assert (
                line
                == f"{path}: cannot be written: database or disk is full; nothing was changed, make room on its disk"
            )
        disk.make_read_only()
        done = disk.inside(sys.executable, "-W", "error", CHILD, "read-only", disk.folder)
        assert done.returncode == 0, done.stderr
        saving, creating = done.stdout.splitlines()
        assert saving.startswith(
            f"{path}: cannot be written: attempt to write a readonly database; nothing was changed, e"
        )
        assert creating.startswith(f"{disk.folder / 'other.db'}: cannot be written: ")
    finally:
        disk.close()
