"""The fleet's part of a robot's daemon: a thread that waits, and now and then a process beside it that does the work.

Offering and fetching take seconds of the processor on a large map; in a process of its own they do not hold the
interpreter that the estimator needs.
"""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
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
_LOOK_S = 0.1
"""Between looks whether the process is done."""


@contextmanager
def part(
    config: Config,
    map_file: Path,
    may_offer: Callable[[], bool],
    hear: Callable[[Met], None],
    first_s: float = _FIRST_S,
) -> Iterator[None]:
    """Meet the service every fleet.period_s, for as long as the context lasts.

    Args:
        may_offer: whether what the map has is worth an offer now; called in the thread.
        hear: what came of each meeting; called in the thread.
    """
    stop = threading.Event()

    def run() -> None:
        wait_s = min(first_s, config.fleet.period_s)
        while not stop.wait(wait_s):
            wait_s = config.fleet.period_s
            met = met_beside(config, map_file, may_offer(), _MOST_S, stop)
            if met is not None:
                hear(met)

    thread = threading.Thread(target=run, name="fleet", daemon=True)
    thread.start()
    try:
        yield
    finally:
        stop.set()
        thread.join(1.0)


def met_beside(
    config: Config, map_file: Path, may_offer: bool, most_s: float, stop: threading.Event | None = None
) -> Met | None:
    """One meeting in a process of its own, which ends with this one.

    Args:
        most_s: after so long it is given up; what has come until then is kept.
        stop: gives it up when it is set.

    Returns:
        None where it was given up because of `stop`.
    """
    stopping = threading.Event() if stop is None else stop
    context = multiprocessing.get_context("spawn")
    try:
        here, there = context.Pipe()
        process = context.Process(target=_work, args=(config, map_file, may_offer, there), daemon=True)
        process.start()
    except OSError as e:  # no memory, no descriptors
        return Met(f"its process cannot be started: {e.strerror or e}", True)
    there.close()
    waited_s = 0.0
    try:
        while not here.poll(_LOOK_S):
            waited_s += _LOOK_S
            if stopping.is_set() or waited_s > most_s:
                process.kill()
                return None if stopping.is_set() else Met(f"map service away: gave up after {most_s:g} s", False)
        found = here.recv()
        return found if isinstance(found, Met) else None
    except EOFError:
        return Met("its process died; the journal says why", True)
    finally:
        process.join(1.0)
        here.close()


def _work(config: Config, map_file: Path, may_offer: bool, to: Connection) -> None:
    """In the process. A signal that ends the daemon is not for it: it goes on until the daemon is gone."""
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, signal.SIG_IGN)
    threading.Thread(target=_end_with, args=(to,), daemon=True).start()
    with contextlib.suppress(OSError):  # the service's unit may forbid it
        os.nice(_NICE)
    met = meet(config, map_file, may_offer)
    to.send(replace(met, said=printable(met.said)))


def _end_with(other: Connection) -> None:
    """Two processes must not tell of the same landmarks: the next daemon may start one as soon as this one is dead."""
    with contextlib.suppress(EOFError, OSError):
        other.recv()  # nothing is ever sent: it ends with the process on the other side
    os._exit(1)
