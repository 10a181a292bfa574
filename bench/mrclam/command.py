"""Real robots in the UTIAS multi-robot format: `make bench-mrclam DATA=DIR`.

Noise is fitted on the training robots, everything else is measured on the test robots.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import sys
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console

from ceilvo.bench.data import data_path
from ceilvo.bench.mrclam import peers
from ceilvo.bench.mrclam import run as runs
from ceilvo.bench.mrclam.data import Run, World, read_run, read_world
from ceilvo.bench.mrclam.noise import Bias, Noise, bias_of, fit, inflated, without
from ceilvo.bench.mrclam.tables import LOCALISE, SLAM, Cell, Results, as_table, bars, trial_rows, verdicts, whole_rows
from ceilvo.bench.results.bars import as_json, table
from ceilvo.bench.results.store import Store, exit_code, fingerprint, run_all
from ceilvo.errors import ConfigError
from ceilvo.files import write_atomic
from ceilvo.json_values import json_value
from ceilvo.tasks.workers import Workers, add_options

FILES = tuple(f"mrclam/{name}.py" for name in ("data", "noise", "run", "peers", "stonesoup"))
DATASET = "mrclam/MRCLAM_Dataset6"
WHOLE = ("localise", "odometry", "slam")
TASKS = (*WHOLE, "start", "kidnap")
RECOVERING = ("ukf_gated", "pf", "pfcf_paper", "joint")
SCORE_FILTER = "ukf_gated"
_WIDTH = 160  # characters of a table that goes to a file; chosen: the widest fits


@dataclass(frozen=True)
class Job:
    """A cell with what it is run on."""

    cell: Cell
    folder: Path
    noise: Noise
    trials: int
    bias: Bias


def main(arguments: Sequence[str] | None = None) -> int:
    """0 whether or not the bars are met; without a data set it says so and is 0 too."""
    args = parser().parse_args(arguments)
    folder = args.folder or default_folder()
    if folder is None:
        print("bench.mrclam: skipped, no data set: give its folder, or set CEILVO_DATA to the folder that holds")
        print(f"  {DATASET}")
        return 0
    return exit_code("mrclam", lambda: experiment(args, folder))


def parser() -> argparse.ArgumentParser:
    p = argparse.ArgumentParser(prog="python -m ceilvo.bench.mrclam", description="Filters on recorded robots.")
    p.add_argument("folder", type=Path, nargs="?", metavar="DIR", help=f"data set (default: $CEILVO_DATA/{DATASET})")
    p.add_argument("--train", default="1,2", metavar="N,N", help="robots that noise is fitted on (%(default)s)")
    p.add_argument("--test", default="3,4,5", metavar="N,N", help="robots that are evaluated (%(default)s)")
    p.add_argument("--tasks", default=",".join(TASKS), metavar="A,B", help="default: %(default)s")
    p.add_argument("--filters", default=",".join(runs.FILTERS), metavar="A,B", help="default: %(default)s")
    p.add_argument("--particles", type=int, default=500, metavar="N", help="of the particle filters (500)")
    p.add_argument("--seeds", type=int, default=3, metavar="N", help="repetitions of whole runs (3)")
    p.add_argument("--trials", type=int, default=60, metavar="N", help="starts, and jumps, over all test robots (60)")
    add_options(p)  # more than one process disturbs times
    p.add_argument(
        "--raw", action="store_true", help="leave latency and bias of sensors and odometry in (off: taken out)"
    )
    p.add_argument("--no-peers", action="store_true", help="leave filterpy, particles and stonesoup out")
    p.add_argument("--json", type=Path, default=Path("build/bench/mrclam.json"), metavar="FILE")
    return p


def default_folder() -> Path | None:
    """$CEILVO_DATA, else a folder shared/data beside the repository."""
    folder = data_path(DATASET)
    return folder if folder.is_dir() else None


def experiment(args: argparse.Namespace, folder: Path) -> None:
    world = read_world(folder)
    train, test = _numbers(args.train, "--train"), _numbers(args.test, "--test")
    if set(train) & set(test):
        raise ConfigError(f"--train {args.train} --test {args.test}: a robot is in both, expected apart")
    training = [read_run(folder, r, world) for r in train]
    _warm_up(training[0], world)
    bias, noise, tried = fitted(training, world, args.raw)
    testing = [without(read_run(folder, r, world), bias) for r in test]
    cells = _cells(args, testing)
    code = fingerprint(FILES, str(folder.resolve()), repr((noise, bias)), str(args.trials), _contents(folder))
    store = Store(args.json.with_suffix(".jsonl"), code, lambda k: Cell(**k))
    jobs = {c: Job(c, folder, noise, args.trials // len(testing), bias) for c in cells}
    run_all(store, cells, asdict, measure, Workers.of(args), jobs)
    _report(args, [*training, *testing], noise, bias, tried, {c: store.results[c] for c in cells})


def _warm_up(run: Run, world: World) -> None:
    """The first numbers of a fresh process are slow; nobody's time is measured on them."""
    f = runs.make(SCORE_FILTER, 10, 0)
    moments = runs.from_truth(runs.events(run))[:200]
    runs.start_on_map(f, world, moments[0].truth)
    for _ in runs.follow(f, moments, fit([run], world)):
        pass


