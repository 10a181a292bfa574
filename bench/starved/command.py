"""One core, others that keep it busy, cameras of 2 to 90 Hz: which rate is used, how old poses are, what is said.

python -m ceilvo.bench.starved --seconds 20

Each camera has a daemon of its own: alone on its core, with one hog, with two, alone again. Ages are from the frame's
stamp to the Zenoh sample at a subscriber, and to each telegram at the base whose pose is told as good (TRACKING,
DEGRADED). Base and subscriber are on all cores, the pictures were drawn beforehand, hogs have the daemon's priority.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table

from ceilvo.bench.place.robot.tally import WRONG_M, WRONG_RAD
from ceilvo.bench.soak.command import Running, Soak
from ceilvo.bench.soak.fault_plan import Fault, Stroke
from ceilvo.bench.soak.poses import Poses
from ceilvo.bench.speed.latency import spread
from ceilvo.bench.starved.drawn_lap import DrawnLap
from ceilvo.config import Config
from ceilvo.errors import CeilvoError
from ceilvo.files import write_atomic
from ceilvo.types import GOOD, State

_SEED = 7
_SETTLED_S = 3.0  # from the start of the world, not counted; chosen: the map has begun
_START_S = 15.0  # until the world moves; chosen: the daemon is up by then, also where others use the computer
_HOG = """
import os, sys
os.sched_setaffinity(0, [int(sys.argv[1])])
parent = os.getppid()
while os.getppid() == parent:
    pass
