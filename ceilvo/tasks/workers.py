"""One function for many items: one after the other, in several processes, or on a Dask cluster."""

from __future__ import annotations

import argparse
import multiprocessing
import sys
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from typing import TypeVar

from ceilvo.config.arguments import from_up
from ceilvo.errors import CeilvoError
from ceilvo.tasks.cluster import on_cluster

Item = TypeVar("Item")
Result = TypeVar("Result")
ATTEMPTS = 3
"""Processes that may die one after the other without anything done; chosen: then it is the work that kills them."""


@dataclass(frozen=True)
class Workers:
    """Who does it.

    Attributes:
        jobs: processes on this machine; 1: this one.
        scheduler: address of a Dask scheduler, whose workers do it instead; "" for none.
    """

    jobs: int = 1
    scheduler: str = ""

    @staticmethod
    def of(options: argparse.Namespace) -> Workers:
        return Workers(options.jobs, options.scheduler)


def add_options(p: argparse.ArgumentParser) -> None:
    """--jobs and --scheduler."""
    p.add_argument("--jobs", type=from_up(1), default=1, metavar="N", help="processes at once (1)")
    p.add_argument(
        "--scheduler",
        default="",
        metavar="tcp://HOST:PORT",
        help="the workers of this Dask scheduler do it; needs pip install 'ceilvo[cluster]', here and there",
    )


def each(
    work: Callable[[Item], Result], items: Sequence[Item], workers: Workers | None = None
) -> Iterator[tuple[int, Result]]:
    """The number of each item and what work makes of it, as they are done.

    Args:
        work: importable, with items and results that can be pickled, but where this process does it all. The same item
            gives the same result wherever it is done. A process that dies costs the items that it was at, which are
            done again.

    Raises:
        CeilvoError: workers die again and again, or a cluster cannot be used; else what work raises.
    """
    workers = workers or Workers()
    if workers.scheduler:
        yield from on_cluster(work, items, workers.scheduler)
    elif workers.jobs == 1:
        for k, item in enumerate(items):
            yield k, work(item)
    else:
        yield from _in_processes(work, items, workers.jobs)


def _in_processes(work: Callable[[Item], Result], items: Sequence[Item], jobs: int) -> Iterator[tuple[int, Result]]:
    left, died = dict(enumerate(items)), 0
    while left:
        pool = ProcessPoolExecutor(min(jobs, len(left)), multiprocessing.get_context("spawn"))
        try:
            futures: dict[Future[Result], int] = {pool.submit(work, item): k for k, item in left.items()}
            for done in as_completed(futures):
                k, result = futures[done], done.result()
                del left[k]
                died = 0
                yield k, result
        except BrokenProcessPool as e:
            died += 1
            if died == ATTEMPTS:
                raise CeilvoError(
                    f"{died} processes died one after the other with nothing done, {len(left)} of {len(items)} are "
                    "left; was memory short? try fewer --jobs"
                ) from e
        finally:
            pool.shutdown(wait=True, cancel_futures=True)


def progress(what: str, count: int) -> Callable[[], None]:
    """To be called for each that is done; on a terminal it counts."""
    done = 0

    def one_more() -> None:
        nonlocal done
        done += 1
        if sys.stderr.isatty():
            end = "\n" if done == count else ""
            print(f"\r{what} {done} of {count} ", end=end, file=sys.stderr, flush=True)

    return one_more
