"""States: a table of stories, and what lowers the quality."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import pytest
from state_runs import PERIOD_NS, run

from ceilvo.config import States
from ceilvo.daemon.integrity.states import Evidence, StateMachine, Verdict
from ceilvo.types import State

CONFIG = States()
GOOD = Evidence(
    stamp_ns=0,
    motion_ok=True,
    failure="",
    inliers=25,
    crossings=30,
    position_sigma_m=0.01,
    heading_sigma_rad=0.002,
    nis=1.0,
    nis_dof=40,
    ess_ratio=0.6,
    landmarks_matched=20,
)
BLIND = replace(GOOD, motion_ok=False, failure="2 crossings", inliers=0, crossings=2, nis_dof=0, landmarks_matched=0)
FEW = replace(GOOD, inliers=3)
OPEN_TILT = replace(GOOD, rocking="too few lines to tell the robot's tilt to better than 0.020 m")
WIDE = replace(GOOD, position_sigma_m=0.08)
TURNED = replace(GOOD, heading_sigma_rad=0.025)
FAR = replace(GOOD, position_sigma_m=0.2)
ASKEW = replace(GOOD, heading_sigma_rad=0.05)
STALE = replace(GOOD, nis=5.0)
WRONG = replace(GOOD, nis=40.0)
GONE = replace(GOOD, position_sigma_m=0.8)
SEARCH = replace(GOOD, in_doubt="stored pose")
UNLIKELY_ELSEWHERE = replace(GOOD, in_doubt="0.1 s without vision", elsewhere=0.001)
UNSEEN = replace(GOOD, landmarks_matched=0, nis_dof=0)


def path(verdicts: Sequence[Verdict]) -> list[str]:
    """States in the order they were entered."""
    return ["INIT", *(v.state.name for v in verdicts if v.changed)]


STORIES: dict[str, tuple[list[Evidence], list[str], str]] = {
    "starts": ([GOOD] * 5, ["INIT", "TRACKING"], "5 good frames in a row"),
    "one frame short": ([GOOD] * 4, ["INIT"], "starting"),
    "the count starts again after a bad frame": ([GOOD] * 4 + [FEW] + [GOOD] * 4, ["INIT"], "starting"),
    "a small doubt of the place": (
        [GOOD] * 5 + [UNLIKELY_ELSEWHERE] * 30 + [GOOD] * 5,
        ["INIT", "TRACKING", "DEGRADED", "TRACKING"],
        "5 good frames in a row",
    ),
    "a small doubt that grows": (
        [GOOD] * 5 + [UNLIKELY_ELSEWHERE] * 5 + [SEARCH] * 3 + [UNLIKELY_ELSEWHERE] * 30,
        ["INIT", "TRACKING", "DEGRADED", "RELOCALISING"],
        "stored pose",
    ),
    "a small doubt at the start": ([UNLIKELY_ELSEWHERE] * 30, ["INIT", "RELOCALISING"], "0.1 s without vision"),
    "one frame missed": ([GOOD] * 5 + [BLIND], ["INIT", "TRACKING", "DEGRADED"], "no motion from this frame: 2 crossi"),
    "one frame shows nothing at all": (
        [GOOD] * 5 + [replace(BLIND, crossings=0, failure="no lines found")],
        ["INIT", "TRACKING", "DEAD_RECKONING"],
        "no vision for 0.03 s: no lines found",
    ),
    "one frame missed, back": ([GOOD] * 5 + [BLIND] + [GOOD] * 5, ["INIT", "TRACKING", "DEGRADED", "TRACKING"], "5 go"),
    "few from the start": ([FEW] * 10, ["INIT", "DEGRADED"], "3 inliers of 30 crossings, fewer than 4"),
    "few from the start, not often enough": ([FEW] * 9, ["INIT"], "starting"),
    "few from the start, and unsure": (
        [replace(FEW, position_sigma_m=0.08)] * 20,
        ["INIT", "DEGRADED"],
        "position sig",
    ),
    "unsure from the start": ([WIDE] * 10, ["INIT", "DEGRADED"], "position sigma 0.080 m, above 0.05"),
    "unsure from the start, then not": ([WIDE] * 10 + [GOOD] * 5, ["INIT", "DEGRADED", "TRACKING"], "5 good frames"),
    "further off from the start than DEGRADED promises": (
        [BLIND] * 5 + [FAR] * 50,
        ["INIT"],
        "position only within 0.60 m, not 0.3 m; say where it is (cmd/initial_pose)",
    ),
    "as far off, and blind": ([replace(FAR, motion_ok=False)] * 50, ["INIT"], "starting"),
    "tilt open from the start": ([OPEN_TILT] * 5, ["INIT", "DEGRADED"], OPEN_TILT.rocking),
    "tilt open": ([GOOD] * 5 + [OPEN_TILT], ["INIT", "TRACKING", "DEGRADED"], OPEN_TILT.rocking),
    "few inliers": ([GOOD] * 5 + [FEW], ["INIT", "TRACKING", "DEGRADED"], "3 inliers of 30 crossings, fewer than 4"),
    "position unsure": ([GOOD] * 5 + [WIDE], ["INIT", "TRACKING", "DEGRADED"], "position sigma 0.080 m, above 0.05"),
    "heading unsure": ([GOOD] * 5 + [TURNED], ["INIT", "TRACKING", "DEGRADED"], "heading sigma 1.43 deg, above 1 deg"),
    "position worse than DEGRADED promises": (
        [GOOD] * 5 + [FAR] * 9,
        ["INIT", "TRACKING", "DEAD_RECKONING"],
        "position only within 0.60 m, not 0.3 m",
    ),
    "heading worse than DEGRADED promises": (
        [GOOD] * 5 + [ASKEW] * 9,
        ["INIT", "TRACKING", "DEAD_RECKONING"],
        "heading only within 8.6 deg, not 5 deg",
    ),
    "a missed frame of a pose that is worse": (
        [GOOD] * 5 + [replace(BLIND, heading_sigma_rad=0.05)],
        ["INIT", "TRACKING", "DEAD_RECKONING"],
        "no vision for 0.03 s",
    ),
    "better again": (
        [GOOD] * 5 + [FAR] * 9 + [WIDE] * 9 + [GOOD] * 9,
        ["INIT", "TRACKING", "DEAD_RECKONING", "DEGRADED", "TRACKING"],
        "5 good frames",
    ),
    "nine high NIS are luck": ([GOOD] * 5 + [STALE] * 9, ["INIT", "TRACKING"], "5 good"),
    "ten are not": (
        [GOOD] * 5 + [STALE] * 10,
        ["INIT", "TRACKING", "DEGRADED"],
        "NIS per degree of freedom 5.0, above 3",
    ),
    "blind": (
        [GOOD] * 5 + [BLIND] * 5,
        ["INIT", "TRACKING", "DEGRADED", "DEAD_RECKONING"],
        "no vision for 0.17 s: 2 cr",
    ),
    "blind from the start": ([BLIND] * 50, ["INIT"], "starting"),
    "sees again": (
        [GOOD] * 5 + [BLIND] * 9 + [GOOD] * 5,
        ["INIT", "TRACKING", "DEGRADED", "DEAD_RECKONING", "TRACKING"],
        "5 good frames",
    ),
    "sees again, but little": (
        [GOOD] * 5 + [BLIND] * 9 + [FEW] * 5,
        ["INIT", "TRACKING", "DEGRADED", "DEAD_RECKONING", "DEGRADED"],
        "3 inliers",
    ),
    "lost by covariance": ([GOOD] * 5 + [GONE], ["INIT", "TRACKING", "LOST"], "position sigma 0.800 m, above 0.5 m"),
    "blind and in doubt until the pose is of no use": (
        [GOOD] * 5 + [BLIND] * 9 + [replace(BLIND, position_sigma_m=0.51, in_doubt="moved", elsewhere=0.1)],
        ["INIT", "TRACKING", "DEGRADED", "DEAD_RECKONING", "RELOCALISING"],
        "moved",
    ),
    "blind until lost": (
        [GOOD] * 5 + [BLIND] * 9 + [replace(BLIND, position_sigma_m=0.51)],
        ["INIT", "TRACKING", "DEGRADED", "DEAD_RECKONING", "LOST"],
        "position sigma 0.510 m",
    ),
    "lost by NIS": (
        [GOOD] * 5 + [WRONG] * 10,
        ["INIT", "TRACKING", "LOST"],
        "NIS per degree of freedom 40.0, above 12",
    ),
    "a wrong start": ([WRONG] * 10, ["INIT", "LOST"], "NIS per degree of freedom 40.0, above 12"),
    "lost without landmarks stays lost": (
        [GOOD] * 5 + [WRONG] * 10 + [UNSEEN] * 99,
        ["INIT", "TRACKING", "LOST"],
        "NIS",
    ),
    "landmarks agree again": ([WRONG] * 10 + [GOOD] * 10, ["INIT", "LOST", "DEGRADED"], "recovering"),
    "landmarks agree again, for good": ([WRONG] * 10 + [GOOD] * 15, ["INIT", "LOST", "DEGRADED", "TRACKING"], "5 good"),
    "searching": ([WRONG] * 10 + [SEARCH], ["INIT", "LOST", "RELOCALISING"], "stored pose"),
    "the search forgets old innovations": (
        [WRONG] * 10 + [SEARCH] + [replace(WRONG, in_doubt="stored pose")] * 50 + [GOOD] * 5,
        ["INIT", "LOST", "RELOCALISING", "TRACKING"],
        "5 good",
    ),
    "no landmark confirms": ([SEARCH] * 3 + [UNSEEN] * 99, ["INIT", "RELOCALISING"], "stored pose"),
    "a landmark confirms": ([SEARCH] * 3 + [UNSEEN] * 9 + [GOOD], ["INIT", "RELOCALISING", "TRACKING"], "5 good"),
    "an old confirmation does not count": (
        [GOOD] * 9 + [SEARCH] + [UNSEEN] * 99,
        ["INIT", "TRACKING", "RELOCALISING"],
        "",
    ),
    "the search ended wrong": ([SEARCH] * 3 + [GONE], ["INIT", "RELOCALISING", "LOST"], "position sigma"),
    "sigma that is not a number": (
        [GOOD] * 5 + [replace(GOOD, position_sigma_m=float("nan"))],
        ["INIT", "TRACKING", "LOST"],
        "position sigma nan m",
    ),
}


@pytest.mark.parametrize("name", STORIES)
def test_story(name: str) -> None:
    evidence, states, reason = STORIES[name]
    verdicts = run(evidence)
    assert path(verdicts) == states
    assert verdicts[-1].reason.startswith(reason)


@pytest.mark.parametrize(
    ("better", "worse"),
    [
        (GOOD, replace(GOOD, inliers=4)),
        (GOOD, replace(GOOD, position_sigma_m=0.045)),
        (GOOD, replace(GOOD, heading_sigma_rad=0.017)),
        (GOOD, replace(GOOD, nis=2.0)),
        (GOOD, replace(GOOD, ess_ratio=0.02)),
    ],
    ids=["inliers", "position", "heading", "nis", "ess"],
)
def test_hovering_at_a_threshold_does_not_flap(better: Evidence, worse: Evidence) -> None:
    """Alternating between good and just-good-enough evidence leaves TRACKING alone and shows in the quality."""
    verdicts = run([better] * 5 + [worse, better] * 50 + [worse] * 30)
    assert path(verdicts) == ["INIT", "TRACKING"]
    assert verdicts[-1].quality < 0.95 * verdicts[4].quality


@pytest.mark.parametrize(
    ("bad", "between"),
    [
        (replace(GOOD, inliers=3), replace(GOOD, inliers=4)),
        (replace(GOOD, position_sigma_m=0.051), replace(GOOD, position_sigma_m=0.045)),
        (replace(GOOD, heading_sigma_rad=0.0176), replace(GOOD, heading_sigma_rad=0.017)),
    ],
    ids=["inliers", "position", "heading"],
)
def test_a_condition_is_left_well_within_its_threshold(bad: Evidence, between: Evidence) -> None:
    assert path(run([GOOD] * 5 + [bad, between] * 50)) == ["INIT", "TRACKING", "DEGRADED"]
    assert path(run([GOOD] * 5 + [between] * 50)) == ["INIT", "TRACKING"]


def test_dead_reckoning_starts_after_its_time_not_after_a_count() -> None:
    slow = [replace(GOOD, stamp_ns=k * 100_000_000) for k in range(5)]
    machine = StateMachine(CONFIG)
    for e in slow:
        machine.step(e)
    last_ns = slow[-1].stamp_ns
    assert machine.step(replace(BLIND, stamp_ns=last_ns + 150_000_000)).state is State.DEGRADED
    assert machine.step(replace(BLIND, stamp_ns=last_ns + 150_000_001)).state is State.DEAD_RECKONING


def test_reason_stays_while_its_cause_does() -> None:
    counts = [3, 2, 1, 2, 3]
    verdicts = run([GOOD] * 5 + [replace(GOOD, inliers=n) for n in counts])
    assert {v.reason for v in verdicts[5:]} == {"3 inliers of 30 crossings, fewer than 4"}
    assert [v.changed for v in verdicts[5:]] == [True, False, False, False, False]


def test_reason_follows_a_new_cause_without_a_change_of_state() -> None:
    verdicts = run([GOOD] * 5 + [FEW, replace(FEW, position_sigma_m=0.08)])
    assert verdicts[-1].reason.startswith("position sigma")
    assert not verdicts[-1].changed


def test_reset_is_reported_once_with_its_reason() -> None:
    machine = StateMachine(CONFIG)
    for k in range(5):
        machine.step(replace(GOOD, stamp_ns=k * PERIOD_NS))
    machine.reset("initial pose set by command")
    verdicts = [machine.step(replace(GOOD, stamp_ns=(5 + k) * PERIOD_NS)) for k in range(5)]
    assert path(verdicts) == ["INIT", "INIT", "TRACKING"]
    assert verdicts[0].reason == "initial pose set by command"
    assert verdicts[0].quality == 0.0


def test_a_search_after_a_reset_says_why() -> None:
    machine = StateMachine(CONFIG)
    machine.reset("stored pose")
    verdict = machine.step(SEARCH)
    assert (verdict.state, verdict.changed) == (State.RELOCALISING, True)
    assert verdict.reason == "stored pose"


def test_quality_is_half_at_each_threshold_alone() -> None:
    """The documented formula, worked by hand for a frame with every other score known."""
    config = States(dead_reckoning_s=0.0)
    sure = replace(GOOD, inliers=10**6, position_sigma_m=0.0, heading_sigma_rad=0.0, ess_ratio=1.0, nis_dof=0)
    nis_score = 1.0 / (1.0 + (1.0 / config.nis_high) ** 2)

    def quality(e: Evidence) -> float:
        return run([sure] * 5 + [e], config)[-1].quality / nis_score

    assert quality(sure) == pytest.approx(1.0, abs=1e-9)
    assert quality(replace(sure, position_sigma_m=config.degraded_sigma_m)) == pytest.approx(0.5)
    assert quality(replace(sure, heading_sigma_rad=0.01745329251994)) == pytest.approx(0.5)
    assert quality(replace(sure, inliers=config.degraded_inliers)) == pytest.approx(0.5)
    assert quality(replace(sure, ess_ratio=0.0)) == pytest.approx(0.8)
    assert quality(replace(sure, motion_ok=False, inliers=0)) == 0.0


def test_one_missed_frame_costs_little_quality_and_blindness_all_of_it() -> None:
    verdicts = run([GOOD] * 5 + [BLIND] * 60)
    before, missed, blind = verdicts[4].quality, verdicts[5].quality, verdicts[-1].quality
    assert 0.7 * before < missed < before
    assert 0.0 <= blind < 1e-3


def test_good_evidence_has_high_quality() -> None:
    assert run([GOOD] * 30)[-1].quality > 0.75
