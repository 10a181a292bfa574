"""Prediction without vision: it does not depend on how a gap is cut into steps, and its covariance holds."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ceilvo import se2
from ceilvo.config import Odometry, States
from ceilvo.daemon.odometry.coasting import LastTwist, RecentTwists, coast
from ceilvo.sim.wander import Wander, driven

RATE_HZ = 10.0
TWISTS = st.tuples(st.floats(-1.5, 1.5), st.floats(-0.3, 0.3), st.floats(-3.0, 3.0))
GAPS_S = (0.2, 0.5, 1.0, 2.0, 4.0)


def after(twist: np.ndarray, cuts_s: list[float]) -> tuple[np.ndarray, np.ndarray]:
    """Where a robot is predicted to be after all of the cuts, and with what covariance."""
    moved, cov = np.zeros(3), np.zeros((3, 3))
    for start_s, end_s in pairwise(cuts_s):
        step, step_cov = coast(Odometry(), LastTwist(twist, 0.1, start_s), end_s - start_s)
        moved, cov = se2.compose(moved, step), se2.compose_cov(moved, cov, step, step_cov)
    return moved, cov


@settings(max_examples=60, deadline=None)
@given(twist=TWISTS, cuts=st.lists(st.floats(0.01, 0.99), max_size=6), gap_s=st.floats(0.1, 4.0))
def test_a_gap_is_the_same_whether_frames_fail_in_it_or_do_not_come(
    twist: tuple[float, ...], cuts: list[float], gap_s: float
) -> None:
    whole, cov = after(np.array(twist), [0.0, gap_s])
    parts, cov_parts = after(np.array(twist), [0.0, *sorted({gap_s * c for c in cuts}), gap_s])
    assert np.abs(se2.between(whole, parts)).max() < 1e-9
    assert cov_parts[2, 2] == pytest.approx(cov[2, 2], rel=1e-9)
    sigma, sigma_parts = (np.sqrt(np.trace(c[:2, :2])) for c in (cov, cov_parts))
    assert sigma_parts == pytest.approx(sigma, rel=0.15)  # the lever of the heading is summed in steps


@settings(max_examples=60, deadline=None)
@given(twist=TWISTS, early_s=st.floats(0.0, 3.9), more_s=st.floats(0.01, 1.0))
def test_what_is_not_known_grows_with_time(twist: tuple[float, ...], early_s: float, more_s: float) -> None:
    _, before = after(np.array(twist), [0.0, early_s])
    _, later = after(np.array(twist), [0.0, early_s + more_s])
    assert later[2, 2] > before[2, 2]
    assert np.trace(later[:2, :2]) > np.trace(before[:2, :2])


def test_a_twist_that_is_not_known_is_worse_than_one_that_is() -> None:
    slow = np.array([0.1, 0.0, 0.0])
    for dt_s in (0.03, 0.3, 3.0):
        known, unknown = (coast(Odometry(), LastTwist(slow, span_s, 0.0), dt_s)[1] for span_s in (0.03, None))
        assert np.all(np.diag(unknown) > np.diag(known))


@pytest.mark.parametrize("fast", [False, True], ids=["slow", "fast"])
def test_covariance_holds_over_drives_that_stop_and_turn_and_speed_up(fast: bool) -> None:
    """Normalised errors squared per degree of freedom, of all gaps in drives of 40 s."""
    drives = [np.array(list(driven(Wander(40 + seed, fast), np.zeros(3), 40.0, RATE_HZ))) for seed in range(6)]
    for gap_s in GAPS_S:
        nees = []
        ahead = round(gap_s * RATE_HZ)
        for poses in drives:
            for k in range(20, len(poses) - ahead, 7):
                twist = se2.between(poses[k - 1], poses[k]) * RATE_HZ
                guess, cov = coast(Odometry(), LastTwist(twist, 1.0 / RATE_HZ, 0.0), gap_s)
                off = se2.between(poses[k], poses[k + ahead]) - guess
                off[2] = se2.wrap(off[2])
                nees.append(float(off @ np.linalg.solve(cov, off)) / 3.0)
        mean, rare, most = float(np.mean(nees)), float(np.quantile(nees, 0.99)), float(np.max(nees))
        print(f"{'fast' if fast else 'slow'} {gap_s} s: NEES/3 mean {mean:.2f}, p99 {rare:.1f}, max {most:.1f}")
        assert 0.03 < mean < 1.0
        assert rare < 16.3 / 3.0  # chi squared with 3 degrees of freedom: 1 in 1000


@pytest.mark.parametrize("fast", [False, True], ids=["slow", "fast"])
def test_what_degraded_promises_holds_while_it_is_promised(fast: bool) -> None:
    """As long as three sigma are within the bounds of DEGRADED, so is the robot."""
    states, rate_hz, kept, broken, longest_s = States(), 30.0, 0, 0, []
    for seed in range(4):
        poses = np.array(list(driven(Wander(70 + seed, fast), np.zeros(3), 40.0, rate_hz)))
        for k in range(30, len(poses) - 60, 11):
            twist = se2.between(poses[k - 1], poses[k]) * rate_hz
            for ahead in range(1, 60):
                guess, cov = coast(Odometry(), LastTwist(twist, 1.0 / rate_hz, 0.0), ahead / rate_hz)
                far_m = 3.0 * float(np.sqrt(np.linalg.eigvalsh(cov[:2, :2])[-1]))
                if (
                    far_m > states.degraded_within_m
                    or 3.0 * np.degrees(np.sqrt(cov[2, 2])) > states.degraded_within_deg
                ):
                    break
                off = se2.between(guess, se2.between(poses[k], poses[k + ahead]))
                good = np.hypot(off[0], off[1]) <= states.degraded_within_m
                good &= abs(np.degrees(off[2])) <= states.degraded_within_deg
                kept, broken = kept + good, broken + (not good)
            longest_s.append((ahead - 1) / rate_hz)
    print(
        f"{'fast' if fast else 'slow'}: broken {broken} of {kept + broken}, promised for {np.median(longest_s):.2f} s"
    )
    assert broken <= 0.003 * (kept + broken)
    assert np.median(longest_s) >= 0.06


def twists_of(steps: np.ndarray, sigma: np.ndarray, rate_hz: float) -> RecentTwists:
    out = RecentTwists()
    for step in steps:
        out = out.then(step * rate_hz, (sigma * rate_hz) ** 2, 1.0 / rate_hz)
    return out


@pytest.mark.parametrize("mistaken", [False, True], ids=["views", "one mistaken view"])
def test_a_gap_after_few_crossings_is_as_wrong_as_it_says(mistaken: bool) -> None:
    """Views at 30 Hz that tell a step to 1 mm; the last one before the gap may be 16 mm off and not know it."""
    rate_hz, sigma, seed = 30.0, np.array([1e-3, 1e-3, 1e-3]), 11
    rng, drives = np.random.default_rng(seed), []
    for k in range(6):
        drives.append(np.array(list(driven(Wander(140 + k), np.zeros(3), 40.0, rate_hz))))
    for gap_s in (0.1, 0.3, 1.0):
        nees, off_m, ahead = [], [], round(gap_s * rate_hz)
        for poses in drives:
            for k in range(20, len(poses) - ahead, 13):
                steps = np.stack([se2.between(poses[j - 1], poses[j]) for j in range(k - 5, k + 1)])
                steps += rng.normal(size=steps.shape) * sigma
                steps[-1, 1] += 0.016 * mistaken
                guess, cov = coast(Odometry(), twists_of(steps, sigma, rate_hz).median(0.0), gap_s)
                off = se2.between(poses[k], poses[k + ahead]) - guess
                off[2] = se2.wrap(off[2])
                nees.append(float(off @ np.linalg.solve(cov, off)) / 3.0)
                off_m.append(float(np.hypot(off[0], off[1])))
        mean, rare = float(np.mean(nees)), float(np.quantile(nees, 0.99))
        far_m = float(np.mean(off_m))
        print(f"seed {seed}, {gap_s} s: NEES/3 mean {mean:.2f}, p99 {rare:.1f}; {1e3 * far_m:.1f} mm off in the mean")
        assert 0.03 < mean < 1.0
        assert rare < 16.3 / 3.0  # chi squared with 3 degrees of freedom: 1 in 1000


@pytest.mark.parametrize("mistaken", [False, True], ids=["views", "a mistaken view"])
def test_a_gap_after_the_first_two_views_is_as_wrong_as_it_says(mistaken: bool) -> None:
    """A robot that stands, and whose second view may be taken for one by a bar of a grille: 13.8 mm."""
    rate_hz, sigma, gap_s = 30.0, np.array([1e-3, 1e-3, 1e-3]), 0.1
    for angle_rad in np.linspace(0.0, 2.0 * np.pi, 8, endpoint=False):
        steps = np.zeros((2, 3))
        steps[1, :2] = 0.0138 * mistaken * np.array([np.cos(angle_rad), np.sin(angle_rad)])
        guess, cov = coast(Odometry(), twists_of(steps, sigma, rate_hz).median(0.0), gap_s)
        far = float(guess[:2] @ np.linalg.solve(cov[:2, :2], guess[:2]))
        print(f"{1e3 * np.hypot(*guess[:2]):.0f} mm, {far:.2f} of {9.21}, sigma {1e3 * np.sqrt(cov[0, 0]):.0f} mm")
        assert far < 9.21  # chi squared with 2 degrees of freedom: 1 in 100
        assert mistaken or np.sqrt(cov[0, 0]) < 0.01


def test_a_turn_that_lines_told_since_replaces_what_views_said() -> None:
    recent = twists_of(np.array([[0.01, 0.0, 0.01]] * 4), np.full(3, 1e-3), 30.0).turning(-0.5)
    last = recent.median(0.2)
    assert last.twist == pytest.approx([0.3, 0.0, -0.5])
    assert last.var[2] == 0.0
    assert last.var[0] > 0.0
    assert last.span_s == pytest.approx(0.1)
    assert last.since_s == 0.2
