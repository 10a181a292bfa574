"""Does the robot know its place, whatever happens to it? Rooms and halls, and faults, through the daemon's own path.

Seeds 0 to 999 are for tuning, 1000 and more for figures that are reported: those are never tuned on.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from rich.console import Console

from ceilvo.bench.place import tables
from ceilvo.bench.place.case import SIZES, as_key, cases, from_key, run_case
from ceilvo.bench.place.changes import KINDS
from ceilvo.bench.results import bars as bars_module
from ceilvo.bench.results.store import Store, exit_code, fingerprint, one_thread, run_all
from ceilvo.errors import CeilvoError
from ceilvo.files import write_atomic

_FILES = tuple(
    f"place/{name}.py"
    for name in ("case", "changes", "drive", "eye", "faults", "robot", "sights", "tally", "truth", "worlds")
)
"""Whose change makes earlier results void."""
_OUT = Path("build/bench/place")
_SHOWN = 10
"""Worst cases that are told one by one; chosen."""


def main(arguments: Sequence[str] | None = None) -> int:
    p = argparse.ArgumentParser(prog="place", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    commands = p.add_subparsers(dest="command", required=True)
    faults = _command(commands, "faults", "faults of all kinds, one after the other", count=300)
    faults.add_argument("--kinds", default=",".join(KINDS), help="comma-separated; all: " + ", ".join(KINDS))
    check = commands.add_parser("eye-check", help="the synthetic eye against rendered frames")
    check.add_argument("--seed", type=int, default=3)
    check.add_argument("--frames", type=int, default=500)
    a = p.parse_args(arguments)
    one_thread()
    return exit_code("place", lambda: _WORK[a.command](a))


def _command(commands: Any, name: str, about: str, count: int) -> argparse.ArgumentParser:
    p: argparse.ArgumentParser = commands.add_parser(name, help=about, description=about)
    p.add_argument("--count", type=int, default=count)
    p.add_argument("--seed", type=int, default=0, help="0 to 999 for tuning, 1000 and more for figures")
    p.add_argument(
        "--rooms", default=",".join(SIZES), help="comma-separated sides of rooms in m, of " + ", ".join(SIZES)
    )
    p.add_argument("--jobs", type=int, default=1)
    p.add_argument(
        "--out", type=Path, default=None, help=f"default {_OUT}/{name}.json; single cases beside it in .jsonl"
    )
    p.add_argument("--resume", action="store_true", help="go on where the file ends, with the same code")
    return p


def _faults(a: argparse.Namespace) -> None:
    kinds = _chosen(a.kinds, tuple(KINDS), "--kinds")
    sizes = _chosen(a.rooms, SIZES, "--rooms")
    out = a.out or _OUT / "faults.json"
    lines = out.with_suffix(".jsonl")
    if not a.resume:
        lines.unlink(missing_ok=True)
    store = Store(lines, fingerprint(_FILES), from_key)
    todo = cases(kinds, a.count, a.seed, sizes)
    run_all(store, todo, as_key, run_case, a.jobs)
    results = [store.results[c] for c in todo]
    bars = tables.fault_bars(results)
    summary = {"seed": a.seed, "bars": bars_module.as_json(bars), "cases": results}
    write_atomic(out, json.dumps(summary, indent=1) + "\n")
    console = Console(width=200)
    console.print(tables.table(results))
    for r in tables.worst_cases(results, tables.wrong_of, _SHOWN):
        console.print(_told(r), soft_wrap=True)
    console.print(bars_module.table(bars, f"faults, seed {a.seed}"))


def _told(r: dict[str, Any]) -> str:
    about = {k: r[k] for k in ("size", "tile_m", "lamps", "wheels", "map", "eye", "rate_hz", "seed", "number")}
    return f"{r['kind']} {about}: wrong {r['fault']['wrong_s']}\n    " + "; ".join(r["fault"]["reasons"][:6])


def _chosen(text: str, known: tuple[str, ...], option: str) -> tuple[str, ...]:
    names = tuple(name.strip() for name in text.split(","))
    unknown = [name for name in names if name not in known]
    if unknown:
        raise CeilvoError(f"{option}: {', '.join(unknown)} is not known; expected some of {', '.join(known)}")
    return names


def _eye_check(a: argparse.Namespace) -> None:
    from ceilvo.bench.place.eye_check import compare

    real, synthetic = compare(a.seed, a.frames)
    for name, value in real.items():
        print(f"{name:45s} real {value:9.3f}   synthetic {synthetic.get(name, float('nan')):9.3f}")


_WORK = {"faults": _faults, "eye-check": _eye_check}
