"""A robot that drives, turns, creeps and stands under an endless ceiling of tiles: what its eye and its wheels say.

Crossings are drawn, not rendered: every line of the ceiling has its own error in every picture, as large as in rendered
pictures (0.07 mm, docs/faults.md). So an hour takes minutes, at any speed of the robot.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from ceilvo import se2
from ceilvo.calibration import Calibration
from ceilvo.crossing_types import quarter_turns, turned_type
from ceilvo.drivers.base.wheel_track import WheelNoise
from ceilvo.types import Array, Crossings, Displacement, Ints, Pose, WheelMotion

TILE_M = 0.6
_VIEW_M = (1.6, 1.2)
"""Half of the picture on the ceiling, along and across; as the simulated camera's."""
_LINE_SIGMA_M, _SAID_SIGMA_M, _COMMON_SIGMA_M = 7e-5, 2.8e-4, 4e-5
"""Error of a line in a picture, the error that vision says its crossings have, and the part that all share; measured on
40 rendered pictures of a standing robot."""
_PSI_SIGMA_RAD = 3e-6
_SUBSTEPS = 8
"""Of the motion within a frame period."""
_LAMP_EVERY = 5
"""One tile in so many, by a hash, has a lamp, whose corners are crossings of other types."""


@dataclass(frozen=True)
class DriveSpec:
    """How a robot drives and errs.

    Attributes:
        rate_hz: of the camera.
        speeds_mps: of its legs, from a creep to the fastest.
        stand_share: of the legs, those on which it stands.
        accel_mps2, turn_accel_radps2: at most.
        shake_m: standard deviation of a vibration, at rest as well.
        wheel_scale, wheel_turn_scale: travelled over true way and turn.
        slips_per_m: how often a slip begins. It lasts up to a second, loses or adds up to slip_share of the way and
            turns by up to slip_radps.
    """

    rate_hz: float = 30.0
    speeds_mps: tuple[float, float] = (0.02, 0.8)
    stand_share: float = 0.3
    accel_mps2: float = 1.0
    turn_accel_radps2: float = 3.0
    shake_m: float = 0.0
    wheel_scale: float = 1.01
    wheel_turn_scale: float = 0.99
    slips_per_m: float = 0.05
    slip_share: float = 0.8
    slip_radps: float = 0.3


@dataclass(frozen=True)
class Path:
    """Pose at the start of every frame (N + 1, 3), heading wrapped, and what wheels count: (N + 1, 3) in odom."""

    time_s: Array
    truth: Array
    wheels: Array
    spec: DriveSpec

    def truth_at(self, time_s: float) -> Pose:
        return _at(self.time_s, self.truth, time_s)

    def wheels_at(self, time_s: float) -> Pose:
        return _at(self.time_s, self.wheels, time_s)


def _at(times: Array, poses: Array, time_s: float) -> Pose:
    """Between two rows, along the shorter way round."""
    k = min(max(int(np.searchsorted(times, time_s)) - 1, 0), len(times) - 2)
    share = float(np.clip((time_s - times[k]) / (times[k + 1] - times[k]), 0.0, 1.0))
    step = se2.between(poses[k], poses[k + 1])
    return Pose(se2.compose(poses[k], share * step))


def drive(spec: DriveSpec, seconds: float, rng: np.random.Generator) -> Path:
    """Legs of random speed and curvature, with pauses and turns on the spot."""
    n, dt = round(seconds * spec.rate_hz * _SUBSTEPS), 1.0 / (spec.rate_hz * _SUBSTEPS)
    speed, turn = _twists(spec, n, dt, rng)
    truth = _integrated(speed, turn, dt)
    share, yaw = _slips(spec, speed, dt, rng)
    noise, way, turned = WheelNoise(), np.abs(speed) * dt, np.abs(turn) * dt
    var_theta = noise.turn_rad2_per_m * way + noise.turn_rad2_per_rad * turned
    told_x = spec.wheel_scale * (1.0 + share) * speed * dt
    told_x = told_x + rng.standard_normal(n) * np.sqrt(noise.slip_m2_per_m * way)
    told_y = rng.standard_normal(n) * np.sqrt(noise.slip_m2_per_m * way)
    told_turn = (spec.wheel_turn_scale * turn + yaw) * dt + rng.standard_normal(n) * np.sqrt(var_theta)
    wheels = _summed(told_x, told_y, told_turn)
    every = slice(None, None, _SUBSTEPS)
    return Path(np.asarray(np.arange(n + 1)[every] * dt, np.float64), truth[every], wheels[every], spec)


def _twists(spec: DriveSpec, n: int, dt: float, rng: np.random.Generator) -> tuple[Array, Array]:
    """(n,) speed and turn rate of the legs, with limited accelerations."""
    low, high = np.log(spec.speeds_mps)
    want, turn = np.zeros(n), np.zeros(n)
    k = round(1.0 / dt)
    while k < n:
        last = k + round(rng.uniform(1.0, 8.0) / dt)
        kind = rng.random()
        if kind > spec.stand_share:
            want[k:last] = np.exp(rng.uniform(low, high)) if kind > spec.stand_share + 0.1 else 0.0
            on_spot = kind <= spec.stand_share + 0.1
            curvature = rng.choice([0.0, rng.uniform(-2.0, 2.0)])
            turn[k:last] = rng.uniform(-1.0, 1.0) if on_spot else np.clip(curvature * want[k:last], -1.2, 1.2)
        k = last
    return _limited(want, spec.accel_mps2 * dt), _limited(turn, spec.turn_accel_radps2 * dt)


def _limited(want: Array, most: float) -> Array:
    """The same, changing by at most so much a step."""
    out, at = np.empty(len(want)), 0.0
    for k, target in enumerate(want.tolist()):
        at += min(max(target - at, -most), most)
        out[k] = at
    return out


