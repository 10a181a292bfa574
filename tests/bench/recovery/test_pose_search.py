"""Known maps, lost poses, kidnapping and the tiles of a periodic ceiling."""

from dataclasses import replace
from itertools import product
from math import comb

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ceilvo.bench.recovery.filters import make_recovering_filter as make_filter
from ceilvo.bench.recovery.recovering_filter import SURE
from ceilvo.bench.recovery.tile_slips import SLIP_CHANCE, SLIP_CHANCE_3_SIGMA, LatticeBelief, neighbours, periods
from ceilvo.bench.recovery.view_score import at_least, unexplained
from ceilvo.config import Filter
from ceilvo.daemon.slam.spatial_index import IndexedMap
from ceilvo.se2 import compose, inverse, transform, wrap
from ceilvo.types import UNLABELLED, Landmarks, Motion, Observations

SEED = 9
TILE_M = 0.6


def map_of(xy, kind):
    n = len(xy)
    return Landmarks(
        np.arange(n), np.asarray(xy, float), np.tile(1e-6 * np.eye(2), (n, 1, 1)), np.asarray(kind), np.full(n, 9)
    )


def random_map(rng, n=60):
    return map_of(rng.uniform(-4, 4, (n, 2)), rng.integers(0, 3, n))


def grid(lamps=0, seed=SEED):
    """Crossings of tiles, and lamps (kind 1) in the middle of some of them."""
    g = TILE_M * np.arange(-5, 6)
    crossings = np.stack(np.meshgrid(g, g), axis=-1).reshape(-1, 2)
    chosen = np.random.default_rng(seed).permutation(len(crossings))[:lamps]
    xy = np.concatenate([crossings, crossings[chosen] + TILE_M / 2])
    return map_of(xy, np.repeat([0, 1], [len(crossings), lamps]))


POINTS = st.lists(st.tuples(st.floats(-20, 20), st.floats(-20, 20), st.integers(0, 2)), min_size=1, max_size=30)


@settings(max_examples=60, deadline=None)
@given(POINTS, POINTS, st.floats(0.01, 5.0))
def test_the_index_finds_what_brute_force_finds(landmarks, points, reach):
    m, q = np.array(landmarks), np.array(points)
    known = IndexedMap(map_of(m[:, :2], m[:, 2].astype(np.int64)))
    kind = q[:, 2].astype(np.int64)
    apart = np.hypot(q[:, None, 0] - m[:, 0], q[:, None, 1] - m[:, 1])
    near = known.near(q[:, :2], reach)
    assert set(np.flatnonzero(np.any(apart <= reach, axis=0))) <= set(near.tolist())
    label, distance = known.nearest(q[:, :2], kind, reach)
    apart[kind[:, None] != m[:, 2]] = np.inf
    best = np.min(apart, axis=1)
    np.testing.assert_array_equal(label >= 0, best <= reach)
    np.testing.assert_allclose(distance[label >= 0], best[best <= reach])


class Drive:
    """A robot on a circle that sees a map within 1.6 m with 2 cm noise, and the filter that follows it."""

    def __init__(self, landmarks, seed, labelled=False, start=(0.0, -1.2, 0.0), particles=60):
        self.rng = np.random.default_rng(seed)
        self.map, self.labelled, self.truth = landmarks, labelled, np.array(start)
        chosen = replace(Filter(method="joint"), particles=particles, feature_independence=1.0, association_gate_m=0.25)
        self.filter = make_filter(chosen, np.random.default_rng(seed + 1))

    def start(self, anywhere=False):
        cov = np.full((3, 3), np.inf) if anywhere else np.eye(3) * 1e-6
        self.filter.reset(np.zeros(3) if anywhere else self.truth, cov, self.map, known=True)
        return self

    def step(self, view=None):
        step, sigma = np.array([0.07, 0.0, 0.07 / 1.2]), np.array([0.004, 0.004, 0.004])
        self.truth = compose(self.truth, step)
        self.filter.predict(Motion(step + sigma * self.rng.standard_normal(3), np.diag(sigma**2), 9, 0.0))
        at = transform(inverse(self.truth), self.map.xy_map_m)
        seen = np.flatnonzero(np.hypot(*at.T) < 1.6)[:view]
        z = at[seen] + 0.02 * self.rng.standard_normal((len(seen), 2))
        label = seen if self.labelled else np.full(len(seen), UNLABELLED)
        self.filter.update(Observations(z, np.full((len(seen), 2), 4e-4), self.map.crossing_type[seen], label))
        pose, _, health = self.filter.estimate()
        return float(np.hypot(*(pose - self.truth)[:2])), abs(wrap(pose[2] - self.truth[2])), health.mode_weight


