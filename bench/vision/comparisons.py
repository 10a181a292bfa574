"""Conditions held to a twin that was run with them, the same without what is asked about: ratios of figures.

- open cells: a step takes at most twice as long as on the base ceiling, in the median and at p99.
- a rolling shutter of 20 ms, and several heights that are known beforehand: as good as a global shutter, and as a flat
  ceiling. The issue says of the former what that means, within 1.5 times; it is taken for both.

Both conditions run with one seed, so what the ceiling has of its own is the same.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from ceilvo.bench.results.bars import Bar
from ceilvo.bench.vision.condition import Condition
from ceilvo.bench.vision.conditions import KNOWN

AS_GOOD = 1.5
"""Times the twin's errors, at most; the issue's, of a rolling shutter."""
AS_LONG = 2.0
"""Times the twin's time, at most; the issue's, of open cells."""
_ERRORS = ("motion_median_mm", "motion_p95_mm", "worst_mm")
_TIMES = ("step_median_ms", "step_p99_ms")


@dataclass(frozen=True)
class Comparison:
    """Figures of a condition over the same of its twin, each `at_most`."""

    condition: str
    twin: str
    figures: tuple[str, ...]
    at_most: float


def comparisons(names: Sequence[str]) -> list[Comparison]:
    """Those of which both conditions are among the names."""
    known = [Comparison(name, "base", _ERRORS, AS_GOOD) for name in names if name.endswith(KNOWN)]
    every = (
        Comparison("open-cells", "base", _TIMES, AS_LONG),
        Comparison("rolling-20ms", "turning", _ERRORS, AS_GOOD),
        *known,
    )
    return [c for c in every if {c.condition, c.twin} <= set(names)]


def compared(chosen: Sequence[Condition], results: Sequence[dict[str, float]]) -> list[Bar]:
    """The ratios of what was run, with their bars."""
    figures = {condition.name: its for condition, its in zip(chosen, results, strict=True)}
    return [
        _ratio(c, name, figures[c.condition][name], figures[c.twin][name])
        for c in comparisons(list(figures))
        for name in c.figures
    ]


def _ratio(c: Comparison, name: str, value: float, twin: float) -> Bar:
    """Not a number, which meets no bar, where the twin's figure is none to divide by."""
    ratio = value / twin if twin > 0.0 else float("nan")
    return Bar(f"{c.condition} / {c.twin}, {name}", ratio, f"{ratio:.2f} ({value:.3g}, {twin:.3g})", high=c.at_most)
