"""A real Dask scheduler and worker processes on loopback."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

from patience import until

COMMON = Path(__file__).parent
END_S = 10.0
"""A process that was told to end has so long before it is killed."""


@contextmanager
def cluster(folder: Path, workers: int = 2) -> Iterator[str]:
    """The scheduler's address; workers have one thread each, logs are in the folder."""
    found, log_file = folder / "scheduler.json", folder / "cluster.log"
    env = os.environ | {"PYTHONPATH": str(COMMON), "OPENBLAS_NUM_THREADS": "1"}
    with ExitStack() as stack:
        log = stack.enter_context(log_file.open("w"))

        def start(what: str, *words: str | Path) -> None:
            command = [sys.executable, "-m", f"distributed.cli.dask_{what}", *map(str, words), "--no-dashboard"]
            process = subprocess.Popen(command, stdout=log, stderr=log, env=env, cwd=folder)
            stack.callback(_end, process)

        start("scheduler", "--host", "127.0.0.1", "--port", "0", "--scheduler-file", found)
        until(lambda: found.exists() and found.read_text().rstrip().endswith("}"), "the scheduler")
        address = str(json.loads(found.read_text())["address"])
        for _ in range(workers):
            start(
                *("worker", address, "--host", "127.0.0.1", "--nthreads", "1"),
                *("--local-directory", folder, "--memory-limit", "0"),
            )
        yield address


def _end(process: subprocess.Popen[bytes]) -> None:
    process.terminate()
    try:
        process.wait(END_S)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()
