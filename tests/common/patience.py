"""Waiting for what must come, on a computer however busy: tests end by events and counts, never by the clock."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable

PATIENCE_S = 180.0
"""Never waited for unless something is broken, or the computer has ten times as much to do as it can."""
_POLL_S = 0.005


def until(true: Callable[[], object], what: object = "it") -> None:
    """For conditions that nobody signals: polled, not slept for. `what` is put into words when it did not come."""
    deadline = time.monotonic() + PATIENCE_S
    pause = threading.Event()
    while not true():
        assert time.monotonic() < deadline, f"not within {PATIENCE_S} s: {what}"
        pause.wait(_POLL_S)
