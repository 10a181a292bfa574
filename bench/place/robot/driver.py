"""A robot that drives about a room by itself, and its base, which counts how far the wheels turned."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from ceilvo import se2
from ceilvo.drivers.base.protocol import ANGLE_UNIT_RAD, LENGTH_UNIT_M, wrap_int32
from ceilvo.drivers.base.wheel_track import WheelNoise, WheelTrack
from ceilvo.drivers.telegrams import BaseStatus
from ceilvo.sim.ceiling.panels import Rect
from ceilvo.types import Array, WheelMotion

Slip = Callable[[Array], Array]
"""What the wheels say (3,) of a true displacement (3,)."""
_ACCEL_MPS2, _TURN_ACCEL_RADPS2, _TURN_RADPS = 0.5, 2.0, 1.0
"""What the robot's drive does; chosen: an ordinary differential drive."""
_STEER_PER_S = 2.0
"""Turn rate a radian of course error; chosen: it ends a turn of 90 deg in 2 s."""
_STRAIGHT_RAD = 1.0
"""With a larger course error it turns on the spot; chosen."""
_THERE_M = 0.3
"""So near a goal the next one counts; chosen."""
_LEG_M = 8.0
"""To the next goal of a random drive, at most; chosen: some turns a minute."""
_LAP_M = 16.0
"""Side of a lap in a large hall; chosen: a lap takes two minutes at most."""
_STOPS, _STOP_S = 0.2, (1.0, 4.0)
"""Share of the goals at which a random drive rests, and for how long; chosen."""
INSET_M = 0.9
"""From the walls; chosen: a robot's own radius and what it leaves free."""


class Driver:
    """Twists (2,) [m/s, rad/s] that lead from goal to goal within a room (x0, y0, x1, y1)."""

    def __init__(self, room: Rect, laps: bool, speed_mps: float, rng: np.random.Generator) -> None:
        inset = min(INSET_M, 0.3 * (room[2] - room[0]))
        self.low, self.high = np.array(room[:2]) + inset, np.array(room[2:]) - inset
        self._laps, self._speed_mps, self._rng = laps, speed_mps, rng
        self._v = self._w = 0.0
        self._rest_s = 0.0
        self._corner = 0
        self.anew(rng.uniform(self.low, self.high))

    def anew(self, xy_m: Array) -> None:
        """Go on from a place (2,) to which the robot was brought; it stands."""
        self._v = self._w = self._rest_s = 0.0
        side = np.minimum(self.high - self.low, _LAP_M)
        self._lap_low = np.clip(xy_m - 0.5 * side, self.low, self.high - side)
        self._lap_side = side
        self._goal = self._next(xy_m)

    def stop(self) -> None:
        self._v = self._w = 0.0

    def head_for(self, xy_m: Array) -> None:
        """Make a place (2,) the next goal."""
        self._goal, self._rest_s = np.asarray(xy_m, float), 0.0

    def start(self) -> Array:
        """(3,) a pose to begin at."""
        return np.array([*self._rng.uniform(self.low, self.high), self._rng.uniform(-np.pi, np.pi)])

    def twist(self, pose: Array, dt_s: float, speed: float = 1.0) -> tuple[float, float]:
        """For the next dt_s from a pose (3,); speed: share of the cruising speed that is wanted."""
        if np.hypot(*(self._goal - pose[:2])) < _THERE_M:
            if not self._laps and self._rng.random() < _STOPS:
                self._rest_s = float(self._rng.uniform(*_STOP_S))
            self._goal = self._next(pose[:2])
        self._rest_s -= dt_s
        to_goal = self._goal - pose[:2]
        off = se2.wrap(float(np.arctan2(to_goal[1], to_goal[0])) - float(pose[2]))
        v = self._speed_mps * max(np.cos(off), 0.0) ** 2 if abs(off) < _STRAIGHT_RAD else 0.0
        w = float(np.clip(_STEER_PER_S * off, -_TURN_RADPS, _TURN_RADPS))
        if self._rest_s > 0.0:
            v = w = 0.0
        self._v += float(np.clip(speed * v - self._v, -_ACCEL_MPS2 * dt_s, _ACCEL_MPS2 * dt_s))
        self._w += float(np.clip(speed * w - self._w, -_TURN_ACCEL_RADPS2 * dt_s, _TURN_ACCEL_RADPS2 * dt_s))
        return self._v, self._w

    def _next(self, xy_m: Array) -> Array:
        if self._laps:
            self._corner = (self._corner + 1) % 4
            return np.asarray(self._lap_low + self._lap_side * np.array([[0, 0], [1, 0], [1, 1], [0, 1]])[self._corner])
        low, high = np.maximum(self.low, xy_m - _LEG_M), np.minimum(self.high, xy_m + _LEG_M)
        return np.asarray(self._rng.uniform(low, high))


def arc(v_mps: float, w_radps: float, dt_s: float) -> Array:
    """(3,) displacement of a constant twist."""
    turn = w_radps * dt_s
    half = 0.5 * turn
    chord = v_mps * dt_s * float(np.sinc(half / np.pi))
    return np.array([chord * np.cos(half), chord * np.sin(half), turn])


class Base:
    """Counts what the wheels say, as the base's telegrams carry it, and answers as the daemon's WheelTrack does."""

    def __init__(self, rng: np.random.Generator) -> None:
        self._rng = rng
        self._noise = WheelNoise()
        self._odom = np.zeros(3)
        self._heading = 0.0
        self.track = WheelTrack(samples=_SAMPLES)

    def turned(self, said: Array, stamp_ns: int) -> None:
        """The wheels say a displacement (3,), up to stamp_ns of the host's clock."""
        n, length = self._noise, float(np.hypot(said[0], said[1]))
        xy = np.sqrt(n.slip_m2_per_m * length)
        theta = np.sqrt(n.turn_rad2_per_m * length + n.turn_rad2_per_rad * abs(float(said[2])))
        said = said + np.array([xy, xy, theta]) * self._rng.standard_normal(3)
        self._odom = se2.compose(self._odom, said)
        self._heading += float(said[2])
        x, y, heading = (
            wrap_int32(round(value / unit))
            for value, unit in (
                (self._odom[0], LENGTH_UNIT_M),
                (self._odom[1], LENGTH_UNIT_M),
                (self._heading, ANGLE_UNIT_RAD),
            )
        )
        self.track.add(BaseStatus(True, False, False, False, x, y, heading, stamp_ns // 1_000_000), stamp_ns)

    def between(self, stamp0_ns: int | None, stamp1_ns: int) -> WheelMotion | None:
        return None if stamp0_ns is None else self.track.between(stamp0_ns, stamp1_ns)


_SAMPLES = 128
"""Kept by the base's history; chosen: 4 s at 30 Hz, half of WheelTrack's own, which costs time."""
