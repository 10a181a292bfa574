"""Publications of others on the robot's own keys: somebody of the same name, or a program with a mistake."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable, Sequence
from typing import Any

import zenoh

from ceilvo.drivers.ports import Clock
from ceilvo.drivers.rate_limit import QuietLog

log = logging.getLogger(__name__)


class ForeignSamples:
    """Counts and reports what arrives where only the robot itself should speak. Nothing is done with it."""

    LOGGED_PER_S, LOG_BURST = 0.02, 1
    """In the log: at once, then one in 50 s with the number left out."""

    def __init__(self, clock: Clock) -> None:
        self._quiet = QuietLog(log, self.LOGGED_PER_S, self.LOG_BURST, clock)
        self._lock = threading.Lock()
        self._count = 0

    @property
    def count(self) -> int:
        with self._lock:
            return self._count

    def watch(
        self, session: zenoh.Session, key: str, hint: Callable[[str], str] = lambda key: "", welcome: Sequence[str] = ()
    ) -> Any:
        """A subscriber of `key` that hears other sessions only, and passes over keys that are welcome; keep it."""

        def heard(sample: zenoh.Sample) -> None:
            if str(sample.key_expr) in welcome:
                return
            with self._lock:
                self._count += 1
            found = str(sample.key_expr)
            self._quiet.warning(
                f"{found}: found a publication of another session, expected none but this daemon's; nothing was done "
                f"with it; {hint(found) or 'is there a second robot of this name?'}"
            )

        return session.declare_subscriber(key, heard, allowed_origin=zenoh.Locality.REMOTE)
