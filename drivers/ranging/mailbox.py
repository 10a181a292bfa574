"""Ranges between the thread that hears them and the one that estimates."""

from __future__ import annotations

import threading

from ceilvo.senses.beacons import Range

_MOST = 500
"""That wait; chosen: eight anchors for six seconds. The oldest go."""


class Mailbox:
    """Thread-safe; nobody waits."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._waiting: list[Range] = []

    def put(self, measured: tuple[tuple[str, float], ...], stamp_ns: int) -> None:
        """A round of (anchor, metres) at a stamp."""
        with self._lock:
            self._waiting.extend(Range(name, stamp_ns, metres) for name, metres in measured)
            del self._waiting[:-_MOST]

    def take(self, stamp_ns: int) -> tuple[Range, ...]:
        """What came up to a stamp, in order; each once."""
        with self._lock:
            taken = tuple(r for r in self._waiting if r.stamp_ns <= stamp_ns)
            self._waiting = [r for r in self._waiting if r.stamp_ns > stamp_ns]
        return taken
