"""Mutated input into every reader for 10 s of processor time: our own errors, soon, and in little memory.

FUZZ_SECONDS=600 takes longer, FUZZ_SEED=7 tries others. `make fuzz` is the same by coverage, ten minutes each.
"""

from __future__ import annotations

import os
from pathlib import Path

import cv2
import numpy as np
import pytest

from ceilvo.bench.fuzz.campaign import CORPUS, campaign, kept, seeds
from ceilvo.bench.fuzz.engine.bounds import CPU_S, MEMORY_BYTES, Read, problem_of, quiet
from ceilvo.bench.fuzz.registry import TARGETS
from ceilvo.errors import CeilvoError

SECONDS = float(os.environ.get("FUZZ_SECONDS", "10"))
SEED = int(os.environ.get("FUZZ_SEED", "1"))
WEIGHTS = {
    "recording": 6.0,
    "snapshot": 3.0,
    "features": 2.0,
    "inputs": 2.0,
    "state_dir": 2.0,
    "map_database": 2.0,
    "calib_session": 2.0,
}
"""Shares of the time, where others have 1: an input of these takes a hundred times as long."""
KEPT = [pytest.param(name, path, id=f"{name}-{path.name}") for name in TARGETS for path in kept(name)]


@pytest.fixture(autouse=True)
def one_thread() -> None:
    """A configuration that is replayed may ask OpenCV for more."""
    cv2.setNumThreads(1)


@pytest.mark.parametrize("name", TARGETS)
def test_the_seeds_are_read_without_an_error(name: str) -> None:
    assert seeds(name)
    with quiet():
        for seed in seeds(name):
            TARGETS[name].read(seed)


@pytest.mark.parametrize(("name", "path"), KEPT)
def test_what_once_broke_a_reader_does_so_no_more(name: str, path: Path) -> None:
    with quiet():
        problem, _ = problem_of(TARGETS[name].read, path.read_bytes())
    assert problem == ""


def test_the_corpus_is_small_and_belongs_to_targets() -> None:
    files = [p for p in CORPUS.glob("*/*") if p.is_file()]
    assert {p.parent.name for p in files} <= set(TARGETS)
    assert 0 < sum(p.stat().st_size for p in files) < 200_000


@pytest.mark.parametrize("name", TARGETS)
def test_mutated_valid_input(name: str, tmp_path: Path) -> None:
    seconds = SECONDS * WEIGHTS.get(name, 1.0) / sum(WEIGHTS.get(n, 1.0) for n in TARGETS)
    result = campaign(name, seconds, SEED)
    print(f"{name}: seed {SEED}, {seconds:.1f} s, {result.runs} inputs, {result.read} of them read")
    assert result.runs
    assert not result.problems, f"seed {SEED}\n{result.text}\nto keep one: cp FILE {CORPUS / name}/"


# -- the harness itself notices what it is for


def test_a_traceback_is_noticed_and_our_error_is_not() -> None:
    assert problem_of(_raise(ValueError("x")), b"")[0].startswith("ValueError at test_fuzz.py:")
    assert problem_of(_raise(CeilvoError("a.csv: found x, expected y")), b"") == ("", False)
    assert problem_of(lambda data: None, b"") == ("", True)
    for unreadable in ("", "\x1b[2J", "x" * 5000, "one line\n\nthree"):
        assert "nobody can read" in problem_of(_raise(CeilvoError(unreadable)), b"")[0]


def _raise(error: Exception) -> Read:
    def read(data: bytes) -> None:
        raise error

    return read


def test_a_reader_that_never_ends_is_noticed() -> None:
    def endless(data: bytes) -> None:
        while True:
            try:
                sum(range(1000))
            except Exception:
                continue

    assert problem_of(endless, b"")[0].startswith(f"slow: more than {CPU_S:g} s")


def test_memory_that_is_given_back_is_noticed() -> None:
    if not os.access("/proc/self/clear_refs", os.W_OK):
        pytest.skip("the kernel's high-water mark cannot be set back here")
    assert problem_of(lambda data: _fill(MEMORY_BYTES + MEMORY_BYTES // 8), b"")[0].startswith("large: ")
    assert problem_of(lambda data: _fill(MEMORY_BYTES // 8), b"") == ("", True)


def _fill(size: int) -> None:
    np.ones(size, np.uint8)
