"""Scales of wheels: drives whose wheels are known to be off by so much."""

import numpy as np
import pytest

from ceilvo import se2
from ceilvo.config.sections.senses import Senses
from ceilvo.daemon.odometry.senses.wheel_scales import WheelScales
from ceilvo.types import Array, Displacement, WheelMotion

DT_S = 0.1
EYE = np.diag([1e-8, 1e-8, 1e-9])
LEFT, RIGHT, TRACK = 1.02, 0.99, 1.015


def counted(true: Array, track_m: float) -> Array:
    """What a base reckons of a true twist with wheels LEFT and RIGHT times as large, TRACK times as far apart."""
    half = 0.5 * track_m * TRACK * true[2]
    left, right = (true[0] - half) / LEFT, (true[0] + half) / RIGHT
    return np.array([0.5 * (left + right), 0.0, (right - left) / track_m])


def learn(scales: WheelScales, steps: int, rng: np.random.Generator, noise: float, omni: bool = False) -> None:
    for k in range(steps):
        turn = 0.06 * np.sin(0.05 * k) if (k // 40) % 2 else 0.0
        true = np.array([0.05, 0.02 * np.cos(0.03 * k) * omni, turn])
        said = true / np.array([LEFT, RIGHT, TRACK]) if omni else counted(true, 0.4)
        way = float(np.hypot(*said[:2])) + 0.25 * abs(said[2])
        said = said + noise * np.sqrt(way) * rng.standard_normal(3) * [1.0, float(omni), 1.0]
        wheels = WheelMotion(Displacement(se2.driven(said, np.ones(1))[0]), np.eye(3))
        step = scales.step(wheels)
        scales.learn(step, se2.driven(true, np.ones(1))[0], EYE, DT_S, 0.0)


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_two_per_cent_are_found_within_twenty_metres(seed: int) -> None:
    scales = WheelScales(Senses(track_m=0.4))
    learn(scales, 400, np.random.default_rng(seed), 0.003)
    true = np.array([LEFT, RIGHT, TRACK]) - 1.0
    off, sigma = scales.state.off - true, np.sqrt(np.diag(scales.state.cov))
    print(scales.state.off, off / sigma)
    assert np.all(np.abs(off[:2]) < 0.002)
    assert np.all(np.abs(off) < 3.5 * sigma)


def test_an_omnidirectional_base_has_a_scale_an_axis() -> None:
    scales = WheelScales(Senses(drive="omni"))
    learn(scales, 500, np.random.default_rng(4), 0.002, omni=True)
    assert scales.names == ("x", "y", "theta")
    off, sigma = scales.state.off - (np.array([LEFT, RIGHT, TRACK]) - 1.0), np.sqrt(np.diag(scales.state.cov))
    print(off, sigma)
    assert np.all(np.abs(off) < np.minimum(3.5 * sigma, 0.006))


@pytest.mark.parametrize(("noise", "low", "high"), [(0.002, 2e-6, 1.2e-5), (0.01, 5e-5, 3e-4)])
def test_the_noise_that_is_learnt_is_what_was_drawn(noise: float, low: float, high: float) -> None:
    scales = WheelScales(Senses(track_m=0.4))
    learn(scales, 1500, np.random.default_rng(5), noise)
    print(scales.state.noise, noise**2)
    assert low < scales.state.noise[0] < high
    assert low < scales.state.noise[2] < high


def test_a_slip_teaches_nothing_and_scales_stay_within_their_bound() -> None:
    scales, rng = WheelScales(Senses(track_m=0.4, scale_bound=0.01)), np.random.default_rng(6)
    learn(scales, 300, rng, 0.002)
    assert np.max(np.abs(scales.state.off)) <= 0.01
    learnt = WheelScales(Senses(track_m=0.4))
    learn(learnt, 300, rng, 0.002)
    before, refused = learnt.state.off.copy(), learnt.state.refused
    for _ in range(6):
        wheels = WheelMotion(Displacement(np.array([0.05, 0.0, 0.0])), np.eye(3))
        learnt.learn(learnt.step(wheels), np.array([0.03, 0.0, 0.0]), EYE, DT_S, 0.0)
    assert learnt.state.refused > refused
    assert np.array_equal(learnt.state.off, before)


@pytest.mark.parametrize("stamp_s", [0.0, 0.002])
def test_how_sure_it_is_of_the_scales_is_right_whether_stamps_err_or_not(stamp_s: float) -> None:
    """What a stretch has too much at its end the next one lacks, so stamps hardly hide the scales."""
    ratio, noise = [], 0.003
    for seed in range(30):
        scales, rng = WheelScales(Senses(track_m=0.4)), np.random.default_rng(100 + seed)
        late_s = 0.0
        for k in range(500):
            true = np.array([0.05, 0.0, 0.06 * np.sin(0.05 * k) if (k // 40) % 2 else 0.0])
            before_s, late_s = late_s, stamp_s * float(rng.standard_normal())
            said = counted(true, 0.4) * (DT_S + late_s - before_s) / DT_S
            way = float(np.hypot(*said[:2])) + 0.25 * abs(said[2])
            said = said + noise * np.sqrt(way) * rng.standard_normal(3) * [1.0, 0.0, 1.0]
            wheels = WheelMotion(Displacement(se2.driven(said, np.ones(1))[0]), np.eye(3))
            scales.learn(scales.step(wheels), se2.driven(true, np.ones(1))[0], EYE, DT_S, 0.0)
        off, sigma = scales.state.off - (np.array([LEFT, RIGHT, TRACK]) - 1.0), np.sqrt(np.diag(scales.state.cov))
        ratio.append((off / sigma)[:2])
    rms = float(np.sqrt(np.mean(np.square(ratio))))
    print(f"errors over their sigma, rms: {rms:.2f}")
    assert 0.75 < rms < 1.25
