"""Slips against arithmetic by hand and against drives whose truth is known: what they do, and how often they begin."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ceilvo.bench.paper.run import known_map
from ceilvo.config import Filter
from ceilvo.daemon.relocalisation.filters import make_filter
from ceilvo.daemon.slam import slip
from ceilvo.daemon.slam.slip import KINDS, LOSS, OVER_RUN, SlipState
from ceilvo.se2 import compose, inverse, transform, wrap
from ceilvo.types import Array, Displacement, Motion, Observations

SEED = 31
CFG = replace(Filter(), feature_independence=1.0)


def driven(metres: float, turn_rad: float = 0.0, steps: int = 10) -> SlipState:
    s = SlipState()
    for _ in range(steps):
        step = np.array([metres / steps, 0.0, turn_rad / steps])
        s.moved(step[:2], Motion(Displacement(step), 1e-6 * np.eye(3), 9, 0.0))
    return s


@given(st.floats(1e-9, 3.0), st.floats(-3.0, 3.0), st.floats(0.0, 1.0), st.integers(0, KINDS - 1))
def test_chances_are_probabilities_and_a_slip_goes_on(metres: float, turn: float, was: float, kind: int) -> None:
    slipping = np.zeros(KINDS)
    slipping[kind] = was
    chance, began = driven(metres, turn).chances(slipping, CFG)
    assert np.all(chance >= 0.0)
    assert np.sum(chance) == pytest.approx(1.0)
    assert np.all(began <= chance[:KINDS] + 1e-12)
    others = np.delete(chance[:KINDS], kind)
    assert np.all(others <= chance[kind] + 1e-12)


def test_who_stands_does_not_slip_and_goes_on_as_it_was() -> None:
    chance, began = SlipState().chances(np.array([0.0, 0.0, 1.0]), CFG)
    assert chance.tolist() == [0.0, 0.0, 0.0, 1.0]
    assert not np.any(began)
    chance, _ = driven(1.0).chances(np.ones(KINDS) / KINDS, replace(CFG, slip_per_m=0.0))
    assert chance[-1] == 1.0


def test_a_turn_without_noise_is_no_turn_of_the_wheels() -> None:
    s = SlipState()
    s.moved(np.zeros(2), Motion(Displacement(np.array([0.0, 0.0, 1.0])), np.zeros((3, 3)), 0, 0.0))
    assert s.exposure_m == 0.0


def test_the_rate_is_learnt_and_bounded() -> None:
    """Slips that begin every 2 m for 400 m are believed; none at all, or one each centimetre, only within bounds."""
    often, never, wild = SlipState(), SlipState(), SlipState()
    for i in range(4000):
        for s, starts in ((often, float(i % 20 == 0)), (never, 0.0), (wild, 10.0)):
            s.travel_m = 0.1
            s.learn(np.array([starts, 0.0, 0.0]))
    rate = CFG.slip_per_m
    assert often.rates(replace(CFG, slip_per_m=0.05))[LOSS] == pytest.approx(0.5, rel=0.15)
    assert never.rates(CFG)[LOSS] == pytest.approx(max(rate * 50.0 / 450.0, slip.RARER * rate), rel=0.01)
    assert wild.rates(CFG)[LOSS] == slip.OFTENER * rate
    assert SlipState().rates(CFG) == pytest.approx(np.full(KINDS, rate))


def test_what_was_seen_long_ago_fades() -> None:
    s = SlipState()
    for i in range(30_000):
        s.travel_m = 0.1
        s.learn(np.array([float(i < 5000 and i % 20 == 0), 0.0, 0.0]))
    assert s.metres <= slip.MEMORY_M + 0.1
    assert s.rates(CFG)[LOSS] < 0.2 * CFG.slip_per_m + 0.002


@pytest.mark.parametrize("kind", [LOSS, OVER_RUN])
def test_a_share_of_the_way_has_the_moments_of_a_uniform_distribution(kind: int) -> None:
    s = driven(0.5)
    lost = CFG.slip_share if kind == LOSS else -slip.OVER_RUN_SHARE
    draws = -lost * np.random.default_rng(SEED).uniform(0, 1, 200_000) * 0.5
    found = s.along(kind, CFG)
    assert found.shift[0] == pytest.approx(np.mean(draws), abs=2e-3)
    assert found.spread[0, 0] == pytest.approx(np.var(draws), rel=0.02)
    assert not np.any(found.spread[1:]) and not np.any(found.shift[1:])


@given(st.floats(1e-3, 1.0), st.floats(-3.0, 3.0))
def test_pieces_of_a_turn_are_the_turn(metres: float, turn: float) -> None:
    """Together they have the mean and, but for what is cut off beyond 2.5 sigma, the spread of one Gaussian."""
    pieces = driven(metres, turn).turned()
    share = np.array([p.share for p in pieces])
    angle = np.array([p.shift[2] for p in pieces])
    assert np.sum(share) == pytest.approx(1.0)
    assert share @ angle == pytest.approx(0.0, abs=1e-9)
    sigma = np.hypot(slip.YAW_RAD_PER_M * min(metres, 2 * slip.LENGTH_M), slip.YAW_SHARE * turn)
    whole = share @ (angle**2 + [p.spread[2, 2] for p in pieces])
    assert 0.8 * sigma <= np.sqrt(whole) <= 1.001 * sigma + 1e-12
    assert (len(pieces) > 1) == (sigma > slip.WIDE_RAD)


def test_a_turned_way_ends_where_a_robot_that_turned_half_way_would_be() -> None:
    s = driven(1.0, 2.0)
    for p in s.turned():
        end = s.displacement_m + p.shift[:2]
        assert np.hypot(*end) == pytest.approx(1.0)
        assert np.arctan2(end[1], end[0]) == pytest.approx(0.5 * p.shift[2])


STEP_M, NOISE = 0.08, 0.004


def drive(error: Array, slip_per_m: float, seed: int = SEED, seen: bool = False) -> tuple[Array, dict[str, int]]:
    """Worst position and heading error of 4 m on a known map; wheels are wrong by `error` in each of steps 20 to 24.

    seen: vision measured the way; the same error is in what is seen of landmarks then, as of lines at another height.
    """
    rng = np.random.default_rng(seed)
    points = rng.uniform([-1, -1.5], [5, 1.5], (40, 2))
    f = make_filter(replace(CFG, slip_per_m=slip_per_m, particles=50), np.random.default_rng(seed))
    known = known_map(points, np.zeros(len(points), np.int64))
    truth = np.zeros(3)
    f.reset(truth, np.eye(3) * 1e-8, known, known=True)
    worst = np.zeros(2)
    for i in range(50):
        step = np.array([STEP_M, 0.0, 0.0])
        truth = compose(truth, step)
        wrong = error * (20 <= i < 25)
        told = step + wrong * (not seen) + NOISE * rng.standard_normal(3)
        f.predict(Motion(Displacement(told), np.diag([NOISE**2] * 3), 9, 0.0, seen=seen))
        at = transform(inverse(truth), points)
        there = np.flatnonzero(np.hypot(*at.T) < 1.2)
        z = at[there] + 0.05 * rng.standard_normal((len(there), 2)) + 2.0 * wrong[:2] * seen
        f.update(Observations(z, np.full((len(there), 2), 0.0025), np.zeros(len(there), np.int64), there))
        off = f.estimate()[0] - truth
        worst = np.maximum(worst, [np.hypot(*off[:2]), abs(wrap(off[2]))])
    return worst, dict(f.counters())


@pytest.mark.parametrize(
    ("error", "kept_m", "kept_rad"),
    [((0.12, 0.0, 0.0), 0.1, 0.06), ((-0.05, 0.0, 0.0), 0.12, 0.06), ((0.0, 0.0, 0.15), 0.12, 0.2)],
    ids=["loss", "over-run", "yaw"],
)
def test_a_slip_of_each_kind_is_followed(error: tuple[float, ...], kept_m: float, kept_rad: float) -> None:
    without, _ = drive(np.array(error), 0.0)
    found, counters = drive(np.array(error), 0.02)
    print(f"seed {SEED}: worst {without} m, rad without slip, {found} with it; {counters['slips']} slips")
    assert found[0] < kept_m and found[1] < kept_rad
    assert counters["slips"] >= 1


def test_a_way_that_vision_measured_has_no_slip() -> None:
    """Landmarks that seem further on for a while, as lines that are taken to be at another height, are not followed."""
    error = np.array([-0.12, 0.0, 0.0])
    believed, _ = drive(error, 0.02, seen=True)
    s = SlipState()
    s.moved(np.array([0.3, 0.0]), Motion(Displacement(np.array([0.3, 0.0, 0.1])), 1e-6 * np.eye(3), 9, 0.0, seen=True))
    print(f"seed {SEED}: worst {believed} m, rad")
    assert s.exposure_m == 0.0 and s.chances(np.zeros(KINDS), CFG)[0][-1] == 1.0
    assert believed[0] < 0.08


def test_without_a_slip_none_is_seen() -> None:
    without, _ = drive(np.zeros(3), 0.0)
    found, counters = drive(np.zeros(3), 0.02)
    assert np.all(np.abs(found - without) < 0.01)
    assert counters["slips"] == 0
