"""Results of single runs as JSON lines, so that a bench that was interrupted goes on where it was."""

from __future__ import annotations

import hashlib
import json
import os
import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, Generic, TypeVar

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

import ceilvo.bench
import ceilvo.daemon
from ceilvo.errors import CeilvoError
from ceilvo.tasks.workers import Workers, each

Key = TypeVar("Key")
Item = TypeVar("Item")
Result = dict[str, Any]
ROOMS = ("odometry", "slam", "relocalisation", "integrity")
INTERRUPTED = 130
"""Exit code of shells for a program ended by Ctrl-C: 128 + SIGINT."""
THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")


class Store(Generic[Key]):
    """One line per run: its key, its figures, and the fingerprint of the code and data that made it.

    Lines of another fingerprint, and a last line that was cut short, are passed over.
    """

    def __init__(self, path: Path, fingerprint: str, key: Callable[[Mapping[str, Any]], Key]) -> None:
        self._path = path
        self._fingerprint = fingerprint
        self.results: dict[Key, Result] = {}
        path.parent.mkdir(parents=True, exist_ok=True)
        if path.exists():
            for line in path.read_text().splitlines():
                row = _parsed(line)
                if row is not None and row["code"] == fingerprint:
                    self.results[key(row["key"])] = row["figures"]

    def add(self, key: Key, as_dict: Mapping[str, Any], figures: Result) -> None:
        self.results[key] = figures
        line = json.dumps({"code": self._fingerprint, "key": dict(as_dict), "figures": figures})
        with self._path.open("a") as file:
            file.write(("" if _ends_well(self._path) else "\n") + line + "\n")


def exit_code(name: str, work: Callable[[], None]) -> int:
    """Of a bench that keeps its results: 0 when all is done; our own errors and Ctrl-C are one line."""
    try:
        work()
    except CeilvoError as e:
        print(f"bench.{name}: {e}", file=sys.stderr)
        return e.exit_code
    except KeyboardInterrupt:
        print(f"bench.{name}: stopped; the same command goes on from here", file=sys.stderr)
        return INTERRUPTED
    return 0


def one_thread() -> None:
    """BLAS on one thread in this process and its children, unless the caller said otherwise; before the first use."""
    for variable in THREADS:
        os.environ.setdefault(variable, "1")


def _ends_well(path: Path) -> bool:
    """Whether the file is empty or ends with a line's end."""
    with path.open("rb") as file:
        if not file.seek(0, os.SEEK_END):
            return True
        file.seek(-1, os.SEEK_END)
        return file.read() == b"\n"


def _parsed(line: str) -> Result | None:
    try:
        row = json.loads(line)
    except json.JSONDecodeError:
        return None
    return row if isinstance(row, dict) and {"code", "key", "figures"} <= row.keys() else None


def fingerprint(bench_files: Sequence[str], *more: str) -> str:
    """Of the rooms that the filters and the state machine load, the named files of bench, and more."""
    digest = hashlib.sha256()
    daemon, bench = (Path(p.__path__[0]) for p in (ceilvo.daemon, ceilvo.bench))
    for path in [*rooms(daemon), *(bench / name for name in bench_files)]:
        digest.update(path.relative_to(daemon.parent).as_posix().encode() + b"\0" + path.read_bytes())
    for text in more:
        digest.update(text.encode() + b"\0")
    return digest.hexdigest()[:16]


def rooms(daemon: Path) -> list[Path]:
    """Every source in the daemon's rooms that make up a filter and its state machine."""
    return sorted(p for room in ROOMS for kind in ("*.py", "*.so") for p in (daemon / room).rglob(kind))


def run_all(
    store: Store[Key],
    keys: Iterable[Key],
    as_dict: Callable[[Key], Mapping[str, Any]],
    work: Callable[[Item], Result],
    workers: Workers,
    items: Mapping[Key, Item] | None = None,
) -> None:
    """Run what the store does not hold yet, with a progress bar.

    Args:
        work: as tasks.workers.each.
        items: what it is given of each key; None: the key itself.
    """
    todo = [k for k in keys if k not in store.results]
    given: list[Any] = [k if items is None else items[k] for k in todo]
    one_thread()
    bars = (TextColumn("runs"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn(), TimeRemainingColumn())
    with Progress(*bars, console=Console(stderr=True)) as progress:
        task = progress.add_task("runs", total=len(todo))
        for k, figures in each(work, given, workers):
            store.add(todo[k], as_dict(todo[k]), figures)
            progress.advance(task)
