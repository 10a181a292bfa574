"""What a soak says: growth after warm-up, recovery from every stroke, wrong poses called good, latency over time."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from ceilvo.bench.soak.fault_plan import WARM_UP_S, Stroke
from ceilvo.bench.soak.flood_verdict import calm, flood_bars, flood_lines, floods_met
from ceilvo.bench.soak.parts import Heard, Usage
from ceilvo.bench.soak.poses import Floats, Poses
from ceilvo.sim.world import World
from ceilvo.types import State

GROWTH_BAR_BYTES = 1e6  # the bar of docs/faults.md, from first to last tenth
RECOVERY_BAR_S = 2.0  # a bar, chosen; docs/faults.md has what was found
WRONG_M = 0.3  # the bar of docs/faults.md, half a tile
STALL_BAR_S = 0.2  # after the first missing frame; the bar of docs/faults.md
_BLIND = ("unplugged", "stalled", "frozen picture", "black picture", "white picture", "corrupt frames")
_NS = 1e-9  # s in a nanosecond


def judge(
    heard: Heard,
    usage: Sequence[Usage],
    plan: Sequence[Stroke],
    world: World,
    t0_ns: int,
    code: int,
    struck: Mapping[str, int],
) -> dict[str, Any]:
    """Figures, lines to print, and whether every bar was met."""
    poses = Poses(heard, world, t0_ns)
    growth = _growth(usage, plan)
    recovery = _recovery(poses, heard, plan, t0_ns)
    wrong = float(np.sum(poses.gap_s[(poses.state == State.TRACKING) & (poses.error_m > WRONG_M)]))
    flagged = [f for s in plan if s.fault.name in _BLIND if (f := poses.flagged_after_s(s)) is not None]
    quiet = poses.quiet(plan)
    latency = 1e3 * poses.latency_s[quiet]
    out: dict[str, Any] = {
        "hours": (usage[-1].t_s if usage else 0.0) / 3600.0,
        "exit_code": code,
        "strokes": len(plan),
        "floods": floods_met(poses, usage, plan, struck),
        "poses": len(poses.t_s),
        "growth": growth,
        "recovery_s": recovery,
        "tracking_but_wrong_s": wrong,
        "flagged_after_s": _spread(flagged),
        "latency_ms": _spread(latency),
        "error_m": _spread(poses.error_m[quiet & (poses.state == State.TRACKING)]),
        "share_tracking": float(np.mean(poses.state == State.TRACKING)) if len(poses.t_s) else 0.0,
        "lost_s": float(np.sum(poses.gap_s[poses.state == State.LOST])),
    }
    bars = _bars(out)
    out["bars"] = {name: met for name, met, _ in bars}
    out["ok"] = all(met for _, met, _ in bars)
    out["lines"] = [f"{'ok    ' if met else 'FAILED'} {name}: {found}" for name, met, found in bars] + _rest(out)
    return out


def _growth(usage: Sequence[Usage], plan: Sequence[Stroke]) -> dict[str, Any]:
    """Memory, descriptors and threads after warm-up, looked at between the strokes."""
    last_s = usage[-1].t_s if usage else 0.0
    warm_s = min(WARM_UP_S, last_s / 3.0)
    still = [u for u in calm(usage, plan) if u.t_s > warm_s]
    if len(still) < 4:
        return {
            "rss_growth_bytes_per_hour": math.nan,
            "descriptors": _thirds([]),
            "threads": _thirds([]),
            "warm_up_s": warm_s,
        }
    t, rss = np.array([u.t_s for u in still]), np.array([u.rss_bytes for u in still], np.float64)
    tenth = max(1, len(still) // 10)
    return {
        "warm_up_s": warm_s,
        "rss_growth_bytes_per_hour": 3600.0 * float(np.polyfit(t, rss, 1)[0]),
        "rss_first_tenth_bytes": float(np.median(rss[:tenth])),
        "rss_last_tenth_bytes": float(np.median(rss[-tenth:])),
        "rss_max_bytes": float(rss.max()),
        "descriptors": _thirds([u.descriptors for u in still]),
        "threads": _thirds([u.threads for u in still]),
        "cpu_share": (still[-1].cpu_s - still[0].cpu_s) / (still[-1].t_s - still[0].t_s),
    }


def _thirds(counts: Sequence[int]) -> dict[str, list[int]]:
    """Values that occurred in the first and in the last third of the time after warm-up."""
    third = max(1, len(counts) // 3)
    return {"first": sorted(set(counts[:third])), "last": sorted(set(counts[-third:]))}


def _constant(thirds: dict[str, list[int]]) -> bool:
    """Neither more nor fewer in the end: pools of threads may breathe, but not grow."""
    first, last = thirds["first"], thirds["last"]
    return bool(first and last and max(last) <= max(first) and min(last) <= min(first))


def _recovery(poses: Poses, heard: Heard, plan: Sequence[Stroke], t0_ns: int) -> dict[str, dict[str, Any]]:
    """Seconds from the end of each stroke until what it struck works again, by fault."""
    answered = np.array([_NS * (a - t0_ns) for _, a in heard.answered_ns])
    out: dict[str, list[float]] = {}
    for s in plan:
        if s.fault.part == "base":
            later = answered[answered > s.to_s]
            took: float | None = float(later[0] - s.to_s) if len(later) else None
        else:
            took = poses.first(s.to_s, (State.TRACKING,))
        out.setdefault(f"{s.fault.part}: {s.fault.name}", []).append(math.inf if took is None else took)
    return {name: _spread(v) for name, v in out.items()}


def _bars(r: dict[str, Any]) -> list[tuple[str, bool, str]]:
    g = r["growth"]
    grown = g.get("rss_last_tenth_bytes", math.nan) - g.get("rss_first_tenth_bytes", math.nan)
    worst = max((v["max"] for v in r["recovery_s"].values()), default=math.inf)
    slowest = max(r["recovery_s"], key=lambda k: r["recovery_s"][k]["max"], default="-")
    flagged = r["flagged_after_s"]
    return [
        ("daemon lived to the end, exit 0", r["exit_code"] == 0, f"exit code {r['exit_code']}"),
        ("memory after warm-up", grown < GROWTH_BAR_BYTES,
         f"{grown / 1e6:+.2f} MB first to last tenth, slope {g['rss_growth_bytes_per_hour'] / 1e6:+.2f} MB/h (< 1)"),
        ("descriptors constant", _constant(g["descriptors"]), f"{g['descriptors']}"),
        ("threads constant", _constant(g["threads"]), f"{g['threads']}"),
        ("recovery", worst <= RECOVERY_BAR_S, f"slowest {worst:.2f} s ({slowest}) (<= {RECOVERY_BAR_S:g} s)"),
        ("blind camera flagged", flagged["max"] <= STALL_BAR_S + 0.05,
         f"median {1e3 * flagged['median']:.0f}, max {1e3 * flagged['max']:.0f} ms after the cause "
         "(<= 200 ms after the first missing frame, which is up to 50 ms later)"),
        *flood_bars(r["floods"]),
        ("TRACKING but wrong", r["tracking_but_wrong_s"] == 0.0, f"{r['tracking_but_wrong_s']:.2f} s (0 s)"),
    ]  # fmt: skip


def _rest(r: dict[str, Any]) -> list[str]:
    lat, err = r["latency_ms"], r["error_m"]
    return [
        *flood_lines(r["floods"]),
        f"       {r['hours']:.2f} h, {r['strokes']} strokes, {r['poses']} poses",
        f"       latency between strokes: median {lat['median']:.1f} ms, p99 {lat['p99']:.1f} ms",
        f"       error between strokes: median {1e3 * err['median']:.1f} mm, max {1e3 * err['max']:.1f} mm",
        f"       TRACKING {100 * r['share_tracking']:.1f} % of the poses, LOST {r['lost_s']:.1f} s, "
        f"processor {100 * r['growth'].get('cpu_share', math.nan):.0f} % of one (the simulator's rendering included)",
    ]  # fmt: skip


def _spread(values: Sequence[float] | Floats) -> dict[str, Any]:
    v = np.asarray(values, np.float64)
    if not len(v):
        return {"count": 0, "median": math.nan, "p99": math.nan, "max": math.nan}
    with np.errstate(invalid="ignore"):
        p99 = float(np.percentile(v, 99)) if np.all(np.isfinite(v)) else math.inf
    return {"count": len(v), "median": float(np.median(v)), "p99": p99, "max": float(v.max())}
