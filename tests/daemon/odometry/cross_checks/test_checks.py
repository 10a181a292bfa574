"""The front: what is admitted, what is remembered, what is counted."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from told_drives import ahead, seen, still, told

from ceilvo import se2
from ceilvo.bench.cross_checks.drives import DriveSpec, Eye, drive, reversed_wheels
from ceilvo.bench.cross_checks.runner import Fault, run
from ceilvo.config import Config
from ceilvo.daemon.odometry.cross_checks.checks import CrossChecks, CrossChecksState
from ceilvo.daemon.odometry.cross_checks.suspicion import Kind, Severity
from ceilvo.daemon.replay.snapshot import read_value, value_json
from ceilvo.sim.rig import simulated_calibration
from ceilvo.types import Crossings, Pose

DRIVING = DriveSpec(speeds_mps=(0.2, 0.6), stand_share=0.1, rate_hz=15.0)


@pytest.fixture
def checks() -> CrossChecks:
    return CrossChecks(Config())


@pytest.fixture(scope="module")
def picture() -> Crossings:
    return Eye(simulated_calibration(), np.random.default_rng(1)).see(np.zeros(3))


def test_nothing_is_suspected_in_a_drive_without_faults_and_vision_is_used() -> None:
    rng = np.random.default_rng(60)
    steps = list(run(drive(DRIVING, 120.0, rng), Config(), rng))
    assert not any(step.suspicions.active for step in steps)
    assert sum(not step.motion.ok for step in steps) <= 1  # the first frame


def test_a_frozen_picture_carries_no_motion_and_is_counted_once(checks: CrossChecks, picture: Crossings) -> None:
    rng, wheels = np.random.default_rng(1), ahead(0.02)
    checks.step(0, picture, seen(np.zeros(3), rng), wheels, 0.1)
    for k in range(1, 4):
        admitted = checks.admit(picture, wheels, 0.1)
        assert admitted.crossings is None
        assert "frozen" in admitted.missing
        suspicions = checks.step(k, picture, seen(np.zeros(3), rng), wheels, 0.1)
        unusable = suspicions.gravest(Severity.UNUSABLE)
        assert unusable is not None and unusable.kind is Kind.FROZEN
    assert checks.counters[Kind.FROZEN.value] == 1
    assert set(checks.counters) == {kind.value for kind in Kind}


def test_a_test_feed_may_repeat_itself(picture: Crossings) -> None:
    checks = CrossChecks(replace(Config(), camera=replace(Config().camera, refuse_repeats=False)))
    for k in range(3):
        assert checks.admit(picture, None, 0.1).crossings is picture
        assert checks.step(k, picture, seen(np.zeros(3), np.random.default_rng(1)), None, 0.1).active == ()


def test_reversed_wheels_are_not_used_any_more() -> None:
    rng = np.random.default_rng(61)
    checks, said = CrossChecks(Config()), False
    for k, (_, motion, wheels, elapsed_s) in enumerate(
        told(DRIVING, 120.0, 61, turned=lambda path: reversed_wheels(path, "x"))
    ):
        admitted = checks.admit(None, wheels, elapsed_s)
        assert (admitted.wheels is None) == said
        said = checks.step(k, None, motion, wheels, elapsed_s).has(Kind.WHEELS_REVERSED)
    assert said
    assert checks.admit(None, still(), rng.uniform()).wheels is None


def test_wheels_are_compared_with_the_picture_of_their_own_time_once_its_delay_is_known() -> None:
    """The eye's motion of a late picture is what wheels told before, and a pose is moved on by what they told since."""
    checks, late_s, off_before, off_after = CrossChecks(Config()), 0.15, [], []
    pose, off_ahead = Pose(np.zeros(3)), []
    motions = list(told(DRIVING, 150.0, 62, late_s))
    on_time = [m for _, m, _, _ in told(DRIVING, 150.0, 62, 0.0)]
    now = np.zeros(3)
    for k, (now_s, motion, wheels, elapsed_s) in enumerate(motions):
        admitted = checks.admit(None, wheels, elapsed_s).wheels
        assert admitted is not None
        off = np.abs(admitted.prev_from_curr - motion.prev_from_curr)[[0, 2]] / elapsed_s
        (off_after if now_s > 60.0 else off_before if now_s < 8.0 else []).append(off)
        checks.step(k, None, motion, wheels, elapsed_s)
        pose, now = Pose(se2.compose(pose, motion.prev_from_curr)), se2.compose(now, on_time[k].prev_from_curr)
        if now_s > 60.0:
            there, cov = checks.ahead(pose, np.eye(3) * 1e-6)
            assert cov[0, 0] >= 1e-6
            off_ahead.append([np.hypot(*(pose - now)[:2]), np.hypot(*(there - now)[:2])])
    assert checks.counters[Kind.LATE.value] == 0
    assert np.quantile(np.array(off_after), 0.95, axis=0).max() < np.quantile(np.array(off_before), 0.95, axis=0).max()
    late_m, ahead_m = np.mean(off_ahead, axis=0)
    assert ahead_m < 0.6 * late_m


