"""Faults on a running daemon, one after the other: what it says while they last, and that it comes back.

One daemon with a simulated camera, a base on a pseudo-terminal and a subscriber lives through all of them. How long
each takes is measured by `make soak` and on the virtual robot; here only the order of events counts.
"""

from __future__ import annotations

import os
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from patience import PATIENCE_S, until

from ceilvo.bench.soak.faulty_camera import FaultyCamera
from ceilvo.bench.soak.floods import ask_until
from ceilvo.bench.soak.parts import STEM, Listener, PoseRow, free_port, set_base_fault
from ceilvo.config import Config
from ceilvo.daemon.app.process import Daemon, Plan
from ceilvo.drivers.bus.requests import Requests
from ceilvo.drivers.camera.mock_camera import MockCamera
from ceilvo.drivers.host.signals import watch_threads
from ceilvo.drivers.host.systemd_notify import Notifier
from ceilvo.sim.base import SimBase
from ceilvo.sim.camera import SimCamera
from ceilvo.sim.motion import LapSpec
from ceilvo.sim.world import World, WorldSpec
from ceilvo.types import State

SEED = 5
RATE_HZ = 15.0
SPEED_MPS = 0.1
"""Slow, so that what the robot sees after a fault is in its map, however long a busy machine makes the fault last."""
GOOD = (State.TRACKING, State.DEGRADED)


class Robot:
    """A daemon in a thread of its own, and everything around it."""

    def __init__(self, folder: Path) -> None:
        self.fault = ""
        self.folder = folder
        self.world = World(WorldSpec(seed=SEED, lap=LapSpec(speed_mps=SPEED_MPS)))
        _ = self.world.renderer
        self.base = SimBase(port_link=folder / "base", odometry=self._odometry)
        self.base.start()
        port = free_port()
        x, y, theta = (float(v) for v in self.world.initial_pose)
        lens, c = self.world.calibration.camera, Config()
        self.state_dir = folder / "state"
        self.state_dir.mkdir()
        config = replace(
            c,
            camera=replace(c.camera, width_px=lens.width_px, height_px=lens.height_px, rate_hz=RATE_HZ),
            filter=replace(
                c.filter, initial_pose_x_m=x, initial_pose_y_m=y, initial_pose_theta_deg=float(np.degrees(theta))
            ),
            base=replace(c.base, port=str(folder / "base"), timeout_s=0.5),
            zenoh=replace(c.zenoh, listen=(f"tcp/127.0.0.1:{port}",), multicast=False, health_period_s=0.1),
            service=replace(c.service, state_dir=str(self.state_dir), state_period_s=0.5),
        )
        camera = FaultyCamera(SimCamera(self.world, RATE_HZ), lambda: self.fault)
        self.daemon = Daemon(Plan(config, self.world.calibration, camera), Notifier({}))
        self.result: list[object] = []
        self._thread = threading.Thread(target=self._run)
        self._thread.start()
        self.listener = Listener(port)

    def _run(self) -> None:
        try:
            self.result.append(self.daemon.run())
        except Exception as e:
            self.result.append(e)

    def _odometry(self, t_s: float) -> tuple[float, ...]:
        return tuple(self.world.wheel_odometry_at(self.world.seconds(round(1e9 * t_s))))

    def close(self) -> None:
        self.daemon.stop()
        self._thread.join(PATIENCE_S)
        self.listener.close()
        self.base.stop()

    @property
    def poses(self) -> list[PoseRow]:
        return self.listener.heard.poses

    def health(self) -> dict[str, object]:
        return self.listener.heard.health[-1][1] if self.listener.heard.health else {}

    def until(self, true: Callable[[], bool], what: str) -> None:
        def true_and_alive() -> bool:
            self.check()
            assert not self.result, self.result
            return true()

        until(true_and_alive, what)

    def check(self) -> None:
        """Raises what ended the daemon, with where it was raised."""
        for result in self.result:
            if isinstance(result, Exception):
                raise result

    def until_state(self, *states: State) -> None:
        """A pose captured from now on is in one of the states."""
        now = time.monotonic_ns()
        self.until(lambda: bool(self.poses) and self.poses[-1].recv_ns > now and self.poses[-1].state in states,
                   f"a pose that is {states}")  # fmt: skip

    def until_said(self, text: str) -> None:
        self.until(lambda: any(text in e for e in self.daemon.events), f"an event with {text!r}")

    def until_health(self, name: str, value: Callable[[object], bool]) -> None:
        self.until(lambda: name in self.health() and value(self.health()[name]), f"health {name}")


@pytest.fixture(scope="module")
def robot(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Robot]:
    made = Robot(tmp_path_factory.mktemp("robot"))
    try:
        made.until_state(State.TRACKING)
        made.until(lambda: len(made.poses) > 60, "a map")
        yield made
    finally:
        made.close()
    made.check()
    assert isinstance(made.result[0], dict), made.result


