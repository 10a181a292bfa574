"""Recent wheel odometry of the base, asked for the displacement between two camera stamps."""

from __future__ import annotations

import math
import threading
from collections import deque
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ceilvo import se2
from ceilvo.drivers.base.protocol import ANGLE_UNIT_RAD, GAINED_UNIT_MPS, GYRO_UNIT_RAD, LENGTH_UNIT_M, wrap_int32
from ceilvo.drivers.telegrams import BaseStatus
from ceilvo.senses.heard import Turn
from ceilvo.types import Displacement, WheelMotion, frozen

Array = NDArray[np.float64]

_CLOCK_TOLERANCE_S = 0.5
"""Between the base's clock and the host's, beside _CLOCK_DRIFT (docs/base-protocol.md)."""
_CLOCK_DRIFT = 0.01
"""Of a cheap oscillator and a busy base: 1 %."""
_OFFSET_SAMPLES = 64
"""Answers whose smallest delay places the base's clock; chosen: some seconds, within which clocks do not drift."""
_SLACK_S = 0.01
"""Of the base's clock in whole milliseconds, and of the moment at which it counts; chosen."""
_ROUNDING = 6.0
"""Two counts, each rounded uniformly over one unit: the variance of their difference is the unit squared over this."""


@dataclass(frozen=True, slots=True)
class WheelNoise:
    """Variances of a displacement; they add along the path, so splitting an interval does not change its sum.

    var_xy = 2 quantum^2/12 + slip * path + 2 (stamp * speed)^2 + coasting
    var_theta = 2 quantum^2/12 + turn_by_path * path + turn_by_turn * turned + 2 (stamp * turn rate)^2 + coasting

    Coasting is the motion beyond the newest sample at constant speed: (accel * t^2 / 2)^2.
    """

    slip_m2_per_m: float = 1e-4
    turn_rad2_per_m: float = 1e-4
    turn_rad2_per_rad: float = 4e-4
    stamp_sigma_s: float = 0.002
    coast_accel_mps2: float = 1.0
    coast_turn_radps2: float = 2.0


