"""Conditions of the vision bench beside their twins: what is compared, and that known heights are told."""

from __future__ import annotations

import json
import math
from dataclasses import replace

import pytest

from ceilvo.bench.vision import command as vision
from ceilvo.bench.vision.comparisons import compared, comparisons
from ceilvo.bench.vision.condition import Condition
from ceilvo.bench.vision.conditions import KNOWN, conditions
from ceilvo.bench.vision.run import Options, run
from ceilvo.daemon.odometry.heights.stage import Heights

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
    assert len(known) == 7
    assert found == {("open-cells", "base"), ("rolling-20ms", "turning"), *((name, "base") for name in known)}


def test_twins_differ_in_nothing_but_what_is_asked_about() -> None:
    rolling, turning = of("rolling-20ms", "turning")
    assert rolling.spec == turning.spec and rolling.fps == turning.fps
    assert rolling.true.camera == replace(turning.true.camera, readout_s=0.02)
    base, cells = of("base", "open-cells")
    assert cells.spec.lap == base.spec.lap and cells.true.camera == base.true.camera
    for name in (n for n in CONDITIONS if n.endswith(KNOWN)):
        known, told_nothing = of(name, name.removesuffix(KNOWN))
        assert known.spec == told_nothing.spec and known.bars == told_nothing.bars, name
        assert replace(known.spec, surroundings=base.spec.surroundings) == base.spec, name
        assert known.known_drops_m and not told_nothing.known_drops_m, name


def test_heights_that_are_known_are_those_of_what_is_seen_from_below() -> None:
    assert CONDITIONS["step-known"].known_drops_m == (0.4,)
    assert CONDITIONS["ducts-known"].known_drops_m == (0.13, 0.55)
    assert CONDITIONS["truss-known"].known_drops_m == (0.5,)


@pytest.mark.parametrize(("name", "told"), [("step-known", [(0.4,)]), ("step", [])])
def test_known_heights_are_told_before_the_first_frame(
    name: str, told: list[tuple[float, ...]], monkeypatch: pytest.MonkeyPatch
) -> None:
    said = []
    know, look = Heights.know, Heights.look
    monkeypatch.setattr(Heights, "know", lambda self, drops_m: (said.append(tuple(drops_m)), know(self, drops_m))[1])
    monkeypatch.setattr(Heights, "look", lambda self, *a: (said.append("frame"), look(self, *a))[1])
    run(CONDITIONS[name], Options(seconds=0.25, baselines=False))
    assert said[: said.index("frame")] == [(), *told], "nothing is known of a pipeline that has just begun"
    assert said.count("frame") == 7


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