CAMERA = {
    "unplugged": ("camera lost: camera: lost while streaming", "camera_connected"),
    "stalled": ("camera lost: camera: no frame within 1 s", "camera_connected"),
    "frozen picture": ("byte for byte; the camera is frozen", "repeated_frames"),
    "corrupt frames": ("frame cut short", "bad_frames"),
    "stamps run backwards": ("is not after the last one", "bad_stamps"),
    "black picture": ("no vision for", ""),
    "white picture": ("no vision for", ""),
}


@pytest.mark.parametrize("fault", CAMERA)
def test_a_camera_fault_is_flagged_at_once_and_over_when_it_is_over(robot: Robot, fault: str) -> None:
    robot.until_state(*GOOD)
    said, counter = CAMERA[fault]
    before = robot.health().get(counter)
    robot.fault = fault
    try:
        robot.until_state(State.DEAD_RECKONING, State.LOST)
        robot.until_said(said)
        # the base hears of it with the next telegram, by state, and by the age of what was seen last
        robot.until(lambda: robot.base.telegrams[-1].telegram.state not in GOOD, "the base hears of it")
        if counter == "camera_connected":
            robot.until_health(counter, lambda v: v is False)
        elif counter:
            robot.until_health(counter, lambda v: v != before)
    finally:
        robot.fault = ""
    robot.until_state(*GOOD)
    robot.until_health("camera_connected", lambda v: v is True)
    robot.until(lambda: robot.base.telegrams[-1].telegram.state in GOOD, "the base hears that it is over")


def test_stamps_that_jump_ahead_cost_frames_and_nothing_else(robot: Robot) -> None:
    robot.until_state(*GOOD)
    before = robot.poses[-1].stamp_ns
    robot.fault = "stamps jump"
    count = len(robot.poses) + 20
    robot.until(lambda: len(robot.poses) > count, "poses go on")
    robot.fault = ""
    stamps = [p.stamp_ns for p in robot.poses if p.stamp_ns >= before]
    assert (np.diff(stamps) > 0).all()
    robot.until_state(*GOOD)


BASE = {
    "silent": "gave no answer",
    "garbage": "no Modbus answer",
    "bad crc": "no Modbus answer",
    "slow": "gave no answer",
    "wrong version": "protocol version 2, expected 1",
    "adapter unplugged": "base",
}


@pytest.mark.parametrize("fault", BASE)
def test_a_base_fault_is_told_and_does_not_touch_the_pose(robot: Robot, fault: str) -> None:
    robot.until_state(*GOOD)
    robot.until_health("base_up", lambda v: v is True)
    first = len(robot.poses)
    set_base_fault(robot.base, fault)
    try:
        robot.until_health("base_up", lambda v: v is False)
        robot.until(lambda: BASE[fault] in str(robot.health()["base_error"]), f"the reason {BASE[fault]!r}")
        count = len(robot.poses) + 10
        robot.until(lambda: len(robot.poses) > count, "poses go on")
    finally:
        set_base_fault(robot.base, "")
    robot.until_health("base_up", lambda v: v is True)
    received = robot.base.model.received
    robot.until(lambda: robot.base.model.received > received + 3, "telegrams again")
    assert State.LOST not in {p.state for p in robot.poses[first:]}


def test_a_base_that_restarts_goes_on_being_told(robot: Robot) -> None:
    robot.until_health("base_up", lambda v: v is True)
    set_base_fault(robot.base, "reboot")
    received = robot.base.model.received
    robot.until(lambda: robot.base.model.received > received + 10, "telegrams")
    assert robot.base.model.motors_on or robot.poses[-1].state is not State.STOPPED


def test_a_flood_of_malformed_commands_is_refused_and_poses_go_on(
    robot: Robot, caplog: pytest.LogCaptureFixture
) -> None:
    robot.until_state(*GOOD)
    caplog.clear()
    count = len(robot.poses) + 15
    session = robot.listener.session
    asked = ask_until(lambda: len(robot.poses) > count, session, "cmd/initial_pose", b'{"x_m": "here"}')
    assert asked > 0
    robot.until(lambda: int(robot.health()["zenoh"]["request_errors"]) >= asked, "refusals are counted")  # type: ignore[index]
    refused = [r for r in caplog.records if "refused" in r.getMessage()]
    assert len(refused) <= 25, "a flood must not fill the log"
    robot.until_state(*GOOD)


