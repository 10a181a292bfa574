"""How the simulated robot moves: laps with eased corners, wheels that err and slip, a body that rocks.

Everything is a deterministic function of time, so any number of threads may ask about any time in any order.
"""

from __future__ import annotations

import threading
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ceilvo import se2
from ceilvo.errors import ConfigError

Array = NDArray[np.float64]

_CORNER_STEP_M = 0.00025
"""Of the table of a corner's arc; poses between are interpolated."""


@dataclass(frozen=True)
class LapSpec:
    """Laps along the walls of a square room, counter-clockwise.

    Attributes:
        room_m: side of the room.
        inset_m: distance of the straights from the walls.
        corner_radius_m: tightest radius in a corner; curvature rises and falls smoothly to it.
        speed_mps: cruising speed.
        rest_s: standing still at the start.
        ramp_s: time from rest to cruising speed.
    """

    room_m: float = 5.0
    inset_m: float = 1.0
    corner_radius_m: float = 0.4
    speed_mps: float = 0.35
    rest_s: float = 0.5
    ramp_s: float = 1.5

    def __post_init__(self) -> None:
        for name in ("room_m", "corner_radius_m", "speed_mps", "ramp_s"):
            if not getattr(self, name) > 0:
                raise ConfigError(f"lap: {name} is {getattr(self, name)}, expected more than 0")
        if self.inset_m < 0 or self.rest_s < 0:
            raise ConfigError(f"lap: inset_m {self.inset_m} and rest_s {self.rest_s} must not be negative")


class LapPath:
    """The robot's true path, map_from_base against time. Speed, curvature and acceleration are continuous."""

    def __init__(self, spec: LapSpec | None = None) -> None:
        self.spec = spec or LapSpec()
        r = self.spec.corner_radius_m
        self._ease_m = r  # curvature rises over this length and falls over the same
        self._arc_m = (0.5 * np.pi - 1.0) * r  # so that the corner turns by pi/2
        self._corner_m = self._arc_m + 2.0 * self._ease_m
        n = int(np.ceil(self._corner_m / _CORNER_STEP_M))
        self._s = np.linspace(0.0, self._corner_m, n + 1)
        middle = self._heading(0.5 * (self._s[:-1] + self._s[1:]))
        h = self._corner_m / n
        self._x = np.concatenate([[0.0], np.cumsum(np.cos(middle)) * h])
        self._y = np.concatenate([[0.0], np.cumsum(np.sin(middle)) * h])
        reach = float(self._x[-1])
        self._straight_m = self.spec.room_m - 2.0 * self.spec.inset_m - 2.0 * reach
        if self._straight_m < 0:
            raise ConfigError(
                f"lap: corner_radius_m {r} does not fit a room of {self.spec.room_m} m with inset_m "
                f"{self.spec.inset_m}; expected at most {r * (1 + self._straight_m / (2 * reach)):.3f}"
            )
        self._start = np.array([self.spec.inset_m + reach, self.spec.inset_m])

    @property
    def lap_m(self) -> float:
        """Length of one lap."""
        return 4.0 * (self._straight_m + self._corner_m)

    def travel_at(self, t_s: ArrayLike) -> Array:
        """Metres driven, same shape as t_s."""
        tau, p = self._ramp(t_s)
        v, ramp = self.spec.speed_mps, self.spec.ramp_s
        eased = ramp * (0.5 * p * p + (np.cos(2 * np.pi * p) - 1.0) / (4 * np.pi**2))
        return np.asarray(v * np.where(tau < ramp, eased, tau - 0.5 * ramp))

    def speed_at(self, t_s: ArrayLike) -> Array:
        """m/s, same shape as t_s."""
        _, p = self._ramp(t_s)
        return np.asarray(self.spec.speed_mps * (p - np.sin(2 * np.pi * p) / (2 * np.pi)))

    def pose_at(self, t_s: ArrayLike) -> Array:
        """map_from_base, (..., 3) for t_s of shape (...)."""
        side, along, over = self._locate(t_s)
        c = np.clip(over, 0.0, None)
        local = np.stack([along + np.interp(c, self._s, self._x), np.interp(c, self._s, self._y)], axis=-1)
        local += self._start - 0.5 * self.spec.room_m
        cos, sin = _quarter(side)
        x = cos * local[..., 0] - sin * local[..., 1] + 0.5 * self.spec.room_m
        y = sin * local[..., 0] + cos * local[..., 1] + 0.5 * self.spec.room_m
        return np.stack([x, y, se2.wrap_array(0.5 * np.pi * side + self._heading(c))], axis=-1)

    def turned_at(self, t_s: ArrayLike) -> Array:
        """Heading since the start, not wrapped, (...) for t_s of shape (...)."""
        side, _, over = self._locate(t_s)
        return np.asarray(0.5 * np.pi * side + self._heading(np.clip(over, 0.0, None)))

    def twist_at(self, t_s: ArrayLike) -> Array:
        """Velocity in base [m/s, m/s, rad/s], (..., 3) for t_s of shape (...)."""
        v = self.speed_at(t_s)
        return np.stack([v, np.zeros_like(v), v * self._curvature(t_s)], axis=-1)

    def acceleration_at(self, t_s: ArrayLike) -> Array:
        """Acceleration in base [m/s^2, m/s^2], forward and left, (..., 2) for t_s of shape (...)."""
        _, p = self._ramp(t_s)
        v = self.speed_at(t_s)
        forward = self.spec.speed_mps / self.spec.ramp_s * (1.0 - np.cos(2 * np.pi * p))
        return np.stack([forward, v * v * self._curvature(t_s)], axis=-1)

    def _ramp(self, t_s: ArrayLike) -> tuple[Array, Array]:
        """Time since driving began and the ramp's progress in 0..1."""
        tau = np.clip(np.asarray(t_s, np.float64) - self.spec.rest_s, 0.0, None)
        return tau, np.clip(tau / self.spec.ramp_s, 0.0, 1.0)

    def _locate(self, t_s: ArrayLike) -> tuple[Array, Array, Array]:
        """Quarter of the lap, metres along its straight, metres into its corner (negative on the straight)."""
        side, rest = np.divmod(self.travel_at(t_s), self._straight_m + self._corner_m)
        return side, np.minimum(rest, self._straight_m), rest - self._straight_m

    def _curvature(self, t_s: ArrayLike) -> Array:
        _, _, over = self._locate(t_s)
        inside = np.minimum(over, self._corner_m - over)
        p = np.clip(inside / self._ease_m, 0.0, 1.0)
        return np.asarray(0.5 * (1.0 - np.cos(np.pi * p)) / self.spec.corner_radius_m)

    def _heading(self, s: Array) -> Array:
        """Turned since the corner began: the integral of the curvature."""

        def eased(d: Array) -> Array:
            return 0.5 * (d - self._ease_m / np.pi * np.sin(np.pi * d / self._ease_m))

        up = np.clip(s, 0.0, self._ease_m)
        flat = np.clip(s - self._ease_m, 0.0, self._arc_m)
        down = np.clip(self._corner_m - s, 0.0, self._ease_m)
        return np.asarray((eased(up) + flat + eased(np.full_like(down, self._ease_m)) - eased(down)) / self._ease_m)


