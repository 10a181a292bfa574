"""The same on a Dask cluster (dask.distributed, BSD-3), which is an extra."""

from __future__ import annotations

import importlib
import platform
from collections.abc import Callable, Iterator, Sequence
from importlib.util import find_spec
from typing import Any, TypeVar

import numpy as np

from ceilvo import __version__
from ceilvo.errors import CeilvoError, one_line

Item = TypeVar("Item")
Result = TypeVar("Result")
CONNECT_S = 10.0
"""A scheduler answers, and has a worker, within; chosen: one that was started a moment ago."""


def versions() -> dict[str, str]:
    """What the last bits of a result may depend on."""
    return {
        "ceilvo": __version__,
        "numpy": np.__version__,
        "python": platform.python_version(),
        "machine": platform.machine(),
    }


def on_cluster(work: Callable[[Item], Result], items: Sequence[Item], address: str) -> Iterator[tuple[int, Result]]:
    """As workers.each(). A worker that dies costs the items that it was at; the others do them again.

    Raises:
        CeilvoError: Dask is not installed, nobody answers, a worker is of another version, or an item killed several
            workers; else what work raises.
    """
    if find_spec("distributed") is None:
        raise CeilvoError("--scheduler: needs Dask, which is not installed: pip install 'ceilvo[cluster]'")
    dask: Any = importlib.import_module("distributed")
    try:
        client = dask.Client(address, timeout=CONNECT_S, set_as_default=False)
    except (OSError, ValueError, TypeError) as e:
        raise CeilvoError(
            f"--scheduler {address}: no Dask scheduler answers ({one_line(e) or type(e).__name__}); start one with "
            "'dask scheduler', workers with 'dask worker', and give its tcp:// address"
        ) from e
    with client:
        _look_at_workers(client, address)
        futures = {client.submit(work, item, pure=False): k for k, item in enumerate(items)}
        for done in dask.as_completed(list(futures), loop=client.loop):
            try:
                result = done.result()
            except dask.KilledWorker as e:
                raise CeilvoError(
                    f"--scheduler {address}: item {futures[done] + 1} of {len(items)} killed worker after worker; "
                    "is their memory enough?"
                ) from e
            k = futures.pop(done)
            done.release()
            yield k, result


def _look_at_workers(client: Any, address: str) -> None:
    try:
        client.wait_for_workers(1, timeout=CONNECT_S)
    except TimeoutError as e:
        raise CeilvoError(f"--scheduler {address}: it has no worker; start some with 'dask worker {address}'") from e
    own = versions()
    for worker, theirs in client.run(versions, on_error="return").items():
        if theirs != own:
            found = theirs if isinstance(theirs, dict) else {"ceilvo": f"none ({one_line(theirs)})"}
            differs = ", ".join(f"{k} {found.get(k)}, expected {v}" for k, v in own.items() if found.get(k) != v)
            raise CeilvoError(f"--scheduler {address}: worker {worker} has {differs}; results would not be the same")
