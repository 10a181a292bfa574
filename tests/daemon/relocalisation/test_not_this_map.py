"""Whether a robot is anywhere on a map: ceilings whose every feature is known, looked at along a way."""

from dataclasses import replace

import numpy as np
import pytest
from place_maps import SQUARE, ceiling

from ceilvo import se2
from ceilvo.bench.place.case import drive_in, load_known
from ceilvo.bench.place.ceiling.worlds import WorldSpec, make_world
from ceilvo.crossing_types import CROSSING_TYPES
from ceilvo.daemon.relocalisation.evidence.chance import Chance
from ceilvo.daemon.relocalisation.evidence.coverage import Coverage
from ceilvo.daemon.relocalisation.evidence.view_evidence import Surroundings, ViewEvidence
from ceilvo.daemon.relocalisation.lattice import Lattice, rival_from_tracked
from ceilvo.daemon.relocalisation.not_this_map import NotThisMap, Weigh
from ceilvo.daemon.relocalisation.place_index.place_index import PlaceIndex
from ceilvo.daemon.relocalisation.relocaliser import Relocaliser
from ceilvo.daemon.relocalisation.relocaliser_state import NOT_THIS_MAP
from ceilvo.se2 import inverse, transform
from ceilvo.types import Array, Landmarks, Observations, State

STARTED_ELSEWHERE = float(np.log(0.05 / 0.95))
SAID = 7.0
"""Log-odds against the map of a robot that was told so: more than one view takes it back."""
WAY = [np.array([x, 4.9, 0.0]) for x in (2.0, 3.5, 5.0, 6.5, 8.0)]
"""8 m of a hall of 10 m."""


def renovated(old: Landmarks, new: Landmarks, side_m: float) -> Landmarks:
    """A square in the middle of the way is another ceiling."""
    low, high = np.array([5.0, 4.9]) - 0.5 * side_m, np.array([5.0, 4.9]) + 0.5 * side_m
    there = [np.all((m.xy_map_m > low) & (m.xy_map_m < high), axis=1) for m in (old, new)]
    kept, put = old.of(~there[0]), new.of(there[1])
    n = len(kept) + len(put)
    xy = np.concatenate([kept.xy_map_m, put.xy_map_m])
    kinds = np.concatenate([kept.crossing_type, put.crossing_type])
    return Landmarks(np.arange(n), xy, np.tile(1e-6 * np.eye(2), (n, 1, 1)), kinds, np.full(n, 50))


def view_of(seen: Landmarks, pose: Array) -> Observations:
    xy = transform(inverse(pose), seen.xy_map_m)
    near = np.all(np.abs(xy) < 1.5, axis=1)
    n = int(near.sum())
    kind = seen.crossing_type[near]
    return Observations(xy[near], np.full((n, 2), 1e-5), kind, np.full(n, -1), 0.0, 1e-6, 0.0, SQUARE)


def weigher(known: Landmarks) -> tuple[Weigh, Coverage, PlaceIndex]:
    same = np.full((2, CROSSING_TYPES), 0.2)
    same[:, 4] = 0.98
    ground, index = Coverage.of(known, 0.6), PlaceIndex.of(known)
    around = Surroundings.of(known, ground, Chance(same, np.minimum(same + 0.1, 0.99)), 3.0, 0.0)

    def weigh(view: Observations, worth: float, poses: Array) -> tuple[Array, Array]:
        evidence = ViewEvidence(view, around, np.full(len(view), worth))
        return evidence.log_ratio_in(index.grid, poses), evidence.known(poses)

    return weigh, ground, index


def asked(known: Landmarks, seen: Landmarks, start_off_m: float = 0.0) -> tuple[list[bool], NotThisMap]:
    """What is said after each view of the way, by a robot whose stored pose is so far off."""
    weigh, ground, index = weigher(known)
    test, lattice = NotThisMap(), Lattice.of(known, 0.0)
    assert lattice is not None
    test.begin(STARTED_ELSEWHERE, ground.area_m2, ground.share_beyond(WAY[0][:2], 6.0))
    said = []
    for pose in WAY:
        view, tracked = view_of(seen, pose), pose + np.array([start_off_m, 0.0, 0.0])
        places = lattice.rivals(tracked, view, 6.0, turned=True)
        found = index.candidates(view)
        places = np.concatenate([np.zeros((1, 3)), places, rival_from_tracked(found.pose, tracked)])
        test.take(view, tracked, places, found.complete, weigh)
        said.append(test.said)
    return said, test


@pytest.mark.parametrize("seed", range(40, 46))
def test_another_building_is_not_this_map(seed: int) -> None:
    """Of the five views three share little ground."""
    said, test = asked(ceiling(seed), ceiling(seed + 1000))
    assert not said[0]
    assert said[-1]
    assert test.state.times == 1


@pytest.mark.parametrize("seed", range(40, 46))
@pytest.mark.parametrize("start_off_m", [0.0, 1.2, 3.0], ids=str)
def test_the_right_map_is_never_another_wherever_the_robot_was_believed(seed: int, start_off_m: float) -> None:
    known = ceiling(seed)
    said, test = asked(known, known, start_off_m)
    assert not any(said)
    assert test.state.odds > 3.0


