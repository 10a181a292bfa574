"""Evidence against the eyes: picture, wheels and stamps must tell the same story, and where they do not it is said.

`admit` says before odometry what of a frame may be used. `step` takes the frame in, with the motion that came of it,
and says what is suspected from then on. No clock, no randomness: all memory is in one state.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np

from ceilvo import se2
from ceilvo.config import Config
from ceilvo.daemon.odometry.coasting import KnownTurn
from ceilvo.daemon.odometry.cross_checks.delay import NO_DELAY_S, Delay, DelayState, Rewound, RewoundState
from ceilvo.daemon.odometry.cross_checks.noticed import EVENTS, suspicions_of
from ceilvo.daemon.odometry.cross_checks.paths import Paths, PathsState
from ceilvo.daemon.odometry.cross_checks.pictures import Pictures, PicturesState
from ceilvo.daemon.odometry.cross_checks.reversal import Reversal, ReversalState
from ceilvo.daemon.odometry.cross_checks.standing import Standing, StandingState, StoppedDead, StoppedState
from ceilvo.daemon.odometry.cross_checks.suspicion import Kind, Severity, Suspicion, Suspicions
from ceilvo.daemon.odometry.cross_checks.turned_camera import YAW_SIGMA_RAD, TurnedCamera, TurnedCameraState
from ceilvo.daemon.odometry.senses.motion_senses import MotionSenses, MotionSensesState, Noticed, Told
from ceilvo.senses.heard import NOTHING, Heard
from ceilvo.types import Array, Crossings, Displacement, Motion, Pose, WheelMotion

_KNOWN_DELAY_S = 0.1
"""By how much a known delay may still be off; chosen: three frames at 30 Hz."""
_STANDS_S = 0.3
"""So long wheels must stand before they vouch for a picture that stands; chosen: pictures may come later."""
_STANDS_M, _STANDS_RAD = 0.002, 0.003
"""Motion of wheels that stand; chosen: a count or two."""


@dataclass(frozen=True, slots=True)
class Admitted:
    """What of a frame may be used: crossings or None with the reason, wheels or None, without those the gyro's turn."""

    crossings: Crossings | None
    wheels: WheelMotion | None
    missing: str = ""
    turn: KnownTurn | None = None


@dataclass(slots=True)
class CrossChecksState:
    """All that the checks remember; counters: how often each kind became active."""

    paths: PathsState = field(default_factory=PathsState)
    pictures: PicturesState = field(default_factory=PicturesState)
    standing: StandingState = field(default_factory=StandingState)
    reversal: ReversalState = field(default_factory=ReversalState)
    turned_camera: TurnedCameraState = field(default_factory=TurnedCameraState)
    delay: DelayState = field(default_factory=DelayState)
    active: list[str] = field(default_factory=list)
    counters: dict[str, int] = field(default_factory=lambda: {kind.value: 0 for kind in Kind})
    senses: MotionSensesState = field(default_factory=MotionSensesState)
    rewound: RewoundState = field(default_factory=RewoundState)
    stopped: StoppedState = field(default_factory=StoppedState)


@dataclass(frozen=True, slots=True)
class _Asked:
    """What admit() was asked, and what it found: a repeat of an earlier picture, wheels between the pictures."""

    crossings: Crossings | None
    wheels: WheelMotion | None
    repeat: Suspicion | None
    usable: WheelMotion | None


