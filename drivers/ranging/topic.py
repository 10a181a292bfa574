"""Ranges over Zenoh: `ceilvo.ranges.1` on `<prefix>/<robot>/ranges` (docs/ranges.md)."""

from __future__ import annotations

import logging
import math
import threading
import time
from typing import Any

import zenoh

from ceilvo.drivers.bus.messages import decode
from ceilvo.drivers.ports import Clock
from ceilvo.drivers.ranging.dwm1001 import FARTHEST_M
from ceilvo.drivers.ranging.mailbox import Mailbox
from ceilvo.drivers.rate_limit import QuietLog
from ceilvo.errors import BusError, one_line
from ceilvo.senses.beacons import NAME_CHARS

log = logging.getLogger(__name__)

NAME = "ranges"
MOST_BYTES = 16_384
"""Of a message; one with 16 anchors has a thousand."""
_MOST_RANGES = 64
_OLDEST_MS = 1000.0
"""A range that is older is useless; the robot is elsewhere."""
_LOGGED_PER_S, _LOG_BURST = 0.2, 5


def decode_ranges(payload: bytes) -> tuple[tuple[tuple[str, float], float], ...]:
    """((anchor, metres), age in s) of a message.

    Raises:
        BusError: it is anything else, in one line.
    """
    if len(payload) > MOST_BYTES:
        raise BusError(f"{NAME} message: {len(payload)} bytes, expected at most {MOST_BYTES}")
    fields = decode(payload, NAME)
    rows = fields.get("ranges")
    if not isinstance(rows, list) or len(rows) > _MOST_RANGES:
        raise BusError(f"{NAME} message: ranges is {one_line(repr(rows), 60)}, expected a list of up to {_MOST_RANGES}")
    return tuple(_row(row, k) for k, row in enumerate(rows))


def _row(row: Any, k: int) -> tuple[tuple[str, float], float]:
    at = f"{NAME} message: ranges[{k}]"
    if not isinstance(row, dict):
        raise BusError(f"{at} is {one_line(repr(row), 60)}, expected anchor, range_m and perhaps age_ms")
    name, metres, age = row.get("anchor"), row.get("range_m"), row.get("age_ms", 0.0)
    if not isinstance(name, str) or not 0 < len(name) <= NAME_CHARS:
        raise BusError(f"{at}.anchor is {one_line(repr(name), 60)}, expected a name of up to {NAME_CHARS} characters")
    metres, age = _number(metres, f"{at}.range_m", FARTHEST_M), _number(age, f"{at}.age_ms", _OLDEST_MS)
    return (name.upper(), metres), 1e-3 * age


def _number(value: Any, where: str, most: float) -> float:
    number = isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)
    if not number or not 0.0 <= value <= most:
        raise BusError(f"{where} is {one_line(repr(value), 60)}, expected 0 to {most:g}")
    return float(value)


class RangesTopic:
    """A speaker of the bus that only listens. What cannot be used is counted and said in one line."""

    def __init__(self, key: str, mailbox: Mailbox, clock: Clock = time.monotonic_ns) -> None:
        self.key, self._mailbox, self._clock = key, mailbox, clock
        self._quiet = QuietLog(log, _LOGGED_PER_S, _LOG_BURST, clock)
        self._lock = threading.Lock()
        self._counts = {"messages": 0, "malformed": 0}
        self._held: list[Any] = []

    def counters(self) -> dict[str, int]:
        with self._lock:
            return dict(self._counts)

    def declare(self, session: zenoh.Session) -> None:
        """On a session that has just opened."""
        self._held.append(session.declare_subscriber(self.key, lambda s: self.take(s.payload.to_bytes())))

    def take(self, payload: bytes) -> None:
        """Never raises."""
        now_ns = self._clock()
        try:
            rows = decode_ranges(payload)
        except BusError as e:
            self._count("malformed")
            self._quiet.warning(f"{self.key}: {e}; nothing was done with it")
            return
        self._count("messages")
        for measured, age_s in rows:
            self._mailbox.put((measured,), now_ns - round(1e9 * age_s))

    def _count(self, name: str) -> None:
        with self._lock:
            self._counts[name] += 1