"""
_HOGS = {"1 hog": 1, "2 hogs": 2}
_COUNTERS = ("camera_rate_hz", "used_rate_hz", "every_nth_frame", "drops", "skipped_frames")
_NS = 1e-9  # s


@dataclass(frozen=True)
class Case:
    """A camera, and what it says its rate is (0 = the truth)."""

    rate_hz: int
    told_hz: int = 0
    wheels: bool = True

    @property
    def name(self) -> str:
        told = f" that says {self.told_hz}" if self.told_hz else ""
        return f"{self.rate_hz} Hz{told}{'' if self.wheels else ', no wheels'}"

    @property
    def file_name(self) -> str:
        return f"starved-{self.rate_hz}-{self.told_hz}{'' if self.wheels else '-no-wheels'}"


CASES = (Case(30), Case(60), Case(90), Case(2), Case(2, told_hz=30), Case(2, wheels=False))


class Starved(Soak):
    """One camera; the hogs are the only fault of its plan."""

    def __init__(self, case: Case, seconds: float, out: Path, core: int) -> None:
        free_s = _SETTLED_S + seconds
        super().__init__(_SEED, free_s + 3 * seconds, case.told_hz or case.rate_hz, out, case.file_name)
        self._case, self._core = case, core
        self._hogs: list[subprocess.Popen[bytes]] = []
        self.start_s = _START_S
        self.world = self.lap = DrawnLap(_SEED, case.rate_hz, out)
        self.phases = [
            Stroke(Fault(name, "process", seconds), _SETTLED_S + k * seconds)
            for k, name in enumerate(("alone", *_HOGS, "alone again"))
        ]
        self.plan = [s for s in self.phases if s.fault.name in _HOGS]

    def _config(self, port: int, router_port: int, link: Path) -> Config:
        c = super()._config(port, router_port, link)
        return replace(c, base=replace(c.base, use_wheels=self._case.wheels))

    def _command(self, file: Path) -> Sequence[object]:
        case = self._case
        told_hz = case.told_hz or case.rate_hz
        return ["ceilvo.bench.starved.robot", _SEED, self.t0_ns, self._core, case.rate_hz, told_hz, self._out, file]

    def _change(self, part: str, old: str, new: str, running: Running) -> None:
        self.end_hogs()
        command = [sys.executable, "-c", _HOG, str(self._core)]
        self._hogs = [subprocess.Popen(command) for _ in range(_HOGS.get(new, 0))]
        for hog in self._hogs:
            os.setpriority(os.PRIO_PROCESS, hog.pid, os.getpriority(os.PRIO_PROCESS, running.daemon.pid))

    def end_hogs(self) -> None:
        for hog in self._hogs:
            hog.kill()
            hog.wait()
        self._hogs = []


def main(arguments: Sequence[str] | None = None) -> int:
    p = argparse.ArgumentParser(
        prog="starved", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    p.add_argument("--seconds", type=float, default=20.0, help="of each phase of each camera (default %(default)g)")
    p.add_argument("--only", default="", help="cameras whose name begins so, e.g. '60 Hz'")
    p.add_argument("--out", type=Path, default=Path("build/bench"))
    a = p.parse_args(arguments)
    a.out.mkdir(parents=True, exist_ok=True)
    core = max(os.sched_getaffinity(0))
    results = []
    for case in (c for c in CASES if c.name.startswith(a.only)):
        print(f"{case.name}: {a.seconds:g} s a phase on core {core}, load {os.getloadavg()[0]:.1f}", file=sys.stderr)
        results.append(measured(case, a.seconds, a.out, core))
    write_atomic(a.out / "starved.json", json.dumps(results, indent=2) + "\n")
    Console(width=160).print(table(results))
    for r in results:
        print(f"{r['case']}: {' | '.join(r['said']) or 'nothing said'}")
    return 0 if all(r["exit_code"] == 0 and r["wrong_s"] == 0.0 for r in results) else 1


def measured(case: Case, seconds: float, out: Path, core: int) -> dict[str, Any]:
    """Raises CeilvoError: the daemon came up when the robot had left the place that it was told."""
    run = Starved(case, seconds, out, core)
    run.lap.draw()
    try:
        code = run.run()
    finally:
        run.end_hogs()
        run.lap.forget()
    poses = Poses(run.heard, run.world, run.t0_ns)
    if not len(poses.t_s) or poses.t_s[0] > run.world.spec.lap.rest_s:
        raise CeilvoError("starved: no pose before the robot drove off; this computer has too much else to do")
    said = [line.partition("camera ")[2] for line in (out / f"{case.file_name}.log").read_text().splitlines()]
    return {
        "case": case.name,
        "exit_code": code,
        "wrong_s": wrong_s(poses, State.TRACKING),
        "wrong_degraded_s": wrong_s(poses, State.DEGRADED),
        "phases": {phase.fault.name: figures(run, poses, phase) for phase in run.phases},
        "said": [text for text in said if text.startswith(("rate: ", "slow: ", "note: "))],
    }


def wrong_s(poses: Poses, state: State) -> float:
    """Seconds of a whole run in a state with a pose that is further off than this promises."""
    wrong = (poses.error_m > WRONG_M) | (poses.error_rad > WRONG_RAD)
    return float(poses.gap_s[wrong & (poses.state == state)].sum())


def figures(run: Starved, poses: Poses, phase: Stroke) -> dict[str, Any]:
    begin_ns, end_ns = (run.t0_ns + round(s / _NS) for s in (phase.from_s, phase.to_s))
    during = poses.inside([phase], after_s=0.0)
    stamp_ns = {r.seq: r.stamp_ns for r in run.heard.poses}
    told = [t for t in run.telegrams if begin_ns <= t.recv_ns < end_ns and t.telegram.sequence in stamp_ns]
    good = [t for t in told if t.telegram.state in GOOD]
    counters = [c for at_ns, c in run.heard.health if at_ns < end_ns][-1]
    return {
        "used_hz": float(during.sum()) / phase.fault.lasts_s,
        "apart_ms": spread([float(v) for v in 1e3 * np.diff(poses.t_s[during])]),
        "age_ms": spread([float(v) for v in 1e3 * poses.latency_s[during]]),
        "told_ms": spread([1e-6 * (t.recv_ns - stamp_ns[t.telegram.sequence]) for t in good]),
        "states": shares([State(int(s)) for s in poses.state[during]]),
        "told_states": shares([t.telegram.state for t in told]),
        "error_m": float(poses.error_m[during].max(initial=0.0)),
        "health": {name: counters[name] for name in _COUNTERS},
    }


def shares(states: Sequence[State]) -> dict[str, float]:
    return {state.name: n / len(states) for state, n in Counter(states).most_common()}


def table(results: Sequence[Mapping[str, Any]]) -> Table:
    columns = ("camera", "with", "used Hz", "one in", "apart", "age, Zenoh", "age, base", "wrong s", "good, base")
    out = Table(*columns, "states", title="ms: median / p99 / max; wrong s: TRACKING, more than 0.3 m or 5 deg off; %")
    for r in results:
        for name, f in r["phases"].items():
            spreads = (f["apart_ms"], f["age_ms"], f["told_ms"])
            times = [" / ".join(f"{v[m]:.0f}" for m in ("median", "p99", "max")) for v in spreads]
            good = sum(share for state, share in f["told_states"].items() if State[state] in GOOD)
            states = ", ".join(f"{state} {100.0 * share:.1f}" for state, share in f["states"].items())
            used = (f"{f['used_hz']:.1f}", str(f["health"]["every_nth_frame"]))
            out.add_row(r["case"], name, *used, *times, f"{r['wrong_s']:.2f}", f"{100.0 * good:.1f}", states)
    return out


if __name__ == "__main__":
    sys.exit(main())
