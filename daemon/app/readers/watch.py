"""`ceilvod watch`: what any Zenoh subscriber gets."""

from __future__ import annotations

import sys
import threading

from ceilvo.config import Zenoh
from ceilvo.drivers.bus.watch import WatchOptions, watch
from ceilvo.drivers.host.signals import stop_on_signals


def watch_robots(config: Zenoh, robot: str, raw: bool, count: int | None) -> int:
    """Print until Ctrl-C or `count` poses; returns the exit code."""
    stop = threading.Event()
    with stop_on_signals(stop):
        watch(config, robot, sys.stdout, stop, WatchOptions(raw=raw, count=count))
    return 0
