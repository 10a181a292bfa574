"""A robot in a room, its camera and base, and the daemon that watches: what faults take hold of."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from ceilvo import se2
from ceilvo.bench.place.ceiling.eye import Sight
from ceilvo.bench.place.robot.driver import Base, Driver, Slip, arc
from ceilvo.bench.place.robot.sights import Camera, Seen, estimated
from ceilvo.bench.place.robot.tally import Tally
from ceilvo.calibration import Calibration
from ceilvo.config import Config
from ceilvo.daemon.app.estimator import Estimator
from ceilvo.daemon.map.map_file import StoredMap, StoredState
from ceilvo.daemon.pipeline import Pipeline
from ceilvo.daemon.replay.inputs import Silence
from ceilvo.senses.heard import NOTHING, Heard
from ceilvo.types import Array, Estimate, Landmarks, Pose, State, WheelMotion

SILENT = "the camera gives no frames"
_SURE = np.diag([1e-6, 1e-6, 1e-6])
"""m^2, m^2, rad^2 of a pose that is given as the truth."""
_SETTLED_S = 3.0
"""TRACKING for so long is no accident; chosen."""
_KEPT = 64
"""Pictures that a fault can come back to; chosen: 2 s at 30 Hz."""


class Conditions:
    """What faults change; made anew for every drive.

    Attributes:
        sight: what is the matter with the eye; picture: what becomes of each picture (None: nothing).
        dark: pictures show nothing; silent: no picture comes, and the daemon says so; skipped: nor does the daemon.
        speed: share of its speed that the robot drives with; carried: (3,) pose it is moved to instead of driving.
        wheels: whether the base reports; slip: what its wheels make of a motion; lifted: they stand.
        clock: rate of the camera's stamps; stamp_jump_ns: added to them once.
        wheels_late_s: by which the base's answers come late, unknown to the daemon.
    """

    def __init__(self, wheels: bool) -> None:
        self.sight = Sight()
        self.picture: Callable[[Seen], Seen] | None = None
        self.dark = self.silent = self.skipped = False
        self.speed = 1.0
        self.carried: Array | None = None
        self.wheels, self.lifted = wheels, True  # carried by hand
        self.slip: Slip | None = None
        self.clock = 1.0
        self.stamp_jump_ns = 0
        self.wheels_late_s = 0.0


class Drive:
    """One robot. tick() after tick(): motion, picture, estimate, and what it was worth.

    Attributes:
        senses: what other senses hear of a frame at a stamp.
    """

    def __init__(
        self,
        camera: Camera,
        calibration: Calibration,
        driver: Driver,
        map_from_room: Array,
        pose: Array,
        wheels: bool,
        rate_hz: float,
        config: Config,
        rng: np.random.Generator,
    ) -> None:
        """pose: (3,) in the room's own frame, map_from_room: (3,) how that lies in the map."""
        self.camera, self.driver, self.rng, self.config = camera, driver, rng, config
        self.conditions = Conditions(wheels)
        self.map_from_room = map_from_room
        self.room_pose = pose
        self.base = Base(rng)
        self.dt_s = 1.0 / rate_hz
        self.tally = Tally()
        self.kept: deque[Seen] = deque(maxlen=_KEPT)
        self.estimate: Estimate | None = None
        self.step_ms: list[float] = []
        self.senses: Callable[[int], Heard] | None = None
        self.calibration = calibration
        self._ns = self._stamp_ns = 10**9
        self._before_ns: int | None = None
        self._turned_rad = 0.0
        self.begin_anew()

    @property
    def turn_radps(self) -> float:
        """How fast the robot turns."""
        return self._turned_rad / self.dt_s

    def begin_anew(self) -> None:
        """Another process of the daemon."""
        self.pipeline = Pipeline(self.calibration, self.config, self.rng.spawn(1)[0])
        self.estimator = Estimator(self.pipeline, lambda: self._ns)
        self._before_ns = None

    def configure(self, pose: Array) -> None:
        """filter.initial_pose from now on: (3,) map_from_base."""
        x_m, y_m, theta_rad = (float(v) for v in pose)
        start = replace(
            self.config.filter,
            initial_pose_x_m=x_m,
            initial_pose_y_m=y_m,
            initial_pose_theta_deg=float(np.degrees(theta_rad)),
        )
        self.config = self.pipeline.config = replace(self.config, filter=start)

    def restart(self) -> None:
        """Another process on what this one would store now, a moment later; without a map it begins anew."""
        landmarks, axis_rad = self.estimator.map()
        last, elsewhere, ceiling = self.estimate, self.estimator.elsewhere(), self.estimator.ceiling()
        self.begin_anew()
        if last is not None and axis_rad is not None and len(landmarks):
            state = StoredState(last.pose, last.cov, last.state, last.stamp_ns, elsewhere, ceiling=ceiling)
            self.estimator.load_map(StoredMap(landmarks, axis_rad), state)

    @property
    def pose(self) -> Array:
        """(3,) where the robot is, map_from_base."""
        return np.asarray(se2.compose(self.map_from_room, self.room_pose))

    def at_truth(self) -> None:
        """An empty map that begins where the robot is; it stands until its first picture."""
        self.estimator.reset(keep_map=False)
        self.pipeline.set_pose(Pose(self.pose), _SURE, "put here")
        speed, self.conditions.speed = self.conditions.speed, 0.0
        self.tick()
        self.conditions.speed = speed

    def load(
        self, landmarks: Landmarks, axis_rad: float, pose: Array | None = None, ago_s: float | None = None
    ) -> None:
        """As the daemon begins with stored files; pose: (3,) stored, else the robot's own; ago_s: since then,
        else since the drive began."""
        at = Pose(self.pose if pose is None else pose)
        stamp_ns = 0 if ago_s is None else self._ns - round(1e9 * ago_s)
        self.estimator.load_map(StoredMap(landmarks, axis_rad), StoredState(at, _SURE, State.TRACKING, stamp_ns))

    def stored(self) -> tuple[Landmarks, float, Array] | None:
        """Map, its axis and pose as the daemon would store them, None without a map."""
        landmarks, axis = self.estimator.map()
        if axis is None or not len(landmarks) or self.estimate is None:
            return None
        return landmarks, axis, np.asarray(self.estimate.pose)

    def go(self, seconds: float) -> None:
        """Drive so long."""
        for _ in range(round(seconds / self.dt_s)):
            self.tick()

    def settle(self, most_s: float) -> bool:
        """Drive until TRACKING for a while; whether that came within most_s."""
        good_s = 0.0
        for _ in range(round(most_s / self.dt_s)):
            estimate = self.tick()
            good_s = good_s + self.dt_s if estimate is not None and estimate.state is State.TRACKING else 0.0
            if good_s >= _SETTLED_S:
                return True
        return False

    def tick(self) -> Estimate | None:
        """One period of the camera."""
        self._ns += round(1e9 * self.dt_s)
        moved = self._move()
        c = self.conditions
        self._stamp_ns += round(1e9 * self.dt_s * c.clock) + c.stamp_jump_ns
        c.stamp_jump_ns = 0
        if c.skipped:
            self._count(None, moved)
            return None
        seen = self._seen()
        wheels = self._wheels()
        heard = NOTHING if self.senses is None else self.senses(self._stamp_ns)
        begun = time.thread_time()
        if c.silent:
            estimate = estimated(self.pipeline, Silence(self._stamp_ns, SILENT, wheels, heard))
        else:
            estimate = self.camera.give(self.pipeline, self._stamp_ns, seen, wheels, heard)
        self.step_ms.append(1e3 * (time.thread_time() - begun))
        self._before_ns = self._stamp_ns
        self.estimate = estimate
        self._count(estimate, moved)
        return estimate

    def _move(self) -> tuple[float, float]:
        """The robot's motion of a period, and what the wheels make of it; returns how much it was, m and rad."""
        c = self.conditions
        if c.carried is not None:
            true = se2.between(self.room_pose, c.carried)
            said = np.zeros(3) if c.lifted else true
            self.room_pose, c.carried = c.carried, None
        else:
            true = said = arc(*self.driver.twist(self.room_pose, self.dt_s, c.speed), self.dt_s)
            self.room_pose = np.asarray(se2.compose(self.room_pose, true))
        if c.slip is not None:
            said = c.slip(said)
        self.base.turned(said, self._ns)
        self._turned_rad = abs(se2.wrap(float(true[2])))
        return float(np.hypot(true[0], true[1])), self._turned_rad

    def _seen(self) -> Seen:
        c = self.conditions
        if c.silent:
            return None
        seen = self.camera.dark() if c.dark else self.camera.look(self.pose, c.sight)
        self.kept.append(seen)
        return seen if c.picture is None else c.picture(seen)

    def _wheels(self) -> WheelMotion | None:
        c = self.conditions
        if not c.wheels or self._before_ns is None:
            return None
        late_ns = round(1e9 * c.wheels_late_s)
        return self.base.between(self._before_ns - late_ns, self._stamp_ns - late_ns)

    def _count(self, estimate: Estimate | None, moved: tuple[float, float]) -> None:
        if estimate is None:  # nothing was said: the base is told so once the last estimate is old
            self.tally.add(self.dt_s, State.DEAD_RECKONING, (0.0, 0.0), moved, "no estimate")
            return
        off = estimate.pose - self.pose
        away = (float(np.hypot(off[0], off[1])), abs(se2.wrap(float(off[2]))))
        self.tally.add(self.dt_s, estimate.state, away, moved, estimate.reason)
