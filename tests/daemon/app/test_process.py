"""The wired process on a simulated robot: real pseudo-terminal, real Zenoh, and what happens when parts fail."""

import json
import os
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest
from daemon_thread import start
from kept_maps import load_database
from patience import PATIENCE_S, until
from subscriber import Subscriber, config_of, free_port

from ceilvo.calibration import Calibration
from ceilvo.camera import CameraModel
from ceilvo.daemon.app.process import Daemon, Plan, run
from ceilvo.drivers.bus.messages import Pose
from ceilvo.drivers.camera.mock_camera import Crash, Good, MockCamera
from ceilvo.drivers.host.systemd_notify import Notifier
from ceilvo.drivers.ports import CameraInfo
from ceilvo.drivers.telegrams import PoseTelegram
from ceilvo.errors import EXIT_CONFIG, CameraError
from ceilvo.sim.base import SimBase
from ceilvo.sim.camera import SimCamera
from ceilvo.sim.motion import LapSpec
from ceilvo.sim.world import World, WorldSpec
from ceilvo.types import Frame, State

SEED = 5


@pytest.fixture(scope="module")
def world() -> World:
    return World(WorldSpec(seed=SEED))


@pytest.fixture
def base() -> Iterator[SimBase]:
    with SimBase(baud=115200) as simulated:
        yield simulated


def in_both(subscriber: Subscriber, base: SimBase) -> list[tuple[PoseTelegram, Pose]]:
    """Telegrams of a robot that knows where it is, with the published poses of the same sequence numbers."""
    published = {p.seq: p for p in subscriber.poses}
    telegrams = [r.telegram for r in base.telegrams]
    return [(t, published[t.sequence]) for t in telegrams if t.sequence in published and t.state is State.TRACKING]


def test_poses_reach_zenoh_and_base_and_the_end_is_orderly(world: World, base: SimBase, tmp_path: Path) -> None:
    port = free_port()
    config = config_of(world, base.port, port, tmp_path)
    slow = WorldSpec(seed=SEED, lap=LapSpec(speed_mps=0.1))
    truth_of = World(slow)
    camera = SimCamera(truth_of, 30.0)
    daemon = Daemon(
        Plan(config, world.calibration, camera, truth=lambda ns: truth_of.truth_at(truth_of.seconds(ns))), Notifier({})
    )
    result: list[object] = []
    thread = start(daemon, result)
    subscriber = Subscriber(port)
    try:
        until(lambda: len(subscriber.poses) >= 60, "60 poses")
        until(lambda: len(in_both(subscriber, base)) > 10, "poses that the base and Zenoh both got")
        assert subscriber.ask("map")["schema"] == "ceilvo.map.1"
        saved = subscriber.ask("cmd/save_map")
        assert "error" not in saved, saved
        taken = subscriber.ask("cmd/initial_pose", json.dumps({"x_m": 1.0, "y_m": 1.0, "theta_rad": 0.0}))
        assert "error" not in taken, taken
    finally:
        daemon.stop()
        thread.join(PATIENCE_S)
        subscriber.close()
    assert not thread.is_alive()
    summary = result[0]
    assert isinstance(summary, dict), summary
    assert summary["frames"] >= 60 and summary["zenoh_samples"] >= 120
    assert base.telegrams[-1].telegram.state is State.STOPPED
    common = in_both(subscriber, base)
    assert len(common) > 10
    for telegram, pose in common:
        assert abs(telegram.x_m - pose.x_m) <= 1e-4
        assert abs(telegram.y_m - pose.y_m) <= 1e-4
    assert (tmp_path / "map.db").exists() and (tmp_path / "state.json").exists()
    seqs = [p.seq for p in subscriber.poses]
    assert seqs == sorted(set(seqs))


def test_a_full_map_is_said_once(world: World, base: SimBase) -> None:
    config = config_of(world, base.port, free_port())
    config = replace(config, filter=replace(config.filter, max_landmarks=10))
    camera = SimCamera(World(WorldSpec(seed=SEED)), 15.0, realtime=False, duration_s=2.0)
    daemon = Daemon(Plan(config, world.calibration, camera), Notifier({}))
    assert daemon.run()["frames"] == 30
    assert len([e for e in daemon.events if "filter.max_landmarks" in e]) == 1


def test_second_start_uses_the_stored_map(world: World, base: SimBase, tmp_path: Path) -> None:
    for attempt in range(2):
        config = config_of(world, base.port, free_port(), tmp_path)
        camera = SimCamera(World(WorldSpec(seed=SEED)), 15.0, realtime=False, duration_s=2.0)
        daemon = Daemon(Plan(config, world.calibration, camera), Notifier({}))
        summary = daemon.run()
        assert summary["frames"] == 30
        loaded = any("stored map" in e for e in daemon.events)
        assert loaded == (attempt == 1)


