"""A daemon on one floor of a building of two: what it says, learns and is told is of its floor."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from daemon_thread import start
from map_writer import landmarks
from patience import until
from subscriber import Subscriber, config_of, free_port

from ceilvo import se2
from ceilvo.config import Filter
from ceilvo.daemon.app.process import Daemon, Plan
from ceilvo.daemon.editing.sources import read
from ceilvo.daemon.map.database.content import MapContent
from ceilvo.daemon.map.database.copies import open_map
from ceilvo.daemon.map.kept.store import MAP_NAME
from ceilvo.daemon.map.transitions import Side
from ceilvo.drivers.bus.messages import Pose
from ceilvo.drivers.host.systemd_notify import Notifier
from ceilvo.sim.camera import SimCamera
from ceilvo.sim.motion import LapSpec
from ceilvo.sim.world import World, WorldSpec
from ceilvo.types import State

SEED, SPEED_MPS = 5, 0.1
LEARNT_M = 0.7
CELLAR_FROM_GROUND = np.array([40.0, -7.0, 1.1])


@pytest.fixture(scope="module")
def world() -> World:
    """Of a slow robot: on what it learns in its first run it still is in the next."""
    return World(WorldSpec(seed=SEED, lap=LapSpec(speed_mps=SPEED_MPS)))


def in_cellar(world: World, stamp_ns: int) -> tuple[float, float, float]:
    """The true pose at a stamp, in the frame of the cellar's map."""
    x, y, theta = se2.compose(CELLAR_FROM_GROUND, world.truth_at(world.seconds(stamp_ns)))
    return float(x), float(y), float(theta)


def driven_m(poses: list[Pose]) -> float:
    return float(np.hypot(poses[-1].x_m - poses[0].x_m, poses[-1].y_m - poses[0].y_m))


def drive(world: World, folder: Path, home: str, done: str, told: bool = False) -> list[Pose]:
    """Poses of a daemon until it is TRACKING on the floor `done`; told: where it is, in the cellar."""
    port = free_port()
    config = config_of(world, "", port, folder)
    config = replace(config, base=replace(config.base, enabled=False), service=replace(config.service, floor=home))
    daemon = Daemon(Plan(config, world.calibration, SimCamera(world, 15.0)), Notifier({}))
    thread = start(daemon, [])
    subscriber = Subscriber(port)
    try:
        until(lambda: bool(subscriber.poses), "a pose")
        if told:
            x, y, theta = in_cellar(world, subscriber.poses[-1].stamp_ns)
            there = {"x_m": x, "y_m": y, "theta_rad": theta, "map_id": "cellar", "sigma_m": 0.3}
            answer = subscriber.ask("cmd/initial_pose", json.dumps(there))
            assert answer["ok"], answer
        until(lambda: any(p.fields["map_id"] == done and p.state is State.TRACKING for p in subscriber.poses), done)
        if not told:
            until(lambda: driven_m(subscriber.poses) > LEARNT_M, "a part of the lap")
        wrong = subscriber.ask(
            "cmd/initial_pose", json.dumps({"x_m": 0.0, "y_m": 0.0, "theta_rad": 0.0, "map_id": "attic"})
        )
        assert not wrong["ok"] and "'attic'" in str(wrong["error"]) and repr(done) in str(wrong["error"])
        return list(subscriber.poses)
    finally:
        subscriber.close()
        daemon.stop()
        thread.join(20)
        assert not thread.is_alive()


def test_a_robot_in_the_cellar_is_found_and_learns_there(world: World, tmp_path: Path) -> None:
    """The cellar's map is what it learnt of this ceiling, in a frame of its own; the ground floor's is another one."""
    path = tmp_path / MAP_NAME
    drive(world, tmp_path, "", "")
    learnt = read(path)
    with open_map(path, "cellar", create=True) as db:
        turned = se2.rotation(float(CELLAR_FROM_GROUND[2]))
        marks = learnt.landmarks
        moved = replace(
            marks,
            xy_map_m=se2.transform(CELLAR_FROM_GROUND, marks.xy_map_m),
            cov_m2=turned @ marks.cov_m2 @ turned.T,
        )
        content = MapContent.of(moved, learnt.axis_rad + float(CELLAR_FROM_GROUND[2]))
        db.edit(replace(content, sides=(Side("lift", "lift", 0.0, 0.0, 0.0),)), "cellar")
    with open_map(path, "ground", create=True) as db:
        other = MapContent.of(landmarks(300), 0.25)
        db.edit(replace(other, sides=(Side("lift", "lift", 0.0, 0.0, 0.0),)), "ground")
    (tmp_path / "state.json").unlink()
    ground = read(path, "ground")
    poses = drive(world, tmp_path, "ground", "cellar", told=True)
    assert {p.fields["map_id"] for p in poses} <= {"ground", "cellar"}
    assert all(p.fields["map_id"] == "cellar" for p in poses if p.state is State.TRACKING)
    last = poses[-1]
    truth = in_cellar(world, last.stamp_ns)
    off_m = np.hypot(last.x_m - truth[0], last.y_m - truth[1])
    print(f"seed {SEED}: off by {off_m:.4f} m in the cellar's frame")
    assert off_m < 0.05
    after = read(path, "ground").landmarks
    assert np.array_equal(after.ids, ground.landmarks.ids), "begun on, and left as it was"
    assert np.array_equal(after.xy_map_m, ground.landmarks.xy_map_m)
    after = read(path, "cellar").landmarks
    near = np.hypot(*(after.xy_map_m[:, None] - moved.xy_map_m).transpose(2, 0, 1)).min(axis=1)
    assert np.median(near) < 0.01, "still where the cellar lies"
    kept = np.isin(moved.ids, after.ids)
    print(f"kept {np.count_nonzero(kept)} of {len(moved)}, sightings of the others {moved.sightings[~kept].tolist()}")
    assert np.all(kept[moved.sightings > 2 * Filter().birth_sightings]) and np.mean(kept) > 0.95, "all but chance"
    assert np.sum(after.sightings) > np.sum(moved.sightings), "learns there"
    assert json.loads((tmp_path / "state.json").read_text())
