"""Wheels that turn while the picture stands, a picture that moves while they stand, blindness on the spot, and, without
wheels, a picture that stops dead."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from ceilvo import se2
from ceilvo.config import Odometry
from ceilvo.daemon.odometry.cross_checks.paths import Paths, displacement
from ceilvo.daemon.odometry.cross_checks.pictures import MOVES_M, MOVES_RAD, STANDS_M, STANDS_RAD
from ceilvo.daemon.odometry.cross_checks.suspicion import Kind, Severity, Suspicion
from ceilvo.types import Array, Displacement, Ints, Motion, WheelMotion

_MOVED_M, _MOVED_RAD = 0.02, 0.03
"""Least motion that counts; chosen: gears and belts of a few millimetres of play turn motors before wheels."""
_STILL_SHARE = 0.15
"""Of that, what still counts as none; chosen: above the noise of a standing picture (0.1 mm) and of whole counts."""
_SIGMAS = 6.0
"""Of the wheels' own error, that a motion must exceed: noise does so once in 10^9 windows, 10^4 h at 30 Hz."""
_HOLE_S, _HOLE_FRAMES = 0.5, 1.5
"""Longest time without a measured motion within one window, or so many of the usual periods of a slow camera; chosen:
longer ones are gaps, with rules of their own."""
_IN_DOUBT_M, _IN_DOUBT_RAD = 0.15, 0.1
"""A pose that may be further off is in doubt; chosen: half of the smallest tile, 0.3 m, and 5.7 deg."""
_MARGIN = 1.1
"""On a bound that wheels gave; chosen: their scale may be off by so much."""
CARRY_MPS, CARRY_RADPS = 15.0, 15.0
"""A robot that is carried or thrown is not moved faster; chosen: far above a hand's 4 m/s."""
_BLIND_S = 0.09
"""Shortest time without a motion in which a robot may have been moved, where frames showed none; chosen: a tile in
0.1 s is 6 m/s. Where there were no frames at all it is a hole: a busy computer leaves them out for some tenths."""
_SURE_STEP = 0.5
"""Of the radius in which features are matched: a longer step on a ceiling of tiles may be another; chosen."""


@dataclass(slots=True)
class StandingState:
    """What the last frames left.

    Attributes:
        stood_wheels, stood_eye: (3,) both paths where the picture began to stand under turning wheels; None otherwise.
        sight_s, sight_wheels: time and (3,) wheels' path of the last measured motion; None before the first.
        failed: frames since then.
    """

    stood_wheels: Array | None = None
    stood_eye: Array | None = None
    sight_s: float = 0.0
    sight_wheels: Array | None = None
    failed: int = 0


