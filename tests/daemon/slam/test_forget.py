"""Forgetting landmarks is marginalising them out: the rest of the belief is the same part of the same Gaussian."""

from __future__ import annotations

import copy
from dataclasses import replace

import numpy as np
import pytest

from ceilvo.config import Filter
from ceilvo.daemon.relocalisation.filters import make_filter
from ceilvo.daemon.relocalisation.survey import MISPLACED_M, MapSurvey
from ceilvo.daemon.slam.joint_filter import JointFilter
from ceilvo.daemon.slam.pose_filter import PoseFilter
from ceilvo.se2 import inverse, rotation, transform
from ceilvo.types import NO_LANDMARK, Array, Displacement, Ints, Landmarks, Motion, Observations

SEED = 29
GRID = np.stack(np.meshgrid(np.arange(-2, 3) * 0.6, np.arange(-2, 3) * 0.6), -1).reshape(-1, 2)
KIND = np.arange(len(GRID)) % 9
METHODS = ("joint", "ukf", "pf", "pfcf_paper")
NONE = np.empty(0, np.int64)


def look(f: PoseFilter, pose: Array, which: Ints, rng: np.random.Generator) -> None:
    """A view of true crossings `which` from a true pose (3,)."""
    xy = transform(inverse(pose), GRID[which]) + 2e-3 * rng.standard_normal((len(which), 2))
    labels, near = f.landmarks_near(GRID, 0.3)
    label = np.full(len(which), NO_LANDMARK)
    if len(near):
        apart = np.hypot(*(GRID[which][:, None] - near.xy_map_m).transpose(2, 0, 1))
        apart[KIND[which][:, None] != near.crossing_type] = np.inf
        label = np.where(np.min(apart, axis=1) < 0.2, labels[np.argmin(apart, axis=1)], NO_LANDMARK)
    f.update(Observations(xy, np.full((len(xy), 2), 4e-6), KIND[which], label, float("nan"), float("inf")))


def driven(method: str, views: int = 12) -> tuple[PoseFilter, Array]:
    """A filter that has made a map on a bent way, and its true pose (3,)."""
    f = make_filter(replace(Filter(), method=method, particles=60), np.random.default_rng(SEED))
    rng, pose = np.random.default_rng(SEED), np.zeros(3)
    f.reset(pose, np.diag([1e-6, 1e-6, 1e-6]))
    step = np.array([0.06, 0.01, 0.03])
    for _ in range(views):
        look(f, pose, np.flatnonzero(rng.random(len(GRID)) < 0.8), rng)
        f.predict(Motion(Displacement(step), np.diag([1e-6, 1e-6, 1e-6]), 20, 0.0))
        pose = np.append(pose[:2] + rotation(float(pose[2])) @ step[:2], pose[2] + step[2])
    return f, pose


def columns(landmarks: Landmarks) -> dict[int, list[object]]:
    names = ("xy_map_m", "cov_m2", "crossing_type", "sightings", "expected")
    return {int(i): [getattr(landmarks, n)[k].tolist() for n in names] for k, i in enumerate(landmarks.ids)}


@pytest.mark.parametrize("method", METHODS)
def test_all_else_stays_to_the_bit_and_unknown_ids_are_passed_over(method: str) -> None:
    f, _ = driven(method)
    before, estimate, counters = columns(f.landmarks()), f.estimate(), f.counters()
    assert len(before) > 15
    gone = f.landmarks().ids[[0, 4, 7, -1]]
    f.forget(np.append(gone, [-5, 10_000]))
    assert columns(f.landmarks()) == {i: row for i, row in before.items() if i not in gone}
    assert f.size() == len(before) - 4
    after = f.estimate()
    np.testing.assert_array_equal(after[0], estimate[0])
    np.testing.assert_array_equal(after[1], estimate[1])
    assert repr(after[2]) == repr(estimate[2])
    assert f.counters() == counters
    labels, near = f.landmarks_near(GRID, 0.3)
    assert near.ids.tolist() == f.landmarks().ids[labels].tolist()
    f.forget(NONE)
    f.forget(gone)
    assert f.size() == len(before) - 4


@pytest.mark.parametrize("method", METHODS)
def test_a_known_map_is_what_it_is(method: str) -> None:
    f, _ = driven(method)
    known = f.landmarks()
    f.reset(np.zeros(3), np.diag([1e-6] * 3), known, known=True)
    f.forget(known.ids[:3], newborn=True)
    assert columns(f.landmarks()) == columns(known)


