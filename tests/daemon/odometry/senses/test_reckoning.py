"""A way and its covariance against many ways that were driven with drawn errors."""

from itertools import pairwise

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from ceilvo import se2
from ceilvo.daemon.odometry.senses.reckoning import Reckoning, Step, arc
from ceilvo.types import Array

twists = st.tuples(st.floats(-0.3, 0.3), st.floats(-0.3, 0.3), st.floats(-1.0, 1.0))
BEND = np.array([0.05, 0.0, 0.03])
BY = np.array([[0.05, 0.0], [0.0, 0.0], [0.0, 0.07]])
NOISE = np.diag([2e-5, 1e-6, 1e-5])
PARAMETERS = np.diag([0.02, 0.02]) ** 2


@given(twists)
def test_an_arc_is_the_constant_twists_and_its_derivative_is_the_differences(twist: tuple[float, ...]) -> None:
    at = np.array(twist)
    moved, by = arc(at)
    assert np.allclose(moved, se2.driven(at, np.ones(1))[0], atol=1e-9)
    steps = 1e-6 * np.eye(3)
    slope = np.array([(arc(at + h)[0] - arc(at - h)[0]) / 2e-6 for h in steps]).T
    assert np.allclose(by, slope, atol=1e-6)


def reckoned(steps: int) -> list[Reckoning]:
    out = [Reckoning.start(2)]
    for _ in range(steps):
        out.append(out[-1].then(Step(BEND, BY, NOISE), 0.1))
    return out


def test_the_covariance_is_that_of_drawn_ways() -> None:
    """Noise is drawn for every step, parameters once a way."""
    rng, steps = np.random.default_rng(3), 60
    end = reckoned(steps)[-1]
    ways = []
    for _ in range(1500):
        way, off = np.zeros(3), BY @ (np.sqrt(np.diag(PARAMETERS)) * rng.standard_normal(2))
        for noise in rng.standard_normal((steps, 3)) * np.sqrt(np.diag(NOISE)):
            way = se2.compose(way, arc(BEND + off + noise)[0])
        ways.append(se2.between(end.way, way))
    c, s = np.cos(end.way[2]), np.sin(end.way[2])
    turn = np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
    ratio = np.linalg.solve(turn @ end.cov(PARAMETERS) @ turn.T, np.cov(np.array(ways).T))
    values = np.linalg.eigvals(ratio).real
    print(values)
    assert np.all((values > 0.8) & (values < 1.25))


def test_shares_of_steps_add_up_to_the_whole() -> None:
    all_ = reckoned(25)
    way, cov = np.zeros(3), np.zeros((3, 3))
    for before, after in pairwise(all_):
        moved: Array = arc(BEND)[0]
        cov = se2.compose_cov(way, cov, moved, after.share_of(before, PARAMETERS, moved))
        way = se2.compose(way, moved)
        ratio = np.linalg.eigvals(np.linalg.solve(after.cov(PARAMETERS), cov)).real
        assert np.all(ratio > 0.97), "never less than the whole"
        assert np.all(np.diag(cov) < 1.3 * np.diag(after.cov(PARAMETERS)) + 1e-12)
    independent = 25 * (BY @ PARAMETERS @ BY.T + NOISE)[2, 2]
    assert cov[2, 2] > 4.0 * independent, "the same error in all steps adds up, it does not average out"


def test_a_bias_that_drifts_errs_from_then_on_only() -> None:
    """Against drives whose bias wanders; as if it had been off all the way the turn would err by 1.7 times as much."""
    rng, runs, steps, walk, before = np.random.default_rng(8), 4000, 50, 4e-6, 1e-6
    bias = np.sqrt(before) * rng.standard_normal(runs)
    true = np.zeros((runs, 3))
    reckoning = Reckoning.start(1)
    dt_s, by = 0.1, np.array([[0.0], [0.0], [-0.1]])
    for _ in range(steps):
        reckoning = reckoning.then(Step(np.array([0.05, 0.0, 0.02]), by, np.zeros((3, 3))), dt_s, np.array([walk]))
        bias = bias + np.sqrt(walk * dt_s) * rng.standard_normal(runs)
        moved = arc_of(0.05, 0.02 - dt_s * bias)
        c, s = np.cos(true[:, 2]), np.sin(true[:, 2])
        true += np.column_stack([c * moved[:, 0] - s * moved[:, 1], s * moved[:, 0] + c * moved[:, 1], moved[:, 2]])
    said, found = reckoning.cov(np.array([[before]])), np.cov((true - reckoning.way).T)
    print(np.sqrt(np.diag(said)), np.sqrt(np.diag(found)))
    squared = np.einsum("ni,ij,nj->n", true - reckoning.way, np.linalg.inv(found), true - reckoning.way)
    assert abs(np.mean(squared) - 3.0) < 0.1
    np.testing.assert_allclose(np.sqrt(np.diag(said)), np.sqrt(np.diag(found)), rtol=0.06)


def arc_of(ahead_m: float, turned_rad: Array) -> Array:
    """(N, 3) arcs of one length that turn by (N,)."""
    x, y = ahead_m * np.sin(turned_rad) / turned_rad, ahead_m * (1.0 - np.cos(turned_rad)) / turned_rad
    return np.column_stack([x, y, turned_rad])
