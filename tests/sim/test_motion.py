"""The simulated path against its geometry, wheels against the path, tilt against its bound."""

from __future__ import annotations

import threading

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ceilvo import se2
from ceilvo.errors import ConfigError
from ceilvo.sim.motion import LapPath, LapSpec, TiltProfile, TiltSpec, WheelOdometry, WheelSpec

T = np.arange(0.0, 75.0, 0.002)
SPECS = (LapSpec(), LapSpec(room_m=8.0, inset_m=0.4, corner_radius_m=0.9, speed_mps=1.1, rest_s=0.0, ramp_s=0.7))


@pytest.fixture(scope="module", params=SPECS, ids=("usual", "fast"))
def path(request: pytest.FixtureRequest) -> LapPath:
    return LapPath(request.param)


def test_starts_at_rest_facing_along_x() -> None:
    path = LapPath()
    for t in (-1.0, 0.0, 0.3, 0.5):
        np.testing.assert_allclose(path.pose_at(t), [path.pose_at(0.0)[0], 1.0, 0.0], atol=1e-12)
        np.testing.assert_allclose(path.twist_at(t), 0.0, atol=1e-12)
    assert path.pose_at(1.5)[0] > path.pose_at(0.5)[0] + 0.05


def test_travel_is_the_arc_length_of_the_poses(path: LapPath) -> None:
    xy = path.pose_at(T)[:, :2]
    arc = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(xy, axis=0).T))])
    np.testing.assert_allclose(path.travel_at(T), arc, atol=2e-4)
    cruising = path.spec.speed_mps * (T[-1] - path.spec.rest_s - 0.5 * path.spec.ramp_s)
    assert abs(float(path.travel_at(T[-1])) - cruising) < 1e-9


def test_twist_is_the_derivative_of_the_pose(path: LapPath) -> None:
    h = 1e-3
    numeric = se2.between(path.pose_at(T - h), path.pose_at(T + h)) / (2 * h)
    twist = path.twist_at(T)
    np.testing.assert_allclose(numeric[:, 0], twist[:, 0], atol=2e-3)
    np.testing.assert_allclose(numeric[:, 2], twist[:, 2], atol=5e-3)
    turned = twist[:, 2] * h  # chord against tangent: the lateral part that a finite step has
    np.testing.assert_allclose(numeric[:, 1], twist[:, 0] * turned / 2, atol=2e-3)


def test_acceleration_is_continuous_and_the_derivative_of_speed(path: LapPath) -> None:
    speed, a = path.speed_at(T), path.acceleration_at(T)
    np.testing.assert_allclose(np.gradient(speed, T), a[:, 0], atol=0.02 * path.spec.speed_mps / path.spec.ramp_s)
    steps = np.abs(np.diff(a, axis=0)).max(axis=0)
    top = np.abs(a).max(axis=0)
    assert (steps < 0.02 * top).all(), (steps, top)
    np.testing.assert_allclose(a[:, 1], path.twist_at(T)[:, 0] * path.twist_at(T)[:, 2], atol=1e-12)


def test_laps_stay_on_the_inset_square_and_turn_left(path: LapPath) -> None:
    p = path.pose_at(T)
    lo, hi = path.spec.inset_m, path.spec.room_m - path.spec.inset_m
    np.testing.assert_allclose(p[:, :2].min(axis=0), lo, atol=1e-9)
    np.testing.assert_allclose(p[:, :2].max(axis=0), hi, atol=1e-9)
    turned = np.unwrap(p[:, 2])
    assert (np.diff(turned) > -1e-9).all()
    assert turned[-1] > 2 * np.pi
    curvature = path.twist_at(T)[:, 2] / np.maximum(path.twist_at(T)[:, 0], 1e-9)
    assert abs(curvature.max() * path.spec.corner_radius_m - 1.0) < 1e-3


def test_a_lap_closes() -> None:
    path = LapPath()
    lap_s = path.lap_m / path.spec.speed_mps
    for t in (5.0, 9.3, 17.0):
        error = se2.between(path.pose_at(t), path.pose_at(t + 3 * lap_s))
        np.testing.assert_allclose(error, 0.0, atol=1e-8)


def test_a_corner_that_does_not_fit_is_refused_with_the_radius_that_does() -> None:
    with pytest.raises(ConfigError, match=r"corner_radius_m 2\.0 .* at most 0\.9") as e:
        LapPath(LapSpec(corner_radius_m=2.0))
    fits = float(str(e.value).rsplit(" ", 1)[1])
    LapPath(LapSpec(corner_radius_m=fits - 1e-3))
    with pytest.raises(ConfigError, match="corner_radius_m"):
        LapPath(LapSpec(corner_radius_m=fits + 1e-3))


@pytest.mark.parametrize("bad", [{"speed_mps": 0.0}, {"room_m": -1.0}, {"ramp_s": float("nan")}, {"inset_m": -0.1}])
def test_impossible_laps_are_refused(bad: dict[str, float]) -> None:
    with pytest.raises(ConfigError, match=next(iter(bad))):
        LapSpec(**bad)


