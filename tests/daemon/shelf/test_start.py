"""The daemon as a process takes the map that was chosen, and finds itself on it before its poses may be used."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from simulated_daemon import SimulatedDaemon

from ceilvo.daemon.map.database.copies import open_map
from ceilvo.daemon.shelf.shelf import Name, Shelf
from ceilvo.types import State

HALL = Name("hall", "2")


def test_the_next_start_takes_it(tmp_path: Path) -> None:
    state, shelf = tmp_path / "state", Shelf(tmp_path / "state")
    state.mkdir()
    with SimulatedDaemon(state, tmp_path) as daemon:
        daemon.until(lambda: daemon.poses and daemon.poses[-1].state is State.TRACKING, "it knows where it is")
        daemon.until_poses(20)
        assert daemon.end() == 0
    with open_map(state / "map.db") as db:
        learnt = db.content()
    assert len(learnt.landmarks) > 20
    shelf.put(HALL, replace(learnt, key_poses=(), sessions=()))
    with open_map(state / "map.db") as db:
        db.edit(
            replace(learnt, landmarks=learnt.landmarks.of(range(5)), seen_s=learnt.seen_s[:5], key_poses=()), "crop"
        )
    shelf.want(HALL)
    with SimulatedDaemon(state, tmp_path, "vda5050.map_id=home") as daemon:
        daemon.until_poses(10)
        assert "map hall 2 taken, which was chosen" in daemon.said()
        assert "searched for on all of it" in daemon.said()
        first = daemon.poses[0].state
        assert daemon.end() == 0
    assert first is not State.TRACKING, "nobody said where the robot is on this map"
    assert shelf.names() == (HALL, Name("home", "")) and len(shelf.read(Name("home", "")).landmarks) == 5
    with open_map(state / "map.db") as db:
        assert "enableMap hall 2" in [e.what for e in db.history()]