def _quarter(side: Array) -> tuple[Array, Array]:
    """Exact cosine and sine of side * 90 deg."""
    k = np.asarray(side).astype(np.int64) % 4
    return np.array([1.0, 0.0, -1.0, 0.0])[k], np.array([0.0, 1.0, 0.0, -1.0])[k]


@dataclass(frozen=True)
class WheelSpec:
    """Errors of the wheel odometry.

    Attributes:
        scale: travelled over true distance.
        drift_radpm: heading error per metre.
        slips_per_min: mean rate of slip episodes (each 0.2-0.6 s).
        slip_speed: during one, forward speed is over-counted by up to this fraction.
        slip_turn_radps: and the turn rate is off by up to this much.
    """

    scale: float = 1.008
    drift_radpm: float = 0.004
    slips_per_min: float = 2.0
    slip_speed: float = 0.4
    slip_turn_radps: float = 0.08


class WheelOdometry:
    """Cumulative wheel odometry of a robot on a path, in its own odom frame that starts at the identity."""

    STEP_S = 0.005
    """Of the integration; chosen: at 0.35 m/s a step is 2 mm."""
    CHUNK_S = 60.0
    """Integrated at once and kept, so that any moment can be asked for."""
    _KEPT = 3
    _SLIP_S = (0.2, 0.6)
    """Of a slip; chosen."""
    """Chunks in memory."""

    def __init__(self, path: LapPath, spec: WheelSpec | None = None, seed: int = 1) -> None:
        self._path, self._spec, self._seed = path, spec or WheelSpec(), seed
        self._lock = threading.Lock()
        self._starts: list[Array] = [np.zeros(3)]
        self._recent: dict[int, Array] = {}

    def at(self, t_s: float) -> Array:
        """(3,) odom_from_base [m, m, rad], theta in [-pi, pi); the identity before time 0."""
        k, offset_s = divmod(max(float(t_s), 0.0), self.CHUNK_S)
        chunk = self._chunk(int(k))
        j, fraction = divmod(offset_s / self.STEP_S, 1.0)
        j = min(int(j), len(chunk) - 2)
        pose = chunk[j] + fraction * (chunk[j + 1] - chunk[j])
        pose[2] = se2.wrap(pose[2])
        return np.asarray(pose)

    def _chunk(self, k: int) -> Array:
        """(n + 1, 3) samples of one chunk, theta not wrapped; the first is the last of the chunk before."""
        with self._lock:
            while len(self._starts) <= k:
                self._starts.append(self._kept(len(self._starts) - 1)[-1].copy())
            return self._kept(k)

    def _kept(self, k: int) -> Array:
        """A chunk whose start is known, integrated once while it is among the recent."""
        if k not in self._recent:
            if len(self._recent) == self._KEPT:
                del self._recent[min(self._recent)]
            self._recent[k] = self._integrate(k, self._starts[k])
        return self._recent[k]

    def _integrate(self, k: int, start: Array) -> Array:
        n = round(self.CHUNK_S / self.STEP_S)
        t = k * self.CHUNK_S + (np.arange(n) + 0.5) * self.STEP_S
        twist = self._path.twist_at(t)
        slip_v, slip_w = self._slips(k, n)
        v = twist[:, 0] * self._spec.scale * (1.0 + slip_v)
        moving = np.minimum(np.abs(twist[:, 0]) / self._path.spec.speed_mps, 1.0)
        w = twist[:, 2] + self._spec.drift_radpm * np.abs(twist[:, 0]) + slip_w * moving
        theta = start[2] + np.concatenate([[0.0], np.cumsum(w) * self.STEP_S])
        middle = 0.5 * (theta[:-1] + theta[1:])
        x = start[0] + np.concatenate([[0.0], np.cumsum(v * np.cos(middle)) * self.STEP_S])
        y = start[1] + np.concatenate([[0.0], np.cumsum(v * np.sin(middle)) * self.STEP_S])
        return np.column_stack([x, y, theta])

    def _slips(self, k: int, n: int) -> tuple[Array, Array]:
        """Relative speed error and turn-rate error of each step."""
        rng = np.random.default_rng([self._seed, k])
        v, w = np.zeros(n), np.zeros(n)
        for _ in range(rng.poisson(self._spec.slips_per_min * self.CHUNK_S / 60.0)):
            first = int(rng.integers(0, n))
            last = first + int(rng.uniform(*self._SLIP_S) / self.STEP_S)
            v[first:last] = rng.uniform(0.0, self._spec.slip_speed)
            w[first:last] = rng.uniform(-1.0, 1.0) * self._spec.slip_turn_radps
        return v, w


