"""Which fault is there at which time: the same answer in every process that asks."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

LEAD_S = 30.0
"""Nothing happens before: the robot starts and builds its map."""
AFTER_FAULT_S = 3.0
"""Until a stroke is over for good; above the bar for recovery."""
WARM_UP_S = 600.0
"""Memory counts from here on (docs/faults.md)."""


@dataclass(frozen=True, slots=True)
class Fault:
    """One cause, how long it lasts and how long the robot is left alone afterwards.

    part: whom it strikes (camera, base, zenoh, process, flood).
    """

    name: str
    part: str
    lasts_s: float
    rest_s: float = 12.0


FAULTS = (
    Fault("unplugged", "camera", 3.0),
    Fault("silent", "base", 3.0),
    Fault("stalled", "camera", 3.0),
    Fault("frozen picture", "camera", 2.0),
    Fault("garbage", "base", 3.0),
    Fault("black picture", "camera", 2.0),
    Fault("subscriber hangs", "zenoh", 4.0),
    Fault("white picture", "camera", 2.0),
    Fault("bad crc", "base", 3.0),
    Fault("corrupt frames", "camera", 2.0),
    Fault("state directory gone", "process", 5.0),
    Fault("stamps run backwards", "camera", 2.0),
    Fault("adapter unplugged", "base", 3.0),
    Fault("stamps jump", "camera", 3.0),
    Fault("slow", "base", 3.0),
    Fault("wrong version", "base", 3.0),
    Fault("stopped", "process", 1.0),
    Fault("reboot", "base", 0.1),
)
"""s; chosen: longer than camera.read_timeout_s (1 s), and for a stopped process less than the watchdog (4 s)."""


@dataclass(frozen=True, slots=True)
class Stroke:
    """A fault with its time, in seconds since the robot started."""

    fault: Fault
    from_s: float

    @property
    def to_s(self) -> float:
        return self.from_s + self.fault.lasts_s


def cycle_s(faults: tuple[Fault, ...] = FAULTS) -> float:
    """Length of one round of all faults."""
    return sum(f.lasts_s + f.rest_s for f in faults)


def strokes(until_s: float, faults: tuple[Fault, ...] = FAULTS) -> list[Stroke]:
    """Every stroke that is over, rest included, by `until_s`."""
    out: list[Stroke] = []
    t = LEAD_S
    while True:
        for fault in faults:
            if t + fault.lasts_s + fault.rest_s > until_s:
                return out
            out.append(Stroke(fault, t))
            t += fault.lasts_s + fault.rest_s


def current(plan: list[Stroke], t_s: float, part: str) -> str:
    """Name of the fault of a part at a time, "" when there is none."""
    return next((s.fault.name for s in plan if s.fault.part == part and s.from_s <= t_s < s.to_s), "")


def floods(until_s: float, names: Sequence[str]) -> list[Stroke]:
    """One flood after the other, all of one length and with a fifth of it to rest, after the warm-up of a long run."""
    first_s = max(LEAD_S, min(WARM_UP_S, until_s / 6.0))
    share_s = (until_s - first_s) / max(1, len(names))
    lasts_s = share_s * 5.0 / 6.0
    return [Stroke(Fault(n, "flood", lasts_s, share_s - lasts_s), first_s + k * share_s) for k, n in enumerate(names)]
