"""The paper's section 3 with its rivals: `make bench-paper`.

Runs are stored one by one in build/bench/paper.jsonl; what is there is not run again unless the code changed.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table

from ceilvo.bench.paper import plots as plots_paper
from ceilvo.bench.paper import tables
from ceilvo.bench.paper.filters import ABOUT, WITHOUT_PARTICLES, settings
from ceilvo.bench.paper.run import EXPERIMENTS, MAPPED, START_SIGMA, Cell, as_key, run
from ceilvo.bench.paper.stats import Interval
from ceilvo.bench.paper.world import (
    DT_S,
    FEATURE_JITTER_M,
    FEATURE_MARGIN_M,
    INSET_M,
    KIDNAP_M,
    LAMP_FRACTION,
    LAP_STEPS,
    ROOM_M,
    SETTINGS,
    SPEED_M_S,
    TILE_M,
    VENT_FRACTION,
    VIEW_M,
)
from ceilvo.bench.results.bars import Bar, as_json
from ceilvo.bench.results.bars import table as bar_table
from ceilvo.bench.results.store import Store, exit_code, fingerprint, run_all
from ceilvo.errors import ConfigError
from ceilvo.files import write_atomic
from ceilvo.json_values import json_value
from ceilvo.tasks.workers import Workers, add_options

PARTICLES = (20, 50, 100, 200, 500)
"""Numbers of particles on the axes of figures 6 to 9; chosen, the paper's text names none."""
FILES = ("paper/world.py", "paper/filters.py", "paper/ekf.py", "paper/run.py")
_WIDTH = 200  # characters of a table that goes to a file; chosen: the widest fits


@dataclass(frozen=True)
class Plan:
    """What is run of an experiment: settings, filters, particle numbers (None = those asked for), most seeds."""

    settings: tuple[str, ...]
    filters: tuple[str, ...]
    particles: tuple[int, ...] | None
    seeds: int


PLANS = {
    "lap": Plan(("P", "S0", "S1"), tables.RIVALS, None, 10**6),
    "laps3": Plan(("P",), tables.RIVALS, (100,), 40),
    "slips": Plan(("Y", "YN", "O", "L", "F"), tables.RIVALS, (100,), 40),
    "grid": Plan(("P", "S1"), ("ukf_gated", "pf", "pfcf_paper", "joint", "ekf_nn"), (200,), 40),
    "kidnap": Plan(("P",), ("ukf_gated", "pf", "pfcf_paper", "joint", "ekf_nn"), (200,), 40),
    "global": Plan(("P",), ("ukf_gated", "pf", "pfcf_paper", "joint"), (500,), 60),
}
"""Particles and most seeds are chosen for the time of a run; the bars of tables.py count of 40 and 60 seeds."""


def main(arguments: Sequence[str] | None = None) -> int:
    """0 whether or not the bars are met: they are in the tables and in the JSON."""
    args = parser().parse_args(arguments)
    return exit_code("paper", lambda: report(args, measured(args, chosen(args))))


def parser() -> argparse.ArgumentParser:
    p = argparse.ArgumentParser(prog="python -m ceilvo.bench.paper", description="The paper's experiment, with rivals.")
    p.add_argument("--seeds", type=int, default=100, metavar="N", help="paired seeds (100); recoveries use 40 or 60")
    p.add_argument("--first-seed", type=int, default=1000, metavar="N")
    p.add_argument("--experiments", default=",".join(EXPERIMENTS), metavar="A,B", help="default: %(default)s")
    p.add_argument("--settings", default=",".join(SETTINGS), metavar="A,B", help="default: %(default)s")
    p.add_argument("--filters", default=",".join(ABOUT), metavar="A,B", help="default: %(default)s")
    p.add_argument("--particles", default=",".join(map(str, PARTICLES)), metavar="N,N", help="default: %(default)s")
    add_options(p)
    p.add_argument("--json", type=Path, default=Path("build/bench/paper.json"), metavar="FILE")
    p.add_argument("--pictures", type=Path, default=Path("build/bench/paper"), metavar="DIR")
    p.add_argument("--no-pictures", action="store_true")
    return p


