"""The joint map's table and index against a plain list that is searched through."""

from __future__ import annotations

import copy

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from ceilvo.daemon.slam.joint_map import JointMap
from ceilvo.daemon.slam.spatial_index import packed
from ceilvo.types import Landmarks

SEED = 3
REACH_M = 9.0
"""Of the landmarks around the origin; some ten cells of the index."""


def landmarks(n: int, seed: int = SEED) -> Landmarks:
    rng = np.random.default_rng(seed)
    cov = rng.uniform(1e-4, 4e-4, n)[:, None, None] * np.eye(2)
    seen = rng.integers(1, 9, n)
    xy = rng.uniform(-REACH_M, REACH_M, (n, 2))
    return Landmarks(np.arange(n), xy, cov, rng.integers(0, 9, n), seen, seen + rng.integers(0, 9, n))


def rows(j: JointMap) -> dict[int, tuple[object, ...]]:
    """What is known of every landmark, by its id."""
    labels = np.arange(len(j))
    columns = (j.xy(labels), j.packed(labels), j.crossing_type, j.sightings, j.expected, j.doubt, j.seen_at)
    return {int(i): (labels[k] < j.size, *(c[k].tolist() for c in columns)) for k, i in enumerate(j.ids)}


def consistent(j: JointMap) -> None:
    """Slots and labels agree; confirmed ones come first; boxes hold what a search through all finds."""
    assert j.confirmed.tolist() == [True] * j.size + [False] * (len(j) - j.size)
    assert j.slot[j.label_of].tolist() == list(range(len(j.label_of)))
    assert np.count_nonzero(j.slot >= 0) == len(j.label_of) == (len(j.mean) - 3) // 2
    assert len(np.unique(j.ids)) == len(j)
    for low, high in (((-2.0, -1.0), (1.5, 3.0)), ((-99.0, -99.0), (99.0, 99.0)), ((5.0, 5.0), (5.1, 5.1))):
        all_xy = j.xy(np.arange(len(j)))
        there = np.flatnonzero(np.all((all_xy >= low) & (all_xy <= high), axis=1))
        assert j.near(np.array(low), np.array(high)).tolist() == there.tolist()


OPERATIONS = ("birth", "bring in", "confirm", "forget", "bound", "merge", "copy", "move")


@settings(max_examples=80)
@given(st.lists(st.tuples(st.sampled_from(OPERATIONS), st.integers(0, 2**31)), max_size=25), st.booleans())
def test_whatever_is_done_no_landmark_becomes_another(steps: list[tuple[str, int]], ask_first: bool) -> None:
    j = JointMap.at(np.zeros(3), 1e-6 * np.eye(3))
    j.load(landmarks(40))
    if ask_first:
        consistent(j)
    for name, seed in steps:
        rng, before = np.random.default_rng(seed), rows(j)
        some = rng.permutation(len(j))[: rng.integers(0, 8)]
        gone, changed, born = set[int](), set[int](), 0
        if name == "birth":
            born = int(rng.integers(0, 90))
            j.give_birth(rng.uniform(-REACH_M, REACH_M, (born, 2)), np.full((born, 2), 1e-4), np.zeros(born, int), 1)
        elif name == "bring in":
            j.bring_in(some)
        elif name == "confirm":
            changed = set(j.ids[some].tolist())
            j.confirm(some)
        elif name == "forget":
            gone = set(j.ids[some].tolist())
            j.forget(some)
        elif name == "bound":
            j.bound(int(rng.integers(8, 40)))
        elif name == "merge" and len(some) > 1:
            changed, gone = set(j.ids.tolist()), {int(j.ids[some[1]])}
            assert j.merge(int(some[0]), int(some[1]), np.inf)
        elif name == "copy":
            j = copy.deepcopy(j)
        elif name == "move":
            changed = set(j.ids.tolist())
            j.mean[3:] += rng.normal(0.0, 1.0, len(j.mean) - 3)
        after = rows(j)
        assert len(after) == len(before) + born - len(gone)
        for i in before.keys() - gone - changed:
            assert after[i] == before[i], name
        assert not gone & after.keys()
        consistent(j)


def test_a_map_comes_out_as_it_went_in() -> None:
    m = landmarks(300)
    j = JointMap.at(np.zeros(3), np.eye(3))
    j.load(m)
    for found in (j.summary(np.arange(j.size)), copy.deepcopy(j).summary(np.arange(j.size))):
        assert found.ids.tolist() == m.ids.tolist()
        np.testing.assert_array_equal(found.xy_map_m, m.xy_map_m)
        np.testing.assert_array_equal(found.cov_m2, m.cov_m2)
        assert found.crossing_type.tolist() == m.crossing_type.tolist()
        assert found.sightings.tolist() == m.sightings.tolist()
        assert found.expected.tolist() == m.expected.tolist()


def test_a_state_of_an_older_recording_has_its_confirmed_landmarks_first() -> None:
    """Its fields were the same but for the counts, and confirmed landmarks stood anywhere."""
    m, cov = landmarks(5), np.eye(7)
    j = JointMap(
        np.array([0.0, 0.0, 0.0, 7.0, 7.5, -3.0, -3.5]),
        cov,
        label_of=np.array([4, 1]),
        ids=m.ids,
        crossing_type=m.crossing_type,
        sightings=m.sightings,
        seen_at=np.arange(5),
        confirmed=np.array([False, True, False, False, True]),
        slot=np.array([-1, 1, -1, -1, 0]),
        table_xy=m.xy_map_m.copy(),
        table_packed=packed(m.cov_m2),
        next_id=5,
    )
    consistent(j)
    assert sorted(j.ids[: j.size].tolist()) == [1, 4]
    assert j.expected.tolist() == j.sightings.tolist()
    at = {int(i): xy for i, xy in zip(j.ids, j.xy(np.arange(5)).tolist(), strict=True)}
    assert at[4] == [7.0, 7.5] and at[1] == [-3.0, -3.5]
    assert at[0] == m.xy_map_m[0].tolist()


def test_what_a_summary_shows_does_not_change_with_the_map() -> None:
    j = JointMap.at(np.zeros(3), np.eye(3))
    j.load(landmarks(100))
    shown = j.summary(np.arange(j.size))
    before = [c.copy() for c in (shown.ids, shown.xy_map_m, shown.sightings, shown.expected)]
    j.forget(np.arange(0, 100, 3))
    j.give_birth(np.ones((50, 2)), np.full((50, 2), 1e-4), np.zeros(50, np.int64), now=1)
    j.sightings += 1
    for a, b in zip((shown.ids, shown.xy_map_m, shown.sightings, shown.expected), before, strict=True):
        np.testing.assert_array_equal(a, b)