def fitted(training: Sequence[Run], world: World, raw: bool) -> tuple[Bias, Noise, list[dict[str, float]]]:
    """Bias and noise of the training robots, and all inflations tried.

    The inflation is that under which the gated UKF gives the truth of each training robot most likelihood when bias and
    noise come from the others: robots differ, and one to be evaluated is none of these.
    """

    def of(runs_: Sequence[Run]) -> tuple[Bias, Noise]:
        bias = Bias() if raw else bias_of(runs_, world)
        return bias, fit([without(run, bias) for run in runs_], world)

    folds = []
    for run in training:
        others = [other for other in training if other is not run] or [run]
        bias, noise = of(others)
        folds.append((without(run, bias), noise))

    def score(sigma_factor: float, odometry_factor: float) -> float:
        found = []
        for run, noise in folds:
            chosen = replace(noise, sigma_factor=sigma_factor, odometry_factor=odometry_factor)
            found.append(runs.localise(runs.make(SCORE_FILTER, 10, 0), run, world, chosen)["nll_mean"])
        return float(np.mean(found))

    bias, noise = of(training)
    return bias, *inflated(noise, score)


def _cells(args: argparse.Namespace, testing: Sequence[Run]) -> list[Cell]:
    tasks, filters = _chosen(args.tasks, TASKS, "--tasks"), _chosen(args.filters, runs.FILTERS, "--filters")
    out = []
    for run in testing:
        for name in filters:
            seeds = 1 if name.startswith("ukf") else args.seeds
            n = 10 if name.startswith("ukf") else args.particles
            for task in (t for t in tasks if t in WHOLE):
                out += [Cell(task, name, n, run.robot, -1, seed) for seed in range(seeds)]
            for task in (t for t in tasks if t in ("start", "kidnap") and name in RECOVERING):
                out += [Cell(task, name, n, run.robot, k, 0) for k in range(args.trials // len(testing))]
        if "localise" in tasks and not args.no_peers:
            for name, (library, _, _) in peers.PEERS.items():
                if peers.missing(library) is None:
                    out.append(Cell("localise", name, args.particles, run.robot, -1, 0))
    return out


def measure(job: Job) -> dict[str, Any]:
    """The figures of a cell; an empty dict for a trial that the run has no room for."""
    cell = job.cell
    world, run = _recording(job.folder, cell.robot, job.bias)
    if cell.filter in peers.PEERS:
        moments = runs.from_truth(runs.events(run))
        return peers.localise_peer(cell.filter, moments, world, job.noise, cell.particles)
    f = runs.make(cell.filter, cell.particles, 1000 * cell.seed + max(cell.trial, 0))
    if cell.task == "localise":
        return {**runs.localise(f, run, world, job.noise), "counters": dict(f.counters())}
    if cell.task == "odometry":
        return {**runs.localise(f, runs.wrong_turns(run), world, job.noise), "counters": dict(f.counters())}
    if cell.task == "slam":
        return dict(runs.slam(f, run, world, job.noise))
    if cell.task == "start":
        starts = runs.start_trials(run, job.trials)
        found = [runs.global_start(f, starts[cell.trial], world, job.noise)] if cell.trial < len(starts) else []
    else:
        jumps = runs.kidnap_trials(run, job.trials)
        found = [runs.kidnap(f, *jumps[cell.trial], world, job.noise)] if cell.trial < len(jumps) else []
    return {"found_s": found[0]} if found else {}


@lru_cache(maxsize=8)
def _recording(folder: Path, robot: int, bias: Bias) -> tuple[World, Run]:
    world = read_world(folder)
    return world, without(read_run(folder, robot, world), bias)


def _contents(folder: Path) -> str:
    """Fingerprint of the data."""
    digest = hashlib.sha256()
    for path in sorted(folder.glob("*.dat*")):
        digest.update(path.name.encode() + path.read_bytes())
    return digest.hexdigest()


def _report(
    args: argparse.Namespace,
    used: Sequence[Run],
    noise: Noise,
    bias: Bias,
    tried: list[dict[str, float]],
    results: Results,
) -> None:
    console = Console(width=None if sys.stdout.isatty() else _WIDTH)
    skipped = (
        [] if args.no_peers else [m for lib in ("filterpy", "particles", "stonesoup") if (m := peers.missing(lib))]
    )
    document: dict[str, Any] = {
        "settings": {
            "train": args.train,
            "test": args.test,
            "seeds": args.seeds,
            "trials": args.trials,
            "particles": args.particles,
            **runs.stated(),
            "bias": asdict(bias),
            "noise": noise.as_dict(),
            "inflation_tried": tried,
            "filters": {n: asdict(runs.settings(n, args.particles)) for n in runs.FILTERS},
            "libraries": {lib: peers.library_version(lib) for lib, _, _ in peers.PEERS.values()},
        },
        "data": {r.robot: {"seconds": r.end_s - r.begin_s, "seen": len(r.seen_s), **r.ignored} for r in used},
        "localise": whole_rows(results, "localise", LOCALISE),
        "odometry": whole_rows(results, "odometry", LOCALISE),
        "slam": whole_rows(results, "slam", SLAM),
        "start": trial_rows(results, "start"),
        "kidnap": trial_rows(results, "kidnap"),
        "robots": [{**asdict(c), **f} for c, f in results.items() if c.trial < 0],
        "bars": as_json(bars(results)),
        "skipped": skipped,
    }
    console.print_json(json.dumps(json_value({"data": document["data"], "settings": document["settings"]})), indent=1)
    for title, key in (
        (f"Known map, start at the truth, mean over robots {args.test}", "localise"),
        (f"The same, wheels that turn by {runs.WRONG_TURNS:g} of what they say", "odometry"),
        ("SLAM, no map", "slam"),
        (f"Start anywhere, known map, found within {runs.WATCH_S:g} s", "start"),
        (f"Kidnap: {runs.JUMP_S:g} s cut out, found within {runs.WATCH_S:g} s", "kidnap"),
    ):
        if document[key]:
            console.print(as_table(document[key], title))
    for line in skipped:
        console.print(line, markup=False)
    console.print(table(bars(results), "What it must show"))
    for line in verdicts(results):
        console.print(line, markup=False, highlight=False, soft_wrap=True)
    args.json.parent.mkdir(parents=True, exist_ok=True)
    write_atomic(args.json, json.dumps(json_value({**document, "text": verdicts(results)}), indent=1) + "\n")
    console.print(f"figures in {args.json}")


def _chosen(text: str, known: Sequence[str], option: str) -> list[str]:
    for name in text.split(","):
        if name not in known:
            raise ConfigError(f"{option}: no '{name}'; known are {', '.join(known)}")
    return text.split(",")


def _numbers(text: str, option: str) -> list[int]:
    try:
        out = [int(x) for x in text.split(",")]
    except ValueError:
        raise ConfigError(f"{option}: found '{text}', expected robots' numbers separated by commas") from None
    if len(set(out)) < len(out):
        raise ConfigError(f"{option}: found '{text}', expected each robot once")
    return out
