"""Trajectory files against evo, and errors against hand-made and random truth."""

from __future__ import annotations

import dataclasses
import json
import math
import warnings
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from ceilvo import se2
from ceilvo.daemon.replay.trajectory import (
    Alignment,
    JsonlWriter,
    TumWriter,
    compare,
    estimate_json,
    format_error,
    match_stamps,
    read_tum,
    trajectory_error,
    tum_line,
)
from ceilvo.errors import FileFormatError
from ceilvo.types import Estimate, FilterHealth, Motion, State

SEED = 11


def estimate(seq: int, stamp_ns: int, pose: Any, **changes: Any) -> Estimate:
    made = Estimate(
        seq=seq,
        stamp_ns=stamp_ns,
        pose=np.asarray(pose, np.float64),
        cov=np.diag([1e-4, 2e-4, 3e-6]),
        odom=np.array([0.5, 0.0, 0.1]),
        twist=np.array([0.3, 0.0, 0.2]),
        state=State.TRACKING,
        quality=0.9,
        reason="5 good frames in a row",
        motion=Motion(np.array([0.01, 0.0, 0.001]), np.eye(3) * 1e-6, 20, 0.0004),
        health=FilterHealth(100, 61.5, 40, float("nan"), 1.1, 38),
        crossings=24,
        landmarks=81,
        latency_ms=MappingProxyType({"total": 7.5}),
    )
    return dataclasses.replace(made, **changes)


def lap(n: int = 200) -> tuple[Any, Any]:
    """Stamps every 33.3 ms that do not round to whole milliseconds, and a lap with all headings."""
    a = np.linspace(0.0, 2.0 * np.pi, n)
    stamps = 1_234_567_890_123_456_789 + np.arange(n, dtype=np.int64) * 33_333_333
    poses = np.column_stack([1.5 * np.cos(a), 1.2 * np.sin(a), se2.wrap_array(a + 0.5 * np.pi)])
    return stamps, poses


def write_tum(path: Path, stamps: Any, poses: Any) -> Path:
    path.write_text("".join(tum_line(int(t), p) for t, p in zip(stamps, poses, strict=True)))
    return path


def test_line_by_hand() -> None:
    line = tum_line(1_000_000_001, np.array([1.5, -2.0, 0.5 * np.pi]))
    assert line == (
        "1.000000001 1.500000000 -2.000000000 0.000000000 0.000000000 0.000000000 0.707106781 0.707106781\n"
    )


def test_no_negative_zero() -> None:
    assert "-0.000000000" not in tum_line(0, np.array([-1e-12, -0.0, -1e-13]))


@given(
    st.integers(0, 2**62), st.floats(-1e4, 1e4), st.floats(-1e4, 1e4), st.floats(-math.pi, math.pi, exclude_max=True)
)
@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], deadline=None, max_examples=60)
def test_what_is_written_is_read(tmp_path: Path, stamp_ns: int, x: float, y: float, theta: float) -> None:
    back = read_tum(write_tum(tmp_path / "t", [stamp_ns], [np.array([x, y, theta])]))
    assert int(back.stamp_ns[0]) == stamp_ns  # to the nanosecond, where a float of seconds would not do
    assert np.abs(back.poses[0, :2] - [x, y]).max() <= 1e-9
    assert abs(se2.wrap(back.poses[0, 2] - theta)) <= 1e-8


