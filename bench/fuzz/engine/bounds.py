"""What one input may do to a reader: be read, or be refused with an error of ours, in little time and memory."""

from __future__ import annotations

import logging
import os
import re
import signal
import threading
import time
import traceback
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from types import FrameType

from ceilvo.errors import CeilvoError

CPU_S = 2.0
"""Processor time of one input; chosen: valid ones take a tenth of it on a slow computer."""
MEMORY_BYTES = 256 << 20
"""That one input may add to the process at its peak; chosen: a small robot's computer has 1 GB."""
LINE_CHARS = 1000
"""Of an error's line: people read it in a terminal."""

Read = Callable[[bytes], None]


class TooSlow(BaseException):
    """Raised in the middle of a reader; no `except Exception` may keep it."""


def problem_of(read: Read, data: bytes) -> tuple[str, bool]:
    """Why an input is more than the reader can take, "" where it is not, and whether it was read without an error."""
    with _peak() as peak:
        start_s = time.process_time()
        try:
            with _limited(CPU_S):
                problem, read_well = _outcome(read, data)
        except TooSlow:
            return f"slow: more than {CPU_S:g} s of processor time", False
        took_s = time.process_time() - start_s
    if not problem and took_s > CPU_S:
        problem = f"slow: {took_s:.1f} s of processor time, expected at most {CPU_S:g}"
    if not problem and peak.grown > MEMORY_BYTES:
        problem = f"large: {peak.grown >> 20} MB more memory, expected at most {MEMORY_BYTES >> 20}"
    return problem, read_well and not problem


@contextmanager
def quiet() -> Iterator[None]:
    """Readers that log or warn do so by the thousand here, and a warning is no traceback."""
    logging.disable(logging.CRITICAL)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    finally:
        logging.disable(logging.NOTSET)


def _outcome(read: Read, data: bytes) -> tuple[str, bool]:
    try:
        read(data)
    except CeilvoError as e:
        lines = str(e).split("\n")
        bad = next((line for line in lines if not 0 < len(line) <= LINE_CHARS or not line.isprintable()), None)
        if bad is not None:
            return f"{type(e).__name__} that nobody can read, {len(bad)} characters: {bad[:80]!r}", False
        return "", False
    except Exception as e:
        last = traceback.extract_tb(e.__traceback__)[-1]
        where = f"{Path(last.filename).name}:{last.lineno}"
        return f"{type(e).__name__} at {where}: {' '.join(str(e).split())[:160]}", False
    return "", True


def kind_of(problem: str) -> str:
    """The same for two problems of one cause."""
    return re.sub(r"\d+(\.\d+)? (s|MB|characters).*", "", problem).split(": ")[0] if problem else ""


@contextmanager
def _limited(cpu_s: float) -> Iterator[None]:
    """TooSlow after so much processor time; in other threads than the main one nothing can be interrupted."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.signal(signal.SIGPROF, _too_slow)
    signal.setitimer(signal.ITIMER_PROF, cpu_s)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0.0)
        signal.signal(signal.SIGPROF, before)


def _too_slow(number: int, frame: FrameType | None) -> None:
    raise TooSlow


class _Peak:
    """How far the process grew; 0 where the kernel does not tell."""

    grown = 0


@contextmanager
def _peak() -> Iterator[_Peak]:
    """The kernel's own high-water mark, which sees what C and C++ take, set back before (proc(5), clear_refs)."""
    out = _Peak()
    try:
        mark = os.open("/proc/self/clear_refs", os.O_WRONLY)
    except OSError:
        yield out
        return
    try:
        os.write(mark, b"5")
        before = _high_water()
        yield out
        out.grown = _high_water() - before
    finally:
        os.close(mark)


def _high_water() -> int:
    """Bytes."""
    status = Path("/proc/self/status").read_bytes()
    found = re.search(rb"VmHWM:\s*(\d+) kB", status)
    return int(found[1]) << 10 if found else 0
