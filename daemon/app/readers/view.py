"""`ceilvod view`: the running robot in Foxglove, or what it says in a file for it."""

from __future__ import annotations

import sys
import threading
from pathlib import Path

from ceilvo.config import Zenoh
from ceilvo.drivers.host.signals import stop_on_signals
from ceilvo.drivers.live.foxglove_server import serve
from ceilvo.drivers.live.kept import keep


def view_robot(config: Zenoh, robot: str, host: str, port: int) -> int:
    """Serve until Ctrl-C; returns the exit code."""

    def ready(on: int) -> None:
        sys.stdout.write(f"{robot} on ws://{host}:{on}: Foxglove, Open connection, Foxglove WebSocket\n")
        sys.stdout.flush()

    stop = threading.Event()
    with stop_on_signals(stop):
        serve(config, robot, host, port, stop, ready)
    return 0


def keep_robot(config: Zenoh, robot: str, path: Path) -> int:
    """Write an MCAP file until Ctrl-C; returns the exit code."""

    def ready() -> None:
        sys.stdout.write(f"{robot} into {path}, until Ctrl-C\n")
        sys.stdout.flush()

    stop = threading.Event()
    with stop_on_signals(stop):
        keep(config, robot, path, stop, ready)
    return 0
