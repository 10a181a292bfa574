"""Floors side by side: geometry there and back, ids, where transitions lead, and rides of a simulated robot."""

from __future__ import annotations

import json

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ceilvo.bench.place.rides import WAYS, ride
from ceilvo.config import Config
from ceilvo.daemon.app.estimator import Estimator
from ceilvo.daemon.map.kept.change import unmoved
from ceilvo.daemon.map.map_file import StoredMap
from ceilvo.daemon.pipeline import Pipeline
from ceilvo.daemon.relocalisation.floor_tracker import AT_M, LEFT_M, FloorTracker, FloorTrackerState
from ceilvo.daemon.relocalisation.floors import APART_M, FloorMap, Floors, Transition, side_by_side
from ceilvo.daemon.replay.inputs import LoadMap, SetPose, input_json, read_input
from ceilvo.errors import CeilvoError
from ceilvo.se2 import compose, transform, wrap
from ceilvo.sim.rig import simulated_calibration
from ceilvo.types import Array, Landmarks, Pose

SEED = 11
angles = st.floats(-3.1, 3.1)
metres = st.floats(-300.0, 300.0)
poses = st.tuples(metres, metres, angles).map(np.array)


def landmarks(seed: int, count: int, at: Array) -> Landmarks:
    """Anywhere in a hall that lies at (3,) in its map; ids with gaps."""
    rng = np.random.default_rng([SEED, seed])
    xy = transform(Pose(at), rng.uniform(0.0, [40.0, 30.0], (count, 2)))
    root = 0.01 * rng.standard_normal((count, 2, 2))
    ids = np.sort(rng.permutation(3 * count)[:count])
    return Landmarks(
        ids, xy, root @ np.swapaxes(root, 1, 2) + 1e-6 * np.eye(2), rng.integers(0, 9, count), np.arange(1, count + 1)
    )


def building(first: Array, second: Array) -> tuple[list[FloorMap], Landmarks, Floors]:
    """Two floors one above the other; (3,) each is how the building lies in its map."""
    lift = np.array([10.0, 5.0, 0.4])
    ends = [Transition("north", "lift", *compose(by, lift)) for by in (first, second)]
    maps = [
        FloorMap(name, landmarks(k, 50 + k, by), float(by[2]) + 0.1, (end,))
        for k, (name, by, end) in enumerate(zip(("ground", "first"), (first, second), ends, strict=True))
    ]
    return maps, *side_by_side(maps)


@given(poses, poses, poses)
def test_a_pose_and_its_covariance_come_back_from_the_frame(first: Array, second: Array, pose: Array) -> None:
    maps, _, floors = building(first, second)
    root = np.array([[0.1, 0.0, 0.0], [0.05, 0.2, 0.0], [0.01, 0.02, 0.03]])
    cov = root @ root.T
    for m, by in zip(maps, (first, second), strict=True):
        on_floor = np.asarray(compose(by, np.array([*(0.05 * pose[:2] + 20.0), pose[2]])))
        there, cov_there = floors.in_frame(m.name, on_floor, cov)
        name, back, cov_back = floors.on_floor(there, cov_there)
        assert name == m.name
        assert np.max(np.abs(back[:2] - on_floor[:2])) < 1e-9
        assert abs(wrap(float(back[2] - on_floor[2]))) < 1e-9
        assert np.max(np.abs(cov_back - cov)) < 1e-12


@given(poses, poses)
def test_landmarks_come_back_from_the_frame_and_lie_apart_with_one_axis(first: Array, second: Array) -> None:
    maps, whole, floors = building(first, second)
    assert len(np.unique(whole.ids)) == len(whole) == sum(len(m.landmarks) for m in maps)
    for m in maps:
        back = floors.landmarks_on(m.name, whole)
        for column in ("ids", "crossing_type", "sightings", "expected"):
            assert np.array_equal(getattr(back, column), getattr(m.landmarks, column)), column
        assert np.max(np.abs(back.xy_map_m - m.landmarks.xy_map_m)) < 1e-9
        settled = unmoved(back, m.landmarks)
        assert np.array_equal(settled.xy_map_m, m.landmarks.xy_map_m), "to the last bit"
        assert np.array_equal(settled.cov_m2, m.landmarks.cov_m2)
        assert abs(wrap(floors.axis_on(m.name, maps[0].axis_rad) - m.axis_rad)) < 1e-9
    ground = whole.xy_map_m[: len(maps[0].landmarks)]
    assert np.min(whole.xy_map_m[len(ground) :, 0]) - np.max(ground[:, 0]) >= APART_M - 1e-6
    assert np.array_equal(ground, maps[0].landmarks.xy_map_m), "the home floor is as it is"


