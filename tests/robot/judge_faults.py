"""What the virtual robot did about each fault: a table, and faults.json.

judge_faults.py OUT SUMMARY; exit status 1 when a promise is broken. Knows the messages, not ceilvo's code.
Where the host gave no real-time priority, other work makes times longer: they are shown, and not judged.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from judge import Check, phases, told

GOOD = ("TRACKING", "DEGRADED")
FLAGGED_S = 0.3
"""From the first missing frame's due time: 200 ms, a period (67 ms) until that is published, and the timing."""
RECOVERY_S = 2.0
PROCESS_S = 5.0
CAMERA = ("stall", "frozen", "black", "white", "replug")


@dataclass(frozen=True)
class Life:
    """Facts, and pose samples as (recv_ns, state, reason)."""

    facts: dict[str, str]
    poses: list[tuple[int, str, str]]
    journal: str
    timed: bool

    def within(self, seconds: float, limit_s: float) -> bool | None:
        """Whether a time was kept, None where it says nothing."""
        return seconds <= limit_s if self.timed else None

    def ns(self, name: str) -> int:
        return int(self.facts.get(name, "0"))

    def first(self, after_ns: int, good: bool) -> float:
        """Seconds from a time until a pose that is (not) good; inf when none came."""
        for recv_ns, state, _ in self.poses:
            if recv_ns > after_ns and (state in GOOD) == good:
                return (recv_ns - after_ns) / 1e9
        return float("inf")


def read(out: Path) -> Life:
    facts = dict(line.split("=", 1) for line in _text(out / "facts.txt").splitlines())
    poses = []
    for line in _text(out / "samples.jsonl").splitlines():
        try:
            sample: dict[str, Any] = json.loads(line)
        except ValueError:
            continue  # the writer was killed in the middle of the last
        if sample["key"].endswith("/pose"):
            poses.append((sample["recv_ns"], sample["body"]["state"], sample["body"]["reason"]))
    return Life(facts, poses, _text(out / "service.txt"), _text(out / "priority").strip() == "chrt")


def _text(path: Path) -> str:
    return path.read_text(errors="replace") if path.exists() else ""


def _after_kills(life: Life) -> Iterator[float]:
    """Seconds from each kill to the first pose that came after another process was ready."""
    for name in [n for n in life.facts if n.startswith("kill") and n.endswith("_ns")]:
        seen_ns = life.ns(name.replace("kill", "life"))
        came = (recv_ns for recv_ns, *_ in life.poses if 0 < seen_ns < recv_ns)
        yield (next(came, float("inf")) - life.ns(name)) / 1e9


def checks(life: Life) -> Iterator[Check]:
    f = life.facts
    yield phases(f)
    yield Check(
        "STATUS= without a camera", f.get("status_absent", "-"), "names it", "camera" in f.get("status_absent", "")
    )
    for name in CAMERA:
        if f"{name}_begin_ns" not in f:
            continue
        flagged = life.first(life.ns(f"{name}_begin_ns"), good=False)
        promise = f"<= {FLAGGED_S:g} s" if name != "replug" else ""
        yield Check(
            f"{name}: flagged after",
            f"{flagged:.2f} s",
            promise,
            life.within(flagged, FLAGGED_S) if promise else None,
            flagged,
        )
        yield from _recovered(life, name)
        status = f.get(f"status_{name}", "")
        yield Check(f"{name}: STATUS=", status, "no good state", not status.startswith(GOOD))
    if "format_end_ns" in f:
        yield from _recovered(life, "format")
    if f.get("phase_formats"):
        pixels = [name.removeprefix("pixels_") for name, state in f.items() if name.startswith("pixels_")]
        yield Check("formats of pixels: TRACKING", ", ".join(pixels), "all", f["phase_formats"] == "ok")
    for name in ("base", "disk", "readonly", "clock", "starved", "memory"):
        if f"{name}_begin_ns" in f:
            span = life.ns(f"{name}_begin_ns"), life.ns(f"{name}_end_ns")
            states = [s for t, s, _ in life.poses if span[0] <= t <= span[1]]
            share = sum(s in GOOD for s in states) / max(len(states), 1)
            kept = share == 1.0 if name in ("base", "disk", "readonly", "clock") else None
            yield Check(
                f"{name}: poses good meanwhile",
                f"{100 * share:.0f} % of {len(states)}",
                "all" if kept is not None else "",
                kept,
            )
    if "memory_end_ns" in f:
        back = life.first(life.ns("memory_end_ns"), good=True)
        kept = life.within(back, PROCESS_S)
        yield Check("memory: same process", f.get("memory_same_process", "-"), "", None)
        yield Check("memory: good again after", f"{back:.2f} s", f"<= {PROCESS_S:g} s", kept, back)
    kills = list(_after_kills(life))
    slowest = max(kills, default=float("inf"))
    yield Check(
        "kill -9: next pose after",
        f"{[round(k, 2) for k in kills]} s",
        f"<= {PROCESS_S:g} s",
        life.within(slowest, PROCESS_S),
        slowest,
    )
    yield Check("kill -9: files damaged or left", f.get("rejected", "-"), "0", f.get("rejected") == "0")
    yield Check(
        "half a calibration",
        f.get("calibration_end", "-"),
        "78, stays down",
        f.get("calibration_end") == "status 78, failed",
    )
    tracebacks = life.journal.count("Traceback (most recent call last)")
    yield Check("Python tracebacks", str(tracebacks), "0", tracebacks == 0 and bool(life.journal))


def _recovered(life: Life, name: str) -> Iterator[Check]:
    took = life.first(life.ns(f"{name}_end_ns"), good=True)
    yield Check(
        f"{name}: good again after", f"{took:.2f} s", f"<= {RECOVERY_S:g} s", life.within(took, RECOVERY_S), took
    )


def main() -> int:
    out, summary = (Path(a) for a in sys.argv[1:])
    return told(list(checks(read(out))), summary)


if __name__ == "__main__":
    sys.exit(main())
