"""How soon do picture, wheels and stamps say that something is wrong, and how often without a reason?

python -m ceilvo.bench.cross_checks hours --hours 2        drives without faults, some that shake or creep
python -m ceilvo.bench.cross_checks faults --count 20      every fault in so many drives
"""

from __future__ import annotations

import argparse
import json
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path as File

import cv2
import numpy as np

from ceilvo.bench.cross_checks.drives import DriveSpec, drive, reversed_wheels
from ceilvo.bench.cross_checks.runner import Fault, run
from ceilvo.config import Config
from ceilvo.daemon.odometry.cross_checks.suspicion import Kind
from ceilvo.files import write_atomic

_LEG_S = 600.0  # of the drives without faults; chosen: each kind of robot has several an hour
_BEGIN_S = 20.0  # of a fault; chosen: by then the robot has driven, stood and turned
_QUICK = DriveSpec(speeds_mps=(0.2, 0.6), stand_share=0.1)  # drives for faults: they move most of the time
ROBOTS = {
    "office": DriveSpec(),
    "at 10 Hz": DriveSpec(rate_hz=10.0),
    "creeping": DriveSpec(speeds_mps=(0.003, 0.03), rate_hz=10.0),
    "shaking": DriveSpec(shake_m=0.0005),
    "slipping": DriveSpec(slips_per_m=0.5, slip_share=0.95, slip_radps=0.6, wheel_scale=1.03, wheel_turn_scale=0.9),
    "quick": DriveSpec(speeds_mps=(0.3, 1.2), accel_mps2=1.5),
}


@dataclass(frozen=True)
class Case:
    """A fault that the suspicions of `kinds` are right about; in no kinds: it must pass unnoticed."""

    name: str
    fault: Fault
    kinds: tuple[Kind, ...]
    reversed_: str = ""
    seconds: float = 60.0


def cases() -> Iterator[Case]:
    def after(seconds: float, **what: object) -> Fault:
        return replace(Fault(_BEGIN_S, _BEGIN_S + seconds), **what)  # type: ignore[arg-type]

    frozen = (Kind.FROZEN,)
    yield Case("frozen", after(15.0, picture="frozen"), frozen)
    yield Case("frozen, no wheels", after(15.0, picture="frozen", no_wheels=True), frozen)
    yield Case("frozen with live noise", after(15.0, picture="frozen noisy"), (Kind.STANDS,))
    for size in (2, 4, 8):
        yield Case(f"ring of {size}", after(15.0, picture=f"ring {size}"), (Kind.REPEATS,))
    yield Case("ring of 4, no wheels", after(15.0, picture="ring 4", no_wheels=True), (Kind.REPEATS,))
    yield Case("wheels spin at .3 m/s", after(2.0, spin_mps=0.3), (Kind.STANDS,))
    yield Case("pushed", after(5.0, wheels_stand=True), (Kind.MOVES,))
    yield Case("carried in .2 s of dark", after(2.0, picture="dark", picture_s=0.2, wheels_stand=True), (Kind.LIFTED,))
    yield Case(
        "carried in 1 s of silence", after(2.0, picture="silent", picture_s=1.0, wheels_stand=True), (Kind.LIFTED,)
    )
    for which in ("x", "y", "theta", "swapped"):
        yield Case(f"wheels reversed: {which}", Fault(0.0), (Kind.WHEELS_REVERSED,), which)
    for deg in (5.0, -5.0, 10.0):
        fault = Fault(_BEGIN_S, yaw_rad=float(np.radians(deg)))
        yield Case(f"camera bumped by {deg:g} deg", fault, (Kind.CAMERA_TURNED,), seconds=120.0)
    yield Case("pictures .3 s late", Fault(0.0, late_s=0.3), (Kind.LATE,), seconds=90.0)


def main(arguments: Sequence[str] | None = None) -> int:
    p = argparse.ArgumentParser(
        prog="cross_checks", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    p.add_argument("what", choices=("hours", "faults"))
    p.add_argument("--hours", type=float, default=1.0, help="for hours (default %(default)s)")
    p.add_argument("--count", type=int, default=20, help="drives a fault, for faults (default %(default)s)")
    p.add_argument("--only", default="", help="faults whose name begins so")
    p.add_argument("--seed", type=int, default=1, help="(default %(default)s)")
    p.add_argument("--out", type=File, default=File("build/bench"))
    a = p.parse_args(arguments)
    cv2.setNumThreads(1)
    a.out.mkdir(parents=True, exist_ok=True)
    result = _hours(a.hours, a.seed) if a.what == "hours" else _faults(a.count, a.seed, a.only)
    write_atomic(a.out / f"cross_checks_{a.what}.json", json.dumps(result, indent=2) + "\n")
    return 0


def _hours(hours: float, seed: int) -> dict[str, object]:
    """Legs of the robots in turn; everything that is suspected is false."""
    said: dict[str, Counter[str]] = {name: Counter() for name in ROBOTS}
    seconds, way_m = dict.fromkeys(ROBOTS, 0.0), dict.fromkeys(ROBOTS, 0.0)
    leg = 0
    while sum(seconds.values()) < 3600.0 * hours:
        name = list(ROBOTS)[leg % len(ROBOTS)]
        rng = np.random.default_rng([seed, leg])
        before: set[Kind] = set()
        for step in run(drive(ROBOTS[name], _LEG_S, rng), Config(), rng):
            now = {s.kind for s in step.suspicions.active}
            for s in step.suspicions.active:
                if s.kind not in before:
                    said[name][s.kind.value] += 1
                    print(f"  {name} {leg} {step.time_s:.1f} s {s.severity.name} {s.reason}", flush=True)
            before = now
            way_m[name] += float(np.hypot(*step.true_motion[:2]))
        seconds[name] += _LEG_S
        leg += 1
        print(f"{leg} legs, {sum(seconds.values()) / 3600.0:.2f} h, {sum(way_m.values()):.0f} m: {said}", flush=True)
    return {"seed": seed, "seconds": seconds, "way_m": way_m, "said": {n: dict(c) for n, c in said.items()}}


def _faults(count: int, seed: int, only: str) -> dict[str, object]:
    out: dict[str, object] = {"seed": seed, "count": count}
    for case in cases():
        if case.name.startswith(only):
            out[case.name] = _fault(case, count, seed)
    return out


def _fault(case: Case, count: int, seed: int) -> dict[str, object]:
    """Time and way until it is said, in every drive; other suspicions before are false, later ones follow from it."""
    said_s, said_m, others = [], [], Counter[str]()
    for k in range(count):
        rng = np.random.default_rng([seed, k])
        path = drive(_QUICK, case.seconds, rng)
        path = reversed_wheels(path, case.reversed_) if case.reversed_ else path
        way_m = 0.0
        for step in run(path, Config(), rng, case.fault):
            way_m += float(np.hypot(*step.true_motion[:2])) if step.time_s > case.fault.begin_s else 0.0
            found = {s.kind for s in step.suspicions.active}
            if found & set(case.kinds):
                said_s.append(step.time_s - case.fault.begin_s)
                said_m.append(way_m)
                break
            others.update(kind.value for kind in found)
    figures = {"said": len(said_s), "of": count, "others": dict(others)}
    for name, values in (("s", said_s), ("m", said_m)):
        figures |= {f"median_{name}": float(np.median(values)), f"max_{name}": float(max(values))} if values else {}
    print(f"{case.name:28} {figures}", flush=True)
    return figures