def test_evo_reads_the_file_and_agrees(tmp_path: Path) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        evo_metrics = pytest.importorskip("evo.core.metrics")
        from evo.core import sync
        from evo.tools import file_interface

        rng = np.random.default_rng(SEED)
        stamps, truth = lap()
        noisy = truth + rng.normal(size=truth.shape) * [0.02, 0.02, 0.01]
        shifted = se2.compose(np.array([0.4, -1.0, 0.7]), noisy)
        with TumWriter(tmp_path / "est") as out:
            for k, (t, p) in enumerate(zip(stamps, shifted, strict=True)):
                out.write(estimate(k, int(t), p))
        write_tum(tmp_path / "ref", stamps, truth)
        est = file_interface.read_tum_trajectory_file(str(tmp_path / "est"))
        ref = file_interface.read_tum_trajectory_file(str(tmp_path / "ref"))
        assert est.check()[0], est.check()
        assert est.num_poses == len(truth)
        ref, est = sync.associate_trajectories(ref, est, max_diff=0.01)
        est.align(ref)
        ape = evo_metrics.APE(evo_metrics.PoseRelation.translation_part)
        ape.process_data((ref, est))
        statistics = ape.get_all_statistics()
    ours = compare(tmp_path / "est", tmp_path / "ref", "se2")
    assert ours.n == len(truth)
    assert ours.position_rms_m == pytest.approx(statistics["rmse"], abs=1e-6)
    assert ours.position_median_m == pytest.approx(statistics["median"], abs=1e-6)
    assert ours.position_max_m == pytest.approx(statistics["max"], abs=1e-6)


def test_evo_agrees_on_steps(tmp_path: Path) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        evo_metrics = pytest.importorskip("evo.core.metrics")
        from evo.tools import file_interface

        stamps, truth = lap()
        noisy = truth + np.random.default_rng(SEED).normal(size=truth.shape) * [0.002, 0.002, 0.001]
        write_tum(tmp_path / "est", stamps, noisy)
        write_tum(tmp_path / "ref", stamps, truth)
        rpe = evo_metrics.RPE(
            evo_metrics.PoseRelation.translation_part, delta=1, delta_unit=evo_metrics.Unit.frames, all_pairs=False
        )
        rpe.process_data(
            (
                file_interface.read_tum_trajectory_file(str(tmp_path / "ref")),
                file_interface.read_tum_trajectory_file(str(tmp_path / "est")),
            )
        )
        median = rpe.get_all_statistics()["median"]
    ours = compare(tmp_path / "est", tmp_path / "ref")
    assert ours.step_median_m == pytest.approx(median, abs=1e-6)


def test_errors_by_hand() -> None:
    reference = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [2.0, 0.0, np.pi - 0.01]])
    estimated = np.array([[0.0, 0.0, 0.1], [1.0, 0.3, 0.0], [2.0, -0.4, -np.pi + 0.01]])
    e = trajectory_error(estimated, reference)
    assert e.position_rms_m == pytest.approx(math.sqrt((0.09 + 0.16) / 3))
    assert e.position_median_m == pytest.approx(0.3)
    assert e.position_max_m == pytest.approx(0.4)
    assert e.heading_max_rad == pytest.approx(0.1)
    assert e.heading_median_rad == pytest.approx(0.02)  # across the wrap
    assert e.heading_rms_rad == pytest.approx(math.sqrt((0.01 + 0.0004) / 3))


@given(st.floats(-100, 100), st.floats(-100, 100), st.floats(-math.pi, math.pi))
@settings(deadline=None, max_examples=60)
def test_alignment_undoes_any_rigid_motion(x: float, y: float, theta: float) -> None:
    _, truth = lap(50)
    moved = se2.compose(np.array([x, y, theta]), truth)
    alignments: tuple[Alignment, ...] = ("first", "se2")
    for align in alignments:
        e = trajectory_error(moved, truth, align)
        assert e.position_max_m < 1e-9
        assert e.heading_max_rad < 1e-9
    assert trajectory_error(moved, truth).step_median_m < 1e-9


def test_least_squares_beats_every_other_alignment() -> None:
    rng = np.random.default_rng(SEED)
    _, truth = lap(60)
    noisy = se2.compose(np.array([0.3, 0.1, -0.4]), truth + rng.normal(size=truth.shape) * 0.05)
    best = trajectory_error(noisy, truth, "se2")
    for nudge in rng.normal(size=(50, 3)) * 0.01:
        other = se2.compose(nudge, se2.compose(best.reference_from_estimated, noisy))
        assert trajectory_error(other, truth).position_rms_m > best.position_rms_m


