"""Processes that write until they are killed, and tell what they have written."""

from __future__ import annotations

import multiprocessing
from collections.abc import Callable
from multiprocessing.connection import Connection
from multiprocessing.context import ForkServerProcess
from pathlib import Path


def started(write: Callable[[Path, Connection], None], at: Path) -> tuple[ForkServerProcess, Connection]:
    """A process that runs `write`, and the end of the pipe where it tells."""
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload([write.__module__])
    here, there = context.Pipe(duplex=False)
    process = context.Process(target=write, args=(at, there))
    process.start()
    there.close()
    return process, here
