"""`ceilvod web`: a running robot in a browser."""

from __future__ import annotations

import sys
import threading

from ceilvo.config import Config
from ceilvo.drivers.host.signals import stop_on_signals
from ceilvo.drivers.host.systemd_notify import Notifier
from ceilvo.drivers.web.server import serve


def serve_pages(config: Config) -> int:
    """Serve until Ctrl-C or SIGTERM; returns the exit code."""
    stop = threading.Event()
    with stop_on_signals(stop), Notifier() as systemd:

        def ready(address: str) -> None:
            sys.stdout.write(f"{config.robot.name} on {address}\n")
            sys.stdout.flush()
            systemd.ready(f"{config.robot.name} on {address}")

        serve(config, stop, ready, systemd.watchdog)
        systemd.stopping()
    return 0
