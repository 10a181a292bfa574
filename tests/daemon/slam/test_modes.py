"""Modes: births and deaths that they follow, what they are together, and when they become one."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ceilvo.config import Filter
from ceilvo.daemon.relocalisation.filters import make_filter
from ceilvo.daemon.slam import modes
from ceilvo.daemon.slam.joint_map import JointMap
from ceilvo.daemon.slam.modes import Mode, merged, settled
from ceilvo.se2 import compose, inverse, transform, wrap
from ceilvo.types import Array, Displacement, Landmarks, Motion, Observations

SEED = 37


def a_map(pose: Array, seed: int = SEED) -> JointMap:
    rng = np.random.default_rng(seed)
    a = 0.1 * rng.standard_normal((3, 3))
    j = JointMap.at(pose, a @ a.T)
    give_birth(j, 4, seed)
    return j


def give_birth(j: JointMap, n: int, seed: int) -> None:
    rng = np.random.default_rng([seed, n])
    j.give_birth(rng.uniform(-2, 2, (n, 2)), rng.uniform(1e-4, 4e-4, (n, 2)), np.arange(n), 1)


def test_a_newborn_landmark_stands_to_every_pose_as_it_was_seen() -> None:
    """The same births in a joint map at the mode's own pose."""
    j, elsewhere = a_map(np.array([1.0, -2.0, 0.4])), a_map(np.array([1.3, -1.8, 0.9]))
    m = Mode(0.5, elsewhere.mean.copy(), elsewhere.cov.copy(), j.ids[j.label_of], np.zeros(3))
    give_birth(j, 3, SEED)
    give_birth(elsewhere, 3, SEED)
    m.follow(j)
    np.testing.assert_allclose(m.mean, elsewhere.mean, atol=1e-12)
    np.testing.assert_allclose(m.cov, elsewhere.cov, atol=1e-12)
    assert m.ids.tolist() == j.ids[j.label_of].tolist()


def test_landmarks_that_go_or_come_back_do_so_everywhere() -> None:
    j = a_map(np.array([1.0, -2.0, 0.4]))
    m = Mode(0.5, j.mean.copy(), j.cov.copy(), j.ids[j.label_of], np.zeros(3))
    kept = m.ids[[0, 2, 3]]
    j.forget(np.array([1]))
    m.follow(j)
    assert sorted(m.ids.tolist()) == sorted(kept.tolist())
    np.testing.assert_allclose(m.cov, j.cov)
    np.testing.assert_allclose(m.mean, j.mean)
    labels = np.arange(3)
    j.seen_at[labels] = labels
    j.bound(2)
    m.follow(j)
    stayed = set(m.ids.tolist())
    assert len(stayed) == len(j.label_of) < 3
    j.bring_in(labels)
    m.follow(j)
    back = np.flatnonzero(~np.isin(m.ids, list(stayed)))
    assert len(back) and not np.any(m.cov[3 + 2 * back][:, :3])
    np.testing.assert_allclose(m.cov, j.cov)


def some(weight: float, mean: list[float], sigma: float = 0.1, age: int = 0) -> Mode:
    return Mode(weight, np.array(mean), sigma**2 * np.eye(3), np.empty(0, np.int64), np.zeros(3), age)


@given(st.floats(0.01, 0.99), st.floats(-1.0, 1.0), st.floats(-0.5, 0.5), st.floats(-np.pi, np.pi))
def test_modes_together_have_the_mean_and_spread_of_all_their_draws(
    w: float, dx: float, turn: float, at: float
) -> None:
    a, b = some(w, [0.0, 0.0, at]), some(1.0 - w, [dx, 0.5, float(wrap(at + turn))], 0.2)
    m = merged([a, b])
    off = np.array([dx, 0.5, turn])
    np.testing.assert_allclose(np.append(m.mean[:2], wrap(m.mean[2] - at)), (1.0 - w) * off, atol=1e-9)
    expected = w * 0.01 * np.eye(3) + (1.0 - w) * 0.04 * np.eye(3) + w * (1.0 - w) * np.outer(off, off)
    np.testing.assert_allclose(m.cov, expected, atol=1e-9)


