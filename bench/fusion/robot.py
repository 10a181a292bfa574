"""A robot that drives about a room, step by step, with what a condition does to it."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from ceilvo import se2
from ceilvo.bench.fusion.conditions import BEGIN_S, BLUR_RADPS, CARRY_S, Condition
from ceilvo.bench.place.robot.driver import Driver, arc
from ceilvo.sim.ceiling.panels import Rect
from ceilvo.types import Array

TICK_S = 0.01
"""Of the simulation; chosen: a fifth of a telegram's period."""
SPEED_MPS = 0.5
"""It cruises with."""
_SPIN_ACCEL_RADPS2 = 10.0
"""Into and out of a fast turn; chosen: 3 rad/s after .3 s."""
_CARRY_TURN_RAD = 2.0
"""By which a carried robot is turned at most; chosen."""
_WOBBLE_RAD, _WOBBLE_HZ = 0.1, 0.8
"""And by which it sways in a person's hands; chosen: 6 deg with every second step."""


@dataclass(frozen=True)
class Moment:
    """One step of the simulation.

    Attributes:
        time_s: its end, from the start of the drive; ns: the same, CLOCK_MONOTONIC.
        pose: (3,) map_from_base then; moved: (3,) since the moment before, in base.
        lifted: the wheels do not touch the floor, and stand.
        slip: share by which the wheels turn more than the robot moves.
        dark: pictures show nothing at all; bare: no lines or lamps, but other marks.
    """

    time_s: float
    ns: int
    pose: Array
    moved: Array
    lifted: bool = False
    slip: float = 0.0
    dark: bool = False
    bare: bool = False


class Ride:
    """Iterate to go on; the robot cruises from goal to goal and rests now and then, until its condition begins.

    Attributes:
        condition: may be another one until it begins: what is before does not depend on it.
    """

    def __init__(self, room: Rect, map_from_room: Array, condition: Condition, rng: np.random.Generator) -> None:
        self.condition, self._map_from_room, self._rng = condition, map_from_room, rng
        self._driver = Driver(room, False, SPEED_MPS, rng)
        self._room_pose = self._driver.start()
        self._way_m = 0.0
        self._turn_radps = 0.0
        self._carry_turn_rad = float(rng.uniform(-1.0, 1.0)) * _CARRY_TURN_RAD
        self._ticks = 0

    @property
    def begins(self) -> bool:
        """Whether the condition begins with the next moment, or has begun."""
        return self._ticks >= round(BEGIN_S / TICK_S)

    def __iter__(self) -> Iterator[Moment]:
        while self._ticks < round(BEGIN_S / TICK_S) + round(self.condition.seconds / TICK_S):
            yield self._next()

    def _next(self) -> Moment:
        c, k = self.condition, self._ticks
        if k == round(BEGIN_S / TICK_S):
            self._way_m = 0.0
            self._head_on()
        self._ticks += 1
        since_s = k * TICK_S - BEGIN_S
        lifted = c.carried_m > 0.0 and 0.0 <= since_s < CARRY_S
        moved = self._carried(since_s) if lifted else self._driven(since_s)
        self._room_pose = np.asarray(se2.compose(self._room_pose, moved))
        self._way_m += float(np.hypot(moved[0], moved[1]))
        on = since_s >= 0.0
        return Moment(
            time_s=(k + 1) * TICK_S,
            ns=10**9 + round(1e9 * TICK_S * (k + 1)),
            pose=np.asarray(se2.compose(self._map_from_room, self._room_pose)),
            moved=moved,
            lifted=lifted,
            slip=c.slip_share if on and self._way_m <= c.slip_m else 0.0,
            dark=lifted or (on and since_s < c.dark_s) or abs(float(moved[2])) > BLUR_RADPS * TICK_S,
            bare=on and self._way_m <= c.bare_m,
        )

    def _head_on(self) -> None:
        """No rest in what follows, and a goal far enough off: what happens needs a stretch of way."""
        d, at = self._driver, self._room_pose[:2]
        corners = np.array([[x, y] for x in (d.low[0], d.high[0]) for y in (d.low[1], d.high[1])])
        d.head_for(corners[int(np.argmax(np.hypot(*(corners - at).T)))])

    def _driven(self, since_s: float) -> Array:
        c = self.condition
        spins_s = 2.0 * np.pi * c.spins / c.spin_radps if c.spins else 0.0
        if since_s >= 0.0 and self._turn_radps >= 0.0 and (since_s < spins_s or self._turn_radps > 0.0):
            want = c.spin_radps if since_s < spins_s else 0.0
            step = _SPIN_ACCEL_RADPS2 * TICK_S
            self._turn_radps += float(np.clip(want - self._turn_radps, -step, step))
            self._driver.stop()
            return arc(0.0, self._turn_radps, TICK_S)
        return arc(*self._driver.twist(self._room_pose, TICK_S), TICK_S)

    def _carried(self, since_s: float) -> Array:
        self._driver.stop()
        inside = self._driver.low, self._driver.high
        sway = 2.0 * np.pi * _WOBBLE_HZ * _WOBBLE_RAD * np.cos(2.0 * np.pi * _WOBBLE_HZ * since_s)
        carry = np.array([self.condition.carried_m, 0.0, self._carry_turn_rad]) / CARRY_S
        moved = np.asarray(se2.driven(carry + np.array([0.0, 0.0, sway]), np.array([TICK_S]))[0])
        there = se2.compose(self._room_pose, moved)
        if np.all(there[:2] > inside[0]) and np.all(there[:2] < inside[1]):
            return moved
        return np.array([0.0, 0.0, moved[2]])
