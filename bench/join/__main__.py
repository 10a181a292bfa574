"""python -m ceilvo.bench.join: pairs of maps in frames of their own: with overlap, without, and on perfect rasters.

Every map is of a part of a hall: landmarks are missing, false, noisy, and the whole is bent as by a calibration that is
off. Example: python -m ceilvo.bench.join --pairs 50 --seed 1000
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path

import numpy as np

from ceilvo.bench.join.pairs import KINDS, Case, Outcome, outcome
from ceilvo.bench.results.store import one_thread
from ceilvo.files import write_atomic
from ceilvo.tasks.workers import Workers, add_options, each, progress


def main(arguments: Sequence[str] | None = None) -> int:
    """0 where no pair was joined wrongly."""
    parser = argparse.ArgumentParser(prog="python -m ceilvo.bench.join", description=__doc__)
    parser.add_argument("--pairs", type=int, default=50, help="of each kind")
    parser.add_argument("--seed", type=int, default=1000, help="0 to 999 for tuning, 1000 and more for figures")
    parser.add_argument("--kinds", default=",".join(KINDS), help="default: %(default)s")
    parser.add_argument("--overlap", type=float, default=0.15, help="share of each map that the other has, too")
    parser.add_argument("--out", type=Path, default=Path("build/bench/join.json"))
    add_options(parser)
    a = parser.parse_args(arguments)
    one_thread()
    kinds = a.kinds.split(",")
    cases = [Case(kind, a.seed + k, a.overlap) for k in range(a.pairs) for kind in kinds]
    tick, began = progress("pairs", len(cases)), time.monotonic()
    done: dict[int, Outcome] = {}
    for k, found in each(outcome, cases, Workers.of(a)):
        done[k] = found
        tick()
        c = cases[k]
        print(f"{c.kind} {c.seed}: {found.verdict} {found.things} {found.false_alarm:.1e} {found.why}", flush=True)
    wrong = 0
    print("| pairs | right | refused | joined wrongly | false alarm stated, median and most where right | s a pair |")
    print("|---|---|---|---|---|---|")
    for kind in kinds:
        own = [done[k] for k, c in enumerate(cases) if c.kind == kind]
        counts = [sum(o.verdict == v for o in own) for v in ("right", "refused", "wrong")]
        wrong += counts[2]
        alarms = [o.false_alarm for o in own if o.verdict == "right"]
        told = f"{np.median(alarms):.1e}, {np.max(alarms):.1e}" if alarms else ""
        print(
            f"| {KINDS[kind]} | {' | '.join(map(str, counts))} | {told} | {np.median([o.seconds for o in own]):.1f} |"
        )
    print(f"{len(cases)} pairs in {time.monotonic() - began:.0f} s")
    a.out.parent.mkdir(parents=True, exist_ok=True)
    rows = [asdict(c) | asdict(done[k]) for k, c in enumerate(cases)]
    write_atomic(a.out, json.dumps(rows, indent=1) + "\n")
    return 1 if wrong else 0


if __name__ == "__main__":
    raise SystemExit(main())
