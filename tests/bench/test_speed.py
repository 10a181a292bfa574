"""The speed bench: its sums and that it runs; no time is asserted."""

from __future__ import annotations

import numpy as np
import pytest

from ceilvo.bench.speed import filter_step as filter_speed


def test_the_scene_has_as_many_landmarks_as_asked_and_only_those_in_view_are_near():
    m, near = filter_speed.scene_of(300, 6)
    assert len(m) == 300
    assert len(near) == 6
    assert np.all(np.hypot(*near.T) <= 1.0)
    assert np.sort(np.hypot(*m.xy_map_m.T))[6] > 3.0


def test_the_exponent_of_a_linear_cost_is_one():
    rows = [{"particles": n, "us": {"pfcf": 2.0 * n}} for n in (3000, 10_000, 30_000)]
    assert filter_speed.exponent(rows) == pytest.approx(1.0)


def test_every_method_steps_and_is_counted_per_step():
    calls = {"a": 0, "b": 0}

    def count(name):
        calls[name] += 1

    found = filter_speed.medians({"a": lambda: count("a"), "b": lambda: count("b")}, 1, {"b": 20})
    assert set(found) == {"a", "b"}
    assert calls["a"] > 1
    m, near = filter_speed.scene_of(16, 6)
    for method in filter_speed.METHODS:
        for known in (True, False):
            filter_speed.stepper(method, 20, m, near, known)()


def test_the_bars_are_read_off_the_figures():
    at = dict.fromkeys(filter_speed.METHODS, 100.0)
    document = {
        "particles": [{"particles": 200, "us": {**at, "pfcf": 290.0}}],
        "map_ends": {"us": {"100": 100.0, "30000": 116.0}},
    }
    assert [b.verdict for b in filter_speed.bars(document)] == ["PASS", "PASS", "MISS"]
