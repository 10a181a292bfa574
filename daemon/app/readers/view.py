"""`ceilvod view --foxglove`: the running robot in Foxglove."""

from __future__ import annotations

import sys
import threading

from ceilvo.config import Zenoh
from ceilvo.drivers.host.signals import stop_on_signals
from ceilvo.drivers.live.foxglove_server import serve


def view_robot(config: Zenoh, robot: str, host: str, port: int) -> int:
    """Serve until Ctrl-C; returns the exit code."""

    def ready(on: int) -> None:
        sys.stdout.write(f"{robot} on ws://{host}:{on}: Foxglove, Open connection, Foxglove WebSocket\n")
        sys.stdout.flush()

    stop = threading.Event()
    with stop_on_signals(stop):
        serve(config, robot, host, port, stop, ready)
    return 0