def test_landmarks_that_moved_stay_moved() -> None:
    before = landmarks(1, 20, np.zeros(3))
    moved = Landmarks(
        before.ids, before.xy_map_m + np.where(np.arange(20)[:, None] < 10, 1e-6, 1e-12), before.cov_m2,
        before.crossing_type, before.sightings,
    )  # fmt: skip
    out = unmoved(moved, before)
    assert np.array_equal(out.xy_map_m[:10], moved.xy_map_m[:10])
    assert np.array_equal(out.xy_map_m[10:], before.xy_map_m[10:])


def test_new_landmarks_get_ids_of_their_floor_that_none_had() -> None:
    maps, whole, floors = building(np.zeros(3), np.array([5.0, -3.0, 1.0]))
    top = int(np.max(whole.ids)) + 1
    there, _ = floors.in_frame("first", np.array([9.0, 0.0, 0.0]), np.eye(3))
    at = {"ground": np.array([3.0, 3.0]), "first": np.asarray(there[:2])}
    for k, (name, xy) in enumerate(at.items()):
        new = Landmarks(np.array([top + k]), xy[None], 1e-4 * np.eye(2)[None], np.array([4]), np.array([1]))
        columns = ("ids", "xy_map_m", "cov_m2", "crossing_type", "sightings", "expected")
        both = Landmarks(*(np.concatenate([getattr(whole, c), getattr(new, c)]) for c in columns))
        here = floors.landmarks_on(name, both)
        known = next(m.landmarks.ids for m in maps if m.name == name)
        assert len(here) == len(known) + 1 and len(np.unique(here.ids)) == len(here)
        assert set(known) < set(here.ids.tolist())


@given(poses, poses, st.floats(-0.9, 0.9), st.floats(-0.9, 0.9), angles)
def test_a_transition_leads_to_the_same_place_of_the_building(
    first: Array, second: Array, dx: float, dy: float, turn: float
) -> None:
    _, _, floors = building(first, second)
    robot = np.array([10.0 + dx, 5.0 + dy, turn])
    here, _ = floors.in_frame("ground", np.asarray(compose(first, robot)), np.eye(3))
    at = floors.transition_at(here, 2.0)
    assert at is not None and at.name == "north"
    (lead,) = floors.leads(at, here)
    name, out, _ = floors.on_floor(np.asarray(compose(lead, here)), np.eye(3))
    wanted = compose(second, robot)
    assert name == "first"
    assert np.max(np.abs(out[:2] - wanted[:2])) < 1e-6
    assert abs(wrap(float(out[2] - wanted[2]))) < 1e-9


def test_a_doubt_comes_when_a_robot_leaves_a_transition_and_where_vision_came_back_in_it() -> None:
    _, _, floors = building(np.zeros(3), np.array([5.0, -3.0, 1.0]))
    tracker = FloorTracker()
    tracker.state = FloorTrackerState(floors)
    way = [(3.0, False, False), (3.0, True, False), (0.5 * AT_M, False, False), (0.5 * AT_M, True, True)]
    way += [(0.5 * (AT_M + LEFT_M), False, False), (1.1 * LEFT_M, False, True), (2.0 * LEFT_M, True, False)]
    for off_m, gap, wanted in way:
        doubt = tracker.step(np.array([10.0 + off_m, 5.0, 0.0]), gap)
        assert (doubt is not None) == wanted, (off_m, gap)
        if doubt is not None:
            assert "lift north" in doubt.reason and len(doubt.leads) == 1


def test_a_transition_that_leads_nowhere_raises_no_doubt() -> None:
    first, second = (FloorMap(n, landmarks(k, 9, np.zeros(3)), 0.0, (Transition(f"to {n}", "lift", 1.0, 1.0, 0.0),))
                     for k, n in enumerate(("a", "b")))  # fmt: skip
    _, floors = side_by_side([first, second])
    tracker = FloorTracker()
    tracker.state = FloorTrackerState(floors)
    assert tracker.step(np.array([1.0, 1.0, 0.0]), True) is None
    assert tracker.step(np.array([9.0, 1.0, 0.0]), False) is None


