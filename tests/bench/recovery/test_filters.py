"""What every filter of the factory must do: closed forms, known maps, faults, counters, repeatability."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ceilvo.bench.recovery.filters import make_recovering_filter as make_filter
from ceilvo.bench.recovery.recovering_filter import RecoveringFilter
from ceilvo.config import Filter
from ceilvo.daemon.relocalisation.filters import make_filter as make_daemon_filter
from ceilvo.daemon.slam import joint_rule
from ceilvo.daemon.slam.joint_filter import JointFilter
from ceilvo.daemon.slam.paper.fastslam import FastSlam
from ceilvo.daemon.slam.pose_filter import COUNTERS, chi_square_bounds
from ceilvo.errors import CeilvoError
from ceilvo.se2 import inverse, rotation, transform, wrap
from ceilvo.types import NO_LANDMARK, UNLABELLED, Landmarks, Motion, Observations

SEED = 11
METHODS = ("joint", "pfcf_paper", "pf", "ukf")
INDEPENDENT = replace(Filter(), feature_independence=1.0, gate_chi2=1e3, slip_per_m=0.0)


def make(method="joint", seed=SEED, **more):
    return make_filter(replace(INDEPENDENT, method=method, **more), np.random.default_rng(seed))


def motion(step=(0.0, 0.0, 0.0), cov=None):
    return Motion(np.asarray(step, float), np.zeros((3, 3)) if cov is None else cov, 20, 0.001)


def observations(xy, label, var=9e-6, kind=None, **more):
    xy = np.asarray(xy, float).reshape(-1, 2)
    kind = np.zeros(len(xy), np.int64) if kind is None else np.asarray(kind, np.int64)
    return Observations(xy, np.broadcast_to(var, xy.shape).astype(float), kind, np.asarray(label, np.int64), **more)


def map_of(xy, var=1e-8, kind=None):
    xy = np.asarray(xy, float).reshape(-1, 2)
    n = len(xy)
    kind = np.zeros(n, np.int64) if kind is None else np.asarray(kind, np.int64)
    return Landmarks(np.arange(n), xy, np.tile(np.eye(2) * var, (n, 1, 1)), kind, np.full(n, 5))


@pytest.mark.parametrize(
    ("method", "kind"), [("joint", RecoveringFilter), ("ukf", JointFilter), ("pf", FastSlam), ("pfcf_paper", FastSlam)]
)
def test_the_settings_choose(method, kind):
    assert isinstance(make(method), kind)


def kalman(pose_var, points, map_var, var, steps):
    """Batch least squares of x, y and all landmarks: theta is 0 and known, so all is linear."""
    n = 2 + 2 * len(points)
    mean = np.concatenate([[0.0, 0.0], points.ravel()])
    cov = np.diag([pose_var] * 2 + [map_var] * (n - 2))
    for step, step_var, seen, z in steps:
        mean[:2] += step
        cov[:2, :2] += step_var * np.eye(2)
        h = np.zeros((2 * len(seen), n))
        for i, k in enumerate(seen):
            h[2 * i : 2 * i + 2, :2] = -np.eye(2)
            h[2 * i : 2 * i + 2, 2 + 2 * k : 4 + 2 * k] = np.eye(2)
        gain = cov @ h.T @ np.linalg.inv(h @ cov @ h.T + np.diag(np.tile(var, len(seen))))
        mean = mean + gain @ (np.ravel(z) - h @ mean)
        cov = cov - gain @ h @ cov
    return mean, cov


@pytest.fixture
def exact_noise(monkeypatch):
    """The stated noise is all there is: nothing is added for model error."""
    monkeypatch.setattr(joint_rule, "learnt_model_var", lambda *_: 0.0)
    fresh = joint_rule.JointRule.fresh
    monkeypatch.setattr(joint_rule.JointRule, "fresh", lambda rule, rng: replace(fresh(rule, rng), model_var_m2=0.0))


@pytest.mark.usefixtures("exact_noise")
@pytest.mark.parametrize("method", ["joint", "ukf"])
def test_where_all_is_linear_it_is_the_kalman_filter(method):
    rng = np.random.default_rng(SEED)
    points, var = rng.uniform(-1.5, 1.5, (6, 2)), np.array([4e-4, 9e-4])
    steps, at = [], np.zeros(2)
    f = make(method)
    f.reset(np.zeros(3), np.diag([1e-4, 1e-4, 0.0]), map_of(points, 1e-3))
    for _ in range(8):
        step = rng.normal(0, 0.05, 2)
        at = at + step
        seen = np.sort(rng.permutation(6)[:4])
        z = points[seen] + rng.normal(0, 0.03, (4, 2)) - at
        f.predict(motion([*step, 0.0], np.diag([1e-4, 1e-4, 0.0])))
        f.update(observations(z, seen, var))
        steps.append((step, 1e-4, seen, z))
    mean, cov = kalman(1e-4, points, 1e-3, var, steps)
    pose, pose_cov, _ = f.estimate()
    m = f.landmarks()
    print(f"{method}: pose off by {np.abs(pose[:2] - mean[:2]).max():.1e} m of {np.sqrt(cov[0, 0]):.1e}")
    np.testing.assert_allclose(pose[:2], mean[:2], atol=1e-6)
    np.testing.assert_allclose(pose_cov[:2, :2], cov[:2, :2], atol=1e-8)
    np.testing.assert_allclose(m.xy_map_m.ravel(), mean[2:], atol=1e-6)
    for k in range(6):
        block = slice(2 + 2 * k, 4 + 2 * k)
        np.testing.assert_allclose(m.cov_m2[k], cov[block, block], atol=1e-8)


@pytest.mark.parametrize("method", METHODS)
def test_prediction_composes(method):
    f = make(method)
    f.reset(np.array([1.0, 2.0, 3.0]), np.diag([1e-8, 1e-8, 1e-10]))
    f.predict(motion((0.3, 0.1, 0.9), np.diag([1e-8, 1e-8, 1e-10])))
    pose, cov, _ = f.estimate()
    np.testing.assert_allclose(pose[:2], [1.0, 2.0] + rotation(3.0) @ [0.3, 0.1], atol=1e-4)
    assert abs(wrap(pose[2] - 3.9)) < 1e-4
    assert np.all(np.linalg.eigvalsh(cov) > 0)
    with pytest.raises(CeilvoError, match="not finite"):
        f.predict(motion((np.nan, 0, 0)))


@pytest.mark.usefixtures("exact_noise")
@pytest.mark.parametrize("method", ["joint", "ukf"])
def test_landmarks_are_born_after_enough_sightings_and_forgotten_without(method):
    f = make(method, birth_sightings=3, gate_chi2=9.0)
    f.reset(np.zeros(3), np.diag([1e-8, 1e-8, 1e-10]))
    for i in range(3):
        assert len(f.landmarks()) == 0
        f.update(observations([[1.0 + 0.001 * (i - 1), 0.5], [2.0 + i, 0.0]], [NO_LANDMARK] * 2, kind=[3, 3]))
    m = f.landmarks()
    assert m.crossing_type.tolist() == [3]
    np.testing.assert_allclose(m.xy_map_m[0], [1.0, 0.5], atol=1e-3)
    np.testing.assert_allclose(m.cov_m2[0], np.eye(2) * 9e-6 / 3, rtol=0.1, atol=1e-7)
    for _ in range(30):
        f.update(observations([[1.0, 0.5]], [0], kind=[3]))
    assert len(getattr(f.state, "tracker", f.state).joint) == 1


@pytest.mark.parametrize("method", METHODS)
def test_an_outlier_moves_nothing(method):
    rng = np.random.default_rng(SEED)
    xy, cov = rng.uniform(-1, 1, (12, 2)), np.diag([1e-6, 1e-6, 1e-7])
    poses = []
    for wrong in (False, True):
        f = make(method, gate_chi2=9.0, particles=200)
        f.reset(np.zeros(3), cov, map_of(xy, 1e-6))
        z, label = xy.copy(), np.arange(12)
        z[4] += [0.12, 0.1]
        keep = np.ones(12, bool)
        keep[4] = wrong
        f.update(observations(z[keep], label[keep]))
        poses.append(f.estimate()[0])
        np.testing.assert_allclose(f.landmarks().xy_map_m[4], xy[4], atol=2e-4)
    assert f.counters()["outliers"] == 1
    assert np.all(np.abs(poses[0] - poses[1]) < 2e-4)


@pytest.mark.parametrize("method", METHODS)
def test_a_known_map_is_left_as_it_is_and_gives_the_pose(method):
    rng = np.random.default_rng(SEED)
    xy = rng.uniform(-2, 2, (30, 2))
    truth = np.array([0.02, -0.03, 0.01])
    z = transform(inverse(truth), xy)
    for label in (np.arange(30), np.full(30, UNLABELLED)):
        f = make(method, particles=400)
        known = map_of(xy)
        f.reset(np.zeros(3), np.diag([1e-3, 1e-3, 1e-4]), known, known=True)
        for _ in range(10):
            f.update(observations(z, label, 4e-4))
        pose = f.estimate()[0]
        assert f.landmarks() is known
        assert np.all(np.abs(pose - truth) < [0.012, 0.012, 0.01]), (label[0], pose)
        assert f.counters()["births"] == 0


def test_without_gate_the_ukf_follows_an_outlier():
    xy = np.random.default_rng(SEED).uniform(-1, 1, (4, 2))
    moved = []
    for gate in (True, False):
        f = make("ukf", ukf_gate=gate, gate_chi2=9.0)
        f.reset(np.zeros(3), np.diag([1e-4, 1e-4, 1e-6]), map_of(xy))
        z = xy.copy()
        z[0] += 0.5
        f.update(observations(z, np.arange(4), 1e-4))
        moved.append(np.hypot(*f.estimate()[0][:2]))
    assert moved[0] < 1e-3 < 0.05 < moved[1]


@pytest.mark.parametrize("method", METHODS)
def test_counters_are_complete_and_only_grow(method):
    f = make(method)
    assert set(f.counters()) == set(COUNTERS)
    assert not any(f.counters().values())
    f.reset(np.zeros(3), np.eye(3) * 1e-6, map_of([[1.0, 0.0], [0.0, 1.0]]))
    f.update(observations([[1.0, 0.0], [0.0, 1.0]], [0, 1]))
    assert f.counters()["updates"] == 1
    assert f.counters()["observations"] == 2
    f.reset(np.zeros(3), np.eye(3) * 1e-6)
    assert f.counters()["updates"] == 1


@pytest.mark.parametrize("method", METHODS)
def test_an_unknown_pose_needs_a_map(method):
    with pytest.raises(CeilvoError, match="no map"):
        make(method).reset(np.zeros(3), np.full((3, 3), np.inf))


@pytest.mark.parametrize("method", METHODS)
def test_without_a_pose_particles_are_all_over_the_map_and_a_gaussian_begins_wide(method):
    f = make_daemon_filter(replace(INDEPENDENT, method=method), np.random.default_rng(SEED))
    f.reset(np.array([1.0, 2.0, 0.5]), np.full((3, 3), np.inf), map_of([[0.0, 0.0], [40.0, 0.0], [0.0, 30.0]]))
    pose, cov, _ = f.estimate()
    if method in ("pf", "pfcf_paper"):
        assert np.all(np.ptp(f.particles()[0], axis=0) > [30.0, 22.0, 5.0])
    else:
        np.testing.assert_array_equal(pose, [1.0, 2.0, 0.5])
        np.testing.assert_allclose(cov, np.eye(3))
    f.update(observations([[1.0, 0.0]], [UNLABELLED]))
    assert f.counters()["searches"] == 0


def run(method, seed):
    f = make(method, seed, slip_per_m=0.05)
    f.reset(np.zeros(3), np.diag([1e-5, 1e-5, 1e-6]))
    rng = np.random.default_rng(SEED)
    xy = rng.uniform(-1, 1, (10, 2))
    for i in range(20):
        f.predict(motion((0.01, 0, 0.01), np.diag([1e-6, 1e-6, 1e-7])))
        f.update(observations(xy - [0.01 * i, 0] + 3e-3 * rng.standard_normal(xy.shape), [UNLABELLED] * 10))
    return b"".join(a.tobytes() for a in (*f.particles(), f.estimate()[0], f.landmarks().xy_map_m))


@pytest.mark.parametrize("method", METHODS)
def test_a_seed_gives_the_same_bytes(method):
    assert run(method, 1) == run(method, 1)


@pytest.mark.parametrize("dof", [2, 10, 60])
def test_chi_square_bounds_hold_what_they_say(dof):
    rng = np.random.default_rng(SEED)
    means = np.mean(rng.standard_normal((20000, dof)) ** 2, axis=1)
    low, high = chi_square_bounds(dof, 2.0)
    print(f"dof {dof}: below {np.mean(means < low):.4f}, above {np.mean(means > high):.4f}, expected 0.0228")
    assert abs(np.mean(means > high) - 0.0228) < 0.006
    assert abs(np.mean(means < low) - 0.0228) < 0.015  # the approximation is poor below, for 2 dof
    assert chi_square_bounds(0) == (0.0, float("inf"))


FINITE = st.floats(-50, 50)
ROW = st.tuples(
    st.floats(-50, 50) | st.just(np.nan), FINITE, st.floats(1e-300, 1e3), st.floats(-1, 1e3), st.integers(-2, 5)
)
STEP = st.tuples(
    st.tuples(FINITE, FINITE, FINITE), st.floats(0, 10), st.lists(ROW, max_size=6), FINITE, st.floats(-1, 10)
)


@settings(max_examples=60, deadline=None)
@given(st.lists(STEP, min_size=1, max_size=6), st.sampled_from(METHODS), st.booleans())
def test_nothing_finite_or_not_makes_it_nan(steps, method, known):
    f = make(method, particles=12, birth_sightings=1, gate_chi2=9.0, slip_per_m=0.1)
    f.reset(np.zeros(3), np.eye(3) * 1e-4, map_of([[1.0, 0.0], [0.0, 1.0], [1.0, 1.0]]) if known else None, known)
    for step, sigma, rows, heading, heading_var in steps:
        f.predict(motion(step, np.eye(3) * sigma**2))
        a = np.array([r[:4] for r in rows], float).reshape(-1, 4)
        label = np.array([r[4] for r in rows], np.int64)
        f.update(Observations(a[:, :2], a[:, 2:], np.zeros(len(a), np.int64), label, heading, heading_var))
        pose, cov, health = f.estimate()
        poses, weights = f.particles()
        m = f.landmarks()
        for values in (pose, cov, poses, weights, m.xy_map_m, m.cov_m2, health.ess, health.nis, health.mode_weight):
            assert np.all(np.isfinite(values))
        assert weights.sum() == pytest.approx(1.0)
        assert np.all(np.diagonal(cov) >= 0.0)
