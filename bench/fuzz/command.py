"""Minutes of mutated input for every reader of bytes: nothing but our own errors, soon and in little memory.

python -m ceilvo.bench.fuzz --minutes 10
python -m ceilvo.bench.fuzz --targets recording,snapshot --minutes 2 --engine mutations

Guided by coverage through atheris where it is installed, else mutations at random; both change valid inputs in the
target's own way. Each target runs in a process of its own. What broke one is kept in build/fuzz/TARGET/; copied to
tests/golden/fuzz_corpus/TARGET/ it is tried in every `make test` from then on.
"""

from __future__ import annotations

import argparse
import hashlib
import importlib
import json
import os
import random
import subprocess
import sys
import time
from collections.abc import Sequence

from ceilvo.bench.fuzz.campaign import CORPUS, OUT, campaign, kept, seeds
from ceilvo.bench.fuzz.registry import TARGETS
from ceilvo.bench.results.store import THREADS

ENGINES = ("atheris", "mutations")
_MAX_BYTES = 1 << 16
"""Of an input that atheris makes; chosen: all valid ones but whole recordings are shorter."""


def main(arguments: Sequence[str] | None = None) -> int:
    p = argparse.ArgumentParser(prog="fuzz", description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    p.add_argument("--minutes", type=float, default=10.0, help="of processor time for each target")
    p.add_argument("--targets", default=",".join(TARGETS), help="with commas between")
    p.add_argument("--seed", type=int, help="of the mutations; default: another one each time, which is printed")
    p.add_argument("--engine", choices=ENGINES, default=ENGINES[0] if _has_atheris() else ENGINES[1])
    p.add_argument("--one", choices=tuple(TARGETS), help="run this one here")
    a = p.parse_args(arguments)
    seed = a.seed if a.seed is not None else random.SystemRandom().randrange(2**31)
    if a.one:
        return (
            _guided(a.one, 60.0 * a.minutes, seed) if a.engine == ENGINES[0] else _blind(a.one, 60.0 * a.minutes, seed)
        )
    unknown = sorted(set(a.targets.split(",")) - set(TARGETS))
    if unknown:
        p.error(f"--targets: found {', '.join(unknown)}, expected some of {', '.join(TARGETS)}")
    results = {}
    for name in a.targets.split(","):
        results[name] = _in_own_process(name, a.minutes, seed, a.engine)
        print(json.dumps({name: results[name]}), flush=True)
    OUT.mkdir(parents=True, exist_ok=True)
    (OUT / "fuzz.json").write_text(json.dumps(results, indent=2) + "\n")
    failed = [name for name, r in results.items() if r["exit"]]
    for name in failed:
        print(f"to keep what broke it: mkdir -p {CORPUS / name} && cp {OUT / name}/crash-* {CORPUS / name}/")
    return 1 if failed else 0


def _in_own_process(name: str, minutes: float, seed: int, engine: str) -> dict[str, object]:
    begun = time.monotonic()
    words = ["--one", name, "--minutes", str(minutes), "--seed", str(seed), "--engine", engine]
    done = subprocess.run(
        [sys.executable, "-m", "ceilvo.bench.fuzz", *words],
        capture_output=True, text=True, errors="replace", check=False, env=os.environ | dict.fromkeys(THREADS, "1"),
    )  # fmt: skip
    lines = (done.stdout + done.stderr).splitlines()
    runs = [line for line in lines if "Done " in line or line.startswith("runs ")]
    return {
        "engine": engine,
        "seed": seed,
        "exit": done.returncode,
        "seconds": round(time.monotonic() - begun, 1),
        "runs": runs[-1].strip() if runs else "",
        "end": "" if done.returncode == 0 else "\n".join(lines[-20:]),
    }


def _has_atheris() -> bool:
    try:
        import atheris  # noqa: F401
    except ImportError:
        return False
    return True


def _blind(name: str, seconds: float, seed: int) -> int:
    result = campaign(name, seconds, seed)
    print(f"runs {result.runs}, {result.read} of them read, {result.failures} failures", flush=True)
    if result.problems:
        print(result.text, flush=True)
    return 1 if result.problems else 0


def _guided(name: str, seconds: float, seed: int) -> int:
    """By coverage; ends at the first input that breaks the target, which atheris writes to the target's folder."""
    import atheris

    corpus = OUT / name
    corpus.mkdir(parents=True, exist_ok=True)
    for data in (*seeds(name), *(p.read_bytes() for p in kept(name))):
        (corpus / hashlib.sha256(data).hexdigest()[:16]).write_bytes(data)
    for loaded in [m for m in sys.modules if m.split(".")[0] in ("ceilvo", "yaml", "mcap")]:
        del sys.modules[loaded]  # imported again below, with counters for what was reached
    with atheris.instrument_imports(include=["ceilvo", "yaml", "mcap"]):
        bounds = importlib.import_module("ceilvo.bench.fuzz.engine.bounds")
        target = importlib.import_module("ceilvo.bench.fuzz.registry").TARGETS[name]

    def one(data: bytes) -> None:
        problem, _ = bounds.problem_of(target.read, data)
        if problem:
            raise AssertionError(problem)

    def mutate(data: bytes, most: int, number: int) -> bytes:
        rng = random.Random(number)
        made: bytes = atheris.Mutate(data, most) if rng.random() < 0.5 else target.mutate(data, rng)
        return made[:most]

    flags = [f"-max_total_time={round(seconds)}", f"-max_len={_MAX_BYTES}", f"-artifact_prefix={corpus}/"]
    flags += ["-rss_limit_mb=4096", f"-seed={seed % 2**31 or 1}"]
    atheris.Setup([name, *flags, str(corpus)], one, custom_mutator=mutate)
    with bounds.quiet():
        atheris.Fuzz()
    return 0
