"""Which of several landmarks at one spot is named, while a map is learnt."""

from dataclasses import replace

import numpy as np

from ceilvo.daemon.relocalisation.place_index.place_index import PlaceIndex
from ceilvo.types import Landmarks


def corner(*seen: tuple[float, float, int, int]) -> Landmarks:
    """Landmarks by x, y, type and sightings of 100."""
    xy, kind, sightings = (np.array([s[k] for s in seen]) for k in (slice(0, 2), 2, 3))
    n = len(seen)
    return Landmarks(np.arange(n) + 7, xy, np.tile(1e-6 * np.eye(2), (n, 1, 1)), kind, sightings, np.full(n, 100))


def named(index: PlaceIndex, landmarks: Landmarks) -> list[bool]:
    return index.named(landmarks.ids).tolist()


def test_the_name_that_is_seen_most_is_the_one() -> None:
    landmarks = corner((1.0, 1.0, 0, 70), (1.01, 1.02, 3, 40), (1.0, 1.01, 1, 20), (2.0, 1.0, 3, 30))
    assert named(PlaceIndex.of(landmarks), landmarks) == [True, False, False, True]


def test_a_joint_and_a_corner_are_two_things_and_so_are_two_of_one_type() -> None:
    landmarks = corner((1.0, 1.0, 4, 95), (1.02, 1.0, 0, 60), (1.03, 1.0, 0, 50))
    assert named(PlaceIndex.of(landmarks), landmarks) == [True, True, True]


def test_names_follow_what_is_seen() -> None:
    """Across a block's border, too: blocks are 1.6 m."""
    before = corner((1.599, 1.0, 0, 40), (1.601, 1.0, 3, 60))
    index = PlaceIndex.of(before)
    assert named(index, before) == [False, True]
    index.sync(corner((1.599, 1.0, 0, 80), (1.601, 1.0, 3, 50)))
    assert named(index, before) == [True, False]
    index.remove(before.ids[:1])
    assert index.named(before.ids[1:]).tolist() == [True]


def test_of_names_that_are_about_as_visible_the_oldest_stays() -> None:
    """A mistaken name of few views may be as visible as one of many, of which the index keeps steps of 5 % only."""
    landmarks = corner((1.0, 1.0, 0, 95), (1.01, 1.0, 3, 96))
    assert named(PlaceIndex.of(landmarks), landmarks) == [True, False]


def test_exactly_one_is_named_however_little_each_differs_from_the_next() -> None:
    for seen in (range(60, 90, 4), range(90, 60, -4), range(60, 90, 3)):
        landmarks = corner(*((1.0 + 0.002 * k, 1.0, k % 4, s) for k, s in enumerate(list(seen)[:4])))
        assert sum(named(PlaceIndex.of(landmarks), landmarks)) == 1


def test_a_newborn_is_not_seen_more_often_because_it_was_born() -> None:
    """Three sightings made it a landmark; the other one was seen in 36 of 60 views."""
    landmarks = replace(
        corner((1.0, 1.0, 2, 0), (1.0, 1.01, 1, 0)), sightings=np.array([36, 3]), expected=np.array([60, 3])
    )
    index = PlaceIndex.of(landmarks.of(np.array([True, False])))
    index.sync(landmarks)
    assert named(index, landmarks) == [True, False]
    index.sync(replace(landmarks, sightings=np.array([36, 23]), expected=np.array([80, 23])))
    assert named(index, landmarks) == [False, True]