def test_a_flood_of_good_commands_is_limited(robot: Robot) -> None:
    begun_s = time.monotonic()
    asked = [robot.listener.session.get(f"{STEM}/cmd/save_map", timeout=PATIENCE_S) for _ in range(200)]
    done = sum(reply.ok is not None for replies in asked for reply in replies)
    most = Requests.COMMAND_BURST + Requests.COMMANDS_PER_S * (time.monotonic() - begun_s)
    assert 10 <= done <= most + 1, "the rest is refused: the disk is not for them"
    robot.until_state(*GOOD)


def test_what_cannot_be_saved_is_told_once_and_saved_when_it_can_be(
    robot: Robot, caplog: pytest.LogCaptureFixture
) -> None:
    robot.until_health("store_error", lambda v: v == "")
    caplog.set_level("INFO", logger="ceilvo.store")
    caplog.clear()
    aside = robot.folder / "aside"
    robot.state_dir.rename(aside)
    try:
        robot.until_health("store_error", lambda v: "no such folder" in str(v))
        robot.until_health("recorder", lambda v: "No such file" in str(v))
    finally:
        aside.rename(robot.state_dir)
    robot.until_health("store_error", lambda v: v == "")
    texts = [r.getMessage() for r in caplog.records]
    complaints = [t for t in texts if "not saved" in t]
    assert complaints
    assert len(complaints) == len(set(complaints)), "a complaint a file, however often it is tried"
    assert texts.count("map and pose are saved again") == 1
    robot.until_state(*GOOD)


def test_the_clock_may_step_by_an_hour(robot: Robot, monkeypatch: pytest.MonkeyPatch) -> None:
    """Nothing but stamp_unix_ns follows the wall clock."""
    real = time.time_ns
    for hours in (1, -1):
        monkeypatch.setattr(time, "time_ns", lambda step=hours: real() + step * 3_600_000_000_000)
        count = len(robot.poses) + 10
        robot.until(lambda n=count: len(robot.poses) > n, "poses go on")
        robot.until_state(*GOOD)
        assert abs(robot.poses[-1].stamp_ns - time.monotonic_ns()) < 60_000_000_000, "stamps follow no wall clock"
    stamps = [p.stamp_ns for p in robot.poses]
    assert (np.diff(stamps) > 0).all()


def test_any_thread_that_raises_ends_the_process(caplog: pytest.LogCaptureFixture) -> None:
    """A library's thread too: systemd starts the process again, a half-dead one would say good things for ever."""
    calibration = replace(World(WorldSpec(seed=SEED)).calibration, camera_id="")
    camera = MockCamera(width_px=calibration.camera.width_px, height_px=calibration.camera.height_px)
    c = Config()
    config = replace(c, base=replace(c.base, enabled=False), zenoh=replace(c.zenoh, enabled=False))
    daemon = Daemon(Plan(config, calibration, camera), Notifier({}))

    def fail() -> None:
        raise RuntimeError("a fault in somebody's thread")

    with watch_threads(daemon._crash):
        thread = threading.Thread(target=fail)
        thread.start()
        thread.join()
    with pytest.raises(RuntimeError, match="somebody's thread"):
        daemon.run()


@pytest.mark.parametrize("thread", ["estimator", "base", "zenoh-offers"])
def test_each_thread_of_the_daemon_ends_the_process_with_an_exit_code(thread: str, tmp_path: Path) -> None:
    """In a process of its own, because the exit code is what systemd sees."""
    code = f"""
import logging
from dataclasses import replace
from ceilvo.config import Config
from ceilvo.daemon import cli
from ceilvo.daemon.app import estimator, process
from ceilvo.drivers.base import link
from ceilvo.drivers.bus import zenoh_bus
from ceilvo.drivers.camera.mock_camera import MockCamera
from ceilvo.sim.base import SimBase
from ceilvo.sim.rig import simulated_calibration
logging.basicConfig(level="INFO")
def fail(*args, **kwargs):
    raise RuntimeError("a fault in {thread}")
part = {{"estimator": (estimator.Estimator, "frame"), "base": (link.BaseLink, "_telegram"),
        "zenoh-offers": (zenoh_bus.ZenohBus, "_note_links")}}["{thread}"]
setattr(*part, fail)
cal = replace(simulated_calibration(), camera_id="")
with SimBase() as base:
    c = Config()
    config = replace(c, base=replace(c.base, port=base.port), zenoh=replace(c.zenoh, multicast=False))
    camera = MockCamera(width_px=cal.camera.width_px, height_px=cal.camera.height_px)
    code = process.run(process.Plan(config, cal, camera, seconds=50.0))
cli.leave(code)
"""
    environment = {k: v for k, v in os.environ.items() if k not in ("NOTIFY_SOCKET", "WATCHDOG_USEC")}
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, timeout=PATIENCE_S, check=False, env=environment
    )
    assert done.returncode == 1, done.stderr
    assert f"a fault in {thread}" in done.stderr
