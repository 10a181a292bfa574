"""What ends the process from outside its loops: signals, and threads that die."""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType


@contextmanager
def watch_threads(crash: Callable[[BaseException], None]) -> Iterator[None]:
    """Whatever thread dies of an exception, a library's too, is a crash of the process."""
    before = threading.excepthook

    def report(args: threading.ExceptHookArgs) -> None:
        if args.exc_value is not None:
            crash(args.exc_value)

    threading.excepthook = report
    try:
        yield
    finally:
        threading.excepthook = before


@contextmanager
def stop_on_signals(stop: threading.Event) -> Iterator[None]:
    """SIGTERM and SIGINT set the event; only in the main thread, where Python allows it."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return

    def ask(number: int, frame: FrameType | None) -> None:
        stop.set()

    before = {number: signal.signal(number, ask) for number in (signal.SIGTERM, signal.SIGINT)}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
