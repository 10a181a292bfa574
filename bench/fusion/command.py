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
from ceilvo.bench.results.paired import Difference, difference
from ceilvo.bench.results.store import Result, Store, exit_code, fingerprint, run_all
from ceilvo.tasks.workers import Workers

FIRST_FIGURE_SEED = 1000
"""Lower ones are for tuning."""
_NO_FIGURES = ("command.py", "motion.py")
"""Sources that a drive's figures do not depend on."""


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
    sources = [f for f in sorted(Path(__file__).parent.glob("*.py")) if f.name not in _NO_FIGURES]
    files = [f.relative_to(f.parents[1]).as_posix() for f in sources]
    store = Store(a.out / "fusion.jsonl", fingerprint(files), from_key)
    seeds = range(a.first, a.first + a.seeds)
    starts = alike(a.conditions)
    cases = [Case(o, names, s) for s in seeds for names in starts for o in a.outfits]
    run_all(store, cases, as_key, run_case, Workers(a.jobs))
    for names in starts:
        for condition in names:
            found = {o: [store.results[Case(o, names, s)][condition] for s in seeds] for o in a.outfits}
            Console(width=140).print(_table(condition, found))
    for names in starts:
        for condition in names:
            found = {o: [store.results[Case(o, names, s)][condition] for s in seeds] for o in a.outfits}
            Console(width=140).print(_compared(condition, found))


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


def _compared(condition: str, found: dict[str, list[Result]]) -> Table:
    """What a sense more changes, seed by seed, with standard errors."""
    out = Table("sense", "added to", "error, factor", "deg, factor", "usable s", "wrong s", "", title=condition)
    for more, less in pairs_of(list(found)):
        (sense,) = set(OUTFITS[more]) - set(OUTFITS[less])
        ratios = [_logarithms(found, more, less, name) for name in ("rms_m", "rms_rad")]
        usable, wrong = (_difference(found, more, less, name) for name in ("claimed_s", "wrong_s"))
        clear = [-ratios[0].clear, -ratios[1].clear, usable.clear, -wrong.clear]
        verdict = ("helps" if 1 in clear else "") + (" and " if {1, -1} <= set(clear) else "")
        verdict += "hurts" if -1 in clear else ""
        factors = [f"{np.exp(r.mean):.3f} ± {np.exp(r.mean) * r.error:.3f}" for r in ratios]
        out.add_row(sense, less, *factors, str(usable), str(wrong), verdict or "as without")
    return out


def pairs_of(outfits: Sequence[str]) -> list[tuple[str, str]]:
    """Outfits of which the first has one sense more than the second, and all of its."""
    worn = {o: set(OUTFITS[o]) for o in outfits}
    return [(a, b) for a in outfits for b in outfits if worn[b] < worn[a] and len(worn[a]) == len(worn[b]) + 1]


def _difference(found: dict[str, list[Result]], more: str, less: str, name: str) -> Difference:
    return difference(*(np.array([r[name] for r in found[o]]) for o in (more, less)))


def _logarithms(found: dict[str, list[Result]], more: str, less: str, name: str) -> Difference:
    return difference(*(np.log([r[name] for r in found[o]]) for o in (more, less)))