class Standing:
    """One check a question; all take their windows from the same paths."""

    def __init__(self, match_radius_m: float) -> None:
        self._sure_step_m = _SURE_STEP * match_radius_m
        self.state = StandingState()

    def restart(self) -> None:
        """The paths begin anew."""
        self.state = StandingState()

    def step(self, paths: Paths, late_s: float, still: bool = False) -> list[Suspicion]:
        """After a frame was added to the paths.

        Args:
            late_s: by how much the picture may lag behind the wheels.
            still: a gyro says that nobody moved the robot in the gap that ends here.
        """
        if not len(paths):
            self.restart()
            return []
        found = (self._stands(paths, late_s), self._lifted(paths, still), self._moves(paths, late_s))
        return [s for s in found if s is not None]

    def _stands(self, paths: Paths, late_s: float) -> Suspicion | None:
        s = self.state
        if s.stood_eye is not None and _size(displacement(s.stood_eye, paths.eye[-1])) > 1.0 and paths.good[-1]:
            s.stood_wheels = s.stood_eye = None
        if s.stood_wheels is None:
            start = _stood_since(paths)
            if start is None or not _moved(paths, float(paths.time_s[start]), float(paths.time_s[-1]) - late_s):
                return None
            s.stood_wheels, s.stood_eye = paths.wheels[start].copy(), paths.eye[start].copy()
        away = displacement(s.stood_wheels, paths.wheels[-1])
        m, rad = float(np.hypot(away[0], away[1])), abs(float(away[2]))
        far = m > _IN_DOUBT_M or rad > _IN_DOUBT_RAD
        return Suspicion(
            Kind.STANDS,
            f"wheels moved {m:.2f} m and {math.degrees(rad):.1f} deg while the picture stood: wheels slip, or the "
            "picture is frozen",
            Severity.IN_DOUBT if far else Severity.DEGRADED,
            _MARGIN * m,
            _MARGIN * rad,
            away,
        )

    def _lifted(self, paths: Paths, still: bool) -> Suspicion | None:
        """Vision is back after a gap in which the wheels stood, which a robot's in the air do as well."""
        s, now_s = self.state, float(paths.time_s[-1])
        if not paths.good[-1]:
            s.failed += 1
            return None
        before, gap_s, failed = s.sight_wheels, now_s - s.sight_s, s.failed
        s.sight_s, s.sight_wheels, s.failed = now_s, paths.wheels[-1].copy(), 0
        if before is None or still or gap_s < (_BLIND_S if failed else _hole_s(paths)):
            return None
        if _size(displacement(before, paths.wheels[-1])) > _STILL_SHARE:
            return None
        return Suspicion(
            Kind.LIFTED,
            f"no motion measured for {gap_s:.2f} s while the wheels stood: the robot may have been carried",
            Severity.IN_DOUBT,
            CARRY_MPS * gap_s,
            min(CARRY_RADPS * gap_s, math.pi),
        )

    def _moves(self, paths: Paths, late_s: float) -> Suspicion | None:
        """A picture that moves steadily is measured well, whoever pushes; one that leaps may have leapt a tile more."""
        seen = _seen_since_wheels_stand(paths, late_s)
        if len(seen) < 2:
            return None
        moved = displacement(paths.eye[seen[0]], paths.eye[-1])
        if _size(moved) < 1.0:
            return None
        step = paths.eye[-1] - paths.eye[seen[-2]]
        step_m, gap_s = float(np.hypot(step[0], step[1])), float(paths.time_s[-1] - paths.time_s[seen[-2]])
        if step_m > self._sure_step_m:
            why = f"the picture moved by {step_m:.2f} m in {gap_s:.2f} s while the wheels stood: carried, or a tile off"
            return Suspicion(Kind.JUMPED, why, Severity.IN_DOUBT, CARRY_MPS * gap_s, CARRY_RADPS * gap_s)
        m, deg = float(np.hypot(moved[0], moved[1])), math.degrees(abs(float(moved[2])))
        why = f"the picture moved by {m:.2f} m and {deg:.1f} deg while the wheels stood: pushed, carried, or they slide"
        return Suspicion(Kind.MOVES, why, Severity.NOTED)


@dataclass(slots=True)
class StoppedState:
    """Without wheels: how fast the picture moved last, and what came since.

    Attributes:
        speed_mps, turn_radps: mean over span_s, between the last two views that moved; 0 before there were any.
        moved: (3,) since the last view; moved_s: time.
        dead_s: since the picture stopped dead; None while it is live.
    """

    speed_mps: float = 0.0
    turn_radps: float = 0.0
    span_s: float = 0.0
    moved: Array = field(default_factory=lambda: np.zeros(3))
    moved_s: float = 0.0
    dead_s: float | None = None


