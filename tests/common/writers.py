"""Processes that write until they are killed, and tell what they have written."""

from __future__ import annotations

import multiprocessing
import threading
from collections.abc import Callable
from multiprocessing.connection import Connection
from multiprocessing.context import ForkServerProcess
from pathlib import Path

from patience import PATIENCE_S


def started(write: Callable[[Path, Connection], None], at: Path) -> tuple[ForkServerProcess, Connection]:
    """A process that runs `write`, and the end of the pipe where it tells."""
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload([write.__module__])
    here, there = context.Pipe(duplex=False)
    process = context.Process(target=write, args=(at, there))
    process.start()
    there.close()
    return process, here


def killed(write: Callable[[Path, Connection], None], at: Path, after_s: float, reached: int, about: str) -> int:
    """Run one that tells the number of each thing that it has written, and kill it so long after its first word.

    Args:
        reached: the number that was told last; the first word, what it finds, is that one or the next.
        about: which run it is, for failures.

    Returns:
        The last number that it told.
    """
    process, said = started(write, at)
    with said:
        assert said.recv() in (reached, reached + 1), about
        threading.Event().wait(after_s)
        process.kill()
        process.join(PATIENCE_S)
        try:
            while said.poll():
                reached = max(reached, said.recv())
        except EOFError:
            pass
    process.close()
    return reached