def _slips(spec: DriveSpec, speed: Array, dt: float, rng: np.random.Generator) -> tuple[Array, Array]:
    """(n,) share of the way that wheels count too much, and turn rate rad/s that they add."""
    share, yaw = np.zeros(len(speed)), np.zeros(len(speed))
    begins = np.flatnonzero(rng.random(len(speed)) < spec.slips_per_m * np.abs(speed) * dt)
    for k in begins.tolist():
        last = k + round(rng.uniform(0.1, 1.0) / dt)
        share[k:last] = rng.uniform(-0.3, 1.0) * spec.slip_share
        yaw[k:last] = rng.uniform(-1.0, 1.0) * spec.slip_radps
    return share, yaw * (np.abs(speed) > 0.0)


def _integrated(speed: Array, turn: Array, dt: float) -> Array:
    return _summed(speed * dt, np.zeros(len(speed)), turn * dt)


def _summed(x: Array, y: Array, turn: Array) -> Array:
    """(n + 1, 3) path of small steps in base, each half turned."""
    theta = np.concatenate([[0.0], np.cumsum(turn)])
    middle = 0.5 * (theta[:-1] + theta[1:])
    c, s = np.cos(middle), np.sin(middle)
    steps = np.column_stack([c * x - s * y, s * x + c * y])
    xy = np.concatenate([np.zeros((1, 2)), np.cumsum(steps, axis=0)])
    return np.column_stack([xy, se2.wrap_array(theta)])


class Eye:
    """Crossings that a camera sees from a pose; noise is new in every picture."""

    def __init__(self, calibration: Calibration, rng: np.random.Generator) -> None:
        self._rng = rng
        self._pixel_from_ceiling = np.linalg.inv(calibration.ceiling_from_level)
        self._mount_xy_m = calibration.mount_xy_m

    def see(self, pose: Array, yaw_rad: float = 0.0, noise: float = 1.0) -> Crossings:
        """From map_from_base (3,), with a camera that was bumped by yaw_rad, and so many times the noise."""
        reach = int(np.hypot(*_VIEW_M) / TILE_M) + 2
        middle = np.rint(pose[:2] / TILE_M).astype(np.int64)
        index = np.arange(-reach, reach + 1)
        lines = [
            (middle[a] + index) * TILE_M + noise * _LINE_SIGMA_M * self._rng.standard_normal(len(index)) for a in (0, 1)
        ]
        xy_map = np.stack(np.meshgrid(*lines, indexing="ij"), axis=-1).reshape(-1, 2)
        cell = np.stack(np.meshgrid(middle[0] + index, middle[1] + index, indexing="ij"), axis=-1).reshape(-1, 2)
        shared = noise * _COMMON_SIGMA_M * self._rng.standard_normal(2)
        xy = se2.transform(se2.inverse(pose), xy_map) + shared
        seen = (np.abs(xy[:, 0]) < _VIEW_M[0]) & (np.abs(xy[:, 1]) < _VIEW_M[1])
        xy, kinds = xy[seen], _kinds(cell[seen])
        psi = float(se2.wrap(-pose[2] * 1.0 + noise * _PSI_SIGMA_RAD * self._rng.standard_normal()))
        xy = (xy - self._mount_xy_m) @ se2.rotation(-yaw_rad).T + self._mount_xy_m
        return self._crossings(xy, kinds, psi - yaw_rad)

    def _crossings(self, xy: Array, kinds: Ints, direction_rad: float) -> Crossings:
        psi = direction_rad - float(np.rint(direction_rad / (0.5 * np.pi))) * 0.5 * np.pi
        kinds = turned_type(kinds, quarter_turns(direction_rad, psi))
        px = np.column_stack([xy, np.ones(len(xy))]) @ self._pixel_from_ceiling.T
        common = np.eye(2) * _COMMON_SIGMA_M**2
        cov = np.tile(np.eye(2) * _SAID_SIGMA_M**2 + common, (len(xy), 1, 1))
        return Crossings(
            px[:, :2] / px[:, 2:], xy, cov, kinds, psi, _PSI_SIGMA_RAD * 8, np.zeros(2), np.full(2, 1e-3), common
        )


def _kinds(cell: Ints) -> Ints:
    """4 is groove on groove; 0 one corner of a lamp."""
    hashed = (cell[:, 0] * 73856093) ^ (cell[:, 1] * 19349663)
    return np.where(hashed % _LAMP_EVERY == 0, 0, 4)


def wheel_motion(path: Path, from_s: float, to_s: float) -> WheelMotion:
    """What a base reports between two moments, with the covariance that WheelTrack gives it."""
    n, step = WheelNoise(), se2.between(path.wheels_at(from_s), path.wheels_at(to_s))
    length, turned, per_s = float(np.hypot(step[0], step[1])), abs(float(step[2])), n.stamp_sigma_s / (to_s - from_s)
    var_xy = n.slip_m2_per_m * length + 2.0 * (per_s * length) ** 2 + 1e-9
    var_turn = n.turn_rad2_per_m * length + n.turn_rad2_per_rad * turned + 2.0 * (per_s * turned) ** 2 + 1e-11
    return WheelMotion(Displacement(step), np.diag([var_xy, var_xy, var_turn]))


def reversed_wheels(path: Path, which: str) -> Path:
    """The path of a base whose register x, y or theta has the wrong sign, or whose wheels are swapped."""
    w = path.wheels.copy()
    if which == "swapped":
        steps = se2.between(w[:-1], w[1:]) * np.array([1.0, -1.0, -1.0])
        w = _summed(steps[:, 0], steps[:, 1], steps[:, 2])
    else:
        w[:, ("x", "y", "theta").index(which)] *= -1.0
    return replace(path, wheels=w)
