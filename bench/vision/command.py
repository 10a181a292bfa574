"""The vision bench: every condition of vision_conditions on exact truth, as a table, JSON and a picture each.

python -m ceilvo.bench.vision [--conditions base,tilt] [--quick] [--seed 61]
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import os
import queue
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn
from rich.table import Table

from ceilvo.bench.data import data_path
from ceilvo.bench.results.bars import as_json as bars_as_json
from ceilvo.bench.results.bars import table as bar_table
from ceilvo.bench.vision.comparisons import compared
from ceilvo.bench.vision.condition import Condition
from ceilvo.bench.vision.conditions import conditions
from ceilvo.bench.vision.drawn import drawn, named
from ceilvo.bench.vision.run import Options, run
from ceilvo.bench.vision.textures import OFFICE_TEXTURE, PICTURED
from ceilvo.config import Config
from ceilvo.config.arguments import from_up
from ceilvo.config.reader import replace as replace_keys
from ceilvo.errors import CeilvoError, ConfigError
from ceilvo.files import write_atomic
from ceilvo.json_values import json_value
from ceilvo.sim.world import WorldSpec

QUICK_S = 6.0  # docs/bench.md (QUICK=1)
_REPORT_EVERY = 15  # frames; chosen: twice a second of world time at 30 Hz
_TABLE_WIDTH = 340  # characters of a table that goes to a file; chosen: all columns fit
COLUMNS: tuple[tuple[str, tuple[tuple[str, str], ...]], ...] = (
    ("recall %\nall grid", (("recall_pct", ".1f"), ("recall_grid_pct", ".1f"))),
    ("precis.\n%", (("precision_pct", ".2f"),)),
    ("cross.\nmed px", (("crossing_median_px", ".3f"),)),
    ("cross.\np95 px", (("crossing_p95_px", ".3f"),)),
    ("motion\nmed mm", (("motion_median_mm", ".3f"),)),
    ("motion\np95 mm", (("motion_p95_mm", ".3f"),)),
    ("turn med\nmdeg", (("motion_median_mdeg", ".2f"),)),
    ("worst\nmm", (("worst_mm", ".1f"),)),
    ("drift\n% path", (("drift_pct", ".3f"),)),
    ("heading\ndeg", (("heading_deg", ".3f"),)),
    ("NEES/3\nmean med", (("nees_mean", ".2f"), ("nees_median", ".2f"))),
    ("failed\nrestart", (("failed", ".0f"), ("restarts", ".0f"))),
    ("wrong\n> 20 mm", (("wrong", ".0f"),)),
    ("TRACKING\n% worst mm", (("tracking_pct", ".0f"), ("tracking_worst_mm", ".1f"))),
    ("usable\n% worst mm", (("usable_pct", ".0f"), ("usable_worst_mm", ".1f"))),
    ("2 points\n% of way", (("two_points_way_pct", ".0f"),)),
    ("usable\n% of that", (("usable_way_pct", ".1f"),)),
    ("wrong\npose s", (("wrong_pose_s", ".2f"),)),
    ("> 3 sigma\n% NEES/2", (("beyond_3_sigma_pct", ".1f"), ("pose_nees", ".2f"))),
    ("gaps\nNEES/3", (("gaps", ".0f"), ("gap_nees", ".2f"))),
    ("time/Canny\nmed p99", (("time_median", ".2f"), ("time_p99", ".2f"))),
    ("edges lines\ncross. odom.", tuple((f"time_{s}", ".1f") for s in ("edges", "lines", "crossings", "odometry"))),
    ("KLT\n% time", (("klt_drift_pct", ".2f"), ("klt_time", ".1f"))),
    ("ORB\n% time", (("orb_drift_pct", ".2f"), ("orb_time", ".1f"))),
)

_EXAMPLE = "example: python -m ceilvo.bench.vision --conditions base,two-lamps --seed 61"

_frames_done: Any = None


def main(arguments: Sequence[str] | None = None) -> int:
    """0 whether or not the bars are met: they are in the table and in the JSON."""
    args = _parser().parse_args(arguments)
    try:
        chosen = [drawn(args.seed, k) for k in range(args.drawn)] or _chosen(args.conditions, args.seed)
        seconds = args.seconds if args.seconds is not None else (QUICK_S if args.quick else None)
        replace_keys(Config(), args.set)  # a typing mistake is told before anything runs
        results = _run_all(chosen, Options(seconds, args.pictures, not args.no_baselines, tuple(args.set)), args.jobs)
        console = Console(width=None if sys.stdout.isatty() else _TABLE_WIDTH)
        if args.drawn:
            console.print("\n".join(f"{c.name}: {c.about}" for c in chosen))
        console.print(table(chosen, results))
        if ratios := compared(chosen, results):
            console.print(bar_table(ratios, "Ratios to a twin (both)"))
        console.print(_verdict(chosen, results))
        if args.json is not None:
            args.json.parent.mkdir(parents=True, exist_ok=True)
            write_atomic(args.json, json.dumps(as_json(chosen, results, seconds), indent=1) + "\n")
            console.print(f"figures in {args.json}, pictures in {args.pictures}")
    except CeilvoError as e:
        print(f"bench.vision: {e}", file=sys.stderr)
        return e.exit_code
    return 0


def _parser() -> argparse.ArgumentParser:
    p = argparse.ArgumentParser(
        prog="python -m ceilvo.bench.vision", description="Front end against exact truth.", epilog=_EXAMPLE
    )
    p.add_argument("--conditions", metavar="A,B", help="names, separated by commas (default: all)")
    p.add_argument(
        "--drawn",
        type=from_up(1),
        default=0,
        metavar="N",
        help="instead, N conditions drawn at random by the seed; drawn-3 names one of them",
    )
    p.add_argument("--quick", action="store_true", help=f"{QUICK_S:g} s of each condition instead of a lap")
    p.add_argument("--seconds", type=float, metavar="S", help="world time of each condition instead of a lap")
    p.add_argument(
        "--seed",
        type=from_up(0),
        default=WorldSpec().seed,
        metavar="N",
        help="draws ceiling, noise and rocking of every condition (default: %(default)s)",
    )
    p.add_argument(
        "--jobs", type=int, default=1, metavar="N", help="conditions at once; more than 1 disturbs the times"
    )
    p.add_argument("--json", type=Path, default=Path("build/bench/vision.json"), metavar="FILE")
    p.add_argument("--pictures", type=Path, default=Path("build/bench/vision"), metavar="DIR")
    p.add_argument(
        "--set", action="append", default=[], metavar="SECTION.KEY=VALUE", help="override one key; may be repeated"
    )
    p.add_argument("--no-baselines", action="store_true", help="leave KLT and ORB out")
    return p


def _chosen(names: str | None, seed: int) -> list[Condition]:
    known = {c.name: c.with_seed(seed) for c in conditions()}
    if names is None:
        return list(known.values())
    for name in names.split(","):
        if name == PICTURED and name not in known:
            raise ConfigError(f"condition: {name} needs {data_path(OFFICE_TEXTURE)}, found nothing; set CEILVO_DATA")
        if drawn_one := named(name, seed):
            known[name] = drawn_one
        if name not in known:
            raise ConfigError(f"condition: no '{name}'; known are {', '.join(known)}")
    return [known[name] for name in names.split(",")]


def _run_all(chosen: list[Condition], options: Options, jobs: int) -> list[dict[str, float]]:
    """Each condition in a process of its own, so that thread counts hold for it from the start."""
    for variable in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
        os.environ[variable] = "1"
    spawn = multiprocessing.get_context("spawn")
    done = spawn.Queue()
    totals = [int((options.seconds or c.lap_s) * c.fps) for c in chosen]
    bars = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with (
        Progress(*bars, console=Console(stderr=True)) as progress,
        spawn.Pool(jobs, _hear, (done,), maxtasksperchild=1) as pool,
    ):
        task = progress.add_task("frames", total=sum(totals))
        running = [pool.apply_async(_job, (c, options)) for c in chosen]
        while not all(r.ready() for r in running):
            try:
                name, frames = done.get(timeout=0.2)
            except queue.Empty:
                continue
            progress.update(task, advance=frames, description=f"{name:16}")
        return [r.get() for r in running]


def _hear(done: Any) -> None:
    global _frames_done
    _frames_done = done


def _job(condition: Condition, options: Options) -> dict[str, float]:
    count = 0

    def progress(frames: int) -> None:
        nonlocal count
        count += frames
        if count % _REPORT_EVERY == 0:
            _frames_done.put((condition.name, _REPORT_EVERY))

    return run(condition, options, progress)


def table(chosen: list[Condition], results: list[dict[str, float]]) -> Table:
    """Figures with their bars, PASS or MISS below those that have one."""
    out = Table("condition", title=f"Vision bench, seed {chosen[0].spec.seed}", show_lines=True)
    for heading, _ in COLUMNS:
        out.add_column(heading, justify="right")
    for condition, figures in zip(chosen, results, strict=True):
        out.add_row(condition.name, *(_cell(condition, figures, parts) for _, parts in COLUMNS))
    return out


def _cell(condition: Condition, figures: dict[str, float], parts: tuple[tuple[str, str], ...]) -> str:
    values = " ".join(f"{figures[name]:{form}}" if name in figures else "-" for name, form in parts)
    rows = [values]
    for name, _ in parts:
        bar = condition.bars.get(name)
        if bar is not None and name in figures:
            met = bar.met(figures[name])
            rows.append(f"[{'green' if met else 'bold red'}]{bar.sense}{bar.value:g} {'PASS' if met else 'MISS'}[/]")
    return "\n".join(rows)


def _verdict(chosen: list[Condition], results: list[dict[str, float]]) -> str:
    ratios = compared(chosen, results)
    missed = [
        f"  {c.name}: {name} {figures[name]:.4g}, bar {bar.sense} {bar.value:g}"
        for c, figures in zip(chosen, results, strict=True)
        for name, bar in c.bars.items()
        if name in figures and not bar.met(figures[name])
    ]
    missed += [f"  {r.name}: {r.text}, bar {r.wanted}" for r in ratios if not r.met]
    count = len(ratios) + sum(name in figures for c, figures in zip(chosen, results, strict=True) for name in c.bars)
    return "\n".join([f"{count - len(missed)} of {count} bars met", *missed])


def as_json(chosen: list[Condition], results: list[dict[str, float]], seconds: float | None) -> dict[str, Any]:
    """null stands for what is not a number."""
    return {
        "seconds": seconds,
        "conditions": {
            c.name: {
                "about": c.about,
                "seed": c.spec.seed,
                "figures": json_value(figures),
                "bars": {
                    k: {"sense": b.sense, "value": b.value, "pass": b.met(figures[k])}
                    for k, b in c.bars.items()
                    if k in figures
                },
            }
            for c, figures in zip(chosen, results, strict=True)
        },
        "ratios": json_value(bars_as_json(compared(chosen, results))),
    }
