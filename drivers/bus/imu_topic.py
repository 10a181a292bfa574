"""A gyro that speaks on Zenoh: `<prefix>/<robot>/imu`, one JSON object a sample (docs/fusion.md)."""

from __future__ import annotations

import json
import math
import threading
from collections import deque
from typing import Any

import numpy as np
import zenoh

from ceilvo.drivers.ports import Clock
from ceilvo.senses.heard import Turn
from ceilvo.types import Array, frozen

NAME = "imu"
"""Last part of the key."""
MAX_BYTES = 1024
"""Of a sample; far more than one needs."""
_MOST_RADPS, _MOST_MPS2 = 100.0, 200.0
"""Beyond is damage: no gyro of a robot measures more."""
_LONGEST_GAP_S = 0.2
"""Between two samples; a longer one is a gap, and what lies beyond the newest by more is not covered."""
_TURN_ACCEL_RADPS2 = 2.0
"""Standard deviation of how the rate changes beyond the newest sample; as drivers/base/wheel_track.py."""
_EARLY_S, _LATE_S = 0.05, 2.0
"""A stamp further ahead or older is of another clock."""
_SAMPLES = 2048
"""Kept: 4 s at 500 Hz."""
_NS = 1e-9
"""Seconds in a nanosecond."""


class ImuTopic:
    """History of a gyro's samples, integrated (trapezoids); safe to use from several threads."""

    def __init__(self, clock: Clock, noise_rad2_ps: float) -> None:
        """noise_rad2_ps: variance that the gyro's white noise adds in a second."""
        self._clock, self._noise = clock, noise_rad2_ps
        self._lock = threading.Lock()
        self._samples: deque[tuple[int, float, float, float]] = deque(maxlen=_SAMPLES)
        self._rates = (0.0, 0.0, 0.0)
        self._declared: list[Any] = []
        self.taken = 0
        self.refused = 0

    def declare(self, session: zenoh.Session, key: str) -> None:
        """Hear a key."""
        self._declared.append(session.declare_subscriber(key, lambda sample: self.add(sample.payload.to_bytes())))

    def add(self, payload: bytes) -> bool:
        """One sample; False where it is refused and counted.

        stamp_ns is CLOCK_MONOTONIC of the robot's computer; without it the time of arrival counts. yaw_rate_radps is
        about base z; ax_mps2 and ay_mps2, where there are any, along base x and y.
        """
        now_ns = self._clock()
        found = _parsed(payload)
        with self._lock:
            if found is None or not self._fits(found[0] or now_ns, now_ns):
                self.refused += 1
                return False
            stamp_ns, rates = found[0] or now_ns, found[1]
            if not self._samples or (stamp_ns - self._samples[-1][0]) * _NS > _LONGEST_GAP_S:
                self._samples.clear()
                self._samples.append((stamp_ns, 0.0, 0.0, 0.0))
            else:
                before_ns, *sums = self._samples[-1]
                half_s = 0.5 * (stamp_ns - before_ns) * _NS
                turned, x, y = (s + half_s * (a + b) for s, a, b in zip(sums, self._rates, rates, strict=True))
                self._samples.append((stamp_ns, turned, x, y))
            self._rates = rates
            self.taken += 1
            return True

    def turn_between(self, stamp0_ns: int, stamp1_ns: int) -> Turn | None:
        """What the gyro says from stamp0 to stamp1, None where the samples do not cover both."""
        with self._lock:
            if len(self._samples) < 2 or stamp1_ns <= stamp0_ns or stamp0_ns < self._samples[0][0]:
                return None
            samples, rates = np.array(self._samples, np.float64), np.array(self._rates)
            origin_ns = self._samples[0][0]
            t = np.array([(s[0] - origin_ns) * _NS for s in self._samples])
        t0, t1 = ((stamp - origin_ns) * _NS for stamp in (stamp0_ns, stamp1_ns))
        beyond_s = max(t1 - float(t[-1]), 0.0)
        if beyond_s > _LONGEST_GAP_S:
            return None
        moved = _at(t, samples[:, 1:], t1) + beyond_s * rates - _at(t, samples[:, 1:], t0)
        span_s = t1 - t0
        step_s = float(np.median(np.diff(t)))
        ends = 2.0 * (0.5 * step_s * moved[0] / span_s) ** 2 + (0.5 * _TURN_ACCEL_RADPS2 * beyond_s**2) ** 2
        gained: Array = frozen(np.asarray(moved[1:]))
        return Turn(float(moved[0]), self._noise * span_s, span_s, float(ends), gained if np.any(gained) else None)

    def _fits(self, stamp_ns: int, now_ns: int) -> bool:
        late_s = (now_ns - stamp_ns) * _NS
        return -_EARLY_S < late_s < _LATE_S and (not self._samples or stamp_ns > self._samples[-1][0])


def _at(t: Array, sums: Array, at_s: float) -> Array:
    return np.array([np.interp(at_s, t, column) for column in sums.T])


def _parsed(payload: bytes) -> tuple[int | None, tuple[float, float, float]] | None:
    """Stamp and rates of a sample; None where it is none."""
    if len(payload) > MAX_BYTES:
        return None
    try:
        body = json.loads(payload)
        stamp = body.get("stamp_ns")
        rates = (float(body["yaw_rate_radps"]), float(body.get("ax_mps2", 0.0)), float(body.get("ay_mps2", 0.0)))
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError, OverflowError):
        return None
    if stamp is not None and (not isinstance(stamp, int) or isinstance(stamp, bool) or stamp <= 0):
        return None
    limits = (_MOST_RADPS, _MOST_MPS2, _MOST_MPS2)
    good = all(math.isfinite(r) and abs(r) <= most for r, most in zip(rates, limits, strict=True))
    return (stamp, rates) if good else None
