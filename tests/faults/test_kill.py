"""kill -9 of the whole daemon while it drives and saves: the next start has the map of the last save.

`make kill-test` does it 200 times; tests/faults/test_files.py kills one that does nothing but save.
"""

from __future__ import annotations

import os
import random
import re
import signal
import threading
import time
from pathlib import Path

from daemon_forks import Forks
from kept_maps import load_database
from patience import until

from ceilvo.daemon.map.kept.store import MAP_NAME, STATE_NAME
from ceilvo.daemon.map.map_file import load_state
from ceilvo.files import REJECTED

KILLS = int(os.environ.get("KILLS", "5"))
SEED = 41
WORLD_SEED = 1
"""Of `ceilvod run --simulate`."""
LONGEST_S = 2.0
"""From the first look at the loaded map to the kill; chosen: some saves, half a second apart."""
ENOUGH = 10
"""Landmarks that a map has after some seconds' drive; chosen."""
SETTINGS = (
    "service.state_period_s=0.5",
    "recorder.ring_bytes=20000000",
    "recorder.kept_bytes=20000000",
    "zenoh.multicast=false",
    "base.timeout_s=2",
)


def half_written(folder: Path) -> set[str]:
    return {p.name for p in folder.glob(".*.tmp")}


def landmarks_in(folder: Path) -> int:
    """Of a whole map; its pose is whole, too."""
    stored, state = load_database(folder / MAP_NAME), load_state(folder / STATE_NAME)
    assert state is not None or stored is None, "a map is written first"
    return 0 if stored is None else len(stored.landmarks)


def wait_for_kill(folder: Path, rng: random.Random) -> None:
    """A random moment; every other time the next one in which a pose or a copy is half-written."""
    threading.Event().wait(rng.uniform(0.0, LONGEST_S))
    if rng.random() < 0.5:
        end_s = time.monotonic() + LONGEST_S
        while not half_written(folder) and time.monotonic() < end_s:
            threading.Event().wait(0.0003)


def test_the_whole_daemon_is_killed_while_it_drives(tmp_path: Path) -> None:
    rng, folder = random.Random(SEED), tmp_path / "state"
    folder.mkdir()
    words = ["run", "--simulate", "--seed", str(WORLD_SEED), "--summary", str(tmp_path / "summary.json")]
    words += [word for s in (*SETTINGS, f"service.state_dir={folder}") for word in ("--set", s)]
    left, torn, most = set[str](), 0, 0
    with Forks(WORLD_SEED) as forks:
        for kill in range(KILLS):
            log = tmp_path / f"{kill}.log"
            before = landmarks_in(folder) if kill else 0
            pid = forks.start(words, log)
            until(lambda log=log: "start -> " in log.read_text(errors="replace"), f"start {kill} (seed {SEED})")
            until(lambda: (folder / STATE_NAME).exists(), "a first save")
            said = log.read_text(errors="replace")
            loaded = re.search(r"stored map loaded, (\d+) landmarks", said)
            assert (int(loaded[1]) if loaded else 0) == before, f"kill {kill} (seed {SEED}): {said}"
            assert not left & half_written(folder), f"kill {kill}: half-written files were not swept away (seed {SEED})"
            wait_for_kill(folder, rng)
            if kill == KILLS - 1:  # on a slow computer the others may come before there is a map
                until(lambda: landmarks_in(folder) > ENOUGH, "landmarks on disk")
            seen = landmarks_in(folder)
            os.kill(pid, signal.SIGKILL)
            assert forks.ended() == -signal.SIGKILL, log.read_text(errors="replace")
            left = half_written(folder)
            torn += bool(left)
            now = landmarks_in(folder)
            assert now >= seen, f"kill {kill}: {now} landmarks on disk, {seen} just before (seed {SEED})"
            most = max(most, now)
            assert not list(folder.glob(f"*{REJECTED}*")) and "Traceback" not in log.read_text(errors="replace")
            log.unlink()
    print(f"\n{KILLS} of {KILLS} kills left whole files, {torn} of them within a save; at most {most} landmarks")
    assert most > ENOUGH