@pytest.mark.parametrize("spoilt", ["state.json", "map.db"])
def test_a_damaged_file_costs_no_map(
    world: World, base: SimBase, tmp_path: Path, spoilt: str, caplog: pytest.LogCaptureFixture
) -> None:
    """The daemon began without the map and wrote the few landmarks of its first seconds over it."""
    held = []
    for run_ in range(3):
        config = config_of(world, base.port, free_port(), tmp_path)
        camera = SimCamera(World(WorldSpec(seed=SEED)), 15.0, realtime=False, duration_s=8.0 if run_ == 0 else 1.0)
        daemon = Daemon(Plan(config, world.calibration, camera), Notifier({}))
        daemon.run()
        stored = load_database(tmp_path / "map.db")
        assert stored is not None
        held.append(set(stored.landmarks.ids.tolist()))
        if run_ == 0:
            (tmp_path / spoilt).write_bytes((tmp_path / spoilt).read_bytes()[:40])
        elif run_ == 1:
            assert any("without a pose" in e for e in daemon.events) == (spoilt == "state.json")
            assert ("the last good copy" in caplog.text) == (spoilt == "map.db")
            assert (tmp_path / f"{spoilt}.rejected").exists()
    assert len(held[0]) > 30 and held[0] <= held[1] and held[0] <= held[2]


def small_world_camera(script: list[object]) -> tuple[MockCamera, Calibration]:
    from ceilvo.sim.rig import simulated_calibration

    camera = MockCamera(script)  # type: ignore[arg-type]
    info = camera.open()
    camera.close()
    model = CameraModel("pinhole", info.width_px, info.height_px, 60.0, 60.0, info.width_px / 2, info.height_px / 2)
    return camera, replace(simulated_calibration(model), camera_id="")


class Unplugged(SimCamera):
    """The simulated camera, gone for good after some frames."""

    left = 40

    def open(self) -> CameraInfo:
        if self.left <= 0:
            raise CameraError("camera: unplugged")
        return super().open()

    def read(self) -> Frame | None:
        self.left -= 1
        if self.left < 0:
            raise CameraError("camera: unplugged")
        return super().read()


def test_a_lost_camera_is_told_at_once(world: World, base: SimBase) -> None:
    port = free_port()
    config = config_of(world, base.port, port)
    daemon = Daemon(Plan(config, world.calibration, Unplugged(World(WorldSpec(seed=SEED)), 30.0)), Notifier({}))
    result: list[object] = []
    thread = start(daemon, result)
    subscriber = Subscriber(port)
    try:
        blind = {State.DEAD_RECKONING, State.LOST}
        until(lambda: subscriber.poses and subscriber.poses[-1].state in blind, "a pose that says so")
        assert "unplugged" in subscriber.poses[-1].reason
        assert any("lost" in e for e in daemon.events)
        until(lambda: blind & {r.telegram.state for r in base.telegrams}, "the base hears of it")
    finally:
        daemon.stop()
        thread.join(PATIENCE_S)
        subscriber.close()
    assert isinstance(result[0], dict)


def test_a_thread_that_raises_takes_the_process_down(base: SimBase, caplog: pytest.LogCaptureFixture) -> None:
    camera, calibration = small_world_camera([Good(2), Crash(RuntimeError("a fault in the driver"))])
    config = config_of(World(WorldSpec(seed=SEED)), base.port, free_port())
    assert run(Plan(config, calibration, camera)) == 1
    assert "a thread died" in caplog.text


def test_a_calibration_of_another_camera_is_refused(base: SimBase, caplog: pytest.LogCaptureFixture) -> None:
    camera, calibration = small_world_camera([Good(100)])
    other = replace(calibration, camera=replace(calibration.camera, width_px=999))
    config = config_of(World(WorldSpec(seed=SEED)), base.port, free_port())
    assert run(Plan(config, other, camera)) == EXIT_CONFIG
    assert "999" in caplog.text


def test_memory_of_a_bad_minute_is_given_back() -> None:
    """With the allocator's settings of the service, which keep it otherwise."""
    code = """
import numpy as np
from ceilvo.drivers.host.machine import give_back_memory
def resident_mb():
    with open("/proc/self/statm") as f:
        return int(f.read().split()[1]) * 4096 / 1e6
frames = [np.ones((480, 640), np.uint8) for _ in range(300)]
last = frames[-1]
del frames
before = resident_mb()
give_back_memory()
print(before - resident_mb())
"""
    settings = {"MALLOC_MMAP_THRESHOLD_": "33554432", "MALLOC_TRIM_THRESHOLD_": "268435456"}
    done = subprocess.run(
        [sys.executable, "-c", code],
        capture_output=True,
        text=True,
        check=True,
        timeout=PATIENCE_S,
        env=os.environ | settings,
    )
    assert float(done.stdout) > 60.0
