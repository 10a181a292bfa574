"""Floods from outside: how often something may happen, and what is said about the rest. Thread-safe."""

from __future__ import annotations

import logging
import threading
import time

from ceilvo.drivers.ports import Clock


class TokenBucket:
    """At most `burst` at once and `rate_hz` in the long run."""

    def __init__(self, rate_hz: float, burst: int, clock: Clock = time.monotonic_ns) -> None:
        self._rate_hz, self._burst, self._clock = rate_hz, float(burst), clock
        self._tokens, self._at_ns = float(burst), clock()
        self._lock = threading.Lock()

    def take(self) -> bool:
        """Whether one more is allowed now."""
        with self._lock:
            now_ns = self._clock()
            self._tokens = min(self._burst, self._tokens + 1e-9 * (now_ns - self._at_ns) * self._rate_hz)
            self._at_ns = now_ns
            if self._tokens < 1.0:
                return False
            self._tokens -= 1.0
            return True


class QuietLog:
    """A logger for what somebody else can trigger: a burst of lines, then few, with the number left out."""

    def __init__(self, log: logging.Logger, rate_hz: float, burst: int, clock: Clock = time.monotonic_ns) -> None:
        self._log, self._bucket = log, TokenBucket(rate_hz, burst, clock)
        self._left_out = 0

    def warning(self, text: str) -> None:
        self._say(logging.WARNING, text)

    def info(self, text: str) -> None:
        self._say(logging.INFO, text)

    def _say(self, level: int, text: str) -> None:
        if not self._bucket.take():
            self._left_out += 1
            return
        left_out, self._left_out = self._left_out, 0
        self._log.log(level, "%s%s", text, f" ({left_out} more like this were not logged)" if left_out else "")