@pytest.mark.parametrize("labelled", [True, False])
def test_a_pose_that_is_not_known_is_found_on_the_map(labelled):
    for seed in range(4):
        d = Drive(random_map(np.random.default_rng(seed)), seed, labelled).start(anywhere=True)
        assert d.filter.estimate()[2].mode_weight == 0.0
        for _ in range(25):
            error, turn, weight = d.step()
        print(f"labelled {labelled}, seed {seed}: {error:.3f} m, {turn:.3f} rad, weight {weight:.3f}")
        assert error < 0.05
        assert turn < 0.05
        assert weight > SURE
        assert d.filter.counters()["searches"] == d.filter.counters()["recoveries"] == 1


def test_one_landmark_at_a_time_is_enough():
    d = Drive(random_map(np.random.default_rng(SEED)), SEED, labelled=True).start(anywhere=True)
    for _ in range(60):
        error, _, weight = d.step(view=1)
    assert error < 0.15
    assert weight > SURE


def test_a_kidnapped_robot_says_so_and_finds_itself_again():
    for seed in range(3):
        d = Drive(random_map(np.random.default_rng(seed + 50)), seed, labelled=seed == 0).start()
        for _ in range(10):
            assert d.step()[0] < 0.05
        d.truth = d.truth + np.array([0.9, 0.7, 2.0])
        wrong_and_sure = 0
        for _ in range(45):
            error, _, weight = d.step()
            wrong_and_sure += error > 0.25 and weight >= SURE
        counters = d.filter.counters()
        print(
            f"seed {seed}: {error:.3f} m, sure while wrong on {wrong_and_sure} updates, {counters['searches']} searches"
        )
        assert error < 0.05
        assert wrong_and_sure <= 3
        assert counters["recoveries"] >= 1


def test_tracking_does_not_search():
    d = Drive(random_map(np.random.default_rng(SEED)), SEED).start()
    errors = [d.step()[0] for _ in range(80)]
    assert max(errors) < 0.05
    assert d.filter.counters()["searches"] == 0


def test_on_a_bare_grid_an_unknown_pose_stays_one_of_several():
    d = Drive(grid(), SEED).start(anywhere=True)
    weights = [d.step()[2] for _ in range(15)]
    assert max(weights) < SURE
    assert d.filter.counters()["recoveries"] == 0


def test_with_lamps_the_grid_gives_the_pose_and_never_the_mean_of_two_tiles():
    d = Drive(grid(lamps=14), SEED).start(anywhere=True)
    crossings = d.map.xy_map_m[d.map.crossing_type == 0]
    for _ in range(40):
        error, _, weight = d.step()
        pose, _, _ = d.filter.estimate()
        seen = transform(inverse(d.truth), crossings)
        at = transform(pose, seen[np.hypot(*seen.T) < 1.0])
        off_grid = np.abs((at / TILE_M + 0.5) % 1.0 - 0.5) * TILE_M
        assert weight == 0.0 or np.median(off_grid) < 0.1
    assert error < 0.05
    assert weight > SURE


def test_the_period_of_a_grid_and_of_nothing():
    basis = periods(grid(lamps=10))
    assert np.allclose(np.sort(np.abs(basis), axis=None), [0, 0, TILE_M, TILE_M], atol=1e-3)
    assert len(neighbours(basis)) == 9
    assert np.allclose(neighbours(basis)[0], 0.0)
    assert len(periods(random_map(np.random.default_rng(SEED)))) == 0
    assert neighbours(np.empty((0, 2))).tolist() == [[0.0, 0.0]]


def test_belief_in_tiles_is_bayes_rule():
    t = LatticeBelief.at_home(neighbours(TILE_M * np.eye(2)))
    log_likelihood = np.zeros(9)
    log_likelihood[3] = 4.0
    t.weigh(log_likelihood, SLIP_CHANCE_3_SIGMA)
    expected = np.full(9, SLIP_CHANCE_3_SIGMA / 8)
    expected[0] = 1 - SLIP_CHANCE_3_SIGMA
    expected *= np.exp(log_likelihood)
    np.testing.assert_allclose(t.weight, expected / expected.sum())
    assert t.weight[3] < 0.95
    for _ in range(3):
        t.weigh(log_likelihood, SLIP_CHANCE)
    assert t.weight[3] > 0.95
    t.settle()
    assert t.weight[0] == 1.0


