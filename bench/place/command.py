"""Does the robot know its place, whatever happens to it? Rooms and halls, and faults, through the daemon's own path.

Seeds 0 to 999 are for tuning, 1000 and more for figures that are reported: those are never tuned on.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any, TypeVar

from rich.console import Console
from rich.table import Table

from ceilvo.bench.place import radio, steps, study_tables, tables
from ceilvo.bench.place.case import SIZES, Case, as_key, cases, from_key, run_case
from ceilvo.bench.place.ceiling.eye_check import compare
from ceilvo.bench.place.faults.changes import SHARE
from ceilvo.bench.place.faults.kinds import CARRIED_KINDS, KINDS
from ceilvo.bench.place.studies import LEG_S, Run, run_study
from ceilvo.bench.results import bars as bars_module
from ceilvo.bench.results.bars import Bar
from ceilvo.bench.results.store import Store, exit_code, fingerprint, one_thread, run_all
from ceilvo.daemon import pipeline
from ceilvo.errors import CeilvoError
from ceilvo.files import write_atomic
from ceilvo.tasks.workers import Workers, add_options

_FILES = (
    *(f"place/{name}.py" for name in ("case", "radio", "studies")),
    *(f"place/faults/{name}.py" for name in ("carried", "changes", "claims", "kinds", "pictures", "script", "signals")),
    *(f"place/robot/{name}.py" for name in ("drive", "driver", "sights", "tally")),
    *(f"place/ceiling/{name}.py" for name in ("eye", "truth", "twins", "worlds")),
)
"""Whose change makes earlier results void."""
_OUT = Path("build/bench/place")
_SHOWN = 10
"""Worst cases that are told one by one; chosen."""
_WIDTH = 200
"""Of tables, whatever the terminal has."""
_TUNING = "0 to 999 for tuning, 1000 and more for figures that are reported"
Result = dict[str, Any]
Key = TypeVar("Key")


def main(arguments: Sequence[str] | None = None) -> int:
    a = _parser().parse_args(arguments)
    one_thread()
    return exit_code("place", lambda: _WORK[a.command](a))


def _parser() -> argparse.ArgumentParser:
    p = argparse.ArgumentParser(prog="place", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    commands = p.add_subparsers(dest="command", required=True)
    faults = _command(commands, "faults", "faults of all kinds, kind after kind", 300)
    faults.add_argument("--kinds", default=",".join(KINDS), help="comma-separated; all: " + ", ".join(KINDS))
    carried = _command(commands, "carried", "carried 1 to 5 tiles, in the dark and in the light, and snatched", 100)
    restart = _command(commands, "restart", "started again on the spot", 100)
    for parser in (faults, carried, restart):
        parser.add_argument("--rooms", default=",".join(SIZES), help="comma-separated, of " + ", ".join(SIZES))
    laps = _command(commands, "laps", "drives without faults", None)
    laps.add_argument("--hours", type=float, default=10.0)
    start = _command(commands, "start", "start anywhere in a hall whose map is known", 200)
    start.add_argument("--room", default=SIZES[-1], choices=SIZES, help="the bars are for 150: 150 m x 100 m")
    radios = _command(commands, "radio", "start anywhere under lamps on a perfect raster, with radio anchors", 100)
    radios.add_argument("--room", default="20", choices=SIZES)
    radios.add_argument("--anchors", type=int, default=3, choices=range(9))
    radios.add_argument("--noise", type=float, default=0.3, help="m, of one range (%(default)s)")
    radios.add_argument("--obstructed", type=float, default=0.0, help="share of the floor where an anchor is hidden")
    _command(
        commands, "renovated", "30 per cent of the ceiling new over night in every other run, all of it in the rest", 40
    )
    _command(commands, "heights", "started again with the calibration of another camera's height", 36)
    _command(commands, "rides", "to another floor, by lift and by ramp, and back out on the same one", 60)
    step = commands.add_parser(
        "steps",
        help="time of a step, and memory, on a small and on a large map",
        description=steps.__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    step.add_argument("--seconds", type=float, default=120.0, help="driven with each map (%(default)s)")
    step.add_argument("--seed", type=int, default=0, help=_TUNING)
    step.add_argument("--out", type=Path, default=_OUT / "steps.json")
    one = commands.add_parser("case", help="one case of faults again, with all that the daemon said")
    one.add_argument("kind", choices=KINDS, metavar="KIND")
    one.add_argument("--seed", type=int, default=0, help=_TUNING)
    one.add_argument("--number", type=int, required=True, help="as told with the worst cases of faults")
    one.add_argument("--rooms", default=",".join(SIZES), help="as they were given to faults")
    check = commands.add_parser("eye-check", help="the synthetic eye against rendered frames")
    check.add_argument("--seed", type=int, default=3)
    check.add_argument("--frames", type=int, default=500)
    return p


def _command(commands: Any, name: str, about: str, count: int | None) -> argparse.ArgumentParser:
    p: argparse.ArgumentParser = commands.add_parser(name, help=about, description=about)
    if count is not None:
        p.add_argument("--count", type=int, default=count)
    p.add_argument("--seed", type=int, default=0, help=_TUNING)
    add_options(p)
    p.add_argument("--out", type=Path, default=_OUT / f"{name}.json", help="single runs go beside it, as .jsonl")
    p.add_argument("--resume", action="store_true", help="go on where the file ends, with the same code")
    return p


def _run(
    a: argparse.Namespace,
    keys: Sequence[Key],
    as_dict: Callable[[Key], Mapping[str, Any]],
    of_dict: Callable[[Mapping[str, Any]], Key],
    work: Callable[[Key], Result],
) -> list[Result]:
    """What is not there yet is run; in the order of the keys."""
    lines = a.out.with_suffix(".jsonl")
    if not a.resume:
        lines.unlink(missing_ok=True)
    store = Store(lines, fingerprint(_FILES, Path(pipeline.__file__).read_text()), of_dict)
    run_all(store, keys, as_dict, work, Workers.of(a))
    return [store.results[key] for key in keys]


def _told(a: argparse.Namespace, table: Table, bars: list[Bar], results: list[Result], worst: Sequence[str]) -> None:
    summary = {"command": a.command, "seed": a.seed, "bars": bars_module.as_json(bars), "runs": results}
    a.out.parent.mkdir(parents=True, exist_ok=True)
    write_atomic(a.out, json.dumps(summary, indent=1) + "\n")
    console = Console(width=_WIDTH)
    console.print(table)
    for line in worst:
        console.print(line, soft_wrap=True, highlight=False)
    console.print(bars_module.table(bars, f"{a.command}, seed {a.seed}" + (" (tuning)" if a.seed < 1000 else "")))


def _faults_of(a: argparse.Namespace, kinds: tuple[str, ...]) -> list[Result]:
    todo: list[Case] = cases(kinds, a.count, a.seed, _chosen(a.rooms, SIZES, "--rooms"))
    return _run(a, todo, as_key, from_key, run_case)


def _faults(a: argparse.Namespace) -> None:
    results = _faults_of(a, _chosen(a.kinds, tuple(KINDS), "--kinds"))
    _told(a, tables.table(results), tables.fault_bars(results), results, tables.worst_cases(results, _SHOWN))


def _carried(a: argparse.Namespace) -> None:
    results = _faults_of(a, CARRIED_KINDS)
    _told(a, tables.table(results), tables.carried_bars(results), results, tables.worst_cases(results, _SHOWN))


def _restart(a: argparse.Namespace) -> None:
    results = _faults_of(a, ("restart here",))
    _told(a, tables.table(results), tables.restart_bars(results), results, tables.worst_cases(results, _SHOWN))


def _studied(a: argparse.Namespace, runs: list[Run]) -> list[Result]:
    return _run(a, runs, asdict, lambda key: Run(**key), run_study)


def _laps(a: argparse.Namespace) -> None:
    legs = [LEG_S] * int(3600.0 * a.hours / LEG_S)
    rest_s = 3600.0 * a.hours - sum(legs)
    legs += [rest_s] if rest_s > 1.0 else []
    results = _studied(a, [Run("laps", a.seed, i, seconds=s) for i, s in enumerate(legs)])
    _told(a, study_tables.laps(results), study_tables.laps_bars(results), results, ())


def _start(a: argparse.Namespace) -> None:
    results = _studied(a, [Run("start", a.seed, i, size=a.room) for i in range(a.count)])
    _told(a, study_tables.start(results), study_tables.start_bars(results), results, ())


def _radio(a: argparse.Namespace) -> None:
    radio_of = {"size": a.room, "anchors": a.anchors, "noise_m": a.noise, "obstructed": a.obstructed}
    runs = [Run("radio", a.seed, i, **radio_of) for i in range(a.count)]
    results = _studied(a, runs)
    _told(a, radio.table(results), radio.bars(results), results, ())


def _renovated(a: argparse.Namespace) -> None:
    results = _studied(a, [Run("renovated", a.seed, i, (SHARE, 1.0)[i % 2]) for i in range(a.count)])
    _told(a, study_tables.renovated(results), study_tables.renovated_bars(results), results, ())


def _heights(a: argparse.Namespace) -> None:
    results = _studied(a, [Run("heights", a.seed, i) for i in range(a.count)])
    _told(a, study_tables.heights(results), study_tables.heights_bars(results), results, ())


def _rides(a: argparse.Namespace) -> None:
    results = _studied(a, [Run("rides", a.seed, i) for i in range(a.count)])
    _told(a, study_tables.rides(results), study_tables.rides_bars(results), results, ())


def _steps(a: argparse.Namespace) -> None:
    site = steps.Site.of(*steps.HALLS, a.seed)
    bytes_ = steps.remembered(site, steps.COUNTS, a.seed)
    rows = steps.measured(site, steps.COUNTS, a.seconds, a.seed)
    _told(a, steps.table(rows, bytes_), steps.bars(rows, bytes_), [*rows, {"bytes_a_landmark": bytes_}], ())


def _case(a: argparse.Namespace) -> None:
    result = run_case(Case(a.kind, a.seed, a.number, _chosen(a.rooms, SIZES, "--rooms")))
    reasons = result.get("fault", result["before"]).pop("reasons")
    print(json.dumps(result, indent=1), *reasons, sep="\n")


def _eye_check(a: argparse.Namespace) -> None:
    real, synthetic = compare(a.seed, a.frames)
    for name, value in real.items():
        print(f"{name:45s} real {value:9.3f}   synthetic {synthetic.get(name, float('nan')):9.3f}")


def _chosen(text: str, known: tuple[str, ...], option: str) -> tuple[str, ...]:
    names = tuple(name.strip() for name in text.split(","))
    unknown = [name for name in names if name not in known]
    if unknown:
        raise CeilvoError(f"{option}: {', '.join(unknown)} is not known; expected some of {', '.join(known)}")
    return names


_WORK: dict[str, Callable[[argparse.Namespace], None]] = {
    "faults": _faults,
    "carried": _carried,
    "restart": _restart,
    "laps": _laps,
    "start": _start,
    "radio": _radio,
    "renovated": _renovated,
    "heights": _heights,
    "rides": _rides,
    "steps": _steps,
    "case": _case,
    "eye-check": _eye_check,
}
