"""Parts of the filter against closed forms: prediction, weights, landmark update, birth, resampling, faults."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ceilvo.config import Filter
from ceilvo.daemon.slam.association import EXPIRES_UPDATES
from ceilvo.daemon.slam.paper.fastslam import FastSlam, independent
from ceilvo.daemon.slam.pose_filter import effective_size, mean_and_cov
from ceilvo.errors import CeilvoError
from ceilvo.se2 import inverse, rotation, transform, wrap
from ceilvo.types import Landmarks, Motion, Observations

SEED = 7
INDEPENDENT = replace(Filter(), feature_independence=1.0)


def make(settings=INDEPENDENT, pose=(0.0, 0.0, 0.0), cov=None, known=None, seed=SEED):
    made = FastSlam(settings, np.random.default_rng(seed))
    made.reset(np.asarray(pose, float), np.zeros((3, 3)) if cov is None else cov, known)
    return made


def motion(step=(0.0, 0.0, 0.0), cov=None):
    return Motion(np.asarray(step, float), np.zeros((3, 3)) if cov is None else cov, 20, 0.001)


def observations(xy, label, var=9e-6, kind=None, **more):
    xy = np.asarray(xy, float).reshape(-1, 2)
    kind = np.zeros(len(xy), np.int64) if kind is None else np.asarray(kind, np.int64)
    return Observations(xy, np.broadcast_to(var, xy.shape).astype(float), kind, np.asarray(label, np.int64), **more)


def known_map(xy, var=1e-8):
    xy = np.asarray(xy, float).reshape(-1, 2)
    n = len(xy)
    return Landmarks(np.arange(n), xy, np.tile(np.eye(2) * var, (n, 1, 1)), np.zeros(n, np.int64), np.full(n, 5))


def test_prediction_has_the_composed_mean_and_covariance():
    q = np.array([[4e-4, 1e-4, 0], [1e-4, 2e-4, 2e-5], [0, 2e-5, 1e-4]])
    f = make(replace(INDEPENDENT, particles=20000), pose=(1.0, 2.0, 2.5))
    f.predict(motion((0.3, 0.1, 0.9), q))
    pose, cov, _ = f.estimate()
    r = np.eye(3)
    r[:2, :2] = rotation(2.5)
    expected = np.array([1.0, 2.0, 2.5]) + r @ [0.3, 0.1, 0.9]
    assert np.all(np.abs(pose[:2] - expected[:2]) < 1e-9)
    assert abs(wrap(pose[2] - expected[2])) < 1e-5
    np.testing.assert_allclose(cov, r @ q @ r.T, atol=0.04 * 4e-4)


def test_prediction_over_the_wrap():
    f = make(pose=(0, 0, np.pi - 0.001), cov=np.diag([1e-6, 1e-6, 1e-4]))
    f.predict(motion((0, 0, 0.002), np.diag([1e-8, 1e-8, 1e-8])))
    pose, cov, _ = f.estimate()
    poses, _ = f.particles()
    assert abs(wrap(pose[2] - (np.pi + 0.001))) < 1e-9
    assert cov[2, 2] == pytest.approx(1e-4, rel=0.5)
    assert np.all((poses[:, 2] >= -np.pi) & (poses[:, 2] < np.pi))


def test_a_motion_that_is_not_finite_is_refused():
    with pytest.raises(CeilvoError, match="not finite"):
        make().predict(motion((np.nan, 0, 0)))


def test_weights_are_the_robust_likelihood_in_closed_form():
    xy = np.array([[1.0, 0.2], [-0.5, 0.8], [0.1, -1.1]])
    f = make(replace(INDEPENDENT, resample_ess_ratio=0.05), cov=np.diag([4e-6, 4e-6, 1e-6]), known=known_map(xy, 1e-6))
    poses, _ = f.particles()
    seen = xy + np.array([[0.002, -0.001], [0.001, 0.003], [0.15, 0.0]])  # the last is an outlier
    var = np.array([4e-5, 9e-5])
    f.update(observations(seen, [0, 1, 2], var, heading_rad=0.002, heading_var_rad2=4e-6))
    expected = []
    for p in poses:
        r, product = rotation(p[2]), 1.0
        for z, m in zip(seen, xy, strict=True):
            s = 1e-6 * np.eye(2) + r @ np.diag(var) @ r.T
            nu = r @ z + p[:2] - m
            normal = np.exp(-0.5 * nu @ np.linalg.inv(s) @ nu) / (2 * np.pi * np.sqrt(np.linalg.det(s)))
            product *= 0.98 * normal + 0.02 / 4
        expected.append(
            product * (0.98 * np.exp(-0.5 * (p[2] - 0.002) ** 2 / 4e-6) / np.sqrt(2 * np.pi * 4e-6) + 0.02 * 2 / np.pi)
        )
    np.testing.assert_allclose(f.particles()[1], np.array(expected) / np.sum(expected), rtol=1e-9)


def test_tempering_takes_the_power_of_the_likelihood_that_leaves_enough_particles():
    xy = np.random.default_rng(SEED).uniform(-1, 1, (30, 2))
    settings = replace(INDEPENDENT, method="pf", resample_ess_ratio=0.05)
    f = make(settings, cov=np.diag([1e-2, 1e-2, 1e-3]), known=known_map(xy))
    f.update(observations(xy, np.arange(30)))
    assert f.estimate()[2].ess == pytest.approx(0.1 * 100, rel=0.02)


def test_effective_number_of_features():
    assert independent(25, 1.0, 0.0) == 25
    assert independent(25, 0.5, 0.0) == 5
    assert independent(25, 1.0, 1.0) == 1
    assert independent(1, 0.5, 0.7) == 1
    # n measurements of variance v that share rho v: their mean has variance v (1 + (n - 1) rho) / n
    cov = 0.3 * np.ones((8, 8)) + 0.7 * np.eye(8)
    assert independent(8, 1.0, 0.3) == pytest.approx(1 / np.mean(cov))


def test_landmark_update_of_a_standing_robot_is_batch_least_squares():
    rng = np.random.default_rng(SEED)
    theta, prior, var = 0.6, np.array([[4e-4, 1e-4], [1e-4, 2e-4]]), np.array([1e-4, 3e-4])
    known = replace(known_map([[1.0, 0.5]]), cov_m2=prior[None])
    f = make(pose=(0.2, -0.1, theta), known=known)
    r = rotation(theta)
    seen = (np.array([1.01, 0.51]) - [0.2, -0.1]) @ r + np.sqrt(var) * rng.standard_normal((12, 2))
    information, vector = np.linalg.inv(prior), np.linalg.inv(prior) @ [1.0, 0.5]
    for z in seen:
        f.update(observations([z], [0], var))
        w = r @ np.diag(1 / var) @ r.T
        information, vector = information + w, vector + w @ (r @ z + [0.2, -0.1])
    m = f.landmarks()
    np.testing.assert_allclose(m.xy_map_m[0], np.linalg.solve(information, vector), atol=1e-9)
    np.testing.assert_allclose(m.cov_m2[0], np.linalg.inv(information), rtol=1e-6)
    assert m.sightings[0] == 5 + 12


def test_an_outlier_moves_neither_landmark_nor_pose():
    xy = np.random.default_rng(SEED).uniform(-1, 1, (12, 2))
    cov, label = np.diag([1e-6, 1e-6, 1e-7]), np.arange(12)
    clean, hit = make(cov=cov, known=known_map(xy, 1e-6)), make(cov=cov, known=known_map(xy, 1e-6))
    wrong = xy.copy()
    wrong[4] += [0.12, 0.1]
    clean.update(observations(np.delete(xy, 4, axis=0), np.delete(label, 4)))
    hit.update(observations(wrong, label))
    assert np.all(np.abs(hit.landmarks().xy_map_m[4] - xy[4]) < 1e-9)
    assert hit.landmarks().sightings[4] == 5
    assert np.all(np.abs(hit.estimate()[0] - clean.estimate()[0]) < [1e-4, 1e-4, 1e-4])


def test_landmarks_are_born_after_enough_sightings_only_and_where_they_are():
    f = make(cov=np.diag([1e-8, 1e-8, 1e-10]))
    for i in range(3):
        assert len(f.landmarks()) == 0
        offset = [0.001 * (i - 1), 0.0]
        f.update(observations([[1.0 + offset[0], 0.5], [2.0 + i, 0.0]], [-1, -1], kind=[3, 3]))
    m = f.landmarks()
    assert len(m) == 1
    assert m.crossing_type.tolist() == [3]
    assert m.sightings.tolist() == [3]
    np.testing.assert_allclose(m.xy_map_m[0], [1.0, 0.5], atol=1e-4)
    np.testing.assert_allclose(m.cov_m2[0], np.eye(2) * 9e-6 / 3, rtol=0.1, atol=1e-7)


def test_a_landmark_is_born_in_each_particle_s_own_map():
    f = make(replace(INDEPENDENT, birth_sightings=1), pose=(1, 1, 0.5), cov=np.diag([1e-2, 1e-2, 1e-2]))
    f.update(observations([[1.0, 0.5]], [-1]))
    poses, _ = f.particles()
    mean, _ = f.state.maps.gather(np.array([0]))
    own = np.array([transform(p, np.array([[1.0, 0.5]]))[0] for p in poses])
    np.testing.assert_allclose(mean[0].T, own, atol=1e-9)


def test_candidates_expire_and_differ_by_kind():
    f = make()
    for _ in range(2):
        f.update(observations([[1.0, 0.5]], [-1], kind=[3]))
    f.update(observations([[1.0, 0.5]], [-1], kind=[4]))
    assert len(f.landmarks()) == 0
    for _ in range(EXPIRES_UPDATES + 1):
        f.update(observations([], []))
    f.update(observations([[1.0, 0.5]], [-1], kind=[3]))
    assert len(f.landmarks()) == 0


def test_no_duplicate_is_born_beside_a_landmark():
    f = make(replace(INDEPENDENT, birth_sightings=1), known=known_map([[1.0, 0.5]]))
    f.update(observations([[1.03, 0.5], [1.3, 0.5]], [-1, -1]))
    assert len(f.landmarks()) == 2


def test_a_full_map_learns_nothing_and_says_so():
    known = replace(known_map(np.random.default_rng(SEED).uniform(-3, -1, (10, 2))), sightings=np.arange(2, 12))
    f = make(replace(INDEPENDENT, birth_sightings=1, max_landmarks=11), known=known)
    assert f.counters()["map_full"] == 0
    f.update(observations([[2.0, 2.0], [1.0, 2.0], [2.0, 1.0]], [-1, -1, -1]))
    assert f.landmarks().ids.tolist() == list(range(11))
    assert f.counters()["map_full"] == 2
    f = make(replace(INDEPENDENT, max_landmarks=8), known=known)
    assert len(f.landmarks()) == 10


def test_maps_grow_beyond_a_chunk_and_follow_their_particles():
    f = make(replace(INDEPENDENT, birth_sightings=1, particles=20), cov=np.diag([1e-2, 1e-2, 1e-2]))
    g = np.stack(np.meshgrid(np.arange(15.0), np.arange(12.0)), axis=-1).reshape(-1, 2)
    for part in np.split(g, 3):
        f.update(observations(part, np.full(60, -1)))
    before, _ = f.state.maps.gather(np.arange(180))
    ancestors = np.random.default_rng(SEED).integers(0, 20, 20)
    f.state.maps.resample(ancestors)
    f.state.maps.resample(ancestors[::-1])
    after, _ = f.state.maps.gather(np.arange(180))
    np.testing.assert_array_equal(after, before[:, :, ancestors[ancestors[::-1]]])
    f.state.maps.scatter(np.array([3]), before[3:4], np.ones((1, 3, 20)))
    np.testing.assert_array_equal(f.state.maps.gather(np.array([3]))[0], before[3:4])


@pytest.mark.parametrize("method", ["pfcf_paper", "pf"])
def test_resampling_keeps_the_estimate_and_makes_weights_uniform(method):
    xy = np.random.default_rng(SEED).uniform(-1, 1, (4, 2))
    f = make(
        replace(INDEPENDENT, method=method, particles=2000, resample_ess_ratio=0.6),
        cov=np.diag([4e-6, 4e-6, 3e-6]),
        known=known_map(xy),
    )
    f.update(observations(xy, np.arange(4)))
    pose, cov, health = f.estimate()
    poses, weights = f.particles()
    assert health.ess < 1200
    assert np.all(weights == 1 / 2000)
    after, after_cov = mean_and_cov(poses, weights)
    sigma = np.sqrt(np.diag(cov))
    print(f"{method}: shift {np.abs(after - pose) / sigma} sigma, std {np.sqrt(np.diag(after_cov)) / sigma}")
    assert np.all(np.abs(after - pose) < 0.15 * sigma)
    np.testing.assert_allclose(np.sqrt(np.diag(after_cov)), sigma, rtol=0.15)
    assert np.isfinite(health.fit_residual) == (method == "pfcf_paper")
    assert health.unique_ancestors < 2000


def test_without_a_curve_resampling_is_systematic():
    xy = np.random.default_rng(SEED).uniform(-1, 1, (4, 2))
    f = FastSlam(INDEPENDENT, np.random.default_rng(SEED), redraw=lambda *_: None)
    f.reset(np.zeros(3), np.diag([4e-5, 4e-5, 1e-5]), known_map(xy))
    before, _ = f.particles()
    f.update(observations(xy, np.arange(4)))
    after, weights = f.particles()
    distance = np.abs(after[:, None] - before[None]).max(axis=2).min(axis=1)
    assert np.all(distance < 1e-4)
    assert np.all(weights == 0.01)
    assert np.isnan(f.estimate()[2].fit_residual)


def nis_of(shift, repeats=200):
    rng = np.random.default_rng(SEED)
    xy, total = rng.uniform(-1.5, 1.5, (20, 2)), []
    for i in range(repeats):
        f = make(cov=np.diag([1e-5, 1e-5, 4e-6]), known=known_map(xy, 4e-6), seed=i)
        truth = np.array([shift, 0.0, 0.0]) + np.sqrt([1e-5, 1e-5, 4e-6]) * rng.standard_normal(3)
        z = transform(inverse(truth), xy + 2e-3 * rng.standard_normal(xy.shape)) + 3e-3 * rng.standard_normal(xy.shape)
        f.update(observations(z, np.arange(20)))
        health = f.estimate()[2]
        assert health.nis_dof == 40
        total.append(health.nis)
    return float(np.mean(total))


def test_nis_is_one_when_all_is_as_assumed_and_high_when_lost():
    good, lost = nis_of(0.0), nis_of(0.1, 5)
    print(f"NIS per degree of freedom: consistent {good:.3f}, 0.1 m off {lost:.1f}")
    assert abs(good - 1.0) < 0.1
    assert lost > 12


def test_reset_with_the_map_kept_and_without():
    f = make(known=known_map([[1.0, 0.5], [2.0, 0.5]]))
    kept = f.landmarks()
    f.reset(np.array([3.0, 1.0, 0.1]), np.eye(3) * 1e-6, kept)
    np.testing.assert_allclose(f.landmarks().xy_map_m, kept.xy_map_m)
    np.testing.assert_allclose(f.landmarks().cov_m2, kept.cov_m2, atol=1e-15)
    np.testing.assert_allclose(f.estimate()[0], [3.0, 1.0, 0.1], atol=1e-6)
    f.reset(np.zeros(3), np.eye(3) * 1e-6)
    assert len(f.landmarks()) == 0


def test_a_label_used_twice_or_unknown_to_the_map_does_no_harm():
    f = make(known=known_map([[1.0, 0.5]]))
    f.update(observations([[1.0, 0.5], [1.01, 0.5], [3.0, 3.0]], [0, 0, 17]))
    assert f.landmarks().sightings.tolist() == [6]


def run(seed):
    f = make(Filter(), cov=np.diag([1e-5, 1e-5, 1e-6]), seed=seed)
    rng = np.random.default_rng(SEED)
    xy = rng.uniform(-1, 1, (10, 2))
    for i in range(30):
        f.predict(motion((0.001, 0, 0.01), np.diag([1e-6, 1e-6, 1e-7])))
        label = np.arange(10) if len(f.landmarks()) == 10 else np.full(10, -1)
        f.update(observations(xy - [0.001 * i, 0] + 3e-3 * rng.standard_normal(xy.shape), label, kind=np.arange(10)))
    return b"".join(a.tobytes() for a in (*f.particles(), f.landmarks().xy_map_m))


def test_a_seed_gives_the_same_bytes():
    assert run(1) == run(1)
    assert run(1) != run(2)


FINITE = st.floats(-50, 50)
ROW = st.tuples(
    st.floats(-50, 50) | st.just(np.nan), FINITE, st.floats(1e-300, 1e3), st.floats(-1, 1e3), st.integers(-1, 5)
)
STEP = st.tuples(
    st.tuples(FINITE, FINITE, FINITE), st.floats(0, 10), st.lists(ROW, max_size=6), FINITE, st.floats(-1, 10)
)


@given(st.lists(STEP, min_size=1, max_size=6), st.sampled_from(["pf", "pfcf_paper"]), st.sampled_from([0.0, 0.02]))
def test_nothing_finite_or_not_makes_it_nan(steps, method, floor):
    f = make(replace(Filter(), method=method, particles=12, birth_sightings=1, outlier_floor=floor))
    for step, sigma, rows, heading, heading_var in steps:
        f.predict(motion(step, np.eye(3) * sigma**2))
        a = np.array([r[:4] for r in rows], float).reshape(-1, 4)
        f.update(
            Observations(
                a[:, :2],
                a[:, 2:],
                np.zeros(len(a), np.int64),
                np.array([r[4] for r in rows], np.int64),
                heading,
                heading_var,
            )
        )
        pose, cov, health = f.estimate()
        poses, weights = f.particles()
        known = f.landmarks()
        for values in (pose, cov, poses, weights, known.xy_map_m, known.cov_m2, health.ess, health.nis):
            assert np.all(np.isfinite(values))
        assert weights.sum() == pytest.approx(1.0)
        assert 1.0 - 1e-9 <= effective_size(weights) <= 12 + 1e-9
