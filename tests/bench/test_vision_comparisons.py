"""Conditions of the vision bench beside their twins: what is compared, and that known heights are told."""

from __future__ import annotations

import json
import math
from dataclasses import replace

import numpy as np
import pytest

from ceilvo.bench.vision import command as vision
from ceilvo.bench.vision.comparisons import compared, comparisons
from ceilvo.bench.vision.condition import Condition
from ceilvo.bench.vision.conditions import KNOWN, conditions
from ceilvo.bench.vision.run import Options, run
from ceilvo.calibration import CeilingShape
from ceilvo.daemon.odometry.heights.stage import Heights
from ceilvo.daemon.pipeline import Pipeline

CONDITIONS = {c.name: c for c in conditions()}
ERRORS = {"motion_median_mm": 0.1, "motion_p95_mm": 0.2, "worst_mm": 4.0}
STEP = {"step_median_ms": 4.0, "step_p99_ms": 10.0}


def of(*names: str) -> list[Condition]:
    return [CONDITIONS[name] for name in names]


def test_what_is_compared_are_twins_that_were_both_run() -> None:
    assert comparisons(["base", "turning", "step"]) == []
    assert comparisons(["rolling-20ms", "open-cells", "step-known"]) == []
    found = {(c.condition, c.twin) for c in comparisons(list(CONDITIONS))}
    known = {name for name in CONDITIONS if name.endswith(KNOWN)}
    assert len(known) == 9
    assert found == {("open-cells", "base"), ("rolling-20ms", "turning"), *((name, "base") for name in known)}


def test_twins_differ_in_nothing_but_what_is_asked_about() -> None:
    rolling, turning = of("rolling-20ms", "turning")
    assert rolling.spec == turning.spec and rolling.fps == turning.fps
    assert rolling.true.camera == replace(turning.true.camera, readout_s=0.02)
    base, cells = of("base", "open-cells")
    assert cells.spec.lap == base.spec.lap and cells.true.camera == base.true.camera
    for name in (n for n in CONDITIONS if n.endswith(KNOWN)):
        known, told_nothing = of(name, name.removesuffix(KNOWN))
        assert known.known and not told_nothing.known, name
        assert known.spec == told_nothing.spec and known.bars == told_nothing.bars, name
        flat = replace(known.spec, surroundings=base.spec.surroundings, ceiling=base.spec.ceiling)
        assert flat == base.spec != known.spec, name


@pytest.mark.parametrize("known", [True, False])
def test_a_robot_that_knows_its_heights_starts_on_map_and_heights_of_a_lap_before(
    known: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What it is told, and after how many frames; the figures are of the second drive alone."""
    seen, told, load, step = [], [], Pipeline.load_map, Pipeline.step
    drops_m = (0.4,)
    monkeypatch.setattr(Heights, "drops_m", property(lambda self: drops_m))
    monkeypatch.setattr(Pipeline, "step", lambda self, *a, **k: (seen.append(self), step(self, *a, **k))[1])
    monkeypatch.setattr(
        Pipeline, "load_map", lambda self, *a, **k: (told.append((self, *a, k)), load(self, *a, **k))[1]
    )
    frames, rate_hz = 24, 10.0
    condition = replace(CONDITIONS["step-known" if known else "step"], fps=rate_hz)
    figures = run(condition, Options(seconds=frames / rate_hz, baselines=False))
    assert figures["frames"] == frames and len(seen) == (2 * frames if known else frames)
    assert len(told) == known
    for again, landmarks, _, pose, _, others in told:
        assert again is seen[frames] is not seen[0] and again is seen[-1]
        assert len(landmarks) > 10 and not np.any(pose)
        assert others["ceiling"] == CeilingShape(drops_m)
        assert figures["tracking_worst_mm"] < 20.0, "the map lies where the truth begins"


def test_ratios_are_held_to_twice_the_time_and_one_and_a_half_times_the_error() -> None:
    chosen = of("base", "open-cells", "turning", "rolling-20ms")
    slow = {"step_median_ms": 7.9, "step_p99_ms": 20.1}
    worse = {"motion_median_mm": 0.16, "motion_p95_mm": 0.1, "worst_mm": 5.9}
    bars = compared(chosen, [{**ERRORS, **STEP}, {**ERRORS, **slow}, ERRORS, worse])
    assert [b.verdict for b in bars] == ["PASS", "MISS", "MISS", "PASS", "PASS"]
    assert bars[0].value == pytest.approx(1.975) and "7.9" in bars[0].text and "4" in bars[0].text
    assert {b.wanted for b in bars[:2]} == {"<= 2"} and {b.wanted for b in bars[2:]} == {"<= 1.5"}


def test_nothing_is_as_good_as_a_twin_without_a_figure() -> None:
    bars = compared(of("turning", "rolling-20ms"), [{**ERRORS, "motion_median_mm": math.nan, "worst_mm": 0.0}, ERRORS])
    assert [b.verdict for b in bars] == ["MISS", "PASS", "MISS"]


def test_ratios_that_miss_are_told_with_the_bars_and_written() -> None:
    chosen = of("turning", "rolling-20ms")
    results = [ERRORS, {**ERRORS, "worst_mm": 40.0}]
    said = vision._verdict(chosen, results)
    assert "rolling-20ms / turning, worst_mm: 10.00 (40, 4), bar <= 1.5" in said
    assert said.startswith("2 of 3 bars met")
    written = json.loads(json.dumps(vision.as_json(chosen, results, None), allow_nan=False))["ratios"]
    assert [r["verdict"] for r in written] == ["PASS", "PASS", "MISS"]
