"""Work for tests of workers, importable where they are."""

from __future__ import annotations

import os
import signal
from pathlib import Path

import numpy as np


def drawn(seed: int) -> tuple[int, list[float]]:
    """The process that did it, and numbers whose last bits tell whether it was done alike."""
    a = np.random.default_rng(seed).normal(size=(40, 40))
    return os.getpid(), np.linalg.solve(a @ a.T + np.eye(40), a[:, 0]).tolist()


def dies_once(item: tuple[Path, int]) -> int:
    """Its number; the first process that is given the second one is killed at it."""
    folder, number = item
    mark = folder / "killed"
    if number == 1 and not mark.exists():
        mark.write_text(str(os.getpid()))
        os.kill(os.getpid(), signal.SIGKILL)
    (folder / f"{number}.{os.getpid()}").touch()
    return number


def always_dies(_number: int) -> int:
    os.kill(os.getpid(), signal.SIGKILL)
    return 0


def fails(number: int) -> int:
    raise ValueError(f"item {number} is bad")


def waits_to_be_killed(item: tuple[Path, int]) -> int:
    """Its number; at the second one it says who it is and waits for its end, once."""
    folder, number = item
    mark = folder / "waiting"
    if number == 1 and not mark.exists():
        beside = folder / "waiting.tmp"
        beside.write_text(str(os.getpid()))
        beside.rename(mark)
        signal.pause()
    (folder / f"{number}.{os.getpid()}").touch()
    return number
