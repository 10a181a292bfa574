"""The bench's count of landmarks that are there twice, on maps made by hand."""

import numpy as np

from ceilvo.bench.place.ceiling.worlds import WorldSpec, landmarks_of, make_world
from ceilvo.bench.refine.lap import around, twice
from ceilvo.bench.refine.study import onto_truth
from ceilvo.se2 import inverse, transform
from ceilvo.types import Landmarks

FEATURES = make_world(WorldSpec("20", 0.6, "sparse", 5)).features


def known() -> Landmarks:
    return landmarks_of(FEATURES, np.zeros(len(FEATURES.xy_map_m)), np.random.default_rng(1))


def moved(m: Landmarks, by: np.ndarray) -> Landmarks:
    return Landmarks(m.ids, transform(by, m.xy_map_m), m.cov_m2, m.crossing_type, m.sightings)


def test_landmarks_near_each_other_that_are_two_things_are_not_there_twice_and_a_second_map_beside_is() -> None:
    own = known()
    assert twice(own, FEATURES) == 0
    some = own.of(np.arange(0, len(own), 10))
    beside = moved(some, np.array([0.004, 0.003, 0.0]))
    both = Landmarks(
        np.concatenate([own.ids, beside.ids + 10**6]),
        *(
            np.concatenate([getattr(own, k), getattr(beside, k)])
            for k in ("xy_map_m", "cov_m2", "crossing_type", "sightings")
        ),
    )
    assert twice(both, FEATURES) == len(some)


def test_how_a_map_lies_on_the_truth_is_found_from_the_nearest_crossings() -> None:
    way = np.array([0.03, -0.02, 0.002])
    motion, used, nearest = onto_truth(moved(known(), inverse(way)), FEATURES.xy_map_m)
    assert np.all(used) and len(np.unique(nearest)) == len(nearest)
    assert np.all(np.abs(motion - way) < [1e-3, 1e-3, 1e-4])


def test_a_lap_closes_after_its_length() -> None:
    lap = around((20.0, 10.0), 1.2, 0.08)
    ends = np.hypot(*(lap[-1, :2] - lap[0, :2]))
    assert ends < 0.2 and abs(0.08 * len(lap) - (2 * (20.0 + 10.0) - (8.0 - 2.0 * np.pi) * 1.2)) < 1.0
