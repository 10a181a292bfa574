"""When map and pose are written: a robot that is switched off where it stands is stored there."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from map_contents import key_poses
from map_writer import estimate, landmarks
from patience import PATIENCE_S, until

from ceilvo.calibration import LEVEL_CEILING, CeilingShape
from ceilvo.config import Base, Config, Filter, Service, Zenoh
from ceilvo.daemon.app.estimator import Estimator
from ceilvo.daemon.app.keeping import COPY_NS, Keeper
from ceilvo.daemon.app.process import Daemon, Plan
from ceilvo.daemon.map.database.database import MapDatabase
from ceilvo.daemon.map.database.key_pose_rows import kept as kept_of
from ceilvo.daemon.map.kept.store import MAP_NAME, STATE_NAME, Store
from ceilvo.daemon.map.key_poses import KeyPoses
from ceilvo.daemon.map.map_file import load_state
from ceilvo.drivers.host.systemd_notify import Notifier
from ceilvo.drivers.ports import CameraInfo
from ceilvo.sim.camera import SimCamera
from ceilvo.sim.world import World, WorldSpec
from ceilvo.types import Estimate, Frame, Landmarks, Pose, State

PERIOD_S = 10.0
TICK_NS = 50_000_000


class Robot(Estimator):
    """Instead of a pipeline whatever a test says."""

    def __init__(self) -> None:
        self.told: Estimate | None = None
        self.doubted = 0.0
        self.shape = LEVEL_CEILING
        self.taken = key_poses("robot", 0)
        self.not_taken = 0

    @property
    def last(self) -> Estimate | None:
        return self.told

    def map_on(self, floor: str) -> tuple[Landmarks, float | None]:
        return landmarks(30), 0.25

    def elsewhere(self) -> float:
        return self.doubted

    def ceiling(self) -> CeilingShape:
        return self.shape

    def key_poses(self, floor: str = "") -> KeyPoses:
        return self.taken

    def key_poses_kept(self, key_poses: KeyPoses | None) -> None:
        assert key_poses is not None
        self.taken = kept_of(self.taken, self.taken.stamp_ns > max(key_poses.stamp_ns, default=0))

    def refused(self) -> int:
        return self.not_taken


class Writes(Store):
    """Counts those of a pose alone."""

    poses = 0

    def save_pose(self, estimate: Estimate, elsewhere: float = 0.0, ceiling: CeilingShape = LEVEL_CEILING) -> bool:
        self.poses += 1
        return super().save_pose(estimate, elsewhere, ceiling)


class Drive:
    """Main thread and robot by the same clock."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.robot, self.store = folder, Robot(), Writes(folder)
        self.keeper = Keeper(self.robot, self.store, PERIOD_S)
        self.now_ns, self.x_m = 10**9, 0.0
        self.state = State.TRACKING

    def go(self, seconds: float, speed_mps: float, turn_radps: float = 0.0) -> None:
        for _ in range(round(1e9 * seconds / TICK_NS)):
            self.now_ns += TICK_NS
            self.x_m += 1e-9 * TICK_NS * speed_mps
            theta = turn_radps * 1e-9 * self.now_ns
            at = Pose(np.array([self.x_m, 2.0, np.remainder(theta + np.pi, 2.0 * np.pi) - np.pi]))
            last = estimate(1)
            self.robot.told = replace(last, stamp_ns=self.now_ns, pose=at, odom=at, state=self.state)
            self.keeper.keep(self.now_ns)

    @property
    def stored_x_m(self) -> float:
        state = load_state(self.folder / STATE_NAME)
        assert state is not None
        return float(state.pose[0])


@pytest.fixture
def drive(tmp_path: Path) -> Drive:
    return Drive(tmp_path)


def test_the_pose_of_a_robot_that_stopped_is_stored_after_a_second_and_once(drive: Drive) -> None:
    drive.go(4.0, 0.5)
    assert drive.stored_x_m < 0.1, "of the first look"
    drive.go(1.2, 0.0)
    assert drive.stored_x_m == pytest.approx(2.0)
    drive.go(4.0, 0.0)
    assert drive.store.poses == 1
    drive.go(20.0, 0.0)
    assert drive.store.poses == 1, "all is written each 10 s, and that is enough"


@pytest.mark.parametrize(("speed_mps", "turn_radps"), [(0.1, 0.0), (0.0, 0.1)])
def test_a_robot_that_moves_is_stored_with_its_map_only(drive: Drive, speed_mps: float, turn_radps: float) -> None:
    drive.go(9.0, speed_mps, turn_radps)
    assert drive.store.poses == 0


def test_what_becomes_known_of_a_standing_robot_is_stored(drive: Drive) -> None:
    drive.state, drive.robot.doubted = State.RELOCALISING, 0.9
    drive.go(3.0, 0.0)
    drive.state, drive.robot.doubted = State.TRACKING, 1e-6
    drive.go(1.2, 0.0)
    state = load_state(drive.folder / STATE_NAME)
    assert state is not None
    assert (state.state, state.elsewhere) == (State.TRACKING, 1e-6)
    assert drive.store.poses == 1


@pytest.mark.parametrize("seconds", [3.0, PERIOD_S + 1.0])
def test_heights_of_the_ceiling_go_with_the_pose(drive: Drive, seconds: float) -> None:
    """Whether it is stored alone or with the map."""
    drive.go(3.0, 0.0)
    drive.robot.shape = CeilingShape((0.4, 0.15), (0.08, -0.01, 1.02))
    drive.state, drive.robot.doubted = State.RELOCALISING, 0.9
    drive.go(seconds, 0.0)
    state = load_state(drive.folder / STATE_NAME)
    assert state is not None and state.ceiling == drive.robot.shape


