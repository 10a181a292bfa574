"""What does each sense give, and does any hurt?

python -m ceilvo.bench.fusion --seeds 4            figures of seeds 1000, 1001, ...; resumable
python -m ceilvo.bench.fusion --first 0            seeds for tuning, apart from those of figures
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.table import Table

from ceilvo.bench.fusion.conditions import CONDITIONS
from ceilvo.bench.fusion.run import Case, alike, as_key, from_key, run_case
from ceilvo.bench.fusion.senses import OUTFITS
from ceilvo.bench.results.store import Result, Store, exit_code, fingerprint, run_all
from ceilvo.tasks.workers import Workers

FIRST_FIGURE_SEED = 1000
"""Lower ones are for tuning."""


def main(arguments: Sequence[str] | None = None) -> int:
    p = argparse.ArgumentParser(
        prog="fusion", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    p.add_argument("--seeds", type=int, default=4, help="drives of each outfit under each condition (%(default)s)")
    p.add_argument("--first", type=int, default=FIRST_FIGURE_SEED, help="the first of them (%(default)s)")
    p.add_argument("--outfits", nargs="*", choices=list(OUTFITS), default=list(OUTFITS))
    p.add_argument("--conditions", nargs="*", choices=list(CONDITIONS), default=list(CONDITIONS))
    p.add_argument("--jobs", type=int, default=1, help="processes (%(default)s)")
    p.add_argument("--out", type=Path, default=Path("build/bench"))
    a = p.parse_args(arguments)
    return exit_code("fusion", lambda: _run(a))


def _run(a: argparse.Namespace) -> None:
    files = [f.relative_to(f.parents[1]).as_posix() for f in sorted(Path(__file__).parent.glob("*.py"))]
    store = Store(a.out / "fusion.jsonl", fingerprint(files), from_key)
    seeds = range(a.first, a.first + a.seeds)
    starts = alike(a.conditions)
    cases = [Case(o, names, s) for s in seeds for names in starts for o in a.outfits]
    run_all(store, cases, as_key, run_case, Workers(a.jobs))
    for names in starts:
        for condition in names:
            found = {o: [store.results[Case(o, names, s)][condition] for s in seeds] for o in a.outfits}
            Console(width=140).print(_table(condition, found))


def _table(condition: str, found: dict[str, list[Result]]) -> Table:
    out = Table("outfit", "rms mm", "rms deg", "worst mm", "NEES/3", "wrong s", "usable s", "blind %", "deg", "NEES/3")
    out.title = condition
    for outfit, results in found.items():

        def mean(name: str, results: list[Result] = results) -> float:
            return float(np.mean([r[name] for r in results]))

        row = [f"{1e3 * mean('rms_m'):.1f}", f"{np.degrees(mean('rms_rad')):.3f}"]
        row += [f"{1e3 * max(r['max_m'] for r in results):.0f}", f"{mean('nees'):.2f}"]
        row += [f"{mean('wrong_s'):.2f}", f"{mean('claimed_s'):.1f}"]
        blind = [r for r in results if "blind_m" in r]
        if blind:
            share = [r["blind_m"] / max(r["blind_way_m"], 1e-3) for r in blind]
            deg = [np.degrees(r["blind_rad"]) for r in blind]
            row += [f"{100 * float(np.sqrt(np.mean(np.square(share)))):.2f}"]
            row += [
                f"{float(np.sqrt(np.mean(np.square(deg)))):.2f}",
                f"{np.mean([r['blind_nees'] for r in blind]):.2f}",
            ]
        out.add_row(outfit, *row)
    return out