class CrossChecks:
    """All checks of one robot.

    Attributes:
        senses: of motion beside the eye; begun: what they noticed in the last frame for the first time.
    """

    def __init__(self, config: Config) -> None:
        self._max_delay_s, self._fine = config.odometry.max_delay_s, config.senses.time
        self._refuse_repeats = config.camera.refuse_repeats
        self._paths, self._pictures = Paths(), Pictures()
        self._standing, self._delay = Standing(config.odometry.match_radius_m), Delay()
        self._rewound, self._stopped = Rewound(config.odometry), StoppedDead(config.odometry)
        self._reversal, self._turned_camera = Reversal(), TurnedCamera()
        self.senses, self._noticed = MotionSenses(config.senses), Noticed()
        self._active: list[str] = []
        self._counters = {kind.value: 0 for kind in Kind}
        self._admitted: _Asked | None = None
        self.begun: tuple[Suspicion, ...] = ()

    @property
    def state(self) -> CrossChecksState:
        """All that is remembered; setting it continues from there."""
        return CrossChecksState(
            self._paths.state,
            self._pictures.state,
            self._standing.state,
            self._reversal.state,
            self._turned_camera.state,
            self._delay.state,
            self._active,
            self._counters,
            self.senses.state,
            self._rewound.state,
            self._stopped.state,
        )

    @state.setter
    def state(self, state: CrossChecksState) -> None:
        self._paths.state, self._pictures.state, self._delay.state = state.paths, state.pictures, state.delay
        self._standing.state, self._reversal.state = state.standing, state.reversal
        self._turned_camera.state, self._rewound.state = state.turned_camera, state.rewound
        self._stopped.state = state.stopped
        self._active, self._counters, self.senses.state = state.active, state.counters, state.senses
        self._admitted = None

    @property
    def counters(self) -> dict[str, int]:
        """How often each kind of suspicion became active, by its name."""
        return dict(self._counters)

    def restart(self) -> None:
        """Begin anew after a reset: what is known of the camera stays, and the counters."""
        old = self.state
        self.senses.restart()
        self.state = CrossChecksState(
            pictures=old.pictures, delay=old.delay, counters=old.counters, senses=self.senses.state
        )

    def admit(
        self, crossings: Crossings | None, wheels: WheelMotion | None, elapsed_s: float, heard: Heard = NOTHING
    ) -> Admitted:
        """What of a frame odometry may use; changes nothing that step() would see.

        Args:
            wheels: what the base reports since the frame before.
            elapsed_s: time since then.
            heard: what other senses say of that time.
        """
        asked = self._asked(crossings, wheels, elapsed_s)
        self._admitted = asked
        told = self.senses.told(asked.usable, heard.turn, elapsed_s)
        if asked.repeat is not None:
            return Admitted(None, told.wheels, asked.repeat.reason, told.turn)
        return Admitted(crossings, told.wheels, turn=told.turn)

    def told(self, wheels: WheelMotion | None, elapsed_s: float, heard: Heard = NOTHING) -> Told:
        """The motion that a picture will show, before it is looked at."""
        return self.senses.told(self.usable_wheels(wheels, elapsed_s), heard.turn, elapsed_s)

    def _asked(self, crossings: Crossings | None, wheels: WheelMotion | None, elapsed_s: float) -> _Asked:
        return _Asked(crossings, wheels, self._repeat(crossings, wheels), self.usable_wheels(wheels, elapsed_s))

    def usable_wheels(self, wheels: WheelMotion | None, elapsed_s: float) -> WheelMotion | None:
        """The wheels' motion between the moments that the last two pictures show, in base as a turned camera has it.

        None while the wheels are not believed.
        """
        if wheels is None or Kind.WHEELS_REVERSED.value in self._active:
            return None
        late_s = self._known_late_s
        if late_s <= 0.0 or elapsed_s <= 0.0:
            return _seen_from(wheels, self._turned_camera.yaw_rad)
        return _seen_from(self._delayed(wheels, late_s, elapsed_s), self._turned_camera.yaw_rad)

    def _delayed(self, wheels: WheelMotion, late_s: float, elapsed_s: float) -> WheelMotion:
        """What the wheels did so much earlier; as they are where the history does not reach."""
        now_s = self._paths.state.time_s
        if late_s >= elapsed_s:
            return self._paths.wheel_motion(now_s - late_s, now_s - late_s + elapsed_s) or wheels
        before = self._paths.wheel_motion(now_s - late_s, now_s)
        return wheels if before is None else _joined(before, _part(wheels, 1.0 - late_s / elapsed_s))

    def corrected(self, pose: Pose, cov: Array) -> tuple[Pose, Array]:
        """The pose (3,) with cov (3, 3) to report, for what is known to be wrong with the camera.

        A late picture's pose is moved on to its stamp by the wheels. A heading that a turned camera gives is turned to
        the wheels' direction; that the camera is not on the rotation centre is left out (5 mm at 5 deg and 6 cm).
        """
        late_s, now_s, yaw_rad = self._known_late_s, self._paths.state.time_s, self._turned_camera.yaw_rad
        late_s = max(late_s, 0.0) if len(self._paths) else max(self.senses.gyro_late[0], 0.0)
        told = self._paths.wheel_motion(now_s - late_s, now_s) if late_s else None
        told = None if Kind.WHEELS_REVERSED.value in self._active else told
        since = self.senses.since(told, late_s) if late_s else None
        if since is None and self._rewound.since is not None and not len(self._paths):
            since = WheelMotion(*self._rewound.since)
        if since is not None:
            moved = _seen_from(since, yaw_rad)
            cov = se2.compose_cov(pose, cov, moved.prev_from_curr, moved.cov)
            pose = Pose(se2.compose(pose, moved.prev_from_curr))
        if yaw_rad:
            cov = cov + np.diag([0.0, 0.0, YAW_SIGMA_RAD**2])
            pose = Pose(se2.compose(pose, np.array([0.0, 0.0, yaw_rad])))
        return pose, cov

    def step(
        self,
        stamp_ns: int,
        crossings: Crossings | None,
        motion: Motion,
        wheels: WheelMotion | None,
        elapsed_s: float,
        heard: Heard = NOTHING,
    ) -> Suspicions:
        """Take a frame in.

        Args:
            stamp_ns: of the frame, for messages only; time is elapsed_s.
            crossings: as vision found them, whatever admit() said of them.
            motion: what odometry made of them.
            wheels: as the base reports them, whatever admit() made of them.
            elapsed_s: time since the frame before, 0 for the first.
            heard: what other senses say of that time.
        """
        asked, self._admitted = self._admitted, None
        if asked is None or asked.crossings is not crossings or asked.wheels is not wheels:
            asked = self._asked(crossings, wheels, elapsed_s)
        if crossings is not None:
            self._pictures.add(crossings, motion)
        self._paths.add(motion, wheels, elapsed_s)
        self._delay.step(self._paths)
        if self._rewound.step(0 if asked.repeat is None else asked.repeat.period, motion, elapsed_s):
            self._delay.told(self._rewound.late_s)
        if self._fine and len(self._paths):
            self.senses.wheels_lag.step(self._paths.series())
        self._noticed = self.senses.step(motion, asked.usable, heard.turn, elapsed_s)
        known_s = self._known_late_s
        late_s = self._max_delay_s if self._steady_late_s is None else max(known_s, 0.0) + _KNOWN_DELAY_S
        found = [] if asked.repeat is None else [asked.repeat]
        found += self._standing.step(self._paths, late_s, self._noticed.still)
        stopped = self._stopped.step(motion, wheels, elapsed_s)
        found += [] if stopped is None else [stopped]
        found += suspicions_of(self._noticed, motion.ok, self._since_jump_s())
        against = self._reversal.step(self._paths, max(known_s, 0.0))
        found += against + self._turned_camera.step(self._paths, max(known_s, 0.0), late_s, bool(against))
        found += self._late()
        return self._count(found)

    def _repeat(self, crossings: Crossings | None, wheels: WheelMotion | None) -> Suspicion | None:
        if crossings is None or not self._refuse_repeats:
            return None
        return self._pictures.judge(crossings, self._wheels_stand(wheels))

    def _wheels_stand(self, wheels: WheelMotion | None) -> bool:
        """Now and for a while."""
        if wheels is None:
            return False
        moved = [wheels.prev_from_curr]
        since_s = self._paths.state.time_s - _STANDS_S
        if len(self._paths) and since_s > self._paths.time_s[0]:
            moved.append(self._paths.wheels[-1] - self._paths.wheels_at(since_s))
        return all(np.hypot(m[0], m[1]) < _STANDS_M and abs(m[2]) < _STANDS_RAD for m in moved)

    @property
    def _known_late_s(self) -> float:
        """By how much pictures come later than wheels, to milliseconds where that is known so well; 0 where not."""
        known_s, sigma_s = self.senses.wheels_late
        return known_s if self._fine and math.isfinite(sigma_s) else self._delay.known_s

    @property
    def _steady_late_s(self) -> float | None:
        known_s, sigma_s = self.senses.wheels_late
        return known_s if self._fine and math.isfinite(sigma_s) else self._delay.state.steady_s

    def _since_jump_s(self) -> tuple[float, float] | None:
        """Size of the last jump of a delay, and how long ago that was noticed."""
        lags = (self.senses.wheels_lag.state, self.senses.gyro_lag.state)
        times = (self._paths.state.time_s, self.senses.gyro_path.state.time_s)
        found = [(t - lag.jumped_at_s, lag.jumped_s) for lag, t in zip(lags, times, strict=True) if lag.jumps]
        return None if not found else (min(found)[1], min(found)[0])

    def _late(self) -> list[Suspicion]:
        steady_s = self._steady_late_s
        if not len(self._paths) and self._rewound.late_s > NO_DELAY_S:
            why = f"old pictures came once more: since then they come {self._rewound.late_s:.2f} s late"
            return [Suspicion(Kind.LATE, why, Severity.DEGRADED)]
        if steady_s is None or abs(steady_s) <= self._max_delay_s:
            return []
        what = "pictures come" if steady_s > 0.0 else "wheel odometry comes"
        why = f"{what} {abs(steady_s):.2f} s late, more than odometry.max_delay_s = {self._max_delay_s:g} s"
        return [Suspicion(Kind.LATE, why, Severity.DEGRADED)]

    def _count(self, found: list[Suspicion]) -> Suspicions:
        now = sorted({f.kind.value for f in found})
        self.begun = tuple(f for f in found if f.kind in EVENTS and f.kind.value not in self._active)
        for kind in now:
            self._counters[kind] = self._counters.get(kind, 0) + (kind not in self._active)
        self._active = now
        return Suspicions(tuple(sorted(found, key=lambda f: -f.severity)))


def _seen_from(wheels: WheelMotion, yaw_rad: float) -> WheelMotion:
    """A motion of the true base as one of a base that is turned by -yaw_rad."""
    if not yaw_rad:
        return wheels
    turn = np.eye(3)
    turn[:2, :2] = se2.rotation(yaw_rad)
    return WheelMotion(Displacement(turn @ wheels.prev_from_curr), turn @ wheels.cov @ turn.T)


def _part(wheels: WheelMotion, share: float) -> WheelMotion:
    """The first part of a motion at constant speed."""
    x, y, turned = (share * wheels.prev_from_curr).tolist()
    return WheelMotion(Displacement(np.array([x, y, turned])), share * wheels.cov)


def _joined(first: WheelMotion, then: WheelMotion) -> WheelMotion:
    moved = se2.compose(first.prev_from_curr, then.prev_from_curr)
    cov = se2.compose_cov(first.prev_from_curr, first.cov, then.prev_from_curr, then.cov)
    return WheelMotion(Displacement(moved), cov)
