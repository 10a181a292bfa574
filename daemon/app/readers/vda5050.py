"""`ceilvod vda5050`: the robot's position for a fleet manager."""

from __future__ import annotations

import threading

from ceilvo.config import Config
from ceilvo.daemon.app.readers.shelved import FleetMaps
from ceilvo.drivers.host.signals import stop_on_signals
from ceilvo.drivers.vda5050.adapter import Adapter


def tell_fleet(config: Config) -> int:
    """Run until Ctrl-C or SIGTERM; returns the exit code."""
    stop = threading.Event()
    with stop_on_signals(stop):
        Adapter(config, FleetMaps(config)).run(stop)
    return 0
