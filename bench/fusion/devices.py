"""Wheels and gyro of a robot, and the base's telegrams that bring what they count."""

from __future__ import annotations

import copy
import threading
from dataclasses import replace
from typing import Any

import numpy as np

from ceilvo import se2
from ceilvo.bench.fusion.robot import TICK_S, Moment
from ceilvo.bench.fusion.said import Said
from ceilvo.bench.place.ceiling.worlds import World
from ceilvo.config import Config
from ceilvo.drivers.base.protocol import ANGLE_UNIT_RAD, GYRO_UNIT_RAD, LENGTH_UNIT_M, wrap_int32
from ceilvo.drivers.base.wheel_track import WheelTrack
from ceilvo.drivers.telegrams import WITH_MOTION, BaseStatus
from ceilvo.senses.beacons import Beacons
from ceilvo.types import Array

_TICKS = 5
"""Between telegrams: 20 Hz, base.rate_hz as it is by default."""
_SAMPLES = 128
"""Kept of them: 6 s."""
TRACK_M = 0.4
"""Between the wheels; chosen: a small warehouse robot."""
_SCALE_SIGMA = 0.02
"""Of each wheel's scale and of the track, as they really are, around what the base reckons with: the issue's 2 %."""
_AHEAD_M2PM, _TURN_RAD2PM, _TURN_RAD2PRAD = 1e-5, 4e-6, 2e-5
"""White noise of the wheels by way and turn: 3 mm and .11 deg after a metre, .26 deg after a radian; chosen: a good
drive on a hard floor."""
_GYRO_RADPS, _GYRO_WALK, _GYRO_BIAS, _GYRO_SCALE = np.radians(0.01), np.radians(0.002), np.radians(0.5), 0.003
"""White noise in 1 Hz, drift of the bias in a second, bias and scale, one standard deviation each: an ordinary chip of
a robot, temperature-compensated; chosen."""


class _Track(WheelTrack):
    """Can be copied, with a lock of its own, for drives that share their start."""

    def __deepcopy__(self, memo: dict[int, Any]) -> _Track:
        out = copy.copy(self)
        for name, value in vars(self).items():
            setattr(out, name, copy.deepcopy(value, memo) if name != "_lock" else threading.Lock())
        return out


class WheelsDevice:
    """Differential drive: two wheels of unknown scales, reckoned with as the base was built."""

    beacons = Beacons()

    def __init__(self, rng: np.random.Generator) -> None:
        self._rng, self.track = rng, _Track(samples=_SAMPLES, seamless=True)
        self.scales, track = 1.0 + _SCALE_SIGMA * rng.standard_normal(2), 1.0 + _SCALE_SIGMA * rng.standard_normal()
        self.track_m = TRACK_M * track
        self._odom, self._heading = np.zeros(3), 0.0
        self._ticks = 0

    def live(self, moment: Moment) -> None:
        said = np.zeros(3) if moment.lifted else self._counted(moment)
        self._odom, self._heading = se2.compose(self._odom, said), self._heading + float(said[2])
        self._ticks += 1
        if self._ticks % _TICKS == 0:
            units = ((self._odom[0], LENGTH_UNIT_M), (self._odom[1], LENGTH_UNIT_M), (self._heading, ANGLE_UNIT_RAD))
            x, y, heading = (wrap_int32(round(value / unit)) for value, unit in units)
            self.track.add(BaseStatus(True, False, False, False, x, y, heading, moment.ns // 1_000_000), moment.ns)

    def tell(self, before_ns: int, stamp_ns: int, said: Said) -> None:
        said.wheels = self.track.between(before_ns, stamp_ns)

    def _counted(self, moment: Moment) -> Array:
        """What the base makes of a step: each wheel's way over its scale, and the track that it was built with."""
        ahead, _, turned = se2.mean_twist(moment.moved, 1.0).tolist()
        way, turn = abs(ahead), abs(turned)
        noise = self._rng.standard_normal(2)
        ahead += float(noise[0]) * np.sqrt(_AHEAD_M2PM * way)
        turned += float(noise[1]) * np.sqrt(_TURN_RAD2PM * way + _TURN_RAD2PRAD * turn)
        sides = np.array([ahead - 0.5 * self.track_m * turned, ahead + 0.5 * self.track_m * turned])
        left, right = (sides / self.scales * (1.0 + moment.slip)).tolist()
        twist = np.array([0.5 * (left + right), 0.0, (right - left) / TRACK_M])
        return np.asarray(se2.driven(twist, np.ones(1))[0])


class GyroDevice:
    """Its integral comes with the base's telegrams, as its wheels' counts do."""

    beacons = Beacons()

    def __init__(self, rng: np.random.Generator, config: Config) -> None:
        self._rng, self._track = rng, _Track(samples=_SAMPLES, seamless=True)
        self._noise = float(np.radians(config.senses.gyro_noise_dps)) ** 2
        self.bias, self.scale = _GYRO_BIAS * rng.standard_normal(), 1.0 + _GYRO_SCALE * rng.standard_normal()
        self._angle, self._ticks = 0.0, 0

    def live(self, moment: Moment) -> None:
        white, walk = self._rng.standard_normal(2).tolist()
        self.bias += _GYRO_WALK * np.sqrt(TICK_S) * walk
        self._angle += self.scale * float(moment.moved[2]) + self.bias * TICK_S + _GYRO_RADPS * np.sqrt(TICK_S) * white
        self._ticks += 1
        if self._ticks % _TICKS == 0:
            count = round(self._angle / GYRO_UNIT_RAD)
            clock_ms = moment.ns // 1_000_000
            status = BaseStatus(True, False, False, False, 0, 0, 0, clock_ms, WITH_MOTION, wrap_int32(count))
            self._track.add(status, moment.ns)

    def tell(self, before_ns: int, stamp_ns: int, said: Said) -> None:
        turn = self._track.turn_between(before_ns, stamp_ns, self._noise)
        said.heard = replace(said.heard, turn=turn)


class WheelsSense:
    """Of the table of senses."""

    def configured(self, config: Config, world: World) -> Config:
        return replace(config, senses=replace(config.senses, time=True, wheels=True, track_m=TRACK_M))

    def device(self, world: World, config: Config, rng: np.random.Generator) -> WheelsDevice:
        return WheelsDevice(rng)


class GyroSense:
    """Of the table of senses."""

    def configured(self, config: Config, world: World) -> Config:
        return replace(config, senses=replace(config.senses, time=True, gyro="base"))

    def device(self, world: World, config: Config, rng: np.random.Generator) -> GyroDevice:
        return GyroDevice(rng, config)
