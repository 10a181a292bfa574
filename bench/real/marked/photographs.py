"""Every marked photograph: recall, spurious lines, an overlay, and a robot that stands under it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ceilvo.bench.real.marked.drawing import drawn
from ceilvo.bench.real.marked.judging import Judged, judge
from ceilvo.bench.real.marked.reading import Marked, all_marked
from ceilvo.bench.real.marked.standing import FRAMES, Stood, stand
from ceilvo.bench.vision.run import save_picture
from ceilvo.config import Config
from ceilvo.daemon.vision.finder.line_finder import LineFinder
from ceilvo.types import Lines

TUNED_ON = ("ceiling_still", "industrial_430", "industrial_470")
"""The others were looked at only for the figures."""
RECALL_LEAST, SPURIOUS_MOST, ON_MARKS_LEAST = 0.85, 0.20, 0.97
"""Bars: joints of 3 grey levels in view by length, spurious among the found lines, found length that lies on marks."""
GOOD_LEAST = 0.8
"""Share of the frames in TRACKING or DEGRADED; chosen: of 60, INIT takes 5 and as many more may be doubted."""


def photographs(data: Path, out: Path, stand_frames: int = FRAMES) -> dict[str, dict[str, float]]:
    """Figures of every marked picture that is below `data`, by name; prints a table and writes overlays into `out`.

    Args:
        stand_frames: of a robot that stands under each, at least 1.
    """
    figures: dict[str, dict[str, float]] = {}
    for marked in all_marked():
        gray = marked.gray(data)
        if gray is None:
            print(f"{marked.name}: left out, {data / marked.picture} is absent")
            continue
        if not figures:
            print(_HEAD)
        lines, judged = look(gray, marked)
        picture = drawn(gray, lines, judged, marked, Config().features.max_view_deg)
        save_picture(out / f"{marked.name}_marked.png", picture)
        figures[marked.name] = _figures(judged, stand(gray, marked.calibration, stand_frames))
        print(_row(marked.name, figures[marked.name]))
    if figures:
        print(f"spurious and missed lines are drawn in {out}/*_marked.png; * held out of tuning")
    return figures


def look(gray: NDArray[np.uint8], marked: Marked) -> tuple[Lines, Judged]:
    """Lines of one picture with the default settings, as the daemon's first frame finds them, and how good they are."""
    features = Config().features
    lines = LineFinder(marked.calibration, features)(gray, None)
    if lines is None:
        lines = _no_lines()
    return lines, judge(lines, marked, features.max_view_deg)


def _no_lines() -> Lines:
    none, whole, two = np.zeros(0), np.zeros(0, np.int64), np.zeros(2)
    points = np.zeros((0, 2), np.float32)
    return Lines(0.0, 0.0, whole, none, none, whole, whole, two, two, two, two, points, whole)


def _figures(judged: Judged, stood: Stood) -> dict[str, float]:
    return {
        "recall_joints": judged.recall_joints,
        **({} if np.isnan(judged.recall_far) else {"recall_far": judged.recall_far}),
        "recall_all": judged.recall_all,
        "lines_true": float(np.sum(judged.true)),
        "lines_spurious": float(np.sum(judged.spurious)),
        "lines_apart": float(np.sum(judged.apart)),
        "spurious_share": judged.spurious_share,
        "on_marks": judged.on_marks,
        **{f"stand_{name}": float(count) for name, count in stood.frames.items()},
        "stand_good_share": stood.good / sum(stood.frames.values()),
        "stand_spread_mm": 1e3 * stood.spread_m,
        "stand_good_spread_mm": 1e3 * stood.good_spread_m,
        "stand_crossings_least": float(stood.crossings[0]),
    }


_HEAD = (
    f"{'photograph':18}{'joints found':>14}{'far':>8}{'all':>8}{'true, spurious, apart':>24}{'spurious':>14}"
    f"{'on marks':>14}{'stands: good':>14}{'spread mm':>11}"
)


def _row(name: str, f: dict[str, float]) -> str:
    counts = ", ".join(f"{f[k]:.0f}" for k in ("lines_true", "lines_spurious", "lines_apart"))
    title = name if name in TUNED_ON else f"{name} *"
    joints = _barred(f["recall_joints"], f["recall_joints"] >= RECALL_LEAST)
    far = f"{f['recall_far']:.1%}" if "recall_far" in f else "-"
    return (
        f"{title:18}{joints:>14}{far:>8}{f['recall_all']:8.1%}"
        f"{counts:>24}{_barred(f['spurious_share'], f['spurious_share'] <= SPURIOUS_MOST):>14}"
        f"{_barred(f['on_marks'], f['on_marks'] >= ON_MARKS_LEAST):>14}"
        f"{_barred(f['stand_good_share'], f['stand_good_share'] >= GOOD_LEAST):>14}{f['stand_spread_mm']:11.1f}"
    )


def _barred(share: float, met: bool) -> str:
    return f"{share:.1%} {word(met)}"


def word(met: bool) -> str:
    """Of a bar."""
    return "PASS" if met else "MISS"