def test_near_modes_become_one_with_age_and_far_ones_never() -> None:
    near, old = some(0.3, [0.2, 0.0, 0.0]), some(0.3, [0.2, 0.0, 0.0], age=modes.KEPT_UPDATES)
    far = some(0.3, [0.0, 0.0, 2.0], age=99)
    kept, told = settled([some(0.7, [0.0, 0.0, 0.0]), near])
    assert len(kept) == 2 and told.weight == pytest.approx(1.0)
    assert told.mean[0] == pytest.approx(0.06)
    assert settled([some(0.7, [0.0, 0.0, 0.0]), old])[0] == []
    kept, told = settled([some(0.7, [0.0, 0.0, 0.0]), far])
    assert [m.weight for m in kept] == pytest.approx([0.7, 0.3])
    np.testing.assert_array_equal(told.mean, 0.0)
    assert told.weight == pytest.approx(0.7)


def test_where_a_map_is_learnt_no_other_place_is_kept_and_all_of_the_weight_is_told() -> None:
    modes_ = [some(0.7, [0.0, 0.0, 0.0]), some(0.3, [0.0, 0.0, 2.0], age=99)]
    kept, told = settled(modes_, mapping=True)
    assert told.weight == 1.0
    assert len(kept) < 2


def test_there_are_few_modes_and_their_weights_are_probabilities() -> None:
    many = [some(0.1, [float(i), 0.0, 0.0]) for i in range(10)]
    kept, told = settled(many)
    assert len(kept) == modes.MOST
    assert sum(m.weight for m in kept) == pytest.approx(1.0)
    assert told.weight == pytest.approx(0.1)


def test_a_robot_that_was_turned_while_blind_is_found_without_a_search() -> None:
    """It turned by 80 deg more than its wheels say, then sees one landmark at a time; each kind is there once."""
    rng = np.random.default_rng(SEED)
    points = np.array([[2.0, 0.3], [0.2, 2.2], [-1.9, -0.4], [-0.3, -2.1], [1.6, 1.7]])
    n = len(points)
    known = Landmarks(np.arange(n), points, np.tile(1e-6 * np.eye(2), (n, 1, 1)), np.arange(n), np.full(n, 9))
    settings = replace(Filter(), feature_independence=1.0)
    f = make_filter(settings, np.random.default_rng(SEED))
    truth = np.array([0.1, 0.0, 0.0])
    f.reset(truth, np.diag([1e-4, 1e-4, 1e-4]), known, known=True)
    f.predict(Motion(Displacement(np.array([0.0, 0.0, 2.0])), np.diag([1e-4, 1e-4, 4e-3]), 0, 0.0))
    truth = compose(truth, np.array([0.0, 0.0, 2.0 + np.radians(80)]))
    said = []
    for i in range(6):
        k = np.array([i % n])
        z = transform(inverse(truth), points[k]) + 0.03 * rng.standard_normal((1, 2))
        f.update(Observations(z, np.full((1, 2), 9e-4), k, k))
        pose, cov, health = f.estimate()
        off = abs(np.degrees(wrap(pose[2] - truth[2])))
        said.append((round(off, 1), round(health.mode_weight, 2)))
        step = np.array([0.02, 0.0, 0.0])
        f.predict(Motion(Displacement(step), np.diag([1e-5, 1e-5, 1e-5]), 0, 0.0))
        truth = compose(truth, step)
    print(f"seed {SEED}: heading off by deg, and weight of what is reported: {said}")
    assert said[-1][0] < 5.0 and said[-1][1] > 0.95
    assert np.hypot(*(f.estimate()[0] - truth)[:2]) < 0.1
    assert abs(wrap(pose[2] - truth[2])) < 5.0 * np.sqrt(cov[2, 2])
