"""Time of a filter's step against particles, landmarks in view and map size: `make bench-filter`.

A step is predict and update. All times are of this process, of this run; what counts are the ratios to `pf` and to
other people's filters in the same run.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn
from rich.table import Table

from ceilvo.bench.paper.run import known_map
from ceilvo.bench.recovery.filters import make_recovering_filter as make_filter
from ceilvo.bench.results.bars import Bar, as_json, table
from ceilvo.bench.results.store import one_thread
from ceilvo.bench.speed import filter_load as load
from ceilvo.bench.speed import filter_step_peers as peers
from ceilvo.config import Filter
from ceilvo.daemon.slam.pose_filter import PoseFilter
from ceilvo.errors import CeilvoError
from ceilvo.files import write_atomic
from ceilvo.json_values import json_value
from ceilvo.types import Array, Displacement, Landmarks, Motion, Observations

METHODS = ("pf", "pfcf_paper", "joint", "ukf")
PARTICLES = (20, 50, 100, 200, 500, 1000, 3000, 10_000, 30_000, 100_000)
"""Axis of a table; chosen, from those of bench/paper to where time is linear in N."""
IN_VIEW = (1, 2, 4, 6, 10, 20, 40)  # landmarks, axis; chosen, around the 6 of REFERENCE
MAPS = (100, 300, 1000, 3000, 10_000, 30_000)  # landmarks, axis; chosen, from a room to a large building
REFERENCE = {"particles": 200, "landmarks": 16, "in_view": 6}
"""The point that the bars are held at; 16 landmarks as in bench/paper."""
SIGMA_M = 0.03  # of an observation; chosen: the time is asked here, not the error
REPEATS = 5  # batches; chosen: a median of them passes over two that were disturbed
BATCH_S = 0.05  # processor time; docs/experiments.md (Speed)
_WARM_STEPS = 100  # at most; chosen: caches are warm, and the size of a batch is known
_MOST_CALLS = 2000  # in a batch; chosen: steps below 25 us make a shorter one
OWN_MAPS_TO = 300  # landmarks; chosen: the joint covariance of a map in the making grows with their square
QUADRATIC, QUADRATIC_TO = "pfcf_paper", 3000
"""Its search for nearest ancestors compares all with all; beyond this it is not run."""
_WIDTH = 140  # characters of a table that goes to a file; chosen: the widest fits


def main(arguments: Sequence[str] | None = None) -> int:
    args = parser().parse_args(arguments)
    one_thread()
    try:
        document = measured(args)
    except CeilvoError as e:
        print(f"bench.filter_speed: {e}", file=sys.stderr)
        return e.exit_code
    console = Console(width=None if sys.stdout.isatty() else _WIDTH)
    for title, key, axis in (
        ("N, mapping, 16 landmarks, 6 in view", "particles", "particles"),
        ("landmarks in view, mapping, N = 200", "in_view", "in_view"),
        ("landmarks of the known map, 6 in view, N = 200", "known_map", "landmarks"),
        ("landmarks mapped so far, 6 in view, N = 200", "own_map", "landmarks"),
    ):
        console.print(_table(document[key], f"Time of a step against {title}", axis))
    console.print(_load_table(document["load"]))
    console.print(_peer_table(document["peers"]))
    for line in document["skipped"]:
        console.print(line, markup=False)
    found = bars(document)
    console.print(table(found, "What it must show"))
    args.json.parent.mkdir(parents=True, exist_ok=True)
    write_atomic(args.json, json.dumps(json_value({**document, "bars": as_json(found)}), indent=1) + "\n")
    console.print(f"figures in {args.json}")
    return 0


def parser() -> argparse.ArgumentParser:
    p = argparse.ArgumentParser(prog="python -m ceilvo.bench.speed.filter_step", description="Time of a filter's step.")
    p.add_argument("--max-particles", type=int, default=PARTICLES[-1], metavar="N", help="(%(default)s)")
    p.add_argument("--max-map", type=int, default=load.MAPS[-1], metavar="N", help="(%(default)s)")
    p.add_argument("--repeats", type=int, default=REPEATS, metavar="N", help="batches; the median counts (%(default)s)")
    p.add_argument("--json", type=Path, default=Path("build/bench/filter_speed.json"), metavar="FILE")
    return p


def measured(args: argparse.Namespace) -> dict[str, Any]:
    """All tables. Filters take turns within a row, so that what disturbs the machine disturbs all of them."""
    counts = [n for n in PARTICLES if n <= args.max_particles]
    maps = [m for m in MAPS if m <= args.max_map]
    total = len(counts) + len(IN_VIEW) + 2 * len(maps) + 1
    bar = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn())
    with Progress(*bar, console=Console(stderr=True)) as progress:
        task = progress.add_task("steps", total=total)

        def rows(key: str, values: Sequence[int], known: bool | None) -> list[dict[str, Any]]:
            out = []
            for value in values:
                out.append(row({**REFERENCE, key: value}, known, args.repeats))
                progress.update(task, advance=1, description=f"{key} {value}")
            return out

        document = {
            "settings": {"filter": asdict(Filter()), "reference": REFERENCE, "sigma_m": SIGMA_M, "batch_s": BATCH_S},
            "particles": rows("particles", counts, False),
            "in_view": rows("in_view", IN_VIEW, False),
            "known_map": rows("landmarks", maps, True),
            "own_map": rows("landmarks", [m for m in maps if m <= OWN_MAPS_TO], False),
        }
        document["map_ends"] = map_ends(maps[0], maps[-1], args.repeats)
        document["load"] = load.measured(medians, args.repeats, args.max_map)
        document["peers"] = peer_row(args.repeats)
        document["skipped"] = peers.skipped()
    return document


def row(at: dict[str, int], known: bool | None, repeats: int) -> dict[str, Any]:
    """us per step of every method at one point."""
    count = max(at["landmarks"], at["in_view"])
    scene = scene_of(count, at["in_view"])
    chosen = [m for m in METHODS if m != QUADRATIC or at["particles"] <= QUADRATIC_TO]
    steps = {m: stepper(m, at["particles"], *scene, known=bool(known)) for m in chosen}
    us: dict[str, float] = dict.fromkeys(METHODS, float("nan"))
    return {**at, "landmarks": count, "us": us | medians(steps, repeats, {})}


def scene_of(landmarks: int, in_view: int) -> tuple[Landmarks, Array]:
    """A square grid of landmarks 0.8 m apart, and the positions of the in_view ones around the robot at the origin."""
    angle = 2.0 * np.pi * np.arange(in_view) / in_view
    near = (0.5 + 0.5 * (np.arange(in_view) % 3) / 2.0)[:, None] * np.column_stack([np.cos(angle), np.sin(angle)])
    side = int(np.ceil(np.sqrt(max(landmarks - in_view, 1))))
    g = 0.8 * np.arange(side) + 3.0
    far = np.stack(np.meshgrid(g, g), axis=-1).reshape(-1, 2)[: landmarks - in_view]
    xy = np.concatenate([near, far])
    return known_map(xy, np.arange(len(xy), dtype=np.int64)), near


def stepper(method: str, particles: int, m: Landmarks, near: Array, known: bool) -> Callable[[], None]:
    """One call is one step of a robot that stands among its landmarks; the motion's noise keeps it resampling."""
    f = make_filter(replace(Filter(), method=method, particles=particles, max_landmarks=100_000), _rng())
    f.reset(np.zeros(3), np.diag([1e-4, 1e-4, 1e-4]), m if known else _looser(m), known)
    return standing(f, near)


