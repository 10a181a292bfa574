"""What the vision bench says of claimed poses and predicted gaps, of estimates made by hand."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from ceilvo import se2
from ceilvo.bench.vision.claims import GapScore, TrackingScore
from ceilvo.bench.vision.conditions import conditions
from ceilvo.types import Motion, State

START = np.array([1.0, 2.0, 0.5])
FRAME_S = 0.1
SIGMA = np.diag([0.01, 0.03, 0.02])
"""m, m, rad: of claims in these tests; unlike along x and y, so that a frame of reference that is mixed up shows."""
STEP = np.array([0.01, 0.0, 0.02])


def estimate(
    true: np.ndarray, off: tuple[float, float, float], state: State = State.TRACKING, crossings: int = 9
) -> SimpleNamespace:
    """Of a robot at the true pose (3,), off in the estimate's own frame, which begins at START."""
    pose = se2.between(START, true) + np.array(off)
    return SimpleNamespace(state=state, pose=pose, cov=SIGMA**2, crossings=crossings)


def tracked(*frames: tuple[np.ndarray, SimpleNamespace]) -> dict[str, float]:
    score = TrackingScore(START, FRAME_S)
    for true, said in frames:
        score.add(said, true)
    return score.figures()


def test_only_poses_in_tracking_are_held_to_what_they_claim() -> None:
    claims = ((State.TRACKING, 0.03), (State.DEGRADED, 0.07), (State.LOST, 9.0), (State.LOST, 9.0))
    f = tracked(*((START, estimate(START, (0.0, off_m, 0.0), state)) for state, off_m in claims))
    assert f["tracking_pct"] == 25.0
    assert abs(f["tracking_worst_mm"] - 30.0) < 1e-6
    assert f["usable_pct"] == 50.0
    assert abs(f["usable_worst_mm"] - 70.0) < 1e-6


def test_a_way_without_two_points_in_view_does_not_count_and_standing_neither() -> None:
    """3 m with two points, of them 2 m good; 5 m with one point; ten frames of standing, not good."""
    at = [START + np.array([0.0, y, 0.0]) for y in (1.0, 2.0, 3.0, 8.0)]
    good, bad = (0.0, 0.0, 0.0), State.RELOCALISING
    f = tracked(
        *((START, estimate(START, good, State.INIT)) for _ in range(10)),
        (at[0], estimate(at[0], good)),
        (at[1], estimate(at[1], good, State.DEGRADED, crossings=2)),
        (at[2], estimate(at[2], good, bad, crossings=2)),
        (at[3], estimate(at[3], good, bad, crossings=1)),
    )
    assert abs(f["two_points_way_pct"] - 37.5) < 1e-9
    assert abs(f["usable_way_pct"] - 200.0 / 3.0) < 1e-9


def test_where_there_is_nothing_to_judge_no_figure_is_given() -> None:
    """A figure that is missing misses no bar, and meets none."""
    f = tracked((START, estimate(START, (0.0, 0.0, 0.0), State.INIT)))
    assert f.keys().isdisjoint({"two_points_way_pct", "usable_way_pct", "beyond_3_sigma_pct", "pose_nees"})
    assert GapScore().figures() == {"gaps": 0.0}


@pytest.mark.parametrize(
    ("state", "off", "wrong_s"),
    [
        (State.TRACKING, (0.31, 0.0, 0.0), FRAME_S),
        (State.DEGRADED, (0.0, 0.0, np.radians(-5.1)), FRAME_S),
        (State.DEGRADED, (0.0, 0.0, 2.0 * np.pi), 0.0),
        (State.TRACKING, (0.2, 0.2, np.radians(4.9)), 0.0),
        (State.RELOCALISING, (9.0, 0.0, 0.0), 0.0),
    ],
)
def test_a_wrong_pose_is_one_that_is_claimed_beyond_the_bar(
    state: State, off: tuple[float, float, float], wrong_s: float
) -> None:
    assert tracked((START, estimate(START, off, state)))["wrong_pose_s"] == wrong_s