def test_one_map_is_left_as_it_is() -> None:
    only = FloorMap("", landmarks(0, 9, np.zeros(3)), 0.3)
    whole, floors = side_by_side([only])
    assert whole is only.landmarks and not floors
    pose, cov = Pose(np.array([1.0, 2.0, 3.0])), np.eye(3)
    assert floors.on_floor(pose, cov)[1] is pose
    assert floors.landmarks_on("", whole) is whole


def test_floors_are_recorded_to_the_last_bit() -> None:
    maps, whole, floors = building(np.array([1.0, 2.0, 0.3]), np.array([5.0, -3.0, 1.0]))
    given_ = LoadMap(whole, maps[0].axis_rad, Pose(np.zeros(3)), np.eye(3), floors=floors)
    number, back = read_input(input_json(given_, 7), lambda seq, stamp: pytest.fail("no frame in it"))
    assert number == 7 and isinstance(back, LoadMap)
    assert [f.name for f in back.floors.floors] == ["ground", "first"]
    for a, b in zip(floors.floors, back.floors.floors, strict=True):
        assert np.array_equal(a.frame_from_floor, b.frame_from_floor)
        assert (a.begins_x_m, a.first_id, a.ids, a.transitions) == (b.begins_x_m, b.first_id, b.ids, b.transitions)
    said = SetPose(Pose(np.zeros(3)), np.eye(3), "told", "first")
    assert json.loads(input_json(said, 8))["floor"] == "first"
    again = read_input(input_json(said, 8), lambda seq, stamp: pytest.fail("no frame in it"))[1]
    assert isinstance(again, SetPose) and again.floor == "first"


@pytest.mark.parametrize("number", [0, 1])
def test_after_a_ride_the_robot_finds_out_which_floor_it_is_on(number: int) -> None:
    """In a lift, and by a ramp; never sure of the wrong floor."""
    r = ride(SEED, number)
    print(f"seed {SEED} number {number}: {r['way']}, found after {r['found_s']} s, {r['found_m']} m")
    assert r["way"] == WAYS[number]
    assert r["settled"] and r["found"]
    assert r["run"]["state_s"].get("RELOCALISING", 0.0) > 0.0, "it says that it does not know"
    assert not r["run"]["wrong_s"].get("TRACKING")


def test_a_pose_can_be_given_on_any_floor_of_the_map() -> None:
    maps, whole, floors = building(np.zeros(3), np.array([5.0, -3.0, 1.0]))
    pipeline = Pipeline(simulated_calibration(tile_m=0.6), Config(), np.random.default_rng(SEED))
    estimator = Estimator(pipeline, lambda: 10**9)
    estimator.load_map(StoredMap(whole, maps[0].axis_rad), None, floors)
    assert estimator.floors() == ("ground", "first") and estimator.floor == "ground"
    pose, sigma = Pose(np.array([8.0, 4.0, 0.7])), np.array([0.1, 0.1, 0.05])
    estimator.set_pose(pose, sigma, "told", "first")
    assert estimator.floor == "first"
    there, cov, _ = pipeline.filter.estimate()
    name, back, cov_back = floors.on_floor(there, cov)
    assert name == "first" and np.max(np.abs(back - pose)) < 1e-3
    assert np.max(np.abs(cov_back - np.diag(sigma**2))) < 1e-3
    estimator.set_pose(pose, sigma, "told")
    assert estimator.floor == "first", "the one that it is on"
    with pytest.raises(CeilvoError, match=r"map_id: found 'attic', expected a floor .*'ground', 'first'"):
        estimator.set_pose(pose, sigma, "told", "attic")
    assert len(estimator.map_on("first")[0]) == len(maps[1].landmarks)
    assert len(estimator.display().landmarks) == len(maps[1].landmarks)
    estimator.reset(keep_map=True)
    assert estimator.floor == "ground", "the configured pose is on the home floor"
    estimator.reset(keep_map=False)
    assert estimator.floors() == () and estimator.floor == ""