def standing(f: PoseFilter, near: Array) -> Callable[[], None]:
    rng = _rng()
    motion = Motion(Displacement(np.zeros(3)), np.diag([4e-4, 4e-4, 1e-4]), 10, 0.0)
    label, variance = np.arange(len(near), dtype=np.int64), np.full((len(near), 2), SIGMA_M**2)

    def step() -> None:
        f.predict(motion)
        f.update(Observations(near + SIGMA_M * rng.standard_normal(near.shape), variance, label, label))
        f.estimate()

    return step


def _looser(m: Landmarks) -> Landmarks:
    """A map as it is while it is being made."""
    return replace(m, cov_m2=np.tile(4e-4 * np.eye(2), (len(m), 1, 1)))


def _rng() -> np.random.Generator:
    return np.random.default_rng(7)


def medians(calls: dict[str, Callable[[], None]], repeats: int, steps_per_call: dict[str, int]) -> dict[str, float]:
    """us per step: median of batches of at least 50 ms, the callables taking turns."""
    sizes = {}
    for name, call in calls.items():
        begun, done = time.perf_counter(), 0
        while done < 3 or (done < _WARM_STEPS and time.perf_counter() - begun < BATCH_S):
            call()
            done += 1
        each = (time.perf_counter() - begun) / done
        sizes[name] = min(max(1, int(BATCH_S / each)), _MOST_CALLS)
    times: dict[str, list[float]] = {name: [] for name in calls}
    for _ in range(repeats):
        for name, call in calls.items():
            begun = time.process_time()
            for _ in range(sizes[name]):
                call()
            spent = time.process_time() - begun
            times[name].append(1e6 * spent / sizes[name] / steps_per_call.get(name, 1))
    return {name: float(np.median(t)) for name, t in times.items()}