def test_correlations_and_counts_of_the_others_stay_and_so_do_slip_and_model() -> None:
    f, _ = driven("joint")
    assert isinstance(f, JointFilter)
    j, before = f.state.joint, copy.deepcopy(f.state)
    gone = f.landmarks().ids[[2, 9]]
    f.forget(gone)
    was = before.joint
    kept = [k for k in range(len(was.label_of)) if was.ids[was.label_of[k]] not in gone]
    rows = np.concatenate([np.arange(3), np.column_stack([3 + 2 * np.array(kept), 4 + 2 * np.array(kept)]).ravel()])
    assert j.ids[j.label_of].tolist() == was.ids[was.label_of[kept]].tolist()
    np.testing.assert_array_equal(j.mean, was.mean[rows])
    np.testing.assert_array_equal(j.cov, was.cov[np.ix_(rows, rows)])
    assert np.max(np.abs(j.cov[:3, 3:])) > 0.0
    for name in ("doubt", "seen_at", "confirmed"):
        old = dict(zip(was.ids.tolist(), getattr(was, name).tolist(), strict=True))
        assert all(old[i] == v for i, v in zip(j.ids.tolist(), getattr(j, name).tolist(), strict=True))
    assert j.next_id == was.next_id
    np.testing.assert_equal(vars_of(f.state.rule.slip), vars_of(before.rule.slip))
    assert f.state.rule.model_var_m2 == before.rule.model_var_m2
    assert f.state.now == before.now


def vars_of(state: object) -> dict[str, object]:
    return {name: getattr(state, name) for name in type(state).__dataclass_fields__}  # type: ignore[attr-defined]


def test_views_of_the_others_say_the_same_whether_or_not_one_was_forgotten() -> None:
    """A Gaussian that is marginalised and then updated is the same as updated and then marginalised."""
    f, pose = driven("joint")
    other, _ = driven("joint")
    gone = f.landmarks().of(np.array([3, 11]))
    f.forget(gone.ids)
    unseen = np.min(np.hypot(*(GRID[:, None] - gone.xy_map_m).transpose(2, 0, 1)), axis=1) < 0.1
    assert np.count_nonzero(unseen) == 2
    for each in (f, other):
        rng = np.random.default_rng(SEED + 1)
        for _ in range(6):
            look(each, pose, np.flatnonzero(~unseen), rng)
            each.predict(Motion(Displacement(np.array([0.0, 0.0, 0.0])), np.diag([1e-8] * 3), 20, 0.0))
    for a, b in zip(f.estimate()[:2], other.estimate()[:2], strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-6, atol=1e-12)
    mine, theirs = columns(f.landmarks()), columns(other.landmarks())
    assert set(theirs) - set(mine) == set(gone.ids.tolist())
    for i, row in mine.items():
        np.testing.assert_allclose(row[0], theirs[i][0], atol=1e-9)


def test_newborn_landmarks_go_only_when_that_is_asked_for() -> None:
    f, _ = driven("joint", views=1)
    assert isinstance(f, JointFilter)
    born = len(f.state.joint)
    assert born > 10 and f.size() == 0
    f.forget(NONE)
    assert len(f.state.joint) == born
    f.forget(NONE, newborn=True)
    assert len(f.state.joint) == 0
    assert len(f.state.joint.mean) == 3


def test_what_lies_at_a_misplaced_crossing_leaves_filter_and_place_index() -> None:
    f, _ = driven("joint")
    survey = MapSurvey.of(f.landmarks(), 0.0)
    pose, before = f.estimate()[0], f.landmarks()
    near, beside = before.xy_map_m[5] + [0.5 * MISPLACED_M, 0.0], before.xy_map_m[12] + [0.0, 1.5 * MISPLACED_M]
    nothing = np.zeros((0, 2))
    survey.forget_near(f, transform(inverse(pose), np.stack([near, beside])), nothing)
    gone = {int(before.ids[5])}
    assert set(before.ids.tolist()) - set(f.landmarks().ids.tolist()) == gone
    assert set(before.ids.tolist()) - set(survey.index.ids.tolist()) == gone
    survey.forget_near(f, np.array([[50.0, 50.0]]), nothing)
    assert f.size() == len(before) - 1 == len(survey.index)


def test_ground_in_view_of_a_misplaced_crossing_is_not_known() -> None:
    """What lies there was shown elsewhere, so that a feature without a landmark contradicts nothing."""
    f, _ = driven("joint")
    survey = MapSurvey.of(f.landmarks(), 0.6)
    pose, at = f.estimate()[0], f.landmarks().xy_map_m
    in_view = 0.5 * np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])
    inside = np.all(np.abs(transform(inverse(pose), at)) < 0.4, axis=1)
    outside = np.any(np.abs(transform(inverse(pose), at)) > 0.9, axis=1)
    survey.coverage.shown[:], survey.coverage.of_lines.shown[:] = 20, 20  # type: ignore[union-attr]
    joints = f.landmarks().crossing_type
    assert np.count_nonzero(inside) > 0 and np.all(survey.coverage.knows(at, joints))
    survey.forget_near(f, np.array([[50.0, 50.0]]), in_view)
    known = survey.coverage.knows(at, joints)
    assert not np.any(known[inside]) and np.all(known[outside])
    assert not np.any(survey.coverage.views(at[inside]))
