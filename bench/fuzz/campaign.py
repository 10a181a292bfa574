"""A target for a while: mutants of valid inputs and of those kept, everything that breaks written to a folder."""

from __future__ import annotations

import hashlib
import random
import time
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path

from ceilvo.bench.fuzz.engine.bounds import kind_of, problem_of, quiet
from ceilvo.bench.fuzz.registry import TARGETS

OUT = Path("build/fuzz")
"""Below it a folder for each target."""
CORPUS = Path(__file__).resolve().parents[2] / "tests" / "golden" / "fuzz_corpus"
"""Inputs that once broke something, a folder for each target; not part of an installation."""
_POOL = 60
"""Inputs to mutate, seeds aside: mutants that were read without an error; chosen."""
_KEPT_BYTES = 64 << 10
"""Of a mutant that is mutated further: larger ones only take longer."""
_AGAIN = 0.3
"""Share of mutants of mutants; chosen."""
_WAITING = 4.0
"""Times its processor time that a campaign may last by the clock, for a target that waits and for a busy computer."""
_MOST_KINDS = 20
"""Of problems of one target, after which it is left: it is broken."""


@dataclass
class Result:
    """What a campaign found.

    Attributes:
        runs: inputs that were tried.
        read: of them, those that were read without an error; the others were refused.
        problems: one example of each kind, with how often it came.
        files: where these examples are.
    """

    runs: int = 0
    read: int = 0
    problems: dict[str, tuple[str, int]] = field(default_factory=dict)
    files: dict[str, Path] = field(default_factory=dict)

    @property
    def failures(self) -> int:
        return sum(count for _, count in self.problems.values())

    @property
    def text(self) -> str:
        return "\n".join(
            f"{example} ({count} times): {self.files[kind]}" for kind, (example, count) in self.problems.items()
        )


@lru_cache
def seeds(name: str) -> tuple[bytes, ...]:
    """Valid inputs of a target, made once."""
    with quiet():
        return TARGETS[name].seeds()


def kept(name: str) -> list[Path]:
    """The target's inputs that once broke something."""
    return sorted(p for p in (CORPUS / name).glob("*") if p.is_file())


def campaign(name: str, seconds: float, seed: int, out: Path = OUT) -> Result:
    """Mutants for so long; the same seed tries the same ones in the same order.

    Args:
        seconds: of processor time, those of the inputs to start from not counted.
        out: gets the inputs that broke the target.
    """
    target, rng, result = TARGETS[name], random.Random(f"{name} {seed}"), Result()
    start = [*seeds(name), *(p.read_bytes() for p in kept(name))]
    pool: list[bytes] = []
    with quiet():
        for data in start:
            problem_of(target.read, data)  # what is made only once is made now
        clocks = time.process_time, time.monotonic
        until = [clock() + budget for clock, budget in zip(clocks, (seconds, _WAITING * seconds), strict=True)]
        while all(clock() < end for clock, end in zip(clocks, until, strict=True)):
            chosen = pool if pool and rng.random() < _AGAIN else start
            data = target.mutate(rng.choice(chosen), rng)
            problem, read = problem_of(target.read, data)
            result.runs += 1
            result.read += read
            if problem:
                _note(result, problem, data, out / name)
                if len(result.problems) >= _MOST_KINDS:
                    break
            elif read and len(data) <= _KEPT_BYTES:
                if len(pool) < _POOL:
                    pool.append(data)
                else:
                    pool[rng.randrange(_POOL)] = data
    return result


def _note(result: Result, problem: str, data: bytes, folder: Path) -> None:
    kind = kind_of(problem)
    example, count = result.problems.get(kind, (problem, 0))
    result.problems[kind] = example, count + 1
    if count == 0:
        folder.mkdir(parents=True, exist_ok=True)
        path = folder / f"crash-{hashlib.sha256(data).hexdigest()[:16]}"
        path.write_bytes(data)
        result.files[kind] = path
