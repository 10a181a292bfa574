"""Figures of many cases: a row for each kind of fault, and the issue's bars."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
from rich.table import Table

from ceilvo.bench.place.faults.kinds import CARRIED_KINDS
from ceilvo.bench.results.bars import Bar

Result = dict[str, Any]
SAY_BAR_S = 1.0
FOUND_BAR = (10.0, 15.0)
"""Metres or seconds within which a robot that was carried is found, in FOUND_SHARE of the tries."""
FOUND_SHARE = 0.95
RESTART_BAR_S = 1.0
"""These bars: issue 12."""
_SETTLED_SHARE = 0.95
"""Of robots that get as far as to have a fault; chosen: large tiles in a small room show few crossings."""


def by_kind(results: Iterable[Result]) -> dict[str, list[Result]]:
    out: dict[str, list[Result]] = {}
    for r in results:
        out.setdefault(r["kind"], []).append(r)
    return out


def table(results: Sequence[Result]) -> Table:
    """A row for each kind, and one for all."""
    columns = ("fault", "cases", "TRACKING wrong s", "DEGRADED", "of it wheels", "worst m", "worst deg", "wrong cases")
    times = ("say s, median", "max", "found again", "s, median", "m, median", "TRACKING %", "ms", "p99")
    out = Table(*columns, *times)
    for kind, group in by_kind(results).items():
        out.add_row(*_row(kind, group))
    out.add_row(*_row("all", list(results)))
    return out


def _row(name: str, group: Sequence[Result]) -> list[str]:
    f = [r["fault"] for r in group if r["settled"]]
    failed, not_settled = sum(bool(r["failed"]) for r in group), len(group) - len(f)
    cases = f"{len(f)}" + (f" (+{not_settled} never TRACKING)" if not_settled else "")
    cases += f", {failed} out of memory" if failed else ""
    if not f:
        return [name, cases, *["-"] * 14]
    say = [x["say_s"] for x in f if x["say_s"] > 0.0 and not x["wrong_now"]]
    never = sum(x["wrong_now"] for x in f)
    found = [x for x in f if x["recovered_s"] is not None]
    seconds = sum(x["seconds"] for x in f)
    tracking = 100.0 * sum(x["state_s"].get("TRACKING", 0.0) for x in f) / seconds
    return [
        name,
        cases,
        f"{wrong_s(f, 'TRACKING'):.1f}",
        f"{wrong_s(f, 'DEGRADED'):.1f}",
        f"{sum(sum(r['fault']['wrong_s'].values()) for r in group if r['settled'] and r['wheels']):.1f}",
        f"{_worst(f, 'worst_m'):.2f}",
        f"{np.degrees(_worst(f, 'worst_rad')):.1f}",
        f"{sum(bool(x['wrong_s']) for x in f)}",
        median(say),
        (f"{max(say):.1f}" if say else "-") + (f", {never} never" if never else ""),
        f"{len(found)}/{len(f)}",
        median([x["recovered_s"] for x in found]),
        median([x["recovered_m"] for x in found]),
        f"{tracking:.0f}",
        median([r["step_ms"]["median"] for r in group if r["settled"]]),
        median([r["step_ms"]["p99"] for r in group if r["settled"]]),
    ]


def wrong_s(figures: Iterable[Result], state: str) -> float:
    return float(sum(x["wrong_s"].get(state, 0.0) for x in figures))


def _worst(figures: Iterable[Result], name: str) -> float:
    return float(max((v for x in figures for v in x[name].values()), default=0.0))


def median(values: Sequence[float]) -> str:
    return f"{np.median(values):.1f}" if len(values) else "-"


def fault_bars(results: Sequence[Result]) -> list[Bar]:
    """What the issue asks of faults."""
    settled = [r for r in results if r["settled"]]
    f = [r["fault"] for r in settled]
    wrong = wrong_s(f, "TRACKING") + wrong_s(f, "DEGRADED")
    before = [r["before"] for r in results]
    wrong_before = wrong_s(before, "TRACKING") + wrong_s(before, "DEGRADED")
    out = [
        Bar("TRACKING or DEGRADED wrong, s", wrong, f"{wrong:.1f}", high=0.0),
        Bar("the same before the fault, s", wrong_before, f"{wrong_before:.1f}", high=0.0),
        share_bar("TRACKING within 60 s on the map it has, share", [r["settled"] for r in results], _SETTLED_SHARE),
        share_bar("ran within memory, share", [not r["failed"] for r in results], 1.0),
    ]
    return out + carried_bars(settled)


def carried_bars(results: Sequence[Result]) -> list[Bar]:
    """Of robots that were carried or snatched 1 to 5 tiles."""
    f = [r["fault"] for r in results if r["settled"] and r["kind"] in CARRIED_KINDS]
    if not f:
        return []
    said = [not x["wrong_now"] and x["say_s"] <= SAY_BAR_S for x in f]
    found = [_found(x) for x in f]
    wrong = wrong_s(f, "TRACKING") + wrong_s(f, "DEGRADED")
    told = [found for x, found in zip(f, found, strict=True) if _soon(x["told_s"], x["told_m"])]
    return [
        share_bar("carried 1 to 5 tiles: said within 1 s of motion, share", said, 1.0),
        share_bar("carried 1 to 5 tiles: found within 10 m or 15 s, share", found, FOUND_SHARE),
        share_bar("of those whose place can be told within that, share", told, FOUND_SHARE),
        Bar("carried 1 to 5 tiles: wrong, s", wrong, f"{wrong:.1f}", high=0.0),
    ]


def _found(x: Result) -> bool:
    return _soon(x["recovered_s"], x["recovered_m"])


def _soon(s: float | None, m: float | None) -> bool:
    return s is not None and m is not None and (m <= FOUND_BAR[0] or s <= FOUND_BAR[1])


def share_bar(name: str, good: Sequence[bool], low: float) -> Bar:
    share = float(np.mean(good)) if good else 1.0
    return Bar(name, share, f"{sum(good)} of {len(good)}", low=low)


def restart_bars(results: Sequence[Result]) -> list[Bar]:
    f = [r["fault"] for r in results if r["settled"]]
    soon = [x["recovered_s"] is not None and x["recovered_s"] <= RESTART_BAR_S for x in f]
    wrong = wrong_s(f, "TRACKING") + wrong_s(f, "DEGRADED")
    return [
        share_bar("TRACKING within 1 s, share", soon, FOUND_SHARE),
        Bar("TRACKING or DEGRADED wrong, s", wrong, f"{wrong:.1f}", high=0.0),
    ]


def worst_cases(results: Sequence[Result], most: int) -> list[str]:
    """Those with most seconds of wrong poses, told."""
    wrong = [r for r in results if r["settled"] and r["fault"]["wrong_s"]]
    return [_told(r) for r in sorted(wrong, key=lambda r: -sum(r["fault"]["wrong_s"].values()))[:most]]


def _told(r: Result) -> str:
    about = {k: r[k] for k in ("size", "tile_m", "lamps", "wheels", "map", "eye", "rate_hz", "seed", "number")}
    return f"{r['kind']} {about}: wrong {r['fault']['wrong_s']}\n    " + "; ".join(r["fault"]["reasons"][:6])
