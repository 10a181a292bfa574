"""Tables and bars of laps, of starts in a hall, and of renovated ceilings."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from rich.table import Table

from ceilvo.bench.place.tables import median, share_bar, wrong_s
from ceilvo.bench.results.bars import Bar

Result = dict[str, Any]
_ALARMS_PER_H = 0.1  # this bar and the following: issue 12
_START_MEDIAN_M, _VIEW_MS = 5.0, 50.0
_RENOVATED_S, _NOT_THIS_MAP_S = 5.0, 10.0
_MAP_SHARE = 0.95
"""Of a map that is right after three laps; chosen: the rest are crossings that are hardly ever seen."""


def laps(results: Sequence[Result]) -> Table:
    columns = ("room m", "tile m", "lamps", "wheels", "map", "hours", "TRACKING %", "wrong s T, D", "worst m", "alarms")
    out = Table(*columns, "ms", "p99")
    for r in results:
        f = r["run"]
        out.add_row(
            r["size"],
            f"{r['tile_m']}",
            r["lamps"],
            "yes" if r["wheels"] else "no",
            "learnt" if r["learnt"] else "known",
            f"{f['seconds'] / 3600.0:.2f}",
            f"{100.0 * f['state_s'].get('TRACKING', 0.0) / f['seconds']:.1f}",
            f"{wrong_s([f], 'TRACKING'):.1f}, {wrong_s([f], 'DEGRADED'):.1f}",
            f"{max(f['worst_m'].values(), default=0.0):.3f}",
            f"{f['alarms']}",
            f"{r['step_ms']['median']:.1f}",
            f"{r['step_ms']['p99']:.1f}",
        )
    return out


def laps_bars(results: Sequence[Result]) -> list[Bar]:
    f = [r["run"] for r in results]
    hours = sum(x["seconds"] for x in f) / 3600.0
    wrong = wrong_s(f, "TRACKING") + wrong_s(f, "DEGRADED")
    rate = sum(x["alarms"] for x in f) / hours
    return [
        Bar("TRACKING or DEGRADED wrong, s", wrong, f"{wrong:.1f} in {hours:.1f} h", high=0.0),
        Bar("false LOST or RELOCALISING an hour", rate, f"{rate:.2f}", high=_ALARMS_PER_H),
    ]


def start(results: Sequence[Result]) -> Table:
    out = Table(
        "wheels",
        "starts",
        "right",
        "wrong",
        "out of memory",
        "still searching",
        "m, median",
        "m, 90 %",
        "can be told, m, median",
        "wrong s",
        "ms",
        "p99",
    )
    for wheels in (True, False):
        group = [r for r in results if r["wheels"] is wheels]
        found = [r["found_m"] for r in group if r["found_m"] is not None]
        if not group:
            continue
        out.add_row(
            "yes" if wheels else "no",
            f"{len(group)}",
            f"{sum(r['right'] for r in group)}",
            f"{sum(_was_wrong(r) for r in group)}",
            f"{sum(bool(r['failed']) for r in group)}",
            f"{sum(r['found_m'] is None and not r['failed'] for r in group)}",
            median(found),
            f"{np.quantile(found, 0.9):.1f}" if found else "-",
            f"{np.median(_told_m(group)):.1f}",
            f"{wrong_s((r['run'] for r in group), 'TRACKING'):.1f}",
            median([r["step_ms"]["median"] for r in group]),
            median([r["step_ms"]["p99"] for r in group]),
        )
    return out


def _told_m(results: Sequence[Result]) -> list[float]:
    """Driven until the place can be told; infinite where that was not yet."""
    return [np.inf if r["run"]["told_m"] is None else r["run"]["told_m"] for r in results]


def _was_wrong(r: Result) -> bool:
    return bool(r["run"]["wrong_s"])


def start_bars(results: Sequence[Result]) -> list[Bar]:
    found = [np.inf if r["found_m"] is None or _was_wrong(r) else r["found_m"] for r in results]
    middle, ms = float(np.median(found)), float(np.median([r["step_ms"]["median"] for r in results]))
    can = float(np.median(_told_m(results)))
    return [
        share_bar("right or still searching, share", [not _was_wrong(r) for r in results], 1.0),
        Bar("driven until right, median, m", middle, f"{middle:.1f}, {can:.1f} at best", high=_START_MEDIAN_M),
        Bar("a view, median, ms", ms, f"{ms:.1f}", high=_VIEW_MS),
    ]


def renovated(results: Sequence[Result]) -> Table:
    columns = (
        "new %",
        "runs",
        "wrong s T, D",
        "right again, s",
        "not again",
        "last TRACKING s",
        "TRACKING %",
        "not this map",
    )
    out = Table(*columns, "map has %", "is true %")
    for share in sorted({r["share"] for r in results}):
        group = [r for r in results if r["share"] == share]
        f = [r["run"] for r in group]
        back = [x["recovered_s"] for x in f if x["recovered_s"] is not None]
        tracking = sum(x["state_s"].get("TRACKING", 0.0) for x in f) / sum(x["seconds"] for x in f)
        out.add_row(
            f"{100.0 * share:.0f}",
            f"{len(group)}",
            f"{wrong_s(f, 'TRACKING'):.1f}, {wrong_s(f, 'DEGRADED'):.1f}",
            median(back),
            f"{len(f) - len(back)}",
            median([r["last_tracking_s"] for r in group]),
            f"{100.0 * tracking:.0f}",
            f"{sum(r['not_this_map_s'] is not None for r in group)}",
            median([100.0 * r["map_recall"] for r in group]),
            median([100.0 * r["map_precision"] for r in group]),
        )
    return out


def renovated_bars(results: Sequence[Result]) -> list[Bar]:
    part, whole = ([r for r in results if (r["share"] < 1.0) is is_part] for is_part in (True, False))
    back = [r["run"]["recovered_s"] for r in part]
    return [
        share_bar("30 % new: right within 5 s, share", [s is not None and s <= _RENOVATED_S for s in back], 1.0),
        share_bar(
            "30 % new: map right after 3 laps, share",
            [min(r["map_recall"], r["map_precision"]) >= _MAP_SHARE for r in part],
            1.0,
        ),
        share_bar(
            "all new: not TRACKING after 10 s, share", [r["last_tracking_s"] <= _NOT_THIS_MAP_S for r in whole], 1.0
        ),
        share_bar(
            "all new: says not this map within 10 s, share",
            [r["not_this_map_s"] is not None and r["not_this_map_s"] <= _NOT_THIS_MAP_S for r in whole],
            1.0,
        ),
        share_bar("30 % new: never says so, share", [r["not_this_map_s"] is None for r in part], 1.0),
    ]


def heights(results: Sequence[Result]) -> Table:
    columns = ("height, share", "runs", "wrong s T, D", "worst m", "TRACKING %", "not this map", "s, median")
    out = Table(*columns, "within 10 s", "map kept")
    for ratio in sorted({r["ratio"] for r in results if r["settled"]}):
        group = [r for r in results if r["settled"] and r["ratio"] == ratio]
        f, said = [r["run"] for r in group], [r["not_this_map_s"] for r in group if r["not_this_map_s"] is not None]
        out.add_row(
            f"{ratio:.2f}",
            f"{len(group)}",
            f"{wrong_s(f, 'TRACKING'):.1f}, {wrong_s(f, 'DEGRADED'):.1f}",
            f"{max((m for x in f for m in x['worst_m'].values()), default=0.0):.2f}",
            f"{100.0 * sum(x['state_s'].get('TRACKING', 0.0) for x in f) / sum(x['seconds'] for x in f):.0f}",
            f"{len(said)}",
            median(said),
            f"{sum(s <= _NOT_THIS_MAP_S for s in said)}",
            f"{sum(r['kept'] for r in group)}",
        )
    return out


def heights_bars(results: Sequence[Result]) -> list[Bar]:
    group = [r for r in results if r["settled"]]
    f, said = [r["run"] for r in group], [r["not_this_map_s"] for r in group]
    wrong = wrong_s(f, "TRACKING") + wrong_s(f, "DEGRADED")
    return [
        Bar("TRACKING or DEGRADED wrong, s", wrong, f"{wrong:.1f} in {len(group)} runs", high=0.0),
        share_bar("says not this map within 10 s, share", [s is not None and s <= _NOT_THIS_MAP_S for s in said], 1.0),
        share_bar("map kept to the bit, share", [r["kept"] for r in group], 1.0),
    ]


def rides(results: Sequence[Result]) -> Table:
    columns = (
        "way",
        "other floor",
        "rides",
        "found",
        "wrong s T, D",
        "after s, median",
        "worst",
        "after m",
        "ms",
        "p99",
    )
    out = Table(*columns)
    for way, above in sorted({(r["way"], r["above"]) for r in results}):
        group = [r for r in results if (r["way"], r["above"]) == (way, above)]
        f, found = [r["run"] for r in group], [r for r in group if r["found"]]
        out.add_row(
            way,
            above,
            f"{len(group)}",
            f"{len(found)}",
            f"{wrong_s(f, 'TRACKING'):.1f}, {wrong_s(f, 'DEGRADED'):.1f}",
            median([r["found_s"] for r in found]),
            f"{max((r['found_s'] for r in found), default=np.nan):.1f}",
            median([r["found_m"] for r in found]),
            median([r["step_ms"]["median"] for r in group]),
            median([r["step_ms"]["p99"] for r in group]),
        )
    return out


def rides_bars(results: Sequence[Result]) -> list[Bar]:
    return [
        share_bar("never wrong after a ride, share", [not _was_wrong(r) for r in results], 1.0),
        share_bar("right floor found within 3 min, share", [bool(r["found"]) for r in results], 1.0),
    ]
