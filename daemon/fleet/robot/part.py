"""The fleet's part of a robot's daemon: a thread that waits, and now and then a process beside it that does the work.

Offering and fetching take seconds of the processor on a large map; in a process of its own they do not hold the
interpreter that the estimator needs.
"""

from __future__ import annotations

import contextlib
import logging
import multiprocessing
import os
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from multiprocessing.connection import Connection
from pathlib import Path

from ceilvo.config import Config
from ceilvo.daemon.fleet.robot.sync import Met, meet
from ceilvo.errors import printable

_NICE = 10
"""Of the process, where that may be set; the estimator goes first."""
_FIRST_S = 20.0
"""After the start; chosen: the robot should know where it is by then."""
_MOST_S = 300.0
"""That a meeting may take; chosen: a map of 100,000 landmarks over a poor radio."""


@contextmanager
def part(
    config: Config,
    map_file: Path,
    may_offer: Callable[[], bool],
    tell: Callable[[str, int], None],
    first_s: float = _FIRST_S,
) -> Iterator[None]:
    """Meet the service every fleet.period_s, for as long as the context lasts.

    Args:
        may_offer: whether what the map has is worth an offer now; called in the thread.
        tell: hears what happened and the level of logging; called in the thread.
    """
    stop = threading.Event()

    def run() -> None:
        wait_s, before = min(first_s, config.fleet.period_s), ""
        while not stop.wait(wait_s):
            wait_s = config.fleet.period_s
            met = _in_a_process(config, map_file, may_offer(), stop)
            if met is not None and met.said and (met.is_news or met.said != before):
                tell(f"fleet: {met.said}", logging.INFO if met.is_news else logging.WARNING)
            before = "" if met is None else met.said

    thread = threading.Thread(target=run, name="fleet", daemon=True)
    thread.start()
    try:
        yield
    finally:
        stop.set()
        thread.join(1.0)


def _in_a_process(config: Config, map_file: Path, may_offer: bool, stop: threading.Event) -> Met | None:
    """None where it was ended by `stop`."""
    context = multiprocessing.get_context("spawn")
    here, there = context.Pipe(duplex=False)
    process = context.Process(target=_work, args=(config, map_file, may_offer, there), daemon=True)
    process.start()
    there.close()
    waited = 0.0
    try:
        while not here.poll(0.2):
            waited += 0.2
            if stop.is_set() or waited > _MOST_S:
                process.kill()
                return None if stop.is_set() else Met(f"gave up after {_MOST_S:g} s", True)
        found = here.recv()
        return found if isinstance(found, Met) else None
    except EOFError:
        return Met("its process died; the journal says why", True)
    finally:
        process.join(1.0)
        here.close()


def _work(config: Config, map_file: Path, may_offer: bool, to: Connection) -> None:
    """In the process."""
    with contextlib.suppress(OSError):  # the service's unit may forbid it
        os.nice(_NICE)
    met = meet(config, map_file, may_offer)
    to.send(Met(printable(met.said), met.is_news))
