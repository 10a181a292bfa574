"""Run statistics against figures computed from the whole series."""

from __future__ import annotations

import json
import math
from types import MappingProxyType
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ceilvo import se2
from ceilvo.daemon.replay.summary import Histogram, RunStatistics, format_summary
from ceilvo.types import Estimate, FilterHealth, Motion, State

SEED = 5
KEYS = {
    "state", "frames", "fps", "drops", "position_rms_m", "position_max_m", "heading_rms_deg", "latency_ms",
    "telegrams_sent", "telegrams_failed", "zenoh_samples", "distance_m", "seconds", "seed",
}  # fmt: skip


def estimate(k: int, pose: Any, latency: dict[str, float] | None = None, odom: Any = (0.0, 0.0, 0.0)) -> Estimate:
    return Estimate(
        seq=k,
        stamp_ns=10**12 + k * 33_333_333,
        pose=np.asarray(pose, np.float64),
        cov=np.eye(3),
        odom=np.asarray(odom, np.float64),
        twist=np.zeros(3),
        state=State.TRACKING,
        quality=1.0,
        reason="",
        motion=Motion(np.zeros(3), np.eye(3), 9, 0.0),
        health=FilterHealth(100, 50.0, 50, 0.0, 1.0, 10),
        crossings=9,
        landmarks=9,
        latency_ms=MappingProxyType(latency or {}),
    )


@given(st.lists(st.floats(1e-3, 1e5), min_size=1, max_size=200), st.sampled_from([0.5, 0.9, 0.99, 1.0]))
def test_quantiles_are_within_one_percent(values: list[float], q: float) -> None:
    histogram = Histogram()
    for v in values:
        histogram.add(v)
    exact = float(np.quantile(values, q, method="inverted_cdf"))
    assert abs(histogram.quantile(q) / exact - 1.0) < 0.01
    assert len(histogram) == len(values)


def test_histogram_takes_anything() -> None:
    histogram = Histogram()
    for v in (0.0, -1.0, float("inf"), float("nan")):
        histogram.add(v)
    assert len(histogram) == 3
    assert math.isfinite(histogram.quantile(1.0))
    assert math.isnan(Histogram().quantile(0.5))


def test_summary_against_the_whole_series() -> None:
    rng = np.random.default_rng(SEED)
    n = 900
    a = np.linspace(0.0, 3.0 * np.pi, n)
    truth = np.column_stack([1.5 * np.cos(a), 1.5 * np.sin(a), se2.wrap_array(a + 0.5 * np.pi)])
    noise = rng.normal(size=(n, 3)) * [0.01, 0.02, 0.003]
    poses = truth + noise
    poses[:, 2] = se2.wrap_array(poses[:, 2])
    latency = rng.gamma(4.0, 2.0, size=n)
    statistics = RunStatistics(seed=42)
    for k in range(n):
        statistics.add(estimate(k, poses[k], {"features": latency[k], "total": 2.0 * latency[k]}), truth[k])
    s = statistics.summary(drops=3, telegrams_sent=600, telegrams_failed=1, zenoh_samples=900)
    off = np.hypot(noise[:, 0], noise[:, 1])
    assert set(s) == KEYS
    assert s["position_rms_m"] == pytest.approx(math.sqrt(np.mean(off**2)), abs=1e-5)
    assert s["position_max_m"] == pytest.approx(off.max(), abs=1e-5)
    assert s["heading_rms_deg"] == pytest.approx(np.degrees(np.sqrt(np.mean(noise[:, 2] ** 2))), abs=1e-4)
    assert s["fps"] == pytest.approx(30.0, abs=1e-3)
    assert s["seconds"] == pytest.approx((n - 1) * 0.033333333, abs=1e-3)
    assert s["distance_m"] == pytest.approx(1.5 * 3.0 * np.pi, abs=1e-2)
    assert s["latency_ms"]["features"]["median"] == pytest.approx(np.median(latency), rel=0.02)
    assert s["latency_ms"]["total"]["p99"] == pytest.approx(2.0 * np.quantile(latency, 0.99), rel=0.03)
    assert (s["state"], s["frames"], s["drops"], s["seed"]) == ("TRACKING", n, 3, 42)
    assert (s["telegrams_sent"], s["telegrams_failed"], s["zenoh_samples"]) == (600, 1, 900)
    assert json.loads(json.dumps(s, allow_nan=False)) == s
    last = statistics.last_error
    assert last is not None
    assert last[0] == pytest.approx(off[-1])
    assert last[1] == pytest.approx(noise[-1, 2])


def test_without_truth_the_errors_are_null_and_the_distance_is_odometry() -> None:
    statistics = RunStatistics(seed=1)
    for k in range(11):
        statistics.add(estimate(k, [9.0 * k, 0, 0], odom=[0.1 * k, 0.0, 0.0]))
    s = statistics.summary()
    assert s["position_rms_m"] is s["position_max_m"] is s["heading_rms_deg"] is None
    assert s["distance_m"] == pytest.approx(1.0)
    assert statistics.last_error is None
    assert "no truth" in format_summary(s)


@pytest.mark.parametrize("frames", [0, 1])
def test_a_run_that_ended_at_once(frames: int) -> None:
    statistics = RunStatistics(seed=1)
    for k in range(frames):
        statistics.add(estimate(k, [0, 0, 0]))
    s = statistics.summary()
    assert (s["frames"], s["fps"], s["seconds"]) == (frames, 0.0, 0.0)
    assert json.dumps(s, allow_nan=False)
    assert format_summary(s)


def test_memory_is_bounded() -> None:
    """The same latency fed a hundred thousand times leaves the same number of bins."""
    histogram = Histogram()
    before = histogram.__dict__["_count"].nbytes
    for k in range(100_000):
        histogram.add(1.0 + k % 7)
    assert histogram.__dict__["_count"].nbytes == before < 20_000


def test_the_table_shows_the_figures() -> None:
    statistics = RunStatistics(seed=1)
    for k in range(31):
        statistics.add(estimate(k, [0.003, 0.004, math.radians(0.5)], {"total": 8.0}), np.zeros(3))
    text = format_summary(statistics.summary(drops=2, telegrams_sent=20, zenoh_samples=31))
    assert "rms 5.0 mm, max 5.0 mm, heading rms 0.500 deg" in text
    assert "31 in 1.0 s = 30.00 fps, 2 dropped" in text
    assert "20 telegrams sent, 0 failed" in text
    assert max(map(len, text.splitlines())) <= 79
