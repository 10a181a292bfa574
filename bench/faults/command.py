"""How often is a wrong pose called good, and a right one lost? Hours of laps with faults, faster than real time.

python -m ceilvo.bench.faults --carried --hours 10 [--resume]
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Sequence
from dataclasses import asdict, fields, replace
from pathlib import Path

import cv2

from ceilvo.bench.faults.crossing_log import record
from ceilvo.bench.faults.drive import KINDS, Drive, Tally
from ceilvo.config import Config
from ceilvo.errors import CeilvoError
from ceilvo.files import write_atomic

ROOMS_M = (5.0, 7.0)  # sides of the rooms in turn; chosen, docs/faults.md gives its figures for these two
_LEG_S = 1800.0  # one room's drive; chosen: an hour has at least two rooms and two maps from nothing


def main(arguments: Sequence[str] | None = None) -> int:
    p = argparse.ArgumentParser(prog="faults", description=__doc__)
    p.add_argument("--hours", type=float, default=10.0)
    p.add_argument("--seed", type=int, default=100)
    p.add_argument("--method", default=Config().filter.method)
    p.add_argument("--carried", action="store_true", help="also carry the robot elsewhere in the dark")
    p.add_argument("--out", type=Path, default=Path("build/bench/faults.json"))
    p.add_argument("--resume", action="store_true", help="go on where the file ends, with the same code")
    a = p.parse_args(arguments)
    cv2.setNumThreads(1)
    a.out.parent.mkdir(parents=True, exist_ok=True)
    config = replace(Config(), filter=replace(Config().filter, method=a.method))
    kinds = (*KINDS, "carried") if a.carried else KINDS
    of = {"method": a.method, "seed": a.seed, "carried": a.carried}
    total, leg, before_s = _so_far(a.out, of) if a.resume else (Tally(), 0, 0.0)
    begun_s = time.process_time() - before_s
    result: dict[str, object] = {"ok": False}
    while (left_s := 3600.0 * a.hours - total.seconds) > 1.0:
        log = record(a.seed + leg, ROOMS_M[leg % len(ROOMS_M)], config.features)
        total.add(Drive(log, config, a.seed + leg, kinds).run(min(_LEG_S, left_s)))
        leg += 1
        result = summary(total, a.method, leg, time.process_time() - begun_s) | of
        write_atomic(a.out, json.dumps(result, indent=2) + "\n")
        print(line(result), flush=True)
    return 0 if result["ok"] else 1


def _so_far(file: Path, of: dict[str, object]) -> tuple[Tally, int, float]:
    """What an interrupted run of the same method, seed and faults has: tally, legs, processor seconds."""
    if not file.exists():
        return Tally(), 0, 0.0
    r = json.loads(file.read_text())
    found = {key: r.get(key) for key in of}
    if found != of:
        raise CeilvoError(f"{file}: found {found}, expected {of}; name another with --out")
    return Tally(**{f.name: r[f.name] for f in fields(Tally)}), r["rooms"], r["cpu_s"]


def summary(t: Tally, method: str, rooms: int, cpu_s: float) -> dict[str, object]:
    hours = max(t.seconds / 3600.0, 1e-9)
    wrong_s = t.wrong_s.get("TRACKING", 0.0)
    return {
        "ok": wrong_s == 0.0 and t.false_lost / hours < 1.0,
        "method": method,
        "hours": hours,
        "rooms": rooms,
        "tracking_but_wrong_s": wrong_s,
        "degraded_but_wrong_s": t.wrong_s.get("DEGRADED", 0.0),
        "false_lost_per_hour": t.false_lost / hours,
        "cpu_s": cpu_s,
        **asdict(t),
    }


def line(r: dict[str, object]) -> str:
    return (
        f"{r['hours']:6.2f} h, {r['rooms']} rooms: TRACKING but > 0.3 m off {r['tracking_but_wrong_s']:.1f} s "
        f"{r['wrong_events']}, DEGRADED {r['degraded_but_wrong_s']:.1f} s, false LOST {r['false_lost']} "
        f"({r['false_lost_per_hour']:.2f}/h), true LOST {r['true_lost']}, blind LOST {r['blind_lost']}, "
        f"helped {r['helped']}, "
        f"states { ({k: round(v) for k, v in r['state_s'].items()}) }, worst TRACKING {r['worst_tracking_m']:.3f} m"  # type: ignore[attr-defined]
    )