class StoppedDead:
    """A picture that moved, and stands from one view to the next with no way to brake on."""

    def __init__(self, config: Odometry) -> None:
        self._brake_mps2, self._brake_radps2 = config.max_accel_mps2, config.max_turn_accel_radps2
        self.state = StoppedState()

    def step(self, motion: Motion, wheels: WheelMotion | None, elapsed_s: float) -> Suspicion | None:
        """After odometry took a frame, elapsed_s after the last one. Wheels are for Standing: this begins anew."""
        if wheels is not None:
            self.state = StoppedState()
            return None
        s = self.state
        s.moved, s.moved_s = se2.compose(s.moved, motion.prev_from_curr), s.moved_s + elapsed_s
        if motion.restarted:
            self.state = StoppedState()
        elif motion.ok and s.moved_s > 0.0:
            self._view()
        s = self.state
        if s.dead_s is None:
            return None
        s.dead_s += elapsed_s
        m, rad = s.speed_mps * s.dead_s, s.turn_radps * s.dead_s
        return Suspicion(
            Kind.STANDS,
            f"the picture stopped dead at {s.speed_mps:.2f} m/s and {s.turn_radps:.2f} rad/s: it is frozen, or the "
            "robot ran into something",
            Severity.IN_DOUBT if m > _IN_DOUBT_M or rad > _IN_DOUBT_RAD else Severity.DEGRADED,
            m,
            rad,
        )

    def _view(self) -> None:
        """A view was laid on the last one."""
        s = self.state
        m, rad = float(np.hypot(s.moved[0], s.moved[1])), abs(float(s.moved[2]))
        if s.dead_s is not None:  # counted from where it stopped
            if m > MOVES_M or rad > MOVES_RAD:
                self.state = StoppedState()
            return
        if m < STANDS_M and rad < STANDS_RAD and self._had_to_move():
            s.dead_s = 0.0
        else:
            s.speed_mps, s.turn_radps, s.span_s = m / s.moved_s, rad / s.moved_s, s.moved_s
        s.moved, s.moved_s = np.zeros(3), 0.0

    def _had_to_move(self) -> bool:
        """Whether a robot that braked as hard as it can would have been seen to move on."""
        s = self.state
        way_m = _least_way(s.speed_mps, s.span_s, s.moved_s, self._brake_mps2)
        return way_m > MOVES_M or _least_way(s.turn_radps, s.span_s, s.moved_s, self._brake_radps2) > MOVES_RAD


def _least_way(mean: float, span_s: float, time_s: float, brake: float) -> float:
    """Of something that moved so fast in the mean over a span, in the time after it."""
    speed = max(mean - 0.5 * brake * span_s, 0.0)
    braking_s = min(time_s, speed / brake)
    return (speed - 0.5 * brake * braking_s) * braking_s


def _seen_since_wheels_stand(paths: Paths, late_s: float) -> Ints:
    """Rows with a measured motion since the wheels stand, but for what a late picture may still show of before."""
    start = _trailing(_still(paths.wheels - paths.wheels[-1]))
    stood = paths.time_s >= paths.time_s[start] + late_s
    stood[:start] = False
    seen = np.flatnonzero(stood & (paths.good > 0.0) & (paths.piece == paths.piece[-1]))
    return seen if len(seen) and seen[-1] == len(paths) - 1 else seen[:0]


def _still(off: Array) -> NDArray[np.bool_]:
    """(N,) which of the distances (N, 3) to a row of a path are none."""
    near = np.hypot(off[:, 0], off[:, 1]) < _STILL_SHARE * _MOVED_M
    return np.asarray(near & (np.abs(off[:, 2]) < _STILL_SHARE * _MOVED_RAD))


def _stood_since(paths: Paths) -> int | None:
    """Row since which the picture stands, with no gap; None when the last frame measured nothing."""
    if not paths.good[-1]:
        return None
    seen = np.flatnonzero((paths.good > 0.0) & (paths.piece == paths.piece[-1]))
    still = _still(paths.eye[seen] - paths.eye[-1])
    still[:-1] &= np.diff(paths.time_s[seen]) < _hole_s(paths)
    return int(seen[_trailing(still)])


def _hole_s(paths: Paths) -> float:
    """How long a hole is at the rate at which frames came before the last one."""
    before_s = np.diff(paths.time_s)[:-1]
    return max(_HOLE_S, _HOLE_FRAMES * float(np.median(before_s))) if len(before_s) else _HOLE_S


def _moved(paths: Paths, from_s: float, to_s: float) -> bool:
    """Whether the wheels moved between two times, beyond their error."""
    if to_s <= from_s:
        return False
    moved = displacement(paths.wheels_at(from_s), paths.wheels_at(to_s))
    var_xy, var_turn = paths.wheel_variance(from_s, to_s)
    far = float(np.hypot(moved[0], moved[1])) > max(_MOVED_M, _SIGMAS * math.sqrt(var_xy))
    return far or abs(float(moved[2])) > max(_MOVED_RAD, _SIGMAS * math.sqrt(var_turn))


def _trailing(holds: NDArray[np.bool_]) -> int:
    """Where the run of True begins that lasts to the end; the last one is True."""
    breaks = np.flatnonzero(~holds)
    return int(breaks[-1]) + 1 if len(breaks) else 0


def _size(moved: Displacement) -> float:
    """A displacement in units of the least that counts."""
    return max(float(np.hypot(moved[0], moved[1])) / _MOVED_M, abs(float(moved[2])) / _MOVED_RAD)
