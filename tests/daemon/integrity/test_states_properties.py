"""States: properties that must hold for any evidence."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from state_runs import run

from ceilvo.config import States
from ceilvo.daemon.integrity.states import Evidence
from ceilvo.types import State

anything: st.SearchStrategy[Evidence] = st.builds(
    Evidence,
    stamp_ns=st.just(0),
    motion_ok=st.booleans(),
    failure=st.just("why"),
    inliers=st.integers(0, 40),
    crossings=st.integers(0, 60),
    position_sigma_m=st.one_of(
        st.floats(0, 1), st.sampled_from([0.04, 0.05, 0.08, 0.1, 0.4, 0.5, float("nan"), float("inf")])
    ),
    heading_sigma_rad=st.one_of(st.floats(0, 0.2), st.just(float("nan"))),
    nis=st.one_of(st.floats(0, 50), st.sampled_from([2.4, 3.0, 9.6, 12.0, float("nan"), float("inf")])),
    nis_dof=st.sampled_from([0, 2, 40]),
    ess_ratio=st.floats(0, 1),
    landmarks_matched=st.integers(0, 20),
    in_doubt=st.sampled_from(["", "", "", "moved"]),
    elsewhere=st.sampled_from([0.0001, 0.0049, 0.005, 1.0]),
)
configs: st.SearchStrategy[States] = st.builds(
    States,
    dead_reckoning_s=st.sampled_from([0.0, 0.15, 1.0]),
    tracking_frames=st.integers(1, 8),
    nis_frames=st.integers(1, 12),
)
runs = st.lists(st.tuples(anything, st.integers(1, 12)), min_size=1, max_size=12)


def spread(parts: list[tuple[Evidence, int]]) -> list[Evidence]:
    return [e for e, n in parts for _ in range(n)]


@settings(max_examples=150, deadline=None)
@given(configs, anything)
def test_constant_evidence_changes_the_state_once_at_most(config: States, e: Evidence) -> None:
    assert sum(v.changed for v in run([e] * 60, config)) <= 1


@settings(max_examples=150, deadline=None)
@given(configs, runs, anything)
def test_constant_evidence_never_returns_to_a_state_it_left(config: States, before: Any, e: Evidence) -> None:
    """From wherever any history led, constant evidence settles without flapping."""
    history = spread(before)
    entered = [v.state for v in run([*history, *[e] * 80], config)[len(history) :] if v.changed]
    assert len(entered) == len(set(entered)) <= 3


@settings(max_examples=200, deadline=None)
@given(configs, runs)
def test_what_always_holds(config: States, parts: Any) -> None:
    evidence = spread(parts)
    verdicts = run(evidence, config)
    state, reason = State.INIT, "starting"
    for e, v in zip(evidence, verdicts, strict=True):
        assert 0.0 <= v.quality <= 1.0
        assert v.changed == (v.state is not state)
        assert v.reason
        assert "\n" not in v.reason
        assert v.state is not State.TRACKING or (e.motion_ok and not e.in_doubt)
        blind = v.state is State.DEAD_RECKONING and not e.motion_ok  # asked again when vision is back
        assert v.state is State.RELOCALISING or blind or not e.in_doubt or e.elsewhere < 0.005
        assert v.quality == 0.0 or v.state not in (State.INIT, State.LOST, State.RELOCALISING)
        if e.position_sigma_m > config.lost_sigma_m:
            assert v.state not in (State.TRACKING, State.DEGRADED, State.DEAD_RECKONING)
        if v.state in (State.TRACKING, State.DEGRADED):  # the promise
            assert 3.0 * e.position_sigma_m <= config.degraded_within_m
            assert 3.0 * np.degrees(e.heading_sigma_rad) <= config.degraded_within_deg
        if not v.changed and v.state not in (State.DEGRADED, State.DEAD_RECKONING, State.LOST):
            waits = v.state is State.INIT and "cmd/initial_pose" in v.reason
            assert v.reason == reason or waits  # one reason a change
        state, reason = v.state, v.reason
    assert run(evidence, config) == verdicts


def worsened(e: Evidence, by: float) -> Evidence:
    return replace(
        e,
        motion_ok=e.motion_ok and by < 0.7,
        inliers=int(e.inliers * (1 - by)),
        position_sigma_m=e.position_sigma_m * (1 + by),
        heading_sigma_rad=e.heading_sigma_rad * (1 + by),
        nis=e.nis * (1 + by),
        ess_ratio=e.ess_ratio * (1 - by),
    )


@settings(max_examples=200, deadline=None)
@given(configs, runs, anything, st.floats(0, 1))
def test_bad_evidence_never_raises_quality(config: States, before: Any, e: Evidence, by: float) -> None:
    history = spread(before)
    better = run([*history, e], config)[-1].quality
    worse = run([*history, worsened(e, by)], config)[-1].quality
    assert worse <= better + 1e-12
