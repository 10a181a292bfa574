"""A map that another program changes while the daemon drives on it: taken where the robot stands, or not at all."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
from daemon_thread import start
from kept_maps import count, load_database
from patience import PATIENCE_S, until
from simulated_daemon import SimulatedDaemon

from ceilvo.config import Base, Config, Filter, Service, Zenoh
from ceilvo.daemon.app import swap
from ceilvo.daemon.app.process import Daemon, Plan
from ceilvo.daemon.map.database.database import MapDatabase
from ceilvo.daemon.map.kept.store import MAP_NAME
from ceilvo.drivers.host.systemd_notify import Notifier
from ceilvo.drivers.ports import CameraInfo
from ceilvo.se2 import compose, rotation, transform
from ceilvo.sim.camera import SimCamera
from ceilvo.sim.world import World, WorldSpec
from ceilvo.types import Estimate, Frame, Landmarks, Pose, State

SEED, RATE_HZ = 5, 15.0
FIRST, MORE, LAST = 45, 45, 30
"""Frames until the map is stored; with the changed one in the database; after it was taken."""
MOVED = np.array([0.006, -0.004, np.radians(0.1)])
"""m, m, rad."""
SEEN_BY_CHANCE = Filter().birth_sightings
"""Sightings that confirm a landmark: what showed so often and never again was none."""


class Stops(SimCamera):
    """A robot that drives in three stretches; it stands after each until it may go on."""

    def __init__(self, world: World) -> None:
        super().__init__(world, RATE_HZ, realtime=False)
        self.go_on = [threading.Event() for _ in range(3)]
        self.at = 0
        self.end_at: int | None = None
        """The frame that shows the end of the last stretch, once it was read."""
        self._frames = self._numbers()

    def open(self) -> CameraInfo:
        return replace(super().open(), live=False)

    def _numbers(self) -> Iterator[int]:
        yield from range(FIRST)
        self.go_on[0].wait(PATIENCE_S)  # the time of its pictures stops as well
        yield from range(FIRST, FIRST + MORE)
        while not self.go_on[1].wait(0.01):
            yield FIRST + MORE - 1
        yield from range(FIRST + MORE, FIRST + MORE + LAST)
        self.end_at = self.at
        while not self.go_on[2].wait(0.01):
            yield FIRST + MORE + LAST - 1

    def read(self) -> Frame | None:
        k = next(self._frames, None)
        if k is None:
            return None
        self.at += 1
        shown = self._world.renderer.render(truth(self._world, k), np.random.default_rng([SEED, self.at]))
        return Frame(self.at, 10**9 + round(1e9 * self.at / RATE_HZ), shown)


def truth(world: World, frame: int) -> np.ndarray:
    """(3,) where the robot is."""
    return world.truth_at(frame / RATE_HZ)


@dataclass
class Run:
    """A daemon in a thread, its camera, and where its map lies."""

    world: World
    camera: Stops
    daemon: Daemon
    path: Path

    @property
    def last(self) -> Estimate:
        found = self.daemon._estimator.last
        assert found is not None
        return found

    def said(self, text: str) -> bool:
        return any(text in event for event in self.daemon.events)

    def change(self, make: Callable[[Landmarks], Landmarks], turned_rad: float = 0.0) -> Landmarks:
        """As another program does it; the map that it made."""
        with MapDatabase(self.path) as db:
            content = db.content()
            made = make(content.landmarks)
            db.edit(replace(content, landmarks=made, axis_rad=content.axis_rad + turned_rad), "another program")
        return made


@pytest.fixture
def run(tmp_path: Path) -> Iterator[Run]:
    world = World(WorldSpec(seed=SEED))
    x, y, theta = (float(v) for v in world.initial_pose)
    config = Config(
        filter=Filter(initial_pose_x_m=x, initial_pose_y_m=y, initial_pose_theta_deg=float(np.degrees(theta))),
        base=Base(enabled=False),
        zenoh=Zenoh(enabled=False),
        service=Service(state_dir=str(tmp_path), state_period_s=0.2),
    )
    camera = Stops(world)
    daemon = Daemon(Plan(config, world.calibration, camera), Notifier({}))
    result: list[object] = []
    thread = start(daemon, result)
    out = Run(world, camera, daemon, tmp_path / MAP_NAME)
    try:
        until(lambda: daemon._estimator.last is not None and out.last.seq == FIRST and daemon._keeper.save(), "a map")
        yield out
    finally:
        for event in camera.go_on:
            event.set()
        daemon.stop()
        thread.join(PATIENCE_S)
    assert not thread.is_alive()
    assert isinstance(result[0], dict), result[0]


def moved(m: Landmarks) -> Landmarks:
    turn = rotation(float(MOVED[2]))
    return replace(m, xy_map_m=transform(Pose(MOVED), m.xy_map_m), cov_m2=turn @ m.cov_m2 @ turn.T)


def test_a_changed_map_is_taken_where_the_robot_stands_and_nothing_is_lost(run: Run) -> None:
    made = run.change(moved, MOVED[2])
    run.camera.go_on[0].set()
    until(lambda: run.said("another program changed the map"), "that it is noticed")
    until(lambda: run.said("landmarks confirm the changed map"), "that it is taken")
    until(lambda: run.last.state is State.TRACKING, "its place")
    run.camera.go_on[1].set()
    until(lambda: run.camera.end_at is not None and run.last.seq >= run.camera.end_at, "the rest of the drive")
    end = compose(MOVED, truth(run.world, FIRST + MORE + LAST - 1))
    off, sigma = run.last.pose - end, np.sqrt(np.diag(run.last.cov))
    print(f"\noff by {1e3 * np.hypot(*off[:2]):.2f} mm, sigma {1e3 * np.hypot(*sigma[:2]):.2f} mm (seed {SEED})")
    assert np.all(np.abs(off) < 3.0 * sigma), f"off {off}, sigma {sigma}"
    assert run.daemon._keeper.save()
    found = load_database(run.path)
    assert found is not None
    stays = np.isin(made.ids, found.landmarks.ids)
    assert np.all(made.sightings[~stays] <= SEEN_BY_CHANCE), "what showed by chance is forgotten once it does not"
    assert np.count_nonzero(~stays) <= 2
    assert len(found.landmarks) > len(made) + 5, "what was learnt meanwhile and since"
    kept = made.of(stays)
    at = np.searchsorted(found.landmarks.ids, kept.ids)
    assert np.median(np.hypot(*(found.landmarks.xy_map_m[at] - kept.xy_map_m).T)) < 0.001
    with MapDatabase(run.path) as db:
        assert db.history()[0].what == "another program"


def test_a_changed_map_that_landmarks_do_not_bear_out_is_given_back(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(swap, "CONFIRM_NS", 3 * 10**9)
    rng = np.random.default_rng(SEED)
    run.change(lambda m: replace(m, xy_map_m=m.xy_map_m + rng.uniform(-0.2, 0.2, m.xy_map_m.shape)))
    run.camera.go_on[0].set()
    until(lambda: run.said("landmarks do not confirm the changed map"), "that it is given back")
    until(lambda: run.last.state is State.TRACKING, "its place on its own map")
    off = run.last.pose - truth(run.world, FIRST + MORE - 1)
    assert np.hypot(*off[:2]) < 0.02, f"{off} (seed {SEED})"
    assert run.daemon._keeper.save()
    assert count(run.path.with_name(f"{MAP_NAME}.1")) >= 20, "the other one stays"


def test_kill_9_after_another_programs_change_leaves_both(tmp_path: Path) -> None:
    """Of a robot that does not stand: it drives on on its own map, and writes onto the changed one."""
    path = tmp_path / MAP_NAME
    with SimulatedDaemon(tmp_path, tmp_path) as daemon:
        daemon.until(lambda: count(path) >= 40, "a map")
        with MapDatabase(path) as db:
            content = db.content()
            made = moved(content.landmarks)
            db.edit(replace(content, landmarks=made, axis_rad=content.axis_rad + MOVED[2]), "another program")
        daemon.until(lambda: "another program changed the map" in daemon.said(), "that it is noticed")
        daemon.until(lambda: count(path) >= len(made) + 10, "landmarks that are learnt since")
        daemon.process.kill()
        daemon.process.wait()
        assert "on the changed map" not in daemon.said(), "never in mid-drive"
    found = load_database(path)
    assert found is not None and np.mean(np.isin(made.ids, found.landmarks.ids)) > 0.9
    both, i, j = np.intersect1d(made.ids, found.landmarks.ids, return_indices=True)
    off = np.hypot(*(made.xy_map_m[i] - found.landmarks.xy_map_m[j]).T)
    assert np.median(off) < 0.001, f"{len(both)} landmarks, off by {off}"
    with SimulatedDaemon(tmp_path, tmp_path) as daemon:
        daemon.until(lambda: f"stored map loaded, {len(found.landmarks)} landmarks" in daemon.said(), "all of them")