def chosen(args: argparse.Namespace) -> list[Cell]:
    """The cells to run, seeds outermost, so that an interrupted bench has all filters of the seeds it has."""
    experiments = _names(args.experiments, EXPERIMENTS, "experiments")
    worlds = _names(args.settings, SETTINGS, "settings")
    filters = _names(args.filters, ABOUT, "filters")
    cells = []
    for experiment in experiments:
        plan = PLANS[experiment]
        for seed in range(args.first_seed, args.first_seed + min(args.seeds, plan.seeds)):
            for world in (w for w in plan.settings if w in worlds):
                for name in (f for f in plan.filters if f in filters):
                    counts = plan.particles or _numbers(args.particles)
                    for n in (0,) if name in WITHOUT_PARTICLES else counts:
                        cells.append(Cell(experiment, world, name, n, seed))
    return cells


def _names(text: str, known: Sequence[str] | dict[str, Any], option: str) -> list[str]:
    for name in text.split(","):
        if name not in known:
            raise ConfigError(f"--{option}: no '{name}'; known are {', '.join(known)}")
    return text.split(",")


def _numbers(text: str) -> tuple[int, ...]:
    try:
        out = tuple(int(x) for x in text.split(","))
    except ValueError:
        raise ConfigError(f"--particles: found '{text}', expected whole numbers separated by commas") from None
    if min(out) < 10:
        raise ConfigError(f"--particles: found {min(out)}, expected at least 10")
    return out


def measured(args: argparse.Namespace, cells: list[Cell]) -> tables.Results:
    store = Store(args.json.with_suffix(".jsonl"), fingerprint(FILES), lambda k: Cell(**k))
    run_all(store, cells, as_key, run, Workers.of(args))
    return {c: store.results[c] for c in cells}


def report(args: argparse.Namespace, results: tables.Results) -> None:
    console = Console(width=None if sys.stdout.isatty() else _WIDTH)
    stated = all_settings(args)
    console.print("Settings", style="bold")
    console.print_json(json.dumps(stated), indent=1)
    bars = [*tables.ratio_bars(results), *tables.nees_bars(results), *tables.other_bars(results)]
    for table in printed(results):
        console.print(table)
    console.print(bar_table(bars, "What it must show"))
    for line in tables.verdicts(results):
        console.print(line, highlight=False, soft_wrap=True)
    out = {**as_document(results), "settings": stated, "bars": as_json(bars), "text": tables.verdicts(results)}
    args.json.parent.mkdir(parents=True, exist_ok=True)
    write_atomic(args.json, json.dumps(json_value(out), indent=1) + "\n")
    console.print(summary(bars))
    if not args.no_pictures:
        for path in plots_paper.draw(results, args.pictures, args.first_seed):
            console.print(f"picture {path}")
    console.print(f"figures in {args.json}")


def summary(bars: list[Bar]) -> str:
    return f"{sum(b.met for b in bars)} of {len(bars)} bars met"


def all_settings(args: argparse.Namespace) -> dict[str, Any]:
    """Everything that decides the figures."""
    return {
        "world": {
            "room_m": ROOM_M,
            "inset_m": INSET_M,
            "speed_m_s": SPEED_M_S,
            "dt_s": DT_S,
            "steps_per_lap": LAP_STEPS,
            "view_m": VIEW_M,
            "feature_margin_m": FEATURE_MARGIN_M,
            "feature_jitter_m": FEATURE_JITTER_M,
            "tile_m": TILE_M,
            "lamp_share": LAMP_FRACTION,
            "vent_share": VENT_FRACTION,
            "kidnap_m": KIDNAP_M,
            "start_sigma": list(START_SIGMA),
        },
        "noise": {name: asdict(s) for name, s in SETTINGS.items()},
        "plans": {name: asdict(plan) for name, plan in PLANS.items()},
        "seeds": args.seeds,
        "first_seed": args.first_seed,
        "filters": {
            name: {
                "about": about,
                "labelled": asdict(settings(name, 100, SETTINGS["P"], False)),
                "unlabelled": asdict(settings(name, 100, SETTINGS["P"], True)),
            }
            for name, about in ABOUT.items()
        },
    }


