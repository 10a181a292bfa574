"""A running daemon whose computer is too slow for its camera, or whose camera is slower than it says."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from daemon_thread import start
from patience import PATIENCE_S, until

from ceilvo.config import Config
from ceilvo.daemon.app.process import Daemon, Plan
from ceilvo.daemon.pipeline import Pipeline
from ceilvo.drivers.camera.mock_camera import MockCamera
from ceilvo.drivers.host.systemd_notify import Notifier
from ceilvo.drivers.ports import CameraInfo
from ceilvo.sim.camera import SimCamera
from ceilvo.sim.motion import LapSpec
from ceilvo.sim.world import World, WorldSpec
from ceilvo.types import Frame, State

SEED = 5
PERIOD_NS = 10_000_000
"""Of the camera that is too fast, 100 Hz."""
STEP_S = 0.045
"""Of the slow stage: more than four periods, however fast the computer."""


@contextmanager
def running(plan: Plan) -> Iterator[Daemon]:
    daemon, result = Daemon(plan, Notifier({})), list[object]()
    thread = start(daemon, result)
    try:
        yield daemon
    finally:
        daemon.stop()
        thread.join(PATIENCE_S)
    assert isinstance(result[0], dict), result


def alone(config: Config) -> Config:
    return replace(config, base=replace(config.base, enabled=False), zenoh=replace(config.zenoh, enabled=False))


def test_every_nth_frame_is_used_evenly_and_that_is_said(monkeypatch: pytest.MonkeyPatch) -> None:
    """Stamps count the camera's periods, whatever else this computer does."""
    calibration = replace(World(WorldSpec(seed=SEED)).calibration, camera_id="")
    lens, stamps, real = calibration.camera, list[int](), Pipeline.step

    def slow(self: Pipeline, frame: Frame, *args: Any) -> Any:
        stamps.append(frame.stamp_ns)
        time.sleep(STEP_S)
        return real(self, frame, *args)

    monkeypatch.setattr(Pipeline, "step", slow)
    camera = MockCamera(width_px=lens.width_px, height_px=lens.height_px, rate_hz=1e9 / PERIOD_NS)
    with running(Plan(alone(Config()), calibration, camera)) as daemon:
        said: Callable[[], list[str]] = lambda: [e for e in daemon.events if "this computer does" in e]  # noqa: E731
        until(said, "an event")
        first = len(stamps) + 2
        until(lambda: len(stamps) > first + 20, "frames")
        health = daemon._telemetry.counters()
        used = stamps[first : first + 20]
    n = int(str(health["every_nth_frame"]))
    assert n >= 5
    assert said() == [e for e in said() if e.startswith("camera rate: gives 100 frames per second")]
    assert abs(float(str(health["camera_rate_hz"])) - 100.0) < 1e-3
    assert abs(float(str(health["used_rate_hz"])) - 100.0 / n) < 1e-3
    assert int(str(health["skipped_frames"])) > 60
    if len(said()) == 1:  # or the computer got still busier
        gaps = np.diff(used) / PERIOD_NS
        assert f"one frame in {n} is used" in said()[0]
        assert np.median(gaps) == n
        assert (gaps >= n).all(), "more only where this computer was late"


class Dozing(SimCamera):
    """Says 30 Hz and gives 4, as automatic exposure does in the dark."""

    def open(self) -> CameraInfo:
        return replace(super().open(), rate_hz=30.0)


def test_a_camera_that_is_slower_than_it_says_is_tracked_with_and_told() -> None:
    """It was taken for a camera that stalls between any two frames, and the state stayed INIT for ever."""
    world, states = World(WorldSpec(seed=SEED, lap=LapSpec(speed_mps=0.1))), list[State]()
    x, y, theta = (float(v) for v in world.initial_pose)
    start = replace(
        Config().filter, initial_pose_x_m=x, initial_pose_y_m=y, initial_pose_theta_deg=float(np.degrees(theta))
    )
    config = alone(replace(Config(), filter=start))
    plan = Plan(config, world.calibration, Dozing(world, 4.0), truth=lambda ns: world.truth_at(world.seconds(ns)))
    with running(plan) as daemon:

        def seen() -> bool:
            last = daemon._estimator.last
            states.append(State.INIT if last is None else last.state)
            return states[-1] is State.TRACKING or int(str(daemon._telemetry.counters()["frames"])) > 200

        until(seen, "TRACKING")
        assert states[-1] is State.TRACKING
        said = "camera slow: gives 4 frames per second, it said 30"
        until(lambda: any(e.startswith(said) for e in daemon.events), "an event")
