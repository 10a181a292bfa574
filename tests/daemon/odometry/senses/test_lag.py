"""A delay that is known, from a drive that speeds up, brakes and turns."""

import numpy as np
import pytest

from ceilvo.daemon.odometry.senses.lag import Lag, Series
from ceilvo.types import Array

DT_S, KEPT = 0.07, 43


def paths(seconds: float, rng: np.random.Generator, steady: bool = False) -> tuple[Array, Array]:
    """(N,) time and (N, 2) way and turn on a fine raster: legs of other speeds, eased."""
    t = np.arange(0.0, seconds, 0.01)
    if steady:
        rate = np.tile([0.4, 0.1], (len(t), 1))
    else:
        want = np.repeat(rng.uniform([0.0, -1.0], [0.6, 1.0], (len(t) // 150 + 1, 2)), 150, axis=0)[: len(t)]
        rate = np.stack([np.convolve(w, np.ones(60) / 60, mode="same") for w in want.T], axis=-1)
    return t, np.cumsum(rate, axis=0) * 0.01


def run(late_s: float, seconds: float, seed: int, lag: Lag, steady: bool = False, odd_s: float = 0.0) -> None:
    """odd_s: by how much every fiftieth picture is later."""
    rng = np.random.default_rng(seed)
    t, way = paths(seconds, rng, steady)
    stamps = np.arange(1.0, seconds, DT_S)
    noise = np.cumsum(rng.standard_normal((len(stamps), 2)) * [0.0008, 0.0012], axis=0)
    sense = 1.01 * np.stack([np.interp(stamps, t, c) for c in way.T], axis=-1) + noise
    late = late_s + odd_s * (np.arange(len(stamps)) % 50 == 49)
    eye = np.stack([np.interp(stamps - late, t, c) for c in way.T], axis=-1)
    eye += rng.standard_normal(eye.shape) * [1e-4, 1e-4]
    offset_s = lag.state.next_s
    for k in range(4, len(stamps)):
        rows = slice(max(0, k - KEPT), k + 1)
        lag.step(
            Series(
                stamps[rows] + offset_s,
                eye[rows],
                sense[rows],
                np.ones(k + 1 - rows.start),
                np.full(2, 1e-5),
                np.full(2, 2e-6),
            )
        )


@pytest.mark.parametrize(("late_s", "seed"), [(0.07, 1), (0.083, 2), (0.09, 3), (0.0, 4), (-0.03, 5)])
def test_it_is_found_within_thirty_seconds_to_three_milliseconds(late_s: float, seed: int) -> None:
    lag = Lag()
    run(late_s, 30.0, seed, lag)
    print(lag.known_s - late_s, lag.sigma_s)
    assert lag.sigma_s < 0.003
    assert abs(lag.known_s - late_s) < 0.003
    assert abs(lag.known_s - late_s) < 4.0 * lag.sigma_s


def test_a_steady_drive_tells_nothing() -> None:
    lag = Lag()
    run(0.08, 60.0, 6, lag, steady=True)
    assert lag.known_s == 0.0
    assert lag.sigma_s == np.inf


def test_a_jump_is_counted_and_taken_over() -> None:
    lag = Lag()
    run(0.05, 40.0, 7, lag)
    assert lag.state.jumps == 0
    run(0.12, 40.0, 8, lag)
    assert lag.state.jumps == 1
    assert abs(lag.state.jumped_s - 0.07) < 0.01
    assert abs(lag.known_s - 0.12) < 0.005


@pytest.mark.parametrize("step_s", [0.03, 0.05, -0.05])
def test_a_jump_is_said_within_seconds_of_changing_speed(step_s: float) -> None:
    took = []
    for seed in range(5):
        lag = Lag()
        run(0.08, 60.0, 20 + seed, lag)
        began_s = lag.state.next_s
        run(0.08 + step_s, 15.0, 40 + seed, lag)
        assert lag.state.jumps == 1
        assert abs(lag.state.jumped_s - step_s) < 0.012
        took.append(lag.state.jumped_at_s - began_s)
    print("said after s", np.round(took, 1))
    assert np.median(took) < 6.0


def test_there_is_no_jump_where_there_is_none() -> None:
    """Half an hour of speeds that change all the time; the test's rate is one in 1000 h."""
    most = 0.0
    for seed in range(6):
        lag = Lag()
        run(0.08, 300.0, 60 + seed, lag)
        assert lag.state.jumps == 0
        assert lag.sigma_s < 0.002 and abs(lag.known_s - 0.08) < 0.002
        most = max(most, float(np.max(lag.state.evidence)))
    print("evidence at the end", most)


def test_single_pictures_that_are_late_are_no_jump() -> None:
    lag = Lag()
    run(0.08, 60.0, 80, lag)
    run(0.08, 60.0, 81, lag, odd_s=0.1)
    print(lag.known_s, lag.sigma_s)
    assert lag.state.jumps == 0
    assert abs(lag.known_s - 0.08) < 0.003
