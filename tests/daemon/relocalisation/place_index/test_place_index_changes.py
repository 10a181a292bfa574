"""An index that follows its map: added, moved and removed landmarks against an index of what is left."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import place_maps
from hypothesis import given, settings
from hypothesis import strategies as st

from ceilvo.crossing_types import LAMP
from ceilvo.daemon.relocalisation.place_index.blocks import FINE_M, fine
from ceilvo.daemon.relocalisation.place_index.place_index import MOVED_M, PlaceIndex
from ceilvo.daemon.replay.snapshot import read_value, value_json


def same_answers(index, other, view):
    a, b = index.candidates(view, margin=30.0), other.candidates(view, margin=30.0)
    assert (a.complete, a.floor, a.seen) == (b.complete, b.floor, b.seen)
    np.testing.assert_array_equal(a.pose, b.pose)
    np.testing.assert_array_equal(a.explained, b.explained)
    np.testing.assert_array_equal(a.contradicted, b.contradicted)
    np.testing.assert_array_equal(a.missed, b.missed)


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 2**16), st.integers(1, 12))
def test_an_index_that_followed_its_map_is_the_index_of_the_map(seed, steps):
    rng = np.random.default_rng(seed)
    world = place_maps.random_map(rng, 200, 8.0, (0, 2, 6, 8, 4, 4, 4, 4))
    index, known = PlaceIndex(), np.zeros(200, bool)
    at = world.xy_map_m.copy()
    for _ in range(steps):
        some = rng.random(200) < 0.2
        at[some] += rng.choice([0.001, 0.05, 1.0]) * rng.standard_normal((np.count_nonzero(some), 2))
        world = replace(world, xy_map_m=at.copy())
        gone = known & (rng.random(200) < 0.1)
        index.remove(world.ids[gone])
        known = (known & ~gone) | some
        index.sync(world.of(known), moved_m=0.0)
    assert sorted(index.ids.tolist()) == np.flatnonzero(known).tolist()
    assert len(index) == np.count_nonzero(known)
    fresh = PlaceIndex.of(world.of(known))
    pose = np.array([*rng.uniform(-2, 2, 2), rng.uniform(-3, 3)])
    same_answers(index, fresh, place_maps.view_of(world.of(known), pose, rng, 1, extra=1))


def test_a_part_of_the_map_can_be_brought_up_to_date_alone():
    rng = np.random.default_rng(1)
    world = place_maps.random_map(rng, 300, 10.0)
    index = PlaceIndex.of(world)
    moved = replace(world, xy_map_m=world.xy_map_m + np.array([0.3, -0.2]))
    for begin in range(0, 300, 37):
        index.sync(moved.of(np.arange(begin, min(begin + 37, 300))))
    same_answers(index, PlaceIndex.of(moved), place_maps.view_of(moved, [0.0, 0.5, 0.2], rng))


def test_a_landmark_that_hardly_moved_stays_and_one_of_another_type_changes():
    rng = np.random.default_rng(2)
    world = place_maps.random_map(rng, 50, 5.0)
    index = PlaceIndex.of(world)
    before = index.grid.cells.copy()
    index.sync(replace(world, xy_map_m=world.xy_map_m + 0.6 * MOVED_M))
    np.testing.assert_array_equal(index.grid.cells, before)
    other = replace(world, crossing_type=np.full(50, 1))
    index.sync(other)
    same_answers(index, PlaceIndex.of(other), place_maps.view_of(other, [0.0, 0.0, 0.0], rng))
    assert np.flatnonzero(index.members.count).tolist() == [1] and index.members.count[1] == 50


def test_an_empty_index_calls_no_landmark_mistaken():
    """A map that grew while nothing was surveyed; a replay of few lamps ended with an IndexError."""
    assert PlaceIndex().named(np.array([3, 5])).all()


def test_what_is_not_there_is_removed_without_harm():
    index = PlaceIndex.of(place_maps.map_of(np.eye(2), np.array([0, 2])))
    index.remove(np.array([1, 7, 1]))
    assert index.ids.tolist() == [0]
    index.remove(np.empty(0, np.int64))
    assert len(index) == 1


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 2**16), st.floats(-5, 5), st.floats(-5, 5), st.floats(0.0, 4.0), st.floats(0.0, 4.0))
def test_the_landmarks_in_a_box_are_those_in_it(seed, x, y, width, height):
    world = place_maps.random_map(np.random.default_rng(seed), 150, 9.0)
    index, low, high = PlaceIndex.of(world), np.array([x, y]), np.array([x + width, y + height])
    at = FINE_M * fine(world.xy_map_m)
    sure, possible = (np.all((at > low + e) & (at < high - e), axis=1) for e in (FINE_M, -FINE_M))
    found = set(index.within(low, high).tolist())
    assert set(world.ids[sure].tolist()) <= found <= set(world.ids[possible].tolist())


def test_an_index_comes_back_from_a_snapshot_and_goes_on():
    rng = np.random.default_rng(6)
    world = place_maps.random_map(rng, 300, 9.0)
    index = PlaceIndex.of(world.of(np.arange(250)))
    back = read_value(value_json(index), PlaceIndex)
    for each in (index, back):
        each.remove(np.arange(10))
        each.sync(world.of(np.arange(200, 300)))
    same_answers(index, back, place_maps.view_of(world, [0.5, 0.0, 0.4], rng))


def test_an_index_of_a_recording_that_is_older_than_points_goes_on():
    world = place_maps.random_map(np.random.default_rng(6), 50, 9.0)
    index = PlaceIndex.of(world)
    older = replace(index.members, slots=index.members.slots[:9], count=index.members.count[:9])
    back = read_value(value_json(replace(index, members=older)), PlaceIndex)
    lamps = replace(world, ids=world.ids + 1000, crossing_type=np.full(50, LAMP))
    for each in (index, back):
        each.add(lamps)
    assert back.members.count.tolist() == index.members.count.tolist()


def test_a_moved_landmark_is_looked_for_where_it_is_now():
    rng = np.random.default_rng(3)
    world = place_maps.random_map(rng, 500, 16.0)
    index = PlaceIndex.of(world)
    drift = 0.02 * rng.standard_normal((500, 2))
    now = replace(world, xy_map_m=world.xy_map_m + 0.5 + drift)
    index.sync(now)
    pose = np.array([1.0, 1.0, 0.3])
    view = place_maps.view_of(now, pose, rng)
    found = index.candidates(view)
    assert np.hypot(*(found.pose[0] - pose)[:2]) < 0.05
    assert found.explained[0] == len(view)


def test_the_index_takes_less_than_200_bytes_a_landmark_also_when_it_grew():
    rng = np.random.default_rng(4)
    side = np.sqrt(15_000.0)  # m: 30,000 landmarks as on 150 m x 100 m
    world = place_maps.random_map(rng, 30_000, side)
    assert PlaceIndex.of(world).nbytes < 200 * 30_000
    index = PlaceIndex()
    for begin in range(0, 30_000, 1000):
        index.sync(world.of(np.arange(begin, begin + 1000)))
    assert index.nbytes < 200 * 30_000


def test_adding_and_removing_for_ever_does_not_grow():
    rng = np.random.default_rng(5)
    index = PlaceIndex.of(place_maps.random_map(rng, 400, 14.0))
    sizes = []
    for round_ in range(30):
        more = place_maps.random_map(rng, 100, 14.0)
        more = replace(more, ids=more.ids + 1000 * (round_ + 1))
        index.add(more)
        index.remove(more.ids)
        sizes.append(index.nbytes)
    assert len(index) == 400
    assert sizes[-1] <= 1.1 * sizes[4]
