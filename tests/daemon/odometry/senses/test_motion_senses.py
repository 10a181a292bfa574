"""The stage as a whole: what it does switched off, over a blackout, when it is carried, and across a restart."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest

from ceilvo import se2
from ceilvo.config.sections.senses import Senses
from ceilvo.daemon.odometry.cross_checks.noticed import suspicions_of
from ceilvo.daemon.odometry.cross_checks.suspicion import Kind, Severity
from ceilvo.daemon.odometry.senses.learnt import learnt
from ceilvo.daemon.odometry.senses.motion_senses import MotionSenses, MotionSensesState
from ceilvo.daemon.replay.snapshot import read_value, value_json
from ceilvo.senses.heard import Turn
from ceilvo.types import Array, Displacement, Motion, WheelMotion

DT_S, BIAS, SCALE = 0.1, 0.004, np.array([1.015, 0.99])
ALL = Senses(time=True, wheels=True, gyro="base", track_m=0.4)
STILL = np.zeros(3)


def wheels_of(twist: Array) -> WheelMotion:
    """Of a base whose left and right wheels are SCALE times as large as it reckons."""
    half = 0.2 * twist[2]
    left, right = (twist[0] + np.array([-half, half])) / SCALE
    said = np.array([0.5 * (left + right), 0.0, (right - left) / 0.4])
    return WheelMotion(Displacement(se2.driven(said, np.ones(1))[0]), np.diag([1e-6, 1e-6, 1e-6]))


def turn_of(rad: float) -> Turn:
    return Turn(rad + BIAS * DT_S, (1.7e-4) ** 2 * DT_S, DT_S, 1e-9)


def seen(twist: Array, failure: str | None = None) -> Motion:
    moved = Displacement(se2.driven(twist, np.ones(1))[0])
    return Motion(moved, np.diag([1e-8, 1e-8, 1e-9]), 40, 1e-4, failure)


def driven(seconds: float) -> list[Array]:
    """Twists of frames: straights and bends of both hands."""
    return [np.array([0.05, 0.0, 0.08 * np.sin(0.1 * k) * ((k // 60) % 2)]) for k in range(round(seconds / DT_S))]


def learn(senses: MotionSenses, twists: Sequence[Array]) -> None:
    for twist in twists:
        senses.step(seen(twist), wheels_of(twist), turn_of(float(twist[2])), DT_S)


def test_switched_off_it_hands_on_what_it_gets_and_remembers_nothing() -> None:
    senses, before = MotionSenses(Senses()), value_json(MotionSenses(Senses()).state)
    wheels = wheels_of(np.array([0.05, 0.0, 0.01]))
    assert senses.told(wheels, turn_of(0.01), DT_S).wheels is wheels
    assert senses.since(wheels, 0.08) is wheels
    learn(senses, driven(5.0))
    assert value_json(senses.state) == before
    assert learnt(senses, Senses()) == {}


def test_ten_seconds_in_the_dark_end_within_a_per_cent_and_a_degree() -> None:
    senses = MotionSenses(ALL)
    learn(senses, driven(60.0))
    way, cov, true = np.zeros(3), np.zeros((3, 3)), np.zeros(3)
    for twist in driven(10.0):
        told = senses.told(wheels_of(twist), turn_of(float(twist[2])), DT_S)
        assert told.wheels is not None and told.wheels.watched
        cov = se2.compose_cov(way, cov, told.wheels.prev_from_curr, told.wheels.cov)
        way, true = se2.compose(way, told.wheels.prev_from_curr), se2.compose(true, se2.driven(twist, np.ones(1))[0])
        senses.step(replace(seen(twist, "dark"), by_wheels=True), wheels_of(twist), turn_of(float(twist[2])), DT_S)
    off = se2.between(true, way)
    print(off, np.sqrt(np.diag(cov)))
    assert np.hypot(*off[:2]) < 0.01 * 5.0
    assert abs(off[2]) < np.radians(1.0)
    assert off @ np.linalg.solve(cov, off) < 16.0
    raw = np.zeros(3)
    for twist in driven(10.0):
        raw = se2.compose(raw, wheels_of(twist).prev_from_curr)
    assert np.hypot(*se2.between(true, raw)[:2]) > 3.0 * np.hypot(*off[:2]), "wheels as commissioned are far worse"


def test_without_wheels_the_gyro_still_tells_the_turn() -> None:
    senses = MotionSenses(replace(ALL, wheels=False))
    for twist in driven(30.0):
        senses.step(seen(twist), None, turn_of(float(twist[2])), DT_S)
    told = senses.told(None, turn_of(0.3), DT_S)
    assert told.wheels is None and told.turn is not None
    assert abs(told.turn.turned_rad - 0.3) < 5.0 * np.sqrt(told.turn.var_rad2) < 0.01


@pytest.mark.parametrize("dark", [True, False])
def test_a_robot_that_is_turned_on_standing_wheels_is_carried(dark: bool) -> None:
    senses = MotionSenses(ALL)
    learn(senses, [*driven(30.0), *[STILL] * 20])
    said = []
    for _ in range(10):
        motion = seen(STILL, "dark") if dark else seen(np.array([0.0, 0.0, 0.03]))
        noticed = senses.step(motion, wheels_of(STILL), turn_of(0.03), DT_S)
        said += suspicions_of(noticed, motion.ok, None)
        assert not any(s.axis != "turning" for s in noticed.slips)
    carried = [s for s in said if s.kind is Kind.CARRIED]
    assert carried
    assert carried[0].severity is (Severity.IN_DOUBT if dark else Severity.NOTED)
    told = senses.told(wheels_of(STILL), turn_of(0.03), DT_S)
    assert (told.wheels is None) == dark, "wheels in the air tell nothing"


def test_a_robot_that_stands_in_the_dark_is_vouched_for_and_one_that_drives_is_not_carried() -> None:
    senses = MotionSenses(ALL)
    learn(senses, [*driven(30.0), *[STILL] * 20])
    for _ in range(8):
        senses.step(seen(STILL, "dark"), wheels_of(STILL), turn_of(0.0), DT_S)
    assert senses.step(seen(STILL), wheels_of(STILL), turn_of(0.0), DT_S).still
    for twist in driven(20.0):
        assert senses.step(seen(twist), wheels_of(twist), turn_of(float(twist[2])), DT_S).carried_rad is None


def test_after_a_reset_what_was_learnt_stays_and_learning_goes_on() -> None:
    senses = MotionSenses(ALL)
    learn(senses, driven(30.0))
    off, stretches, windows = (
        senses.wheels.state.off.copy(),
        senses.wheels.state.stretches,
        senses.gyro_lag.state.counts.copy(),
    )
    senses.restart()
    assert np.array_equal(senses.wheels.state.off, off)
    learn(senses, driven(30.0))
    assert senses.wheels.state.stretches > stretches
    assert np.any(senses.gyro_lag.state.counts > windows), "the delay is followed by the new time"


def test_a_snapshot_goes_on_as_the_run_does() -> None:
    one, other = MotionSenses(ALL), MotionSenses(ALL)
    learn(one, driven(20.0))
    state = read_value(value_json(one.state), MotionSensesState)
    assert state is not None
    other.state = state
    for senses in (one, other):
        learn(senses, driven(10.0))
    assert value_json(one.state) == value_json(other.state)
    json.dumps(learnt(one, ALL), allow_nan=False)


@pytest.mark.parametrize(("where", "together"), [("base", True), ("topic", False)])
def test_wheels_and_gyro_of_one_base_learn_their_delay_anew_together(where: str, together: bool) -> None:
    senses = MotionSenses(replace(ALL, gyro=where))
    learn(senses, driven(30.0))
    senses.wheels_lag.state.jumped_now, senses.wheels_lag.state.delay_s = True, 0.12
    windows = senses.gyro_lag.state.counts.copy()
    assert np.any(windows > 0.0)
    learn(senses, driven(0.1))
    s = senses.gyro_lag.state
    assert (s.delay_s == 0.12 and not np.any(s.counts)) == together
    learn(senses, driven(30.0))
    assert abs(senses.gyro_lag.known_s) < 0.003, "what was told is only where it begins"
