"""What a flood cost: the rate of poses while it lasted, and what is left of it in memory two minutes later."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ceilvo.bench.soak.fault_plan import AFTER_FAULT_S, Stroke
from ceilvo.bench.soak.parts import Usage
from ceilvo.bench.soak.poses import Poses

RATE_BAR = 0.9  # of the rate without a flood; the bar of docs/faults.md
MEMORY_BAR = 1.1  # of what it was before, 2 min later; the bar of docs/faults.md
_AFTER_FLOOD_S = 60.0  # free memory goes back to the kernel once a minute


def calm(usage: Sequence[Usage], plan: Sequence[Stroke]) -> list[Usage]:
    """Looks at the process while nothing struck it, nor had just before."""

    def struck(t_s: float) -> bool:
        return any(s.from_s <= t_s < s.to_s + _settling_s(s) for s in plan)

    return [u for u in usage if not struck(u.t_s)]


def floods_met(
    poses: Poses, usage: Sequence[Usage], plan: Sequence[Stroke], struck: Mapping[str, int]
) -> dict[str, dict[str, Any]]:
    """By flood: how often it struck, share of the rate, and memory, descriptors and threads before and after."""
    floods = [s for s in plan if s.fault.part == "flood"]
    blind = [s for s in plan if s.fault.part in ("camera", "process")]
    still = calm(usage, plan)
    faulty = poses.inside(blind)
    usual_hz = _rate_hz(poses, ~(faulty | poses.inside(floods, 0.0)))
    out = {}
    for k, flood in enumerate(floods):
        begun_s = floods[k - 1].to_s if k else 0.0
        before = [u for u in still if begun_s <= u.t_s < flood.from_s]
        after = [u for u in still if flood.to_s <= u.t_s < flood.to_s + flood.fault.rest_s]
        seen = poses.inside([flood], 0.0) & ~faulty
        out[flood.fault.name] = {
            "struck": struck.get(flood.fault.name, 0),
            "seconds": flood.fault.lasts_s,
            "rate_share": _rate_hz(poses, seen) / usual_hz,
            "latency_p99_ms": 1e3 * float(np.percentile(poses.latency_s[seen], 99)) if seen.any() else float("nan"),
            "rss_max_bytes": max((u.rss_bytes for u in usage if flood.from_s <= u.t_s < flood.to_s), default=0),
            "before": _middle(before),
            "after": _middle(after),
        }
    return out


def flood_bars(found: Mapping[str, Mapping[str, Any]]) -> list[tuple[str, bool, str]]:
    out = []
    for name, f in found.items():
        kept, grown = f["rate_share"] >= RATE_BAR, f["after"]["rss_bytes"] / f["before"]["rss_bytes"]
        out.append((f"rate in {name}", bool(kept), f"{100 * f['rate_share']:.1f} % (>= {100 * RATE_BAR:.0f} %)"))
        flat = all(f["after"][k] <= f["before"][k] for k in ("descriptors", "threads"))
        out.append(
            (f"memory after {name}", bool(grown <= MEMORY_BAR and flat),
             f"{grown:.3f} of what it was (<= {MEMORY_BAR}), descriptors, threads {_count(f['before'])} "
             f"before, {_count(f['after'])} after")
        )  # fmt: skip
    return out


def flood_lines(found: Mapping[str, Mapping[str, Any]]) -> list[str]:
    return [
        f"       {name}: struck {f['struck']} times in {f['seconds']:.0f} s, latency p99 {f['latency_p99_ms']:.0f} ms, "
        f"memory {f['before']['rss_bytes'] / 1e6:.0f} MB, at most {f['rss_max_bytes'] / 1e6:.0f}, "
        f"then {f['after']['rss_bytes'] / 1e6:.0f}"
        for name, f in found.items()
    ]


def _settling_s(stroke: Stroke) -> float:
    return _AFTER_FLOOD_S if stroke.fault.part == "flood" else AFTER_FAULT_S


def _rate_hz(poses: Poses, chosen: NDArray[np.bool_]) -> float:
    """Of some samples, each with the time up to the next one."""
    seconds = float(np.sum(poses.gap_s[chosen]))
    return float(np.count_nonzero(chosen)) / seconds if seconds > 0 else float("nan")


def _middle(looks: Sequence[Usage]) -> dict[str, float]:
    """Median of each, NaN without a look."""
    names = ("rss_bytes", "descriptors", "threads")
    return {n: float(np.median([getattr(u, n) for u in looks])) if looks else float("nan") for n in names}


def _count(look: Mapping[str, float]) -> str:
    return f"{look['descriptors']:.0f}, {look['threads']:.0f}"