def test_wheels_without_errors_follow_the_path() -> None:
    path = LapPath()
    wheels = WheelOdometry(path, WheelSpec(scale=1.0, drift_radpm=0.0, slips_per_min=0.0))
    start = path.pose_at(0.0)
    for t in (0.0, 0.4, 3.0, 31.4, 59.9999, 60.0, 60.0001, 130.0):
        error = se2.between(path.pose_at(t), se2.compose(start, wheels.at(t)))
        np.testing.assert_allclose(error, 0.0, atol=2e-4)


def test_wheel_scale_and_drift_are_as_specified() -> None:
    path = LapPath()
    wheels = WheelOdometry(path, WheelSpec(scale=1.02, drift_radpm=0.01, slips_per_min=0.0))
    t = np.arange(0.0, 64.0, 0.01)
    odom = np.array([wheels.at(s) for s in t])
    driven = np.hypot(*np.diff(odom[:, :2], axis=0).T).sum()
    travel = float(path.travel_at(t[-1]))
    assert abs(driven / travel - 1.02) < 1e-4
    heading = np.unwrap(odom[:, 2])[-1] - np.unwrap(path.pose_at(t)[:, 2])[-1]
    assert abs(heading - 0.01 * travel) < 1e-4


@pytest.mark.parametrize("seed", range(5))
def test_wheel_drift_is_there_but_bounded(seed: int) -> None:
    path, wheels = LapPath(), None
    wheels = WheelOdometry(path, seed=seed)
    steps = [se2.between(wheels.at(t), wheels.at(t + 1.0)) for t in np.arange(3.0, 120.0)]
    true = [se2.between(path.pose_at(t), path.pose_at(t + 1.0)) for t in np.arange(3.0, 120.0)]
    error = np.abs(np.array(steps) - np.array(true))
    assert error[:, 0].max() < 0.35 * 0.45 * 1.0 + 0.01
    assert error[:, 2].max() < 0.08 * 1.0 + 0.01
    assert np.median(error[:, 0]) < 0.006
    assert error[:, 0].max() > 0.01, "no slip in two minutes"


def test_wheels_are_a_function_of_time_whoever_asks_first() -> None:
    times = np.random.default_rng(5).uniform(0.0, 200.0, 60)
    ordered = WheelOdometry(LapPath(), seed=7)
    expected = {t: ordered.at(t) for t in sorted(times)}
    shared = WheelOdometry(LapPath(), seed=7)
    wrong: list[float] = []

    def ask(order: np.ndarray) -> None:
        wrong.extend(t for t in order if not np.array_equal(shared.at(t), expected[t]))

    threads = [threading.Thread(target=ask, args=(np.roll(times, 13 * i),)) for i in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert wrong == []
    assert not np.array_equal(WheelOdometry(LapPath(), seed=8).at(150.0), shared.at(150.0))


def test_changing_what_at_returned_changes_nothing() -> None:
    wheels = WheelOdometry(LapPath())
    before = wheels.at(10.0)
    wheels.at(10.0)[:] = 99.0
    np.testing.assert_array_equal(wheels.at(10.0), before)


@settings(max_examples=50, deadline=None)
@given(st.floats(0.0, 1e4), st.floats(0.001, 0.035), st.integers(0, 1000))
def test_tilt_stays_within_its_amplitude(t: float, amplitude: float, seed: int) -> None:
    tilt = TiltProfile(LapPath(), TiltSpec(amplitude), seed).at(t)
    assert tilt.shape == (2,)
    assert (np.abs(tilt) <= amplitude * (1 + 1e-12)).all()


def test_tilt_is_off_by_default_rests_at_rest_and_reaches_near_its_amplitude() -> None:
    path = LapPath()
    assert not TiltProfile(path).at(T).any()
    tilt = TiltProfile(path, TiltSpec(np.radians(2.0))).at(T)
    assert not tilt[T < 0.5].any()
    assert (np.abs(tilt).max(axis=0) > np.radians(1.2)).all()


def test_the_nose_rises_when_speeding_up_and_the_body_leans_out_of_a_left_bend() -> None:
    path = LapPath(LapSpec(speed_mps=0.8, ramp_s=1.0))
    seeds = range(60)  # the waves have random phases, the reaction to acceleration has not
    mean = np.mean([TiltProfile(path, TiltSpec(0.03), s).at(T) for s in seeds], axis=0)
    a = path.acceleration_at(T)
    assert mean[np.argmax(a[:, 0]), 1] < -0.003
    assert mean[np.argmax(a[:, 1]), 0] > 0.003


def test_the_heading_that_is_not_wrapped_is_the_turn_rates_integral() -> None:
    path, t = LapPath(), np.linspace(0.0, 80.0, 4001)
    turned = path.turned_at(t)
    assert turned[-1] > 2.0 * np.pi, "more than a lap"
    middle = path.twist_at(0.5 * (t[1:] + t[:-1]))[:, 2]
    assert np.allclose(np.diff(turned), middle * np.diff(t), atol=1e-4)


def test_a_robot_that_rocks_at_rest_does_so_from_the_first_instant() -> None:
    spec = TiltSpec(np.radians(2.0), at_rest=True)
    standing = TiltProfile(LapPath(), spec).at(np.linspace(0.0, 0.5, 50))
    assert np.ptp(standing, axis=0).min() > np.radians(0.3)
    assert np.abs(TiltProfile(LapPath(), spec).at(T)).max() <= spec.amplitude_rad