class WheelTrack:
    """Bounded history of cumulative wheel odometry; safe to use from several threads.

    Samples are placed on the host's clock by the base's own clock plus the smallest delay seen lately, so a late
    answer does not shift them. A base that restarts (clock going back, or odometry jumping) starts a new history.
    """

    def __init__(
        self,
        noise: WheelNoise | None = None,
        *,
        samples: int = 256,
        max_gap_s: float = 0.5,
        coast_s: float = 0.1,
        max_speed_mps: float = 5.0,
        max_turn_radps: float = 10.0,
        seamless: bool = False,
    ) -> None:
        """Stamps inside a gap longer than max_gap_s, or later than the newest sample by coast_s, are not covered.

        Args:
            seamless: intervals that follow each other add up to the whole way: what was coasted at the end of one, and
                turned out otherwise, is made good in the next. Otherwise that is lost, and wheels seem late by some
                10 ms while the robot speeds up.
        """
        self._noise = noise or WheelNoise()
        self._max_gap_s = max_gap_s
        self._coast_s = coast_s
        self._max_speed_mps = max_speed_mps
        self._max_turn_radps = max_turn_radps
        self._seamless = seamless
        self._ends: dict[str, tuple[int, Array]] = {}
        self._lock = threading.Lock()
        self._samples: deque[tuple[int, int, int, int]] = deque(maxlen=samples)
        self._turned: deque[tuple[int, ...]] = deque(maxlen=samples)
        self._offsets_ns: deque[int] = deque(maxlen=_OFFSET_SAMPLES)
        self._last: tuple[BaseStatus, int] | None = None
        self._restarts = 0

    @property
    def restarts(self) -> int:
        """How often the history was begun anew because the base restarted or its odometry jumped."""
        return self._restarts

    def add(self, status: BaseStatus, stamp_ns: int) -> None:
        """A status that the base sampled at about stamp_ns of the host's clock; repeated ones are ignored."""
        with self._lock:
            if self._last is not None and not self._continues(status, stamp_ns):
                self._restarts += 1
                self._samples.clear()
                self._turned.clear()
                self._ends.clear()
                self._offsets_ns.clear()
                self._last = None
            self._append(status, stamp_ns)

    def between(self, stamp0_ns: int, stamp1_ns: int) -> WheelMotion | None:
        """Displacement prev_from_curr from stamp0 to stamp1, None when the history does not cover both."""
        return self._asked(stamp0_ns, stamp1_ns, self._seamless)

    def aside(self, stamp0_ns: int, stamp1_ns: int) -> WheelMotion | None:
        """The same for somebody else: it does not count as the interval before the next one."""
        return self._asked(stamp0_ns, stamp1_ns, False)

    def _asked(self, stamp0_ns: int, stamp1_ns: int, seamless: bool) -> WheelMotion | None:
        with self._lock:
            if len(self._samples) < 2 or stamp1_ns < stamp0_ns:
                return None
            samples = np.array(self._samples, dtype=np.int64)
            offset_ns = min(self._offsets_ns)
        times = self._times(samples[:, 0], offset_ns, stamp0_ns, stamp1_ns)
        if times is None:
            return None
        t, t0, t1 = times
        path = np.column_stack(
            (samples[:, 1:3] * LENGTH_UNIT_M, np.unwrap(samples[:, 3].astype(np.float64) * ANGLE_UNIT_RAD))
        )
        start, end = self._between(t, path, (t0, t1), (stamp0_ns, stamp1_ns), "wheels" * seamless)
        return self._motion(t, path, t0, t1, start, end)

    def turn_between(self, stamp0_ns: int, stamp1_ns: int, noise_rad2_ps: float) -> Turn | None:
        """What the base's gyro says from stamp0 to stamp1, None without one or where the history does not cover both.

        Args:
            noise_rad2_ps: variance that its white noise adds in a second.
        """
        with self._lock:
            last = self._last
            if last is None or last[0].gyro_count is None or len(self._samples) < 2 or stamp1_ns < stamp0_ns:
                return None
            clock = np.array([s[0] for s in self._samples], dtype=np.int64)
            counts = np.array(self._turned, dtype=np.int64)
            offset_ns = min(self._offsets_ns)
        times = self._times(clock, offset_ns, stamp0_ns, stamp1_ns)
        if times is None:
            return None
        t, t0, t1 = times
        path = counts * np.array([GYRO_UNIT_RAD, GAINED_UNIT_MPS, GAINED_UNIT_MPS])
        start, end = self._between(t, path, (t0, t1), (stamp0_ns, stamp1_ns), "gyro" * self._seamless)
        moved = end - start
        span_s, beyond_s = 1e-9 * (stamp1_ns - stamp0_ns), max(0.0, t1 - float(t[-1]))
        rate = abs(float(moved[0])) / span_s if span_s > 0.0 else 0.0
        ends = GYRO_UNIT_RAD**2 / _ROUNDING + 2.0 * (self._noise.stamp_sigma_s * rate) ** 2
        ends += (0.5 * self._noise.coast_turn_radps2 * beyond_s**2) ** 2
        gained = None if last[0].gained_x_count is None or last[0].gained_y_count is None else frozen(moved[1:])
        return Turn(float(moved[0]), noise_rad2_ps * span_s, span_s, ends, gained)

    def _continues(self, status: BaseStatus, stamp_ns: int) -> bool:
        if self._last is None:
            return True
        before, before_ns = self._last
        base_s = 1e-3 * wrap_int32(status.clock_ms - before.clock_ms)
        host_s = 1e-9 * (stamp_ns - before_ns)
        if base_s < 0.0 or abs(base_s - host_s) > _CLOCK_TOLERANCE_S + _CLOCK_DRIFT * host_s:
            return False
        dx, dy, turned = _step(before, status)
        slack_s = base_s + _SLACK_S
        return math.hypot(dx, dy) <= self._max_speed_mps * slack_s and abs(turned) <= self._max_turn_radps * slack_s

    def _append(self, status: BaseStatus, stamp_ns: int) -> None:
        if self._last is None:
            clock_ns, x, y, theta = 0, status.wheel_x_count, status.wheel_y_count, status.wheel_theta_count
            turned = _motion_counts(status)
        else:
            before = self._last[0]
            elapsed_ms = wrap_int32(status.clock_ms - before.clock_ms)
            if elapsed_ms == 0:
                return
            clock_ns, x, y, theta = self._samples[-1]
            clock_ns += elapsed_ms * 1_000_000
            x += wrap_int32(status.wheel_x_count - before.wheel_x_count)
            y += wrap_int32(status.wheel_y_count - before.wheel_y_count)
            theta += wrap_int32(status.wheel_theta_count - before.wheel_theta_count)
            now, then = _motion_counts(status), _motion_counts(before)
            turned = tuple(t + wrap_int32(a - b) for t, a, b in zip(self._turned[-1], now, then, strict=True))
        self._samples.append((clock_ns, x, y, theta))
        self._turned.append(turned)
        self._offsets_ns.append(stamp_ns - clock_ns)
        self._last = (status, stamp_ns)

    def _times(self, clock_ns: NDArray[np.int64], offset_ns: int, *stamps_ns: int) -> tuple[Array, float, float] | None:
        """(N,) seconds of the samples and those of both stamps, from the first sample on; None where they do not cover
        both."""
        origin_ns = int(clock_ns[0])
        t = np.asarray(1e-9 * (clock_ns - origin_ns), dtype=np.float64)
        t0, t1 = (1e-9 * (stamp - offset_ns - origin_ns) for stamp in stamps_ns)
        return (t, t0, t1) if self._covers(t, t0) and self._covers(t, t1) else None

    def _covers(self, t: Array, at_s: float) -> bool:
        if at_s < t[0] or at_s > t[-1] + self._coast_s:
            return False
        after = int(np.searchsorted(t, at_s))
        return after == 0 or after == len(t) or bool(t[after] - t[after - 1] <= self._max_gap_s)

    def _between(
        self, t: Array, path: Array, at_s: tuple[float, float], stamps_ns: tuple[int, int], which: str
    ) -> tuple[Array, Array]:
        """(3,) both ends of an interval; where it follows the last one of that name, that one's end."""
        start, end = _pose_at(t, path, at_s[0]), _pose_at(t, path, at_s[1])
        if which:
            before_ns, told = self._ends.get(which, (None, start))
            start = told if before_ns == stamps_ns[0] else start
            self._ends[which] = stamps_ns[1], end
        return start, end

    def _motion(self, t: Array, path: Array, t0: float, t1: float, start: Array, end: Array) -> WheelMotion:
        inside = path[(t > t0) & (t < t1)]
        points = np.vstack((start, inside, end))
        steps = np.diff(points, axis=0)
        length_m = float(np.hypot(steps[:, 0], steps[:, 1]).sum())
        turned_rad = float(np.abs(steps[:, 2]).sum())
        cov = self._cov(length_m, turned_rad, t1 - t0, max(0.0, t1 - float(t[-1])))
        return WheelMotion(Displacement(frozen(se2.between(points[0], points[-1]))), frozen(cov))

    def _cov(self, length_m: float, turned_rad: float, elapsed_s: float, coast_s: float) -> Array:
        n = self._noise
        per_s = n.stamp_sigma_s / elapsed_s if elapsed_s > 0.0 else 0.0
        var_xy = LENGTH_UNIT_M**2 / _ROUNDING + n.slip_m2_per_m * length_m + 2.0 * (per_s * length_m) ** 2
        var_theta = (
            ANGLE_UNIT_RAD**2 / _ROUNDING
            + n.turn_rad2_per_m * length_m
            + n.turn_rad2_per_rad * turned_rad
            + 2.0 * (per_s * turned_rad) ** 2
        )
        var_xy += (0.5 * n.coast_accel_mps2 * coast_s**2) ** 2
        var_theta += (0.5 * n.coast_turn_radps2 * coast_s**2) ** 2
        return np.diag([var_xy, var_xy, var_theta])


def _motion_counts(status: BaseStatus) -> tuple[int, ...]:
    """Gyro and both accelerometers, 0 where there are none."""
    return status.gyro_count or 0, status.gained_x_count or 0, status.gained_y_count or 0


def _step(before: BaseStatus, after: BaseStatus) -> tuple[float, float, float]:
    dx = LENGTH_UNIT_M * wrap_int32(after.wheel_x_count - before.wheel_x_count)
    dy = LENGTH_UNIT_M * wrap_int32(after.wheel_y_count - before.wheel_y_count)
    return dx, dy, se2.wrap(ANGLE_UNIT_RAD * wrap_int32(after.wheel_theta_count - before.wheel_theta_count))


def _pose_at(t: Array, path: Array, at_s: float) -> Array:
    """(3,) linear between samples, constant speed beyond the last."""
    i = min(max(int(np.searchsorted(t, at_s)), 1), len(t) - 1)
    fraction = (at_s - t[i - 1]) / (t[i] - t[i - 1])
    return np.asarray(path[i - 1] + fraction * (path[i] - path[i - 1]), dtype=np.float64)
