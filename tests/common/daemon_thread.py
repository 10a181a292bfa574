"""A daemon in a thread of the test's own process."""

from __future__ import annotations

import threading

from ceilvo.daemon.app.process import Daemon


def start(daemon: Daemon, result: list[object]) -> threading.Thread:
    """Run it; what it returns or raises goes into result."""

    def body() -> None:
        try:
            result.append(daemon.run())
        except Exception as e:
            result.append(e)

    thread = threading.Thread(target=body)
    thread.start()
    return thread
