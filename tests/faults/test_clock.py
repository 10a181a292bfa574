"""The wall clock steps by hours while the whole daemon drives (libfaketime): nothing but times of day follows it."""

from __future__ import annotations

import json
import re
import time
from pathlib import Path

import numpy as np
import pytest
from kept_maps import load_database
from patience import PATIENCE_S
from simulated_daemon import SimulatedDaemon

from ceilvo.bench.soak.parts import STEM
from ceilvo.daemon.app.command_log import NAME
from ceilvo.daemon.map.kept.store import MAP_NAME, STATE_NAME
from ceilvo.daemon.map.map_file import load_state
from ceilvo.types import State

LIBRARY = next(iter(Path("/usr/lib").glob("**/faketime/libfaketimeMT.so.1")), None)
STEPS_H = (5, -5, 0)
"""Ahead, back by ten hours, and right again."""
SLEEP = "import threading, time\ntime.sleep = lambda s: threading.Event().wait(s)\n"
"""For the simulated camera: libfaketime 0.9.10 takes Python's sleep, to a moment of the monotonic clock, for one to a
time of day. The daemon itself does not sleep."""


@pytest.mark.skipif(LIBRARY is None, reason="libfaketime is not installed (apt install faketime)")
def test_the_clock_steps_by_hours_while_it_drives(tmp_path: Path) -> None:
    state_dir, offset = tmp_path / "state", tmp_path / "offset"
    state_dir.mkdir()
    offset.write_text("+0\n")
    (tmp_path / "sitecustomize.py").write_text(SLEEP)
    environment = {
        "LD_PRELOAD": str(LIBRARY),
        "FAKETIME_TIMESTAMP_FILE": str(offset),
        "FAKETIME_CACHE_DURATION": "1",
        "FAKETIME_DONT_FAKE_MONOTONIC": "1",
        "PYTHONPATH": str(tmp_path),
    }

    def hours_off() -> int:
        """Of the daemon's time of day, as its log of commands has it; the first few of a flood are taken."""
        for _ in daemon.listener.session.get(f"{STEM}/cmd/save_map", timeout=PATIENCE_S):
            pass
        last = json.loads((state_dir / NAME).read_text().splitlines()[-1])
        return round(1e-9 * (last["unix_ns"] - time.time_ns()) / 3600.0)

    def stored_ns() -> int:
        state = load_state(state_dir / STATE_NAME)
        return 0 if state is None else state.stamp_ns

    with SimulatedDaemon(state_dir, tmp_path, "base.timeout_s=2", environment=environment) as daemon:
        daemon.until(lambda: daemon.poses and daemon.poses[-1].state is State.TRACKING, "TRACKING")
        for hours in STEPS_H:
            offset.write_text(f"{hours:+d}h\n")
            daemon.until(lambda last=hours: hours_off() == last, f"a clock that is off by {hours} hours")
            before_ns = stored_ns()
            daemon.until_poses(10)
            daemon.until(lambda least=before_ns: stored_ns() > least, "a later pose on disk")
        assert daemon.end() == 0
    said = daemon.said()
    assert "Traceback" not in said and "not saved" not in said
    apart_s = 1e-9 * np.diff([p.stamp_ns for p in daemon.poses])
    assert (apart_s > 0).all() and apart_s.max() < 60.0, "stamps follow the wall clock"
    off_mm = [int(mm) for mm in re.findall(r"s (?:TRACKING|DEGRADED), .* error (\d+) mm", said)]
    assert off_mm and max(off_mm) < 300, "a pose that is called good is wrong"
    stored = load_database(state_dir / MAP_NAME)
    assert stored is not None and len(stored.landmarks) > 10