def map_ends(small: int, large: int, repeats: int) -> dict[str, Any]:
    """joint on the smallest and the largest known map, taking turns."""
    steps = {}
    for count in (small, large):
        m, near = scene_of(count, REFERENCE["in_view"])
        steps[str(count)] = stepper("joint", REFERENCE["particles"], m, near, known=True)
    return {"us": medians(steps, 3 * repeats, {})}


def peer_row(repeats: int) -> dict[str, Any]:
    """The reference step on a known map, ours and others', one update per observation for Kalman filters."""
    m, near = scene_of(REFERENCE["landmarks"], REFERENCE["in_view"])
    steps = {name: stepper(name, REFERENCE["particles"], m, near, known=True) for name in METHODS}
    others = peers.steppers(near, REFERENCE["particles"], SIGMA_M)
    us = medians(steps | others, repeats, dict.fromkeys(others, peers.STEPS_PER_CALL))
    return {"us": us, "pfcf_to": {k: us["joint"] / v for k, v in us.items()}}


def bars(document: dict[str, Any]) -> list[Bar]:
    rows = document["particles"]
    reference = next((r for r in rows if r["particles"] == REFERENCE["particles"]), None)
    out = []
    if reference is not None:
        us = reference["us"]
        ratio = us["joint"] / us["pf"]
        out.append(Bar("N = 200, 16 landmarks, 6 in view: joint / pf", ratio, f"{ratio:.2f}", high=3.0))
        out.append(Bar("the same, joint ms", us["joint"] / 1e3, f"{us['joint'] / 1e3:.3f}", high=1.5))
    if rows[-1]["particles"] >= 10_000:
        slope = exponent([r for r in rows if r["particles"] >= 3000])
        out.append(Bar("joint: exponent of N from 3,000 up", slope, f"{slope:.2f}", high=1.15))
    (small, few_us), (large, many_us) = document["map_ends"]["us"].items()
    ratio = many_us / few_us
    name = f"joint, known map of {large} / of {small}, taking turns"
    out.append(Bar(name, ratio, f"{ratio:.3f}", 0.85, 1.15))
    return out + load.bars(document["load"])


def exponent(rows: Sequence[dict[str, Any]]) -> float:
    """Slope of log time against log N: 1 is linear."""
    n, us = (
        np.log([float(x) for x in v]) for v in zip(*((r["particles"], r["us"]["joint"]) for r in rows), strict=True)
    )
    return float(np.polyfit(n, us, 1)[0])


def _table(rows: Sequence[dict[str, Any]], title: str, axis: str) -> Table:
    out = Table(axis, *(f"{m} us" for m in METHODS), *(f"{m} / pf" for m in METHODS[1:]), title=title)
    for r in rows:
        us = r["us"]
        out.add_row(str(r[axis]), *(f"{us[m]:.0f}" for m in METHODS), *(f"{us[m] / us['pf']:.2f}" for m in METHODS[1:]))
    return out


def _load_table(found: dict[str, Any]) -> Table:
    title = f"ms of a daemon's step: {load.OVER_VIEW} landmarks, crossings in view; and {load.USUAL} in view, landmarks"
    views, maps = (list(next(iter(found.values()))[key]) for key in ("in_view", "map"))
    out = Table("joint", *(f"{k} in view" for k in views), *(f"{n} landmarks" for n in maps), title=title)
    for name, us in found.items():
        out.add_row(name, *(f"{1e-3 * t:.1f}" for key in ("in_view", "map") for t in us[key].values()))
    return out


def _peer_table(found: dict[str, Any]) -> Table:
    out = Table(
        "filter", "us per step", "joint / it", title="Known map, N = 200, 16 landmarks, 6 in view, with others'"
    )
    for name, us in found["us"].items():
        out.add_row(name, f"{us:.0f}", f"{found['pfcf_to'][name]:.2f}")
    return out


if __name__ == "__main__":
    sys.exit(main())