@dataclass(frozen=True)
class TiltSpec:
    """Rocking of the body while it drives: |roll| and |pitch| stay within the amplitude at any time.

    Attributes:
        at_rest: it rocks while it stands, too, as one that somebody leans on.
    """

    amplitude_rad: float = 0.0
    at_rest: bool = False


class TiltProfile:
    """Roll and pitch of the robot's body: sway, drive-train vibration, and squatting when it accelerates."""

    SWAY, VIBRATION, SQUAT = 0.6, 0.2, 0.2  # shares of the amplitude
    SQUAT_FULL_MPS2 = 0.5
    SWAY_HZ = ((0.31, 0.73), (0.27, 0.61))  # roll, pitch
    VIBRATION_HZ = ((7.3, 12.7), (8.9, 14.3))

    def __init__(self, path: LapPath, spec: TiltSpec | None = None, seed: int = 1) -> None:
        self._path, self._spec = path, spec or TiltSpec()
        self._phase = np.random.default_rng([seed, 0x7117]).uniform(0.0, 2.0 * np.pi, (2, 4))

    def at(self, t_s: ArrayLike) -> Array:
        """Rotation of the body about base x and y [rad], (..., 2) for t_s of shape (...); nose up is negative y."""
        t = np.asarray(t_s, np.float64)
        if self._spec.amplitude_rad == 0.0:
            return np.zeros((*t.shape, 2))
        moving = 1.0 if self._spec.at_rest else self._path.speed_at(t) / self._path.spec.speed_mps
        squat = np.clip(self._path.acceleration_at(t) / self.SQUAT_FULL_MPS2, -1.0, 1.0)
        push = (squat[..., 1], -squat[..., 0])  # outwards in a bend, nose up when speeding up
        axes = [self._waves(t, i) * moving + self.SQUAT * push[i] for i in (0, 1)]
        return np.asarray(self._spec.amplitude_rad * np.stack(axes, axis=-1))

    def _waves(self, t: Array, axis: int) -> Array:
        hz = (*self.SWAY_HZ[axis], *self.VIBRATION_HZ[axis])
        shares = (0.5 * self.SWAY,) * 2 + (0.5 * self.VIBRATION,) * 2
        waves = [a * np.sin(2 * np.pi * f * t + p) for a, f, p in zip(shares, hz, self._phase[axis], strict=True)]
        return np.asarray(sum(waves))