def test_a_delay_beyond_the_configured_one_is_an_error(checks: CrossChecks) -> None:
    for k, (_, motion, wheels, elapsed_s) in enumerate(told(DRIVING, 90.0, 63, 0.3)):
        suspicions = checks.step(k, None, motion, wheels, elapsed_s)
    late = suspicions.gravest(Severity.DEGRADED)
    assert late is not None and late.kind is Kind.LATE
    assert "odometry.max_delay_s = 0.2 s" in late.reason


def test_a_state_that_was_written_goes_on_as_the_original(checks: CrossChecks) -> None:
    eye, rng = Eye(simulated_calibration(), np.random.default_rng(2)), np.random.default_rng(3)
    again = CrossChecks(Config())
    for k, (_, motion, wheels, elapsed_s) in enumerate(told(DRIVING, 12.0, 64)):
        if k == 90:
            state = read_value(value_json(checks.state), CrossChecksState)
            assert state is not None
            again.state = state
        picture = eye.see(np.array([*rng.uniform(-1.0, 1.0, 2), 0.1]))
        said = checks.step(k, picture, motion, wheels, elapsed_s)
        if k >= 90:
            assert again.step(k, picture, motion, wheels, elapsed_s) == said
    assert json.loads(value_json(again.state)) == json.loads(value_json(checks.state))


def test_a_restart_forgets_the_way_but_neither_the_camera_nor_the_counters(checks: CrossChecks) -> None:
    for k, (_, motion, wheels, elapsed_s) in enumerate(told(DRIVING, 90.0, 65, 0.3)):
        checks.step(k, None, motion, wheels, elapsed_s)
    counted, steady_s = checks.counters, checks.state.delay.steady_s
    checks.restart()
    assert len(checks.state.paths.rows) == 0
    assert checks.counters == counted
    assert checks.state.delay.steady_s == steady_s is not None


@pytest.mark.parametrize(
    ("fault", "kind", "within_s"),
    [
        (Fault(20.0, 30.0, picture="frozen"), Kind.FROZEN, 0.1),
        (Fault(20.0, 30.0, picture="frozen", no_wheels=True), Kind.FROZEN, 0.1),
        (Fault(20.0, 30.0, picture="frozen noisy"), Kind.STANDS, 1.0),
        (Fault(20.0, 30.0, picture="ring 4", no_wheels=True), Kind.REPEATS, 0.1),
        (Fault(20.0, 22.0, spin_mps=0.3), Kind.STANDS, 1.0),
        (Fault(20.0, 21.0, picture="dark", picture_s=0.2, wheels_stand=True), Kind.LIFTED, 0.4),
    ],
)
def test_faults_are_said_in_time(fault: Fault, kind: Kind, within_s: float) -> None:
    rng = np.random.default_rng(66)
    moving = drive(replace(DRIVING, stand_share=0.0), 26.0, rng)
    said = [step.time_s for step in run(moving, Config(), rng, fault) if step.suspicions.has(kind)]
    assert said
    assert fault.begin_s <= said[0] < fault.begin_s + within_s
