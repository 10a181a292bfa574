"""What was learnt in doubt is carried along with the robot, rigidly, by every filter alike."""

from dataclasses import fields

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ceilvo import se2
from ceilvo.config import Config
from ceilvo.config.reader import replace
from ceilvo.daemon.relocalisation.filters import make_filter
from ceilvo.daemon.slam.joint_filter import JointFilter
from ceilvo.daemon.slam.pose_filter import PoseFilter
from ceilvo.daemon.slam.upkeep import carried
from ceilvo.types import NO_LANDMARK, UNLABELLED, Array, Displacement, Landmarks, Motion, Observations

SEED = 31
OLD, NEW = 40, 12
number = st.floats(-9.0, 9.0)
moves = st.tuples(number, number, st.floats(-3.1, 3.1)).map(np.array)


def old_map() -> Landmarks:
    rng = np.random.default_rng(SEED)
    cov = np.tile(np.diag([4e-6, 1e-6]), (OLD, 1, 1))
    return Landmarks(np.arange(OLD), rng.uniform(-4, 4, (OLD, 2)), cov, rng.integers(0, 9, OLD), np.full(OLD, 30))


def learnt(method: str) -> PoseFilter:
    """On the old map, with NEW landmarks that were learnt beside it."""
    config = replace(Config(), (f"filter.method={method}", "filter.particles=50"))
    made, rng = make_filter(config.filter, np.random.default_rng(SEED)), np.random.default_rng(SEED + 1)
    made.reset(np.array([1.0, -2.0, 0.3]), np.diag([1e-6, 1e-6, 1e-8]), old_map())
    pose, xy, kind = np.array([1.0, -2.0, 0.3]), rng.uniform(6.0, 9.0, (NEW, 2)), rng.integers(0, 9, NEW)
    for _ in range(8):
        made.predict(Motion(Displacement(np.zeros(3)), np.diag([1e-8, 1e-8, 1e-10]), 10, 0.001))
        at = se2.transform(se2.inverse(pose), xy) + 1e-3 * rng.normal(size=(NEW, 2))
        near = made.landmarks().xy_map_m
        apart = np.hypot(*(xy[:, None] - near).transpose(2, 0, 1))
        label = np.where(apart.min(axis=1) < 0.05, apart.argmin(axis=1), NO_LANDMARK)
        made.update(Observations(at, np.full((NEW, 2), 1e-6), kind, label, 0.3, 1e-6, 0.0, at[:3]))
    assert made.size() == OLD + NEW
    return made


def same(a: Landmarks, b: Landmarks) -> bool:
    order_a, order_b = np.argsort(a.ids), np.argsort(b.ids)
    return all(
        np.allclose(getattr(a, f.name)[order_a], getattr(b, f.name)[order_b], atol=1e-12) for f in fields(Landmarks)
    )


@pytest.mark.parametrize("method", ["joint", "ukf", "pf"])
@settings(max_examples=4, deadline=None)
@given(moves)
def test_every_filter_carries_as_the_whole_map_would(method: str, moved: Array) -> None:
    made = learnt(method)
    before = made.landmarks()
    told = made.carry(OLD, moved)
    whole = carried(before, OLD, moved)
    assert same(made.landmarks(), whole)
    assert same(told, whole.of(whole.ids >= OLD))
    assert made.next_id() == OLD + NEW


def test_what_the_landmarks_know_of_each_other_turns_with_them() -> None:
    """Their distances are known better than their places, before and after; those of the rest keep to the bit."""
    made, moved = learnt("joint"), np.array([3.0, -1.0, 1.1])
    assert isinstance(made, JointFilter)
    joint = made.state.joint
    inside = joint.label_of[joint.ids[joint.label_of] >= OLD]
    rows, rest = joint.rows(inside), joint.rows(joint.label_of[joint.ids[joint.label_of] < OLD])
    before, kept = joint.cov[np.ix_(rows, rows)].copy(), joint.cov[np.ix_(rest, rest)].copy()
    made.carry(OLD, moved)
    turn = np.kron(np.eye(len(inside)), se2.rotation(float(moved[2])))
    inside = joint.label_of[joint.ids[joint.label_of] >= OLD]
    rows, rest = joint.rows(inside), joint.rows(joint.label_of[joint.ids[joint.label_of] < OLD])
    assert len(inside) == NEW
    assert np.allclose(joint.cov[np.ix_(rows, rows)], turn @ before @ turn.T, atol=1e-15)
    assert np.array_equal(joint.cov[np.ix_(rest, rest)], kept)
    assert np.allclose(joint.cov, joint.cov.T)


def test_they_are_found_where_they_are_now_and_not_where_they_were() -> None:
    made, moved = learnt("joint"), np.array([30.0, 0.0, 0.0])
    assert isinstance(made, JointFilter)
    made.state.joint.bound(0)  # all into the table, whose index is asked
    centre = np.array([[7.5, 7.5]])
    assert len(made.landmarks_near(centre, 2.0)[0]) == NEW
    made.carry(OLD, moved)
    assert not len(made.landmarks_near(centre, 2.0)[0])
    assert len(made.landmarks_near(centre + moved[:2], 2.0)[0]) == NEW


def test_a_robot_that_was_put_sees_them_where_it_saw_them() -> None:
    """Tracked at one pose, found at another: the same view fits without an innovation."""
    made, tracked, found = learnt("joint"), np.array([1.0, -2.0, 0.3]), np.array([-6.0, 4.0, 1.9])
    xy = made.landmarks().of(made.landmarks().ids >= OLD).xy_map_m
    view = se2.transform(se2.inverse(tracked), xy)
    new = made.carry(OLD, np.asarray(se2.compose(found, se2.inverse(tracked))))
    made.jump(found, np.diag([1e-4, 1e-4, 1e-6]))
    seen = Observations(
        view, np.full((NEW, 2), 1e-6), new.crossing_type, np.full(NEW, UNLABELLED), 0.0, np.inf, 0.0, view[:3]
    )
    made.update(seen)
    pose, _, health = made.estimate()
    assert np.allclose(pose, found, atol=1e-6)
    assert health.nis_dof >= NEW
    assert health.nis < 1e-3


def test_what_is_known_for_good_carries_nothing() -> None:
    made = make_filter(Config().filter, np.random.default_rng(SEED))
    made.reset(np.zeros(3), np.eye(3), old_map(), known=True)
    assert made.next_id() == OLD
    assert not len(made.carry(0, np.ones(3)))
    assert np.array_equal(made.landmarks().xy_map_m, old_map().xy_map_m)
