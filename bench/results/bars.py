"""A bar: what a figure must reach, printed beside it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from rich.table import Table


@dataclass(frozen=True)
class Bar:
    """A figure, its bar and what it measures; low and high are inclusive.

    `text` is the figure as printed, e.g. with its interval.
    """

    name: str
    value: float
    text: str
    low: float = float("-inf")
    high: float = float("inf")

    @property
    def met(self) -> bool:
        return self.low <= self.value <= self.high

    @property
    def verdict(self) -> str:
        return "PASS" if self.met else "MISS"

    @property
    def wanted(self) -> str:
        if self.low == float("-inf"):
            return f"<= {self.high:g}"
        return f">= {self.low:g}" if self.high == float("inf") else f"{self.low:g} to {self.high:g}"


def table(bars: list[Bar], title: str) -> Table:
    out = Table("measure", "figure", "bar", "", title=title)
    for b in bars:
        out.add_row(b.name, b.text, b.wanted, f"[{'green' if b.met else 'bold red'}]{b.verdict}[/]")
    return out


def as_json(bars: list[Bar]) -> list[dict[str, Any]]:
    return [{"name": b.name, "value": b.value, "text": b.text, "bar": b.wanted, "verdict": b.verdict} for b in bars]