def test_a_robot_that_stands_is_aligned_by_its_heading() -> None:
    truth = np.tile([1.0, 2.0, 0.5], (10, 1))
    e = trajectory_error(np.tile([4.0, 4.0, -1.0], (10, 1)), truth, "se2")
    assert e.heading_max_rad < 1e-12
    assert e.position_max_m < 1e-12


def test_stamps_are_matched_one_to_one_within_the_tolerance() -> None:
    a = np.array([0, 10, 20, 30, 100], np.int64)
    b = np.array([1, 12, 13, 29, 60], np.int64)
    i, j = match_stamps(a, b, 5)
    assert i.tolist() == [0, 1, 3]
    assert j.tolist() == [0, 1, 3]


@given(
    st.sets(st.integers(0, 300), min_size=1, max_size=25),
    st.sets(st.integers(0, 300), min_size=1, max_size=25),
    st.integers(0, 40),
)
def test_matching_is_mutual_and_nearest(a: set[int], b: set[int], tolerance: int) -> None:
    x, y = np.array(sorted(a), np.int64), np.array(sorted(b), np.int64)
    i, j = match_stamps(x, y, tolerance)
    assert len(set(i.tolist())) == len(i) == len(set(j.tolist()))
    for p, q in zip(i, j, strict=True):
        assert abs(x[p] - y[q]) == np.abs(x[p] - y).min() == np.abs(y[q] - x).min() <= tolerance


def test_different_rates_and_a_gap(tmp_path: Path) -> None:
    stamps, truth = lap(300)
    keep = np.r_[0:100, 150:300]
    write_tum(tmp_path / "est", stamps[keep] + 2_000_000, truth[keep])
    write_tum(tmp_path / "ref", stamps[::3], truth[::3])
    e = compare(tmp_path / "est", tmp_path / "ref")
    assert e.n == len([k for k in range(0, 300, 3) if k in set(keep.tolist())])
    assert e.position_max_m < 1e-8


BAD = {
    "empty": ("", "has no poses"),
    "comment only": ("# t x y z qx qy qz qw\n", "has no poses"),
    "seven values": ("0 1 2 3 0 0 1\n", ":1: 7 values in the line"),
    "a word": ("# ok\n0 one 2 3 0 0 0 1\n", ":2: '0 one 2 3 0 0 0 1' has a value that is not a number"),
    "nan": ("0 nan 2 3 0 0 0 1\n", "not finite"),
    "stamp nan": ("nan 1 2 3 0 0 0 1\n", "not a number"),
    "stamp infinite": ("inf 1 2 3 0 0 0 1\n", "too large"),
    "stamp enormous": ("1e999999999 1 2 3 0 0 0 1\n", "has a value that is not"),
    "stamp too large": ("1e30 1 2 3 0 0 0 1\n", "too large"),
    "no quaternion": ("0 1 2 3 0 0 0 0\n", "quaternion of length 0"),
    "backward": ("1 0 0 0 0 0 0 1\n1 0 0 0 0 0 0 1\n", ":2: stamp 1.000000000 is not after the last"),
}


@pytest.mark.parametrize("name", BAD)
def test_a_bad_file_is_one_clear_line(tmp_path: Path, name: str) -> None:
    text, expected = BAD[name]
    path = tmp_path / "t"
    path.write_text(text)
    with pytest.raises(FileFormatError) as caught:
        read_tum(path)
    assert expected in str(caught.value)
    assert "\n" not in str(caught.value)


