"""Prints what became of a fleet's map while its service was killed and robots lied: python -m ceilvo.bench.fleet"""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from collections import Counter
from dataclasses import replace
from pathlib import Path

import numpy as np

from ceilvo.bench.fleet.run import ROUNDS_PER_HOUR, Judgement, Outcome, Plan, judged, run
from ceilvo.config.arguments import from_up
from ceilvo.errors import CeilvoError


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    plan = Plan()
    parser.add_argument("--robots", type=from_up(3), default=plan.robots, metavar="N", help="in all (50)")
    parser.add_argument("--rounds", type=from_up(2), default=plan.rounds, metavar="N", help="of ten minutes each (12)")
    parser.add_argument("--kills", type=from_up(0), default=plan.kills, metavar="N", help="of the service (10)")
    parser.add_argument("--processes", type=from_up(1), default=plan.processes, metavar="N", help="of robots (5)")
    parser.add_argument("--seed", type=from_up(0), default=plan.seed, metavar="N", help="of the building (1)")
    parser.add_argument("--honest", action="store_true", help="nobody lies, to compare with")
    parser.add_argument("--folder", type=Path, metavar="DIR", help="keep everything there (default: nothing is kept)")
    options = parser.parse_args()
    names = ("robots", "rounds", "kills", "processes", "seed")
    plan = replace(plan, **{name: getattr(options, name) for name in names})
    plan = replace(plan, renovated_at=plan.rounds // 2, lies=() if options.honest else plan.lies)
    began = time.monotonic()

    def say(text: str) -> None:
        print(f"\r{time.monotonic() - began:6.1f} s  {text:60}", end="", file=sys.stderr, flush=True)

    try:
        with tempfile.TemporaryDirectory() as temporary:
            folder = options.folder or Path(temporary)
            folder.mkdir(parents=True, exist_ok=True)
            out = run(plan, folder, say)
    except CeilvoError as e:
        print(f"bench.fleet: {e}", file=sys.stderr)
        return e.exit_code
    print(file=sys.stderr)
    found = judged(out)
    _print(plan, out, found)
    good = not (found.invented or found.lost or found.behind) and out.kills == plan.kills
    print(f"{'verdict':26} {'nothing lost, nothing invented' if good else 'FAILED'}")
    return 0 if good else 1


def _print(plan: Plan, out: Outcome, j: Judgement) -> None:
    honest = [r for r in out.robots if not r["lie"]]
    hours = plan.rounds / ROUNDS_PER_HOUR
    seen = f"{plan.region_m[0]:g} m x {plan.region_m[1]:g} m"
    rows = {
        "robots": f"{len(honest)} honest, {len(out.robots) - len(honest)} that lie, in {plan.processes} processes",
        "simulated": f"{plan.rounds} x 10 min of {seen} each, in {out.seconds:.0f} s",
        "building": f"{plan.size_m[0]:g} m x {plan.size_m[1]:g} m, {plan.surveyed_m:g} m of it surveyed before",
        "service": f"{out.kills} times killed -9; {out.service_cpu_s:.1f} s of processor",
        "back after": f"{np.median(out.down_s):.1f} s median, {max(out.down_s):.1f} s at most" if out.down_s else "-",
        "version": f"{out.version}, held by {len(honest) - j.behind} of {len(honest)} honest robots",
        "map": f"{j.landmarks} landmarks, {100.0 * j.covered:.1f} % of the building",
        "places": f"{1e3 * j.rms_m:.2f} mm rms, {1e3 * j.worst_m:.1f} mm worst",
        "invented": str(j.invented),
        "of before the renovation": str(j.stale),
        "acknowledged": f"{j.acknowledged} new landmarks of honest robots, {j.lost} lost",
        "still waiting": f"{j.waiting} offers of ground beyond the map; {len(out.claimed)} landmarks till others agree",
        "bytes in": _bytes([r["bytes_in"] for r in honest], hours),
        "bytes out": _bytes([r["bytes_out"] for r in honest], hours),
        "on its socket": _bytes([r["socket_bytes"] for r in out.robots], hours) + " both ways, those that lie as well",
        "away": f"{sum(r['away'] for r in honest)} times a robot found no service and went on",
        "refused of the honest": str(dict(sum((Counter(r["answers"]) for r in honest), Counter()))),
    }
    for name, text in rows.items():
        print(f"{name:26} {text}")
    for r in out.robots:
        if r["lie"]:
            print(f"{'lie: ' + r['lie']:26} {r['answers']}")
    print(f"{'service counted':26} " + ", ".join(f"{n.replace('_', ' ')} {v}" for n, v in out.counters.items()))


def _bytes(values: list[float], hours: float) -> str:
    kb = np.array(values) / 1e3 / hours
    return f"{np.mean(kb):.0f} kB a robot and hour, {kb.max():.0f} at most"
