"""Tables, bars and verdicts of the recorded robots' figures."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from rich.table import Table

from ceilvo.bench.results.bars import Bar

LOCALISE = ("rmse_m", "rmse_over_time_m", "max_m", "theta_rmse_deg", "nees_mean", "nees_median", "us_per_update")
SLAM = ("rmse_aligned_m", "rmse_m", "landmark_rmse_aligned_m", "landmarks")


@dataclass(frozen=True, order=True)
class Cell:
    """One filter on one robot; trial -1 is the whole run."""

    task: str
    filter: str
    particles: int
    robot: int
    trial: int
    seed: int


Results = dict[Cell, dict[str, Any]]


def mean_over_robots(results: Results, task: str, name: str, figure: str) -> float:
    """Mean over the seeds of a robot, then over the robots."""
    by_robot: dict[int, list[float]] = {}
    for c, f in results.items():
        if (c.task, c.filter) == (task, name) and figure in f:
            by_robot.setdefault(c.robot, []).append(float(f[figure]))
    return float(np.mean([np.mean(v) for v in by_robot.values()])) if by_robot else float("nan")


def whole_rows(results: Results, task: str, figures: Sequence[str]) -> list[dict[str, Any]]:
    names = dict.fromkeys(c.filter for c in results if c.task == task)
    return [{"filter": n, **{f: mean_over_robots(results, task, n, f) for f in figures}} for n in names]


def trial_rows(results: Results, task: str) -> list[dict[str, Any]]:
    """Trials of all robots together."""
    rows = []
    for name in dict.fromkeys(c.filter for c in results if c.task == task):
        of = [(c, f) for c, f in results.items() if (c.task, c.filter) == (task, name)]
        found = np.array([f["found_s"] for _, f in of if "found_s" in f])
        if len(found):
            good = found[np.isfinite(found)]
            median = float(np.median(good)) if len(good) else float("inf")
            fraction = len(good) / len(found)
            row = {"filter": name, "trials": len(found), "found": len(good), "share": fraction, "median_s": median}
            rows.append(row)
    return rows


def bars(results: Results) -> list[Bar]:
    def mean(task: str, name: str, figure: str) -> float:
        return mean_over_robots(results, task, name, figure)

    rmse, nees = mean("localise", "joint", "rmse_m"), mean("localise", "joint", "nees_mean")
    ratio = rmse / mean("localise", "ukf_gated", "rmse_m")
    out = [
        Bar("known map: joint RMSE m", rmse, f"{rmse:.4f}", high=0.138),
        Bar("known map: joint NEES (xy)", nees, f"{nees:.2f}", high=2.5),
        Bar("known map: joint / ukf_gated", ratio, f"{ratio:.3f}", high=1.03),
    ]
    for rival, high in (("ukf_gated", 1.05), ("pf", 0.7)):
        r = mean("slam", "joint", "rmse_aligned_m") / mean("slam", rival, "rmse_aligned_m")
        out.append(Bar(f"SLAM aligned: joint / {rival}", r, f"{r:.3f}", high=high))
    for task, title, least, seconds in (("start", "start anywhere", 0.95, 5.0), ("kidnap", "60 s jump", 1.0, 15.0)):
        for row in trial_rows(results, task):
            if row["filter"] == "joint":
                of = f"{row['found']} of {row['trials']}"
                out.append(Bar(f"{title}: joint found", row["share"], of, low=least))
                out.append(Bar(f"{title}: joint median s", row["median_s"], f"{row['median_s']:.1f}", high=seconds))
    return [b for b in out if not np.isnan(b.value)]


def verdicts(results: Results) -> list[str]:
    """Who is best, from the figures."""
    out = []
    for task, figure in (("localise", "rmse_m"), ("slam", "rmse_aligned_m")):
        rows = sorted(whole_rows(results, task, (figure,)), key=lambda row: float(row[figure]))
        if rows:
            listed = ", ".join(f"{r['filter']} {r[figure]:.4f} m" for r in rows)
            out.append(f"{task}: {rows[0]['filter']} is best ({listed}).")
    for task in ("start", "kidnap"):
        trials = sorted(trial_rows(results, task), key=lambda row: (-row["found"], row["median_s"]))
        if trials:
            listed = ", ".join(f"{r['filter']} {r['found']}/{r['trials']} ({r['median_s']:.1f} s)" for r in trials)
            out.append(f"{task}: {trials[0]['filter']} is best ({listed}).")
    return out


def as_table(rows: list[dict[str, Any]], title: str) -> Table:
    out = Table(*rows[0], title=title)
    for row in rows:
        out.add_row(*(_cell(v) for v in row.values()))
    return out


def _cell(value: Any) -> str:
    if isinstance(value, float):
        return f"{value:.4f}" if abs(value) < 1.0 else f"{value:.2f}"
    return str(value)