@given(st.binary(max_size=120))
@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], deadline=None, max_examples=100)
def test_any_bytes_are_a_trajectory_or_an_error(tmp_path: Path, raw: bytes) -> None:
    path = tmp_path / "t"
    path.write_bytes(b"0 1 2 3 0 0 0 1\n" + raw)
    try:
        assert np.all(np.isfinite(read_tum(path).poses))
    except FileFormatError as e:
        assert str(path) in str(e)


def test_comments_blanks_and_tabs_are_accepted(tmp_path: Path) -> None:
    path = tmp_path / "t"
    path.write_text("# head\r\n\n 1.5\t1 2 3 0 0 0 1 \r\n  # tail\n2 1 2 3 0 0 1 0")
    back = read_tum(path)
    assert back.stamp_ns.tolist() == [1_500_000_000, 2_000_000_000]
    assert abs(back.poses[1, 2]) == pytest.approx(math.pi)


def test_yaw_of_a_tilted_pose_is_its_own(tmp_path: Path) -> None:
    """A reference in 3-D: rotated by yaw, then tilted by 20 deg about its own x."""
    yaw, tilt = 2.0, math.radians(20)
    q = (
        math.sin(tilt / 2) * math.cos(yaw / 2),
        math.sin(tilt / 2) * math.sin(yaw / 2),
        math.cos(tilt / 2) * math.sin(yaw / 2),
        math.cos(tilt / 2) * math.cos(yaw / 2),
    )
    path = tmp_path / "t"
    path.write_text("0 0 0 0 " + " ".join(map(repr, q)))
    assert read_tum(path).poses[0, 2] == pytest.approx(yaw)


def test_no_common_clock_is_an_error(tmp_path: Path) -> None:
    stamps, truth = lap(5)
    write_tum(tmp_path / "est", stamps, truth)
    write_tum(tmp_path / "ref", stamps - stamps[0], truth)
    with pytest.raises(FileFormatError, match="the two must share a clock"):
        compare(tmp_path / "est", tmp_path / "ref")


def test_a_folder_that_is_not_there(tmp_path: Path) -> None:
    with pytest.raises(FileFormatError, match="cannot be written: No such file"):
        TumWriter(tmp_path / "nowhere" / "t")
    with pytest.raises(FileFormatError, match="cannot be read"):
        read_tum(tmp_path / "t")


def test_jsonl_holds_the_whole_estimate_but_no_latency(tmp_path: Path) -> None:
    failed = Motion(np.zeros(3), np.full((3, 3), np.inf), 0, float("nan"), "2 crossings")
    made = estimate(7, 123, [0.1, 0.2, 0.3], motion=failed, state=State.DEGRADED)
    with JsonlWriter(tmp_path / "j") as out:
        out.write(made)
        out.write(estimate(8, 124, [0.1, 0.2, 0.3]))
    first, second = (json.loads(line) for line in (tmp_path / "j").read_text().splitlines())
    assert first["pose_map_from_base"] == [0.1, 0.2, 0.3]
    assert first["cov"] == made.cov.tolist()
    assert first["motion"]["failure"] == "2 crossings"
    assert first["motion"]["cov"] == [[None] * 3] * 3
    assert first["depletion"]["fit_residual"] is None
    assert (first["state"], second["state"]) == ("DEGRADED", "TRACKING")
    assert second["motion"]["failure"] is None
    assert "latency" not in json.dumps(first)
    assert set(first) == set(second)


def test_latency_does_not_reach_the_bytes() -> None:
    a = estimate(1, 5, [1 / 3, 0.0, 0.0])
    b = dataclasses.replace(a, latency_ms=MappingProxyType({"total": 99.0}))
    assert estimate_json(a) == estimate_json(b)
    assert "0.3333333333333333" in estimate_json(a)


def test_table_has_every_figure() -> None:
    _, truth = lap(20)
    off = truth + np.array([0.1, 0.0, math.radians(2)])
    text = format_error(trajectory_error(off, truth))
    assert "0.1000" in text
    assert "2.000" in text
    assert "20 poses" in text