def test_poses_within_what_they_claim_are_beyond_three_sigmas_as_seldom_as_that_means() -> None:
    rng, at = np.random.default_rng(5), START + np.array([2.0, -1.0, 1.2])
    said = [estimate(at, tuple(SIGMA @ rng.standard_normal(3))) for _ in range(20_000)]
    f = tracked(*((at, e) for e in said))
    assert abs(f["beyond_3_sigma_pct"] - 0.27) < 0.15
    assert abs(f["pose_nees"] - 1.0) < 0.03
    for e in said:
        e.cov = 0.25 * e.cov
    assert tracked(*((at, e) for e in said))["beyond_3_sigma_pct"] > 20.0


def test_only_the_first_poses_of_a_drive_are_too_sure_and_they_are_counted() -> None:
    f = tracked(*((START, estimate(START, (off_m, 0.0, 0.0))) for off_m in (0.04, 0.0, 0.0, 0.0)))
    assert f["beyond_3_sigma_pct"] == 25.0


def driven(score: GapScore, motions: list[Motion]) -> None:
    """STEP after STEP from START, the first motion ending there."""
    true = START
    for k, motion in enumerate(motions):
        true = se2.compose(true, STEP) if k else true
        score.add(motion, true)


def seen() -> Motion:
    return Motion(STEP, np.eye(3), 10, 0.0)


def predicted(off: np.ndarray, cov: np.ndarray, restarted: bool = False) -> Motion:
    return Motion(STEP + off, cov, 0, 0.0, "nothing fits", restarted=restarted)


@pytest.mark.parametrize(("factor", "nees"), [(1.0, 1.0), (3.0, 9.0)])
def test_the_error_of_a_gap_is_in_units_of_what_was_claimed_of_it(factor: float, nees: float) -> None:
    """Gaps of one to four frames, each the last error of several steps, not one of the steps' own."""
    rng, score = np.random.default_rng(7), GapScore()
    sigma = 1e-3 * SIGMA
    motions = [seen()]
    for k in range(3000):
        for _ in range(1 + k % 4):
            motions.append(predicted(factor * sigma @ rng.standard_normal(3), sigma**2))
        motions.append(seen())
    driven(score, motions)
    f = score.figures()
    assert f["gaps"] == 3000
    assert abs(f["gap_nees"] - nees) < 0.05 * nees


def test_a_gap_counts_once_it_has_ended_by_what_was_predicted_in_it() -> None:
    """Not what has not ended, nor the frame that ends it: it was seen, or its claim is of a robot that is carried."""
    off, cov = np.array([3e-3, 0.0, 0.0]), np.diag([1e-6] * 3)
    begins, ends = predicted(100.0 * off, cov, restarted=True), predicted(100.0 * off, np.eye(3), restarted=True)
    score = GapScore()
    driven(score, [begins, seen(), predicted(off, cov), seen(), seen(), predicted(2.0 * off, cov), ends, ends, seen()])
    assert score.figures() == {"gaps": 2.0, "gap_nees": pytest.approx(0.5 * (3.0 + 12.0))}
    score.add(predicted(100.0 * off, cov), START)
    assert score.figures()["gaps"] == 2.0


def test_few_lines_are_held_to_the_way_with_two_points_and_all_to_what_they_claim() -> None:
    held = {c.name for c in conditions() if c.bars.get("usable_way_pct") is not None}
    slats, points = (
        {"wood-slats", "slats-round", "strips-only"},
        {"plaster-round", "plaster-glints", "two-lamps", "bare"},
    )
    assert held == {*slats, *points, "hexagons", "hexagons-round"}
    for c in conditions():
        assert c.name not in held or (c.bars["drift_pct"].met(0.5) and not c.bars["usable_way_pct"].met(89.9)), c.name
        assert not c.bars["wrong_pose_s"].met(1.0 / c.fps), c.name
        assert not c.bars["gap_nees"].met(2.01) and not c.bars["beyond_3_sigma_pct"].met(0.31), c.name