def test_the_chance_of_so_many_is_the_binomial_tail():
    for k, n, p in ((0, 5, 0.05), (1, 1, 0.05), (2, 3, 0.05), (4, 26, 0.05), (9, 9, 0.3)):
        brute = (
            sum(p ** sum(x) * (1 - p) ** (n - sum(x)) for x in product((0, 1), repeat=n) if sum(x) >= k)
            if n < 10
            else None
        )
        tail = sum(comb(n, i) * p**i * (1 - p) ** (n - i) for i in range(k, n + 1))
        assert at_least(k, n, p) == pytest.approx(tail, abs=1e-12)
        assert brute is None or at_least(k, n, p) == pytest.approx(brute, abs=1e-12)


def test_lamps_that_no_landmark_explains_are_a_surprise_and_crossings_alone_are_not():
    known, pose = IndexedMap(grid(lamps=30)), np.zeros(3)
    at = known.landmarks.xy_map_m
    seen = np.flatnonzero(np.hypot(*at.T) < 1.6)
    view = Observations(
        at[seen], np.full((len(seen), 2), 4e-4), known.landmarks.crossing_type[seen], np.full(len(seen), UNLABELLED)
    )
    assert not unexplained(known, pose, view, 0.2)
    tile_on = np.array([TILE_M, 0.0, 0.0])
    assert unexplained(known, tile_on, view, 0.2)
    crossings = np.flatnonzero(view.crossing_type == 0)
    bare = replace(
        view,
        xy_base_m=view.xy_base_m[crossings],
        var_m2=view.var_m2[crossings],
        crossing_type=view.crossing_type[crossings],
        label=view.label[crossings],
    )
    assert not unexplained(known, tile_on, bare, 0.2)


def test_two_tiles_off_is_found_out_by_the_lamps():
    """Beyond the neighbouring tiles, with a view whose crossings all fit."""
    for seed in range(4):
        d = Drive(grid(lamps=30), seed).start()
        for _ in range(10):
            d.step()
        d.truth = d.truth + np.array([2 * TILE_M, -TILE_M, 0.0])
        found, wrong_and_sure = [], 0
        for _ in range(40):
            error, _, weight = d.step()
            found.append(error < 0.05 and weight > SURE)
            wrong_and_sure += error > 0.25 and weight >= SURE
        print(f"seed {seed}: right and sure on {sum(found)} of 40 updates, sure while wrong on {wrong_and_sure}")
        assert found[-1]
        assert wrong_and_sure <= 3


def test_a_single_wrong_sighting_does_not_move_the_pose():
    d = Drive(random_map(np.random.default_rng(SEED)), SEED, labelled=True).start()
    for _ in range(10):
        d.step()
    pose = d.filter.estimate()[0]
    wrong = transform(inverse(pose), d.map.xy_map_m[:1]) + np.array([[1.5, 1.0]])
    d.filter.update(Observations(wrong, np.full((1, 2), 4e-4), d.map.crossing_type[:1], np.array([0])))
    after, _, health = d.filter.estimate()
    assert np.hypot(*(after - pose)[:2]) < 0.02
    assert health.mode_weight > SURE
    for _ in range(10):
        error, _, weight = d.step()
    assert error < 0.05
    assert weight > SURE


def test_a_jump_of_half_a_tile_is_flagged_on_a_bare_grid_and_resolved_with_lamps():
    for lamps in (0, 30):
        d = Drive(grid(lamps), SEED).start()
        for _ in range(10):
            d.step()
        d.truth = d.truth + np.array([0.36, 0.0, 0.0])
        weights, errors = [], []
        for _ in range(30):
            error, _, weight = d.step()
            weights.append(weight)
            errors.append(error)
        print(f"{lamps} lamps: weight at the end {weights[-1]:.2f}, least {min(weights):.2f}, error {errors[-1]:.3f} m")
        assert min(weights) < SURE
        if lamps:
            assert errors[-1] < 0.05
            assert weights[-1] > SURE
        else:
            assert weights[-1] < SURE