@pytest.mark.parametrize("seed", range(40, 46))
def test_a_ceiling_of_which_a_part_was_renovated_is_still_this_map(seed: int) -> None:
    """Nearly all of one view, and half of its neighbours, are of another ceiling."""
    known = ceiling(seed)
    said, _ = asked(known, renovated(known, ceiling(seed + 1000), 2.9))
    assert not any(said)


@pytest.mark.parametrize("seed", range(40, 46))
def test_a_place_that_was_found_beside_itself_takes_it_back_once_it_is_put_right(seed: int) -> None:
    """The robot drove over all the ground there is: no view shows any that is new."""
    known, there = ceiling(seed), np.array([1.2, 0.0, 0.0])
    weigh, ground, _ = weigher(known)
    test = NotThisMap()
    test.begin(STARTED_ELSEWHERE, ground.area_m2, 0.0)
    for beside_m in (0.07, 0.0):
        places = np.stack([np.zeros(3), there + np.array([beside_m, 0.0, 0.0])])
        for pose in WAY:
            test.take(view_of(known, pose), pose - there, places, True, weigh, likeliest=1)
        print(f"seed {seed}, {beside_m} m beside: odds {test.state.odds:.1f}")
        assert test.said == (beside_m > 0.0)
    assert test.state.times == 1


@pytest.mark.parametrize("seed", range(40, 46))
def test_where_views_were_seen_from_is_put_right_with_the_tracked_pose(seed: int) -> None:
    """The right place stays where it is while the tracked pose, which is another, is moved by 0.1 m."""
    known, there, by = ceiling(seed), np.array([1.2, 0.0, 0.0]), np.array([0.1, 0.0, 0.0])
    weigh, ground, _ = weigher(known)
    odds = []
    for told in (True, False):
        test = NotThisMap()
        test.begin(STARTED_ELSEWHERE, ground.area_m2, 0.0)
        for pose in WAY[:3]:
            test.take(view_of(known, pose), pose - there, np.stack([np.zeros(3), there]), True, weigh, likeliest=1)
        if told:
            test.put_right(WAY[2] - there, WAY[2] - there + by, weigh)
        places = np.stack([np.zeros(3), there - by])
        for pose in WAY[3:]:
            test.take(view_of(known, pose), pose - there + by, places, True, weigh, likeliest=1)
        odds.append(test.state.odds)
    print(f"seed {seed}: odds {odds[0]:.1f}, {odds[1]:.1f} if it is not told")
    assert odds[0] > 3.0
    assert odds[0] > odds[1] + 1.0


@pytest.mark.parametrize("seed", range(40, 46))
def test_a_small_doubt_does_not_settle_what_a_large_one_has_begun(seed: int) -> None:
    """A frame that is lost meanwhile: what views have said of another building is not forgotten."""
    known, seen = ceiling(seed), ceiling(seed + 1000)
    _, test = asked(known, seen)
    assert test.said
    odds = test.state.odds
    test.begin(-10.0, Coverage.of(known, 0.6).area_m2, 0.0)
    assert test.said
    assert test.state.unknown >= -odds
    _, right = asked(known, known)
    right.begin(-10.0, Coverage.of(known, 0.6).area_m2, 0.0)
    print(f"seed {seed}: {test.state.unknown:.1f} on another map, {right.state.unknown:.1f} on the right one")
    assert right.state.unknown < -3.0


def test_it_asks_no_more_once_it_was_ended() -> None:
    test = NotThisMap()
    assert not test.asks
    test.begin(STARTED_ELSEWHERE, 100.0, 0.0)
    assert test.asks
    test.end()
    assert not test.asks
    assert not test.said


def told_that_it_is_not_the_map(relocaliser: Relocaliser) -> None:
    """As after views that chance, or people, made look like no part of it."""
    asked_of = NotThisMap()
    asked_of.begin(SAID, relocaliser.state.survey.coverage.area_m2, 0.0)
    state = relocaliser.state
    state.not_this_map = replace(asked_of.state, said=True, odds=-SAID)
    relocaliser.state = state


@pytest.mark.parametrize("seed", [40, 42])
def test_while_it_is_said_no_place_is_believed_and_when_views_take_it_back_the_right_one_is(seed: int) -> None:
    """A robot that stands where it was stored, and would be TRACKING within a second."""
    print(f"seed {seed}")
    world = make_world(WorldSpec("5", 0.6, "raster", seed))
    drive = drive_in(world, np.random.default_rng(seed), False, 10.0, False, 0.5)
    load_known(drive, world, np.random.default_rng(seed))
    drive.tick()
    assert not drive.pipeline.relocaliser.sure
    told_that_it_is_not_the_map(drive.pipeline.relocaliser)
    for _ in range(10):
        estimate = drive.tick()
        assert estimate is not None
        assert estimate.state is State.RELOCALISING
        assert estimate.reason.startswith(NOT_THIS_MAP)
        assert drive.estimator.elsewhere() > 0.9  # what a restart is told
    assert drive.settle(40.0)
    assert drive.estimate is not None
    assert np.hypot(*se2.between(drive.pose, np.asarray(drive.estimate.pose))[:2]) < 0.05
    assert not drive.pipeline.relocaliser.state.not_this_map.said
    assert drive.estimator.elsewhere() < 1e-4
