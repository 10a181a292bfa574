"""Minutes of mutated input for every reader of bytes: nothing but our own errors may come out.

python -m ceilvo.bench.fuzz --minutes 10

Guided by coverage through atheris where it is installed, else mutations of valid inputs at random. Each target runs
in a process of its own; an input that brought something else out is kept in build/fuzz/TARGET/.
"""

from __future__ import annotations

import argparse
import hashlib
import importlib
import json
import random
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path

from ceilvo.bench.fuzz.targets import TARGETS, run, seeds

_OUT = Path("build/fuzz")
_TOKENS = b'null true 1e309 -1 NaN [ ] { } : \n " !! &a *a \xff'.split(b" ")


def main(arguments: Sequence[str] | None = None) -> int:
    p = argparse.ArgumentParser(prog="fuzz", description=__doc__)
    p.add_argument("--minutes", type=float, default=10.0, help="of each target")
    p.add_argument("--targets", default=",".join(TARGETS))
    p.add_argument("--one", choices=tuple(TARGETS), help="run this one here")
    p.add_argument("--seconds", type=float, default=600.0, help="with --one")
    a = p.parse_args(arguments)
    if a.one:
        return _guided(a.one, a.seconds) if _has_atheris() else _blind(a.one, a.seconds)
    results = {}
    for name in a.targets.split(","):
        results[name] = _in_own_process(name, 60.0 * a.minutes)
        print(json.dumps({name: results[name]}), flush=True)
    _OUT.mkdir(parents=True, exist_ok=True)
    (_OUT / "fuzz.json").write_text(json.dumps(results, indent=2) + "\n")
    return 0 if all(r["exit"] == 0 for r in results.values()) else 1


def _in_own_process(name: str, seconds: float) -> dict[str, object]:
    begun = time.monotonic()
    args = [sys.executable, "-m", "ceilvo.bench.fuzz", "--one", name, "--seconds", str(seconds)]
    done = subprocess.run(args, capture_output=True, text=True, check=False)
    lines = (done.stdout + done.stderr).splitlines()
    runs = [line for line in lines if "Done " in line or line.startswith("runs ")]
    return {
        "engine": "atheris" if _has_atheris() else "random",
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


def _guided(name: str, seconds: float) -> int:
    import atheris

    corpus = _OUT / name
    corpus.mkdir(parents=True, exist_ok=True)
    for seed in seeds(name):
        (corpus / hashlib.sha256(seed).hexdigest()[:16]).write_bytes(seed)
    for loaded in [m for m in sys.modules if m.split(".")[0] in ("ceilvo", "yaml")]:
        del sys.modules[loaded]  # imported again below, with counters for what was reached
    with atheris.instrument_imports(include=["ceilvo", "yaml"]):
        fresh = importlib.import_module("ceilvo.bench.fuzz.targets")
    flags = [f"-max_total_time={round(seconds)}", "-max_len=8192", f"-artifact_prefix={corpus}/", "-rss_limit_mb=2048"]
    atheris.Setup([name, *flags, str(corpus)], lambda data: fresh.run(fresh.TARGETS[name], data))
    atheris.Fuzz()
    return 0


def _blind(name: str, seconds: float) -> int:
    rng, start, until = random.Random(1), seeds(name), time.monotonic() + seconds
    runs = 0
    while time.monotonic() < until:
        data = mutated(rng.choice(start), rng)
        try:
            run(TARGETS[name], data)
        except Exception:
            folder = _OUT / name
            folder.mkdir(parents=True, exist_ok=True)
            (folder / f"crash-{hashlib.sha256(data).hexdigest()[:16]}").write_bytes(data)
            raise
        runs += 1
    print(f"runs {runs}")
    return 0


def mutated(data: bytes, rng: random.Random) -> bytes:
    """A few bytes changed, cut, doubled or replaced by something that means something."""
    out = bytearray(data)
    for _ in range(rng.randint(1, 6)):
        at = rng.randrange(len(out) + 1)
        how = rng.randrange(5)
        if how == 0 and out:
            out[at % len(out)] = rng.randrange(256)
        elif how == 1:
            del out[at : at + rng.randint(1, 40)]
        elif how == 2:
            out[at:at] = out[at : at + rng.randint(1, 40)]
        elif how == 3:
            out[at:at] = rng.choice(_TOKENS)
        else:
            out[at : at + rng.randint(1, 8)] = rng.choice(_TOKENS)
    return bytes(out)
