"""`ceilvod web`: a running robot in a browser."""

from __future__ import annotations

import sys
import threading
from pathlib import Path

from ceilvo.config import Config
from ceilvo.drivers.host.signals import stop_on_signals
from ceilvo.drivers.host.systemd_notify import Notifier
from ceilvo.drivers.web.server import serve


def serve_pages(config: Config, config_file: Path | None = None, simulate: bool = False) -> int:
    """Serve until Ctrl-C or SIGTERM; returns the exit code.

    Args:
        config_file: where the configuration came from, None = the defaults.
        simulate: the robot is the simulated one.
    """
    stop = threading.Event()
    with stop_on_signals(stop), Notifier() as systemd:

        def ready(address: str) -> None:
            sys.stdout.write(f"{config.robot.name} on {address}\n")
            sys.stdout.flush()
            systemd.ready(f"{config.robot.name} on {address}")

        serve(config, stop, ready, systemd.watchdog, config_file, simulate)
        systemd.stopping()
    return 0
