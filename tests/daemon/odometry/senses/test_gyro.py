"""A gyro of known bias and scale, against the ceiling's direction."""

from dataclasses import replace

import numpy as np

from ceilvo.config.sections.senses import Senses
from ceilvo.daemon.odometry.senses.gyro import Gyro
from ceilvo.senses.heard import Turn

DT_S, BIAS, SCALE, NOISE = 0.07, 0.006, -0.004, 1.7e-4


def turn(true_rad: float, rng: np.random.Generator) -> Turn:
    said = (1.0 + SCALE) * true_rad + BIAS * DT_S + NOISE * np.sqrt(DT_S) * rng.standard_normal()
    return Turn(said, NOISE**2 * DT_S, DT_S)


def test_bias_and_scale_are_found_while_it_turns() -> None:
    gyro, rng = Gyro(Senses()), np.random.default_rng(1)
    for k in range(900):
        true = DT_S * (1.2 if (k // 60) % 3 == 1 else 0.0)
        gyro.passed(DT_S)
        gyro.learn(turn(true, rng), true, 1e-8, 0.0)
    off = gyro.state.bias_scale - [BIAS, SCALE]
    sigma = np.sqrt(np.diag(gyro.cov))
    print(off, sigma)
    assert np.all(np.abs(off) < 4.0 * sigma)
    assert sigma[0] < np.radians(0.02)
    assert sigma[1] < 0.001
    said = turn(2.0, rng)
    assert abs(gyro.turned_rad(said) - 2.0) < 4.0 * np.sqrt(gyro.var_rad2(said))


def test_a_robot_that_stands_in_the_dark_tells_the_bias_and_one_that_is_turned_does_not() -> None:
    gyro, rng = Gyro(Senses()), np.random.default_rng(2)
    for _ in range(150):
        gyro.learn_standing(turn(0.0, rng))
    assert abs(gyro.state.bias_scale[0] - BIAS) < np.radians(0.05)
    before = gyro.state.bias_scale.copy()
    for _ in range(30):
        gyro.learn_standing(turn(0.5 * DT_S, rng))
    assert gyro.state.refused == 30
    assert np.array_equal(gyro.state.bias_scale, before)


def test_a_direction_that_jumps_teaches_nothing() -> None:
    gyro, rng = Gyro(Senses()), np.random.default_rng(3)
    for _ in range(200):
        gyro.learn(turn(0.0, rng), 0.0, 1e-8, 0.0)
    before = gyro.state.bias_scale.copy()
    for k in range(8):
        gyro.learn(turn(0.0, rng), 0.5 * (k == 3), 1e-8, 0.0)
    assert gyro.state.refused == 1
    assert np.array_equal(gyro.state.bias_scale, before)


def test_how_sure_it_is_of_bias_and_scale_is_right_where_stamps_err() -> None:
    ratio = []
    for seed in range(30):
        gyro, rng = Gyro(Senses(gyro_walk_dps=0.0)), np.random.default_rng(50 + seed)
        far = 0.0
        for k in range(900):
            true = DT_S * (0.08 + (1.2 if (k // 60) % 3 == 1 else 0.0))
            before, far = far, 0.002 * float(rng.standard_normal()) * true / DT_S
            said = turn(true, rng)
            moved = replace(said, turned_rad=said.turned_rad + far - before)
            gyro.learn(moved, true, 1e-8, 0.0)
        ratio.append((gyro.state.bias_scale - [BIAS, SCALE]) / np.sqrt(np.diag(gyro.cov)))
    rms = np.sqrt(np.mean(np.square(ratio), axis=0))
    print("errors over their sigma, rms:", rms)
    assert np.all(rms > 0.5) and np.all(rms < 1.3)
