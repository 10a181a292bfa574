"""From the exposure to whoever needs the pose: a Zenoh subscriber and the base's register, in real time.

python -m ceilvo.bench.speed.latency --seconds 40

The daemon is a process of its own at 30 frames a second; the base paces itself as a 115200 baud line does. Times are
CLOCK_MONOTONIC, from the frame's stamp (start of the exposure).
"""

from __future__ import annotations

import argparse
import json
import math
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from ceilvo.bench.soak.command import Soak
from ceilvo.bench.soak.fault_plan import LEAD_S
from ceilvo.config import Base
from ceilvo.config.serial_budget import wire_budget
from ceilvo.files import write_atomic

RATE_HZ = 30.0  # of camera and base; docs/faults.md (bench-latency), the usual rate of a USB camera
_SETTLED_S = 5.0  # from the start of the world, not counted; chosen: the map has begun
_NS = 1e-9  # s in a nanosecond


def main(arguments: Sequence[str] | None = None) -> int:
    p = argparse.ArgumentParser(prog="latency", description=__doc__)
    p.add_argument("--seconds", type=float, default=LEAD_S + 10.0)
    p.add_argument("--base-rate-hz", type=float, default=RATE_HZ)
    p.add_argument("--out", type=Path, default=Path("build/bench"))
    a = p.parse_args(arguments)
    a.out.mkdir(parents=True, exist_ok=True)
    run = Soak(7, a.seconds, RATE_HZ, a.out, "latency", a.base_rate_hz)
    run.plan = []
    code = run.run()
    result = figures(run, Base(rate_hz=a.base_rate_hz)) | {"exit_code": code}
    write_atomic(a.out / "latency.json", json.dumps(result, indent=2) + "\n")
    for name, v in result.items():
        if isinstance(v, dict):
            print(f"{name:<44} median {v['median']:6.1f} ms   p99 {v['p99']:6.1f} ms   of {v['count']}")
    print(f"the telegram itself on the wire: {result['wire_ms']:.1f} ms at 115200 baud")
    return code


def figures(run: Soak, base: Base) -> dict[str, object]:
    begin_ns = run.t0_ns + round(_SETTLED_S / _NS)
    poses = {r.seq: r for r in run.heard.poses if r.stamp_ns > begin_ns}
    sample = [(r.recv_ns - r.stamp_ns) * 1e-6 for r in poses.values()]
    first: dict[int, tuple[float, float]] = {}
    for t in run.telegrams:
        row = poses.get(t.telegram.sequence)
        if row is not None and t.telegram.sequence not in first:
            first[t.telegram.sequence] = ((t.recv_ns - row.stamp_ns) * 1e-6, 1e3 * t.telegram.age_s)
    budget = wire_budget(base)
    wire_ms = 1e3 * (budget.request_bytes * budget.char_s + budget.gap_s)
    registered = [r for r, _ in first.values()]
    sent = [age for _, age in first.values()]
    return {
        "exposure to Zenoh sample": spread(sample),
        "exposure to telegram begun (wire excluded)": spread(sent),
        "exposure to base register (wire included)": spread(registered),
        "wire_ms": wire_ms,
        "camera_hz": RATE_HZ,
        "base_hz": base.rate_hz,
    }


def spread(values: Sequence[float]) -> dict[str, float]:
    v = np.array(values, np.float64)
    if not len(v):
        return {"count": 0, "median": math.nan, "p99": math.nan, "max": math.nan}
    return {
        "count": len(v),
        "median": float(np.median(v)),
        "p99": float(np.percentile(v, 99)),
        "max": float(v.max()),
    }


if __name__ == "__main__":
    sys.exit(main())
