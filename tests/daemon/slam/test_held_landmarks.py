"""Landmarks that are held: what a view corrects without teaching them, against Schmidt's update worked out here."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from ceilvo.config import Filter
from ceilvo.daemon.relocalisation.filters import make_filter
from ceilvo.daemon.slam import modes
from ceilvo.daemon.slam.conditional import View, hold
from ceilvo.daemon.slam.joint_filter import JointFilter
from ceilvo.daemon.slam.pose_filter import PoseFilter
from ceilvo.json_values import MAX_ID
from ceilvo.se2 import compose, inverse, rotation, transform, wrap
from ceilvo.types import NO_LANDMARK, Array, Displacement, Ints, Landmarks, Motion, Observations

SEED = 53
METHODS = ("joint", "ukf", "pf", "pfcf_paper")
SIGMA_M, MAP_SIGMA_M = 0.01, 0.02
STEP = np.array([0.1, 0.0, 0.05])
STEP_COV = np.diag([4e-6, 4e-6, 1e-6])
PRIOR = np.diag([2.5e-3, 2.5e-3, 4e-4])
"""m^2, rad^2: a pose that is known to 5 cm and 1 deg."""
COLUMNS = ("ids", "xy_map_m", "cov_m2", "crossing_type", "sightings", "expected")


def predicted(state: Array, k: int) -> Array:
    """(2 K + 1,) the first K landmarks of a state (S,) as they are seen in base, and the heading."""
    there = (state[3:].reshape(-1, 2)[:k] - state[:2]) @ rotation(float(state[2]))
    return np.append(there.ravel(), state[2])


def schmidt(state: Array, cov: Array, seen: Array, noise: Array, held: Array) -> tuple[Array, Array]:
    """Joseph's form, which holds for any gain, with Kalman's gain but for the held rows; numerical derivatives."""
    k = len(seen) // 2
    h = np.stack([(predicted(state + d, k) - predicted(state - d, k)) / 2e-6 for d in 1e-6 * np.eye(len(state))], 1)
    gain = cov @ h.T @ np.linalg.inv(h @ cov @ h.T + noise)
    gain[held] = 0.0
    rest = np.eye(len(state)) - gain @ h
    return state + gain @ (seen - predicted(state, k)), rest @ cov @ rest.T + gain @ noise @ gain.T


@pytest.mark.parametrize("held", [0, 3, 8])
def test_an_update_with_held_landmarks_is_schmidts(held: int) -> None:
    """Eight landmarks, five of them in view, all correlated with each other and the pose; so many are held."""
    rng, n, k = np.random.default_rng([SEED, held]), 8, 5
    root = 0.05 * rng.standard_normal((3 + 2 * n, 3 + 2 * n))
    state, cov = np.concatenate([[0.3, -0.2, 0.5], rng.uniform(-2, 2, 2 * n)]), root @ root.T
    still = np.arange(3 + 2 * n) >= 3 + 2 * (n - held)
    still[3:] = np.roll(still[3:], 4)  # some of them in view
    var, heading_var = rng.uniform(1e-4, 4e-4, (k, 2)), 1e-4
    seen = predicted(state, k) + 0.02 * rng.standard_normal(2 * k + 1)
    expected = schmidt(state, cov, seen, np.diag(np.append(var.ravel(), heading_var)), still)
    rows = 3 + np.arange(2 * k)
    block = np.concatenate([np.arange(3), rows])
    z, landmark = seen[:-1].reshape(-1, 2), state[rows].reshape(-1, 2)
    view = View(z, var, landmark, cov[np.ix_(block, block)], float(seen[-1]), heading_var, 1.0, still)
    step, found = modes.corrected(state, cov, view, rows, state[:3], known=False)
    np.testing.assert_allclose(state + step, expected[0], atol=1e-8)
    np.testing.assert_allclose(found, expected[1], atol=1e-8)
    assert np.array_equal((state + step)[still], state[still])
    assert np.array_equal(found[np.ix_(still, still)], cov[np.ix_(still, still)])
    assert np.min(np.linalg.eigvalsh(found)) > -1e-12
    all_learn, _ = modes.corrected(state, cov, replace(view, held=still[:0]), rows, state[:3], known=False)
    np.testing.assert_allclose(step[:3], all_learn[:3], atol=1e-12)  # the pose is corrected no less


def test_without_held_rows_a_step_stays_as_it_is() -> None:
    step, less = np.arange(5.0), np.ones((5, 5))
    hold(step, less, np.zeros(0, bool))
    assert np.array_equal(step, np.arange(5.0))
    assert np.all(less == 1.0)


class Robot:
    """A filter with a map that is off as its covariances say, and the truth."""

    def __init__(self, method: str, seed: int, rng: np.random.Generator, particles: int = 50) -> None:
        self.xy, self.rng = rng.uniform(-3, 3, (60, 2)), rng
        self.kind = np.arange(60)
        self.map = Landmarks(
            np.arange(60),
            self.xy + MAP_SIGMA_M * rng.standard_normal((60, 2)),
            np.tile(MAP_SIGMA_M**2 * np.eye(2), (60, 1, 1)),
            self.kind,
            np.full(60, 9),
            np.full(60, 12),
        )
        settings = replace(
            Filter(), method=method, feature_independence=1.0, slip_per_m=0.0, gate_chi2=100.0, particles=particles
        )
        self.filter = make_filter(settings, np.random.default_rng(seed))
        self.truth = np.linalg.cholesky(PRIOR) @ rng.standard_normal(3)
        self.filter.reset(np.zeros(3), PRIOR, self.map)
        if method == "joint":
            self.filter.state.rule.model_var_m2 = 0.0

    def go(self) -> None:
        self.truth = compose(self.truth, STEP + np.linalg.cholesky(STEP_COV) @ self.rng.standard_normal(3))
        self.filter.predict(Motion(Displacement(STEP), STEP_COV, 9, 0.0))

    def look(self, learnt_from: int, unknown: Array | None = None) -> None:
        """All within 1.5 m, and features (N, 2) in map that no landmark explains."""
        at = transform(inverse(self.truth), self.xy)
        seen = np.flatnonzero(np.hypot(*at.T) < 1.5)
        ids = self.filter.landmarks().ids
        label = np.array([int(np.flatnonzero(ids == i)[0]) for i in seen], np.int64)
        z, kind = at[seen], self.kind[seen]
        if unknown is not None:
            z = np.concatenate([z, transform(inverse(self.truth), unknown)])
            kind = np.concatenate([kind, 100 + np.arange(len(unknown))])
            label = np.concatenate([label, np.full(len(unknown), NO_LANDMARK)])
        z = z + SIGMA_M * self.rng.standard_normal(z.shape)
        square = 1.5 * np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])
        view = Observations(z, np.full(z.shape, SIGMA_M**2), kind, label, visible_m=square)
        self.filter.update(view, learnt_from)

    @property
    def off(self) -> Array:
        """(3,) of the pose."""
        off = self.filter.estimate()[0] - self.truth
        off[2] = wrap(float(off[2]))
        return off


def columns(f: PoseFilter, below_id: int) -> list[object]:
    landmarks = f.landmarks()
    order = np.argsort(landmarks.ids)[: int(np.count_nonzero(landmarks.ids < below_id))]
    return [getattr(landmarks, name)[order].tolist() for name in COLUMNS]


@pytest.mark.parametrize("method", METHODS)
def test_held_landmarks_stay_to_the_bit_and_the_pose_is_corrected(method: str) -> None:
    r = Robot(method, SEED, np.random.default_rng(SEED), particles=400)
    before, began = columns(r.filter, MAX_ID), float(np.hypot(*r.off[:2]))
    unknown = np.array([[0.3, 0.4], [0.9, -0.2]])
    for _ in range(12):
        r.look(MAX_ID, unknown)
        r.go()
    ended = float(np.hypot(*r.off[:2]))
    print(f"seed {SEED}, {method}: {1e3 * began:.1f} -> {1e3 * ended:.1f} mm")
    assert columns(r.filter, MAX_ID) == before
    assert r.filter.counters()["births"] == 0
    assert ended < 0.5 * began
    for _ in range(4):
        r.look(0, unknown)
    after = columns(r.filter, 60)
    assert after != before  # sure again, it learns
    assert r.filter.size() == 62


@pytest.mark.parametrize("method", METHODS)
def test_what_was_begun_in_doubt_is_learnt_beside_what_is_held(method: str) -> None:
    r = Robot(method, SEED, np.random.default_rng(SEED), particles=400)
    before, unknown = columns(r.filter, 60), np.array([[0.3, 0.4], [0.9, -0.2], [-0.5, 0.6]])
    for _ in range(5):
        r.look(60, unknown)
    own = r.filter.landmarks()
    assert r.filter.size() == 63
    for _ in range(5):
        labels, near = r.filter.landmarks_near(unknown, 0.3)
        mine = labels[near.ids >= 60]
        z = transform(inverse(r.truth), unknown) + SIGMA_M * r.rng.standard_normal((3, 2))
        kind = r.filter.landmarks().crossing_type[mine]
        r.filter.update(Observations(z[kind - 100], np.full((3, 2), SIGMA_M**2), kind, mine), 60)
    now = r.filter.landmarks()
    assert columns(r.filter, 60) == before
    mine_before, mine_now = own.of(own.ids >= 60), now.of(now.ids >= 60)
    assert np.all(mine_now.sightings > mine_before.sightings)
    assert not np.any(mine_now.xy_map_m == mine_before.xy_map_m)


def ambiguous(rng: np.random.Generator) -> tuple[JointFilter, Array, Ints]:
    """A filter that maps, with two modes: a slip that one view left open."""
    at, n = np.array([[1.2, 0.5], [1.0, -0.7]]), np.arange(2)
    f = make_filter(replace(Filter(), feature_independence=1.0, particles=400), rng)
    assert isinstance(f, JointFilter)
    map_ = Landmarks(n, at, np.tile(1e-4 * np.eye(2), (2, 1, 1)), n, n + 9)
    f.reset(np.zeros(3), np.diag([1e-4, 1e-4, 1e-4]), map_)
    f.predict(Motion(Displacement(np.array([0.25, 0.0, 0.0])), np.diag([1e-4, 1e-4, 1e-5]), 9, 0.0))
    f.update(Observations(transform(inverse(np.array([0.12, 0.0, 0.0])), at), np.full((2, 2), 0.05**2), n, n))
    return f, at, n


def test_modes_that_weigh_otherwise_do_not_move_what_is_held() -> None:
    """What is told is of all modes together: it moved as their weights did, though none of them learnt."""
    f, at, n = ambiguous(np.random.default_rng(SEED))
    assert len(f.state.rule.modes) >= 2
    before = columns(f, MAX_ID)
    for x_m in (0.12, 0.15, 0.2):
        f.update(Observations(transform(inverse(np.array([x_m, 0.0, 0.0])), at), np.full((2, 2), 0.05**2), n, n), 99)
        assert columns(f, MAX_ID) == before
        f.predict(Motion(Displacement(np.array([0.05, 0.0, 0.0])), np.diag([1e-4, 1e-4, 1e-5]), 9, 0.0))
        assert np.min(np.linalg.eigvalsh(f.state.joint.cov)) > -1e-12


def test_what_a_doubtful_place_says_of_wheels_and_lens_is_not_learnt() -> None:
    f, at, n = ambiguous(np.random.default_rng(SEED))
    rule = f.state.rule
    model, slips, share = rule.model_var_m2, repr(rule.slip), rule.turns.share
    f.update(Observations(transform(inverse(np.array([0.5, 0.0, 0.0])), at), np.full((2, 2), 0.05**2), n, n), 99)
    f.update(Observations(transform(inverse(np.array([0.4, 0.1, 0.0])), at), np.full((2, 2), 0.05**2), n, n), 99)
    assert f.state.rule.model_var_m2 == model
    assert f.state.rule.turns.share == share
    assert repr(f.state.rule.slip) == slips


def test_two_of_ones_own_are_merged_without_moving_what_is_held() -> None:
    r = Robot("joint", SEED, np.random.default_rng(SEED))
    r.look(0)
    j = r.filter.state.joint
    own = j.give_birth(np.array([[0.5, 0.5], [0.503, 0.5]]), np.full((2, 2), SIGMA_M**2), np.full(2, 200), 3)
    assert np.array_equal(j.ids[own], [60, 61])
    before, pose = (j.xy(np.arange(60)).tolist(), j.packed(np.arange(60)).tolist()), j.pose.copy()
    assert j.merge(int(own[0]), int(own[1]), 25.0, 60)
    assert len(j) == 61
    assert (j.xy(np.arange(60)).tolist(), j.packed(np.arange(60)).tolist()) == before
    assert not np.array_equal(j.xy(own[:1])[0], pose[:2])
    assert np.min(np.linalg.eigvalsh(j.cov)) > -1e-15


@pytest.mark.parametrize("method", ["joint", "ukf"])
def test_errors_are_as_large_as_said_in_doubt_and_after_it(method: str) -> None:
    """Mean NEES a degree of freedom over random maps and ways: the map, seen again and again, is no new evidence."""
    in_doubt, after, landmarks = [], [], []
    for seed in range(60):
        r = Robot(method, seed, np.random.default_rng([SEED, seed]))
        for _ in range(15):
            r.look(MAX_ID)
            r.go()
        assert np.min(np.linalg.eigvalsh(r.filter.state.joint.cov)) > -1e-12
        in_doubt.append(r.off @ np.linalg.solve(r.filter.estimate()[1], r.off) / 3.0)
        for _ in range(15):
            r.look(0)
            r.go()
        after.append(r.off @ np.linalg.solve(r.filter.estimate()[1], r.off) / 3.0)
        j = r.filter.state.joint
        mine = j.label_of
        off = (j.mean[3:].reshape(-1, 2) - r.xy[j.ids[mine]]).ravel()
        landmarks.append(off @ np.linalg.solve(j.cov[3:, 3:], off) / len(off))
    means = [float(np.mean(nees)) for nees in (in_doubt, after, landmarks)]
    print(f"{method}, 60 seeds: NEES in doubt {means[0]:.2f}, after it {means[1]:.2f}, of the map {means[2]:.2f}")
    assert 0.7 < means[0] < 1.4  # 180 degrees of freedom: 1 +- .11
    assert 0.7 < means[1] < 1.4
    assert 0.85 < means[2] < 1.15
