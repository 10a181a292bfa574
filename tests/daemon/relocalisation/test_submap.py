"""What is learnt in doubt, and how it joins the rest: rigid motions known exactly, and a drive with darkness."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ceilvo.bench.place.case import drive_in
from ceilvo.bench.place.ceiling.worlds import WorldSpec, make_world
from ceilvo.crossing_types import quarter_turns, turned_type
from ceilvo.daemon.relocalisation.evidence.admission import of_doubtful_place, of_sure_place
from ceilvo.daemon.relocalisation.evidence.coverage import VIEWS, Coverage
from ceilvo.daemon.relocalisation.submap import rest_of
from ceilvo.daemon.slam.upkeep import carried
from ceilvo.se2 import compose, inverse, transform
from ceilvo.types import Array, Ints, Landmarks, Observations, State

number = st.floats(-20.0, 20.0)
poses = st.tuples(number, number, st.floats(-3.1, 3.1)).map(np.array)


def landmarks(xy: Array, first_id: int = 0, kind: int = 0) -> Landmarks:
    n = len(xy)
    return Landmarks(
        first_id + np.arange(n), xy, np.tile(np.diag([4e-6, 1e-6]), (n, 1, 1)), np.full(n, kind), np.full(n, 9)
    )


def both(a: Landmarks, b: Landmarks) -> Landmarks:
    names = ("ids", "xy_map_m", "cov_m2", "crossing_type", "sightings", "expected")
    return Landmarks(*(np.concatenate([getattr(a, n), getattr(b, n)]) for n in names))


@settings(max_examples=50, deadline=None)
@given(poses, poses)
def test_a_joined_landmark_is_seen_from_the_found_pose_as_it_was_from_the_tracked_one(
    tracked: Array, found: Array
) -> None:
    rng = np.random.default_rng(4)
    old, new = landmarks(rng.uniform(200, 220, (5, 2))), landmarks(rng.uniform(-3, 3, (7, 2)), first_id=5)
    whole = carried(both(old, new), 5, compose(found, inverse(tracked)))
    assert np.array_equal(whole.xy_map_m[:5], old.xy_map_m)
    before = transform(inverse(tracked), new.xy_map_m)
    assert np.allclose(transform(inverse(found), whole.xy_map_m[5:]), before, atol=1e-9)
    assert np.allclose(np.linalg.eigvalsh(whole.cov_m2), [1e-6, 4e-6])
    assert np.array_equal(whole.ids, np.arange(12))


@pytest.mark.parametrize("quarters", range(4))
def test_a_joined_landmark_has_the_type_that_it_is_seen_as_from_the_found_pose(quarters: int) -> None:
    """It kept its name: one that was turned by 90 deg contradicted the map, and the right place was given up."""
    rng = np.random.default_rng(5)
    seen, psi, tracked = rng.integers(0, 9, 30), -0.2, np.array([1.0, 2.0, 0.25])
    found = np.array([4.0, -3.0, 0.25 + 0.5 * np.pi * quarters + 0.01])
    old = landmarks(rng.uniform(200, 220, (5, 2)))
    new = landmarks(rng.uniform(-3, 3, (30, 2)), first_id=5)
    new = replace(new, crossing_type=turned_type(seen, quarter_turns(psi + tracked[2], 0.0)))
    whole = carried(both(old, new), 5, compose(found, inverse(tracked)))
    assert np.array_equal(whole.crossing_type[5:], turned_type(seen, quarter_turns(psi + found[2], 0.0)))


def test_of_what_both_know_the_rest_is_kept() -> None:
    old = landmarks(np.array([[1.0, 1.0], [2.0, 1.0]]))
    new = landmarks(np.array([[1.03, 1.0], [5.0, 5.0]]), first_id=2)
    assert carried(both(old, new), 2, np.zeros(3)).ids.tolist() == [0, 1, 3]
    assert len(carried(both(old, replace(new, crossing_type=np.full(2, 8))), 2, np.zeros(3))) == 4
    assert np.array_equal(carried(old, 2, np.ones(3)).xy_map_m, old.xy_map_m), "no submap"
    assert rest_of(both(old, new), 2).ids.tolist() == [0, 1]
    assert len(rest_of(both(old, new), None)) == 4


def view(xy: Array, label: list[int]) -> Observations:
    n = len(xy)
    return Observations(xy, np.full((n, 2), 1e-5), np.zeros(n, np.int64), np.array(label), 0.0, 1e-6, 0.0, xy[:3])


def known_square() -> Coverage:
    out = Coverage()
    for _ in range(VIEWS):
        out.show(np.array([[-2.0, -2.0], [2.0, -2.0], [2.0, 2.0], [-2.0, 2.0]]))
    return out


def test_in_doubt_only_new_ground_is_learnt_and_what_nearly_all_agrees_corrects() -> None:
    rng = np.random.default_rng(2)
    xy, far, ground = rng.uniform(-1, 1, (20, 2)), np.array([50.0, 0.0, 0.0]), known_square()
    here = np.zeros(3)
    strange, agreed = view(xy, [-1] * 20), view(xy, [*range(18), -1, -1])
    assert of_doubtful_place(strange, here, ground, submap=True) is None
    assert of_doubtful_place(strange, far, ground, submap=False) is None
    learnt = of_doubtful_place(strange, far, ground, submap=True)
    assert learnt is not None
    assert len(learnt) == 20
    assert not len(learnt.visible_m)
    corrects = of_doubtful_place(agreed, here, ground, submap=True)
    assert corrects is not None
    assert corrects.label.tolist() == list(range(18))
    assert of_sure_place(strange, here, ground) is None
    assert of_sure_place(agreed, here, ground) is agreed
    assert of_sure_place(strange, far, ground) is strange


@pytest.mark.parametrize("off_m, told", [(0.02, True), (0.13, False)])
def test_a_place_that_is_led_by_another_is_not_put_right_at_the_cost_of_that_one(off_m: float, told: bool) -> None:
    """It was, by 0.13 m, to where its own joints lie, and the true place, which moved along, was lost."""
    rng = np.random.default_rng(4)
    xy = rng.uniform(-1, 1, (20, 2))
    map_ = landmarks(xy + np.array([0.0, off_m]))
    seen = view(xy, list(range(20)))

    def near(at: Array, reach_m: float) -> tuple[Ints, Landmarks]:
        assert reach_m >= off_m
        return np.arange(20), map_

    assert of_doubtful_place(seen, np.zeros(3), known_square(), submap=True) is not None
    assert (of_doubtful_place(seen, np.zeros(3), known_square(), submap=True, near=near, led=True) is not None) == told


@pytest.mark.parametrize("doubtful", [True, False])
def test_tiles_that_were_hung_anew_a_part_of_a_tile_off_do_not_take_the_pose_along(doubtful: bool) -> None:
    """Every one has a landmark within the gate, and a third of the view was off by 0.1 m, all alike."""
    rng = np.random.default_rng(7)
    xy = rng.uniform(-1, 1, (30, 2))
    off = np.where(np.arange(30)[:, None] < 3 if doubtful else np.arange(30)[:, None] < 10, [0.0, 0.1], 0.0)
    map_ = landmarks(xy + off)
    seen = view(xy, list(range(30)))

    def near(at: Array, reach_m: float) -> tuple[Ints, Landmarks]:
        return np.arange(30), map_

    if doubtful:
        told = of_doubtful_place(seen, np.zeros(3), known_square(), submap=False, near=near)
    else:
        told = of_sure_place(seen, np.zeros(3), known_square(), near)
    assert told is not None
    assert told.label[told.label >= 0].tolist() == list(range(3 if doubtful else 10, 30))


@pytest.mark.parametrize("seed", [6])
def test_a_lap_in_doubt_on_new_ground_is_joined_when_the_robot_is_back(seed: int) -> None:
    """25 s of mapping in a hall of 20 m, 2 s of darkness without wheels, new ground, and back."""
    print(f"seed {seed}")
    rng = np.random.default_rng(seed)
    world = make_world(WorldSpec("20", 0.6, "sparse", seed))
    drive = drive_in(world, rng, False, 10.0, True, 0.8)
    drive.at_truth()
    drive.go(3)
    map_from_truth = compose(np.asarray(drive.tick().pose), inverse(drive.pose))  # type: ignore[union-attr]
    drive.go(22)
    before = drive.pipeline.filter.size()
    drive.conditions.dark = True
    drive.go(2)
    drive.conditions.dark = False
    drive.go(20)
    assert drive.estimate is not None
    assert drive.estimate.state is State.RELOCALISING
    assert drive.pipeline.filter.size() > before + 30  # it goes on mapping
    assert drive.settle(150.0)
    off = compose(inverse(compose(map_from_truth, drive.pose)), np.asarray(drive.estimate.pose))
    assert np.hypot(*off[:2]) < 0.1
    there = transform(map_from_truth, world.features.xy_map_m)
    for at in drive.pipeline.filter.landmarks().xy_map_m:
        assert np.min(np.hypot(*(there - at).T)) < 0.1