def test_a_camera_that_says_nothing_is_no_standing_robot(drive: Drive) -> None:
    drive.go(4.0, 0.5)
    for _ in range(100):
        drive.now_ns += TICK_NS
        drive.keeper.keep(drive.now_ns)
    assert drive.store.poses == 0


def test_key_poses_go_with_the_map_and_wait_where_it_cannot_be_saved(drive: Drive) -> None:
    drive.go(1.0, 0.5)
    drive.robot.taken, drive.robot.not_taken = key_poses("robot", 5), 7
    drive.folder.rename(drive.folder.with_name("away"))
    drive.go(PERIOD_S, 0.5)
    assert len(drive.robot.taken) == 5, "they wait"
    drive.folder.with_name("away").rename(drive.folder)
    drive.go(PERIOD_S, 0.5)
    assert len(drive.robot.taken) == 0
    with MapDatabase(drive.folder / MAP_NAME) as db:
        (of_drive,), (session,) = db.content().key_poses, db.content().sessions
    assert len(of_drive) == 5
    assert (session.name, session.added, session.faded, session.refused) == ("robot", 30, 0, 7)


def test_the_good_copy_is_made_anew_every_hour(drive: Drive) -> None:
    drive.go(1.0, 0.5)
    first = (drive.folder / "map.db.good").stat().st_ino
    drive.go(60.0, 0.5)
    assert (drive.folder / "map.db.good").stat().st_ino == first
    drive.now_ns += COPY_NS
    drive.go(1.0, 0.5)
    assert (drive.folder / "map.db.good").stat().st_ino != first


# --- in the process

SEED, RATE_HZ = 5, 15.0
DRIVES, GOES_ON, STANDS = 45, 30, 40
"""Frames until the map is stored, from there until it stands, and then."""


class Parks(SimCamera):
    """A robot that drives, goes on once it may, stands, and then shows nothing more until it is let go."""

    def __init__(self, world: World) -> None:
        super().__init__(world, RATE_HZ, realtime=False)
        self.may_go_on, self.let_go = threading.Event(), threading.Event()
        self._frames = self._numbers()

    def open(self) -> CameraInfo:
        return replace(super().open(), live=False)

    def _numbers(self) -> Iterator[int]:
        yield from range(DRIVES)
        self.may_go_on.wait(PATIENCE_S)
        yield from range(DRIVES, DRIVES + GOES_ON + STANDS)
        self.let_go.wait(PATIENCE_S)

    def read(self) -> Frame | None:
        k = next(self._frames, None)
        if k is None:
            return None
        shown = self._world.renderer.render(parked_at(self._world, k), np.random.default_rng([SEED, k]))
        return Frame(k, 10**9 + round(1e9 * k / RATE_HZ), shown)


def parked_at(world: World, frame: int) -> np.ndarray:
    """(3,) where the robot is."""
    return world.truth_at(min(frame, DRIVES + GOES_ON) / RATE_HZ)


def test_what_a_kill_would_leave_of_a_parked_robot_is_where_it_stands(tmp_path: Path) -> None:
    """Nothing is asked of the daemon any more when the file is looked at: kill -9 leaves the same."""
    world = World(WorldSpec(seed=SEED))
    x, y, theta = (float(v) for v in world.initial_pose)
    config = Config(
        filter=Filter(initial_pose_x_m=x, initial_pose_y_m=y, initial_pose_theta_deg=float(np.degrees(theta))),
        base=Base(enabled=False),
        zenoh=Zenoh(enabled=False),
        service=Service(state_dir=str(tmp_path), state_period_s=3600.0),
    )
    camera = Parks(world)
    daemon = Daemon(Plan(config, world.calibration, camera), Notifier({}))
    thread = threading.Thread(target=daemon.run)
    thread.start()
    try:
        until(lambda: daemon._keeper.save() and daemon._estimator.last.seq == DRIVES, "a map")  # type: ignore[union-attr]
        camera.may_go_on.set()
        parked = parked_at(world, DRIVES + GOES_ON)
        until(lambda: off_m(tmp_path, parked) < 0.02, "the pose where it stands")
        assert off_m(tmp_path, parked_at(world, DRIVES)) > 0.5, "it had driven on"
    finally:
        camera.may_go_on.set()
        camera.let_go.set()
        daemon.stop()
        thread.join(PATIENCE_S)
    assert not thread.is_alive()


def off_m(folder: Path, pose: np.ndarray) -> float:
    state = load_state(folder / STATE_NAME)
    return np.inf if state is None else float(np.hypot(*(state.pose - pose)[:2]))


def test_what_was_learnt_on_a_floor_is_kept_when_the_robot_has_left_it(tmp_path: Path) -> None:
    """Of two floors, each save is of the one that the robot is on; once, of the one that it was on before."""

    class Rides(Robot):
        def map_on(self, floor: str) -> tuple[Landmarks, float | None]:
            return landmarks({"": 30, "ground": 31, "first": 32}[floor]), 0.25

    class Counts(Writes):
        left: list[str]

        def save_left(self, floor: str, landmarks: Landmarks, map_axis_rad: float, key_poses: KeyPoses | None) -> bool:
            self.left.append(f"{floor} {len(landmarks)}")
            return True

    robot, store = Rides(), Counts(tmp_path)
    store.left = []
    keeper = Keeper(robot, store, PERIOD_S)
    for floor, left in (("ground", []), ("ground", []), ("first", ["ground 31"]), ("first", ["ground 31"])):
        robot.told = replace(estimate(1), floor=floor)
        assert keeper.save(), store.error
        assert store.left == left, floor