def printed(results: tables.Results) -> list[Table]:
    out = []
    for experiment, setting in dict.fromkeys((c.experiment, c.setting) for c in results):
        if experiment in MAPPED:
            out.append(_table1(results, experiment, setting))
    grid = tables.grid_rows(results)
    if grid:
        t = Table(
            "setting", "filter", "runs", "failed", "position m", "/ EKF-NN", title="Unlabelled 0.6 m grid, mapped"
        )
        for r in grid:
            t.add_row(
                r["setting"], r["filter"], str(r["runs"]), str(r["failures"]), str(r["position"]), str(r["to_ekf"])
            )
        out.append(t)
    out.append(_health(tables.health_rows(results)))
    for experiment, seconds in tables.RECOVERY_S.items():
        rows = tables.recovery_rows(results, experiment)
        if rows:
            out.append(_recovery(rows, f"{experiment}: known unlabelled grid with kinds, within {seconds:g} s"))
    return out


def _table1(results: tables.Results, experiment: str, setting: str) -> Table:
    laps = "three laps" if experiment == "laps3" else "one lap"
    heads = (
        "position m",
        "feature m",
        "pos / pf",
        "feat / pf",
        "pos / ukf",
        "feat / ukf",
        "pos / gated",
        "feat / gated",
    )
    t = Table(
        "filter", *heads, "NEES pos\nmedian mean", "NEES feat\nmean", "paper", title=f"Table 1, {setting}, {laps}"
    )
    figures = ("position", "feature", "position_to_pf", "feature_to_pf", "position_to_ukf", "feature_to_ukf")
    for r in tables.table1(results, experiment, setting):
        paper = "-" if r["paper"] is None or setting != "P" else " / ".join(f"{x:.3f}" for x in r["paper"])
        t.add_row(
            r["filter"],
            *(_short(r[k]) for k in (*figures, "position_to_gated", "feature_to_gated")),
            f"{r['nees_position_median']:.2f} {r['nees_position_mean']:.2f}",
            f"{r['nees_feature_mean']:.1f}",
            paper,
        )
    return t


def _short(i: Interval) -> str:
    return "-" if i.value != i.value else f"{i.value:.3f}\n[{i.low:.3f} {i.high:.3f}]"


def _health(rows: list[dict[str, Any]]) -> Table:
    """The counters that say something; all of them are in the JSON."""
    health = ("ess_share", "ancestors_share", "fit_residual", "nis", "nis_in_bounds", "mode_weight")
    counts = ("observations", "outliers", "rejected_updates", "slips", "searches", "recoveries", "tile_slips")
    heads = (*(n.replace("_", "\n") for n in health), *(n.replace("_", "\n") for n in counts))
    t = Table("experiment", "filter", *heads, title="Health with every estimate, and counters: means over runs")
    for r in rows:
        cells = (f"{r[k]:.3f}" if k in r else "-" for k in (f"health_{n}" for n in health))
        counted = (f"{r[k]:.1f}" if k in r else "-" for k in (f"count_{n}" for n in counts))
        t.add_row(f"{r['experiment']} {r['setting']}", r["filter"], *cells, *counted)
    return t


def _recovery(rows: list[dict[str, Any]], title: str) -> Table:
    t = Table("filter", "recovered", "median s", "longest wrong\nTRACKING s", "runs > 1 s", title=title)
    for r in rows:
        of = f"{r['recovered']} of {r['runs']}"
        wrong = f"{r['wrong_tracking_max_s']:.1f}"
        t.add_row(r["filter"], of, f"{r['median_s']:.1f}", wrong, str(r["wrong_tracking_runs"]))
    return t


def as_document(results: tables.Results) -> dict[str, Any]:
    """All printed tables, and errors against N."""

    def bare(row: dict[str, Any]) -> dict[str, Any]:
        return {k: asdict(v) if isinstance(v, Interval) else v for k, v in row.items()}

    laps = dict.fromkeys((c.experiment, c.setting) for c in results if c.experiment in MAPPED)
    return {
        "table1": {f"{e} {s}": [bare(r) for r in tables.table1(results, e, s)] for e, s in laps},
        "against_n": plots_paper.against_n(results),
        "grid": [bare(r) for r in tables.grid_rows(results)],
        "health": tables.health_rows(results),
        "recovery": {e: tables.recovery_rows(results, e) for e in tables.RECOVERY_S},
    }
