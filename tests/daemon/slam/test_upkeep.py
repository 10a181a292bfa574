"""What views teach a map of what is there: counts, and landmarks that fade."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from ceilvo.config import Filter
from ceilvo.crossing_types import JOINTS
from ceilvo.daemon.relocalisation.filters import make_filter
from ceilvo.daemon.slam import upkeep
from ceilvo.daemon.slam.joint_map import JointMap
from ceilvo.daemon.slam.pose_filter import PoseFilter
from ceilvo.se2 import inverse, transform
from ceilvo.types import NO_LANDMARK, Array, Displacement, Ints, Landmarks, Motion, Observations

SEED = 17
SQUARE = np.array([[-1.5, -1.0], [1.5, -1.0], [1.5, 1.0], [-1.5, 1.0]])
GRID = np.stack(np.meshgrid(np.arange(-4, 5) * 0.6, np.arange(-3, 4) * 0.6), -1).reshape(-1, 2)
TYPES = np.arange(len(GRID)) % 9
STEP_M = 0.06


def map_of(xy: Array, seen: int = 10_000, kind: Ints | None = None) -> Landmarks:
    n = len(xy)
    kind = TYPES if kind is None else kind
    return Landmarks(np.arange(n), xy, np.tile(1e-6 * np.eye(2), (n, 1, 1)), kind, np.full(n, seen))


class Robot:
    """Drives to and fro below landmarks and sees those of the world that are in view, each with its own chance."""

    def __init__(self, known: Landmarks, method: str = "joint") -> None:
        settings = replace(Filter(), method=method, feature_independence=1.0, slip_per_m=0.0)
        self.filter: PoseFilter = make_filter(settings, np.random.default_rng(SEED))
        self.filter.reset(np.zeros(3), np.diag([1e-8, 1e-8, 1e-8]), known)
        self.rng = np.random.default_rng(SEED)
        self.pose = np.zeros(3)

    def look(self, world: Landmarks, chance: float = 1.0, visible: Array = SQUARE) -> None:
        at = transform(inverse(self.pose), world.xy_map_m)
        seen = upkeep.inside(SQUARE, at) & (self.rng.random(len(at)) < chance)
        xy = at[seen] + 1e-3 * self.rng.standard_normal((np.count_nonzero(seen), 2))
        labels, near = self.filter.landmarks_near(world.xy_map_m, 0.0)
        apart = np.hypot(*(world.xy_map_m[seen][:, None] - near.xy_map_m[None]).transpose(2, 0, 1))
        apart[world.crossing_type[seen][:, None] != near.crossing_type] = np.inf
        nearest = np.argmin(apart, axis=1)
        label = np.where(np.min(apart, axis=1, initial=np.inf) < 0.2, labels[nearest], NO_LANDMARK)
        variance = np.full((len(xy), 2), 1e-6)
        self.filter.update(Observations(xy, variance, world.crossing_type[seen], label, 0.0, 1e-6, visible_m=visible))

    def drive(self, step_m: float) -> None:
        self.pose = self.pose + np.array([step_m, 0.0, 0.0])
        self.filter.predict(Motion(Displacement(np.array([step_m, 0.0, 0.0])), np.diag([1e-8] * 3), 20, 0.0))

    def ids(self) -> set[int]:
        return set(self.filter.landmarks().ids.tolist())


def at(xy: tuple[float, float]) -> int:
    return int(np.argmin(np.hypot(*(GRID - xy).T)))


def views_until_gone(robot: Robot, world: Landmarks, which: int, most: int, step_m: float = STEP_M) -> int:
    for i in range(most):
        robot.drive(step_m if i % 4 < 2 else -step_m)
        robot.look(world)
        if which not in robot.ids():
            return i + 1
    return most + 1


def test_what_is_in_view_is_expected_and_what_is_not_seen_there_is_counted() -> None:
    robot = Robot(map_of(GRID, seen=5))
    hidden, outside = at((0.6, 0.0)), at((2.4, 1.8))
    for _ in range(3):
        robot.look(map_of(GRID).of(np.arange(len(GRID)) != hidden))
    m = robot.filter.landmarks()
    row = {int(i): k for k, i in enumerate(m.ids)}
    assert (m.sightings[row[at((0.0, 0.0))]], m.expected[row[at((0.0, 0.0))]]) == (8, 8)
    assert (m.sightings[row[hidden]], m.expected[row[hidden]]) == (5, 8)
    assert (m.sightings[row[outside]], m.expected[row[outside]]) == (5, 5)
    assert m.visibility[row[hidden]] == pytest.approx(6 / 10)


def test_where_the_view_is_not_known_nothing_is_missed() -> None:
    robot = Robot(map_of(GRID, seen=5))
    for _ in range(3):
        robot.look(map_of(GRID).of(np.arange(len(GRID)) != at((0.6, 0.0))), visible=np.empty((0, 2)))
    m = robot.filter.landmarks()
    np.testing.assert_array_equal(m.expected, m.sightings)


@pytest.mark.parametrize(("seen", "most"), [(10_000, 20), (30, 40), (4, 120)])
def test_a_lamp_that_was_taken_away_fades_however_often_it_was_seen(seen: int, most: int) -> None:
    robot, lamp = Robot(map_of(GRID, seen)), at((0.0, 0.0))
    world = map_of(GRID).of(np.arange(len(GRID)) != lamp)
    views = views_until_gone(robot, world, lamp, most)
    print(f"seen {seen} times: gone after {views} views")
    assert 5 < views <= most
    assert robot.ids() == set(range(len(GRID))) - {lamp}
    assert robot.filter.counters()["faded"] == 1


def test_a_lamp_that_was_moved_is_learnt_where_it_is() -> None:
    """Also nearer than the association gate, where what is seen is first taken for the old one."""
    robot, lamp = Robot(map_of(GRID)), at((0.0, 0.0))
    moved = GRID.copy()
    moved[lamp] += [0.07, 0.05]
    assert views_until_gone(robot, map_of(moved), lamp, 20) <= 20
    views_until_gone(robot, map_of(moved), 0, 6)
    m = robot.filter.landmarks()
    assert len(m) == len(GRID)
    new = m.of(m.ids >= len(GRID))
    np.testing.assert_allclose(new.xy_map_m, moved[[lamp]], atol=2e-3)
    assert new.crossing_type.tolist() == [TYPES[lamp]]


def test_a_robot_that_stands_below_something_hidden_forgets_nothing() -> None:
    robot, lamp = Robot(map_of(GRID)), at((0.0, 0.0))
    world = map_of(GRID).of(np.arange(len(GRID)) != lamp)
    assert views_until_gone(robot, world, lamp, 100, step_m=0.0) == 101
    assert robot.filter.landmarks().expected[lamp] == 10_100


def test_a_dim_picture_does_not_say_that_the_room_was_emptied() -> None:
    robot = Robot(map_of(GRID))
    for i in range(60):
        robot.drive(STEP_M if i % 4 < 2 else -STEP_M)
        robot.look(map_of(GRID), chance=0.25)
    assert robot.ids() == set(range(len(GRID)))


@pytest.mark.parametrize("chance", [0.95, 0.7, 0.4])
def test_a_landmark_that_is_there_is_dropped_no_more_often_than_stated(chance: float) -> None:
    """Each view independent, which is the worst that the rule assumes nothing about."""
    n, views, rng = 100, 2000, np.random.default_rng(SEED)
    j = JointMap.at(np.zeros(3), 1e-6 * np.eye(3))
    xy = rng.uniform([-1.4, -0.9], [1.4, 0.9], (n, 2))
    j.load(map_of(xy, 40, np.zeros(n, np.int64)))
    dropped = 0
    for _ in range(views):
        seen = np.flatnonzero(rng.random(n) < chance)
        gone = upkeep.gone(j, seen, upkeep.count(j, seen, SQUARE))
        j.doubt[gone] = 0.0
        dropped += len(gone)
    allowed = upkeep.GONE_RATE * n * views
    print(f"visibility {chance}: {dropped} of {n} landmarks in {views} views, at most {allowed:.0f} expected")
    assert dropped <= allowed


def filled(most: int, known: Landmarks | None = None) -> PoseFilter:
    f = make_filter(replace(Filter(), max_landmarks=most, feature_independence=1.0), np.random.default_rng(SEED))
    f.reset(np.zeros(3), np.diag([1e-8, 1e-8, 1e-8]), known)
    return f


def look_at(f: PoseFilter, xy: Array) -> None:
    label = np.full(len(xy), NO_LANDMARK)
    labels, near = f.landmarks_near(xy, 0.1)
    for i, p in enumerate(xy):
        off = np.hypot(*(near.xy_map_m - p).T)
        label[i] = labels[np.argmin(off)] if np.min(off, initial=np.inf) < 0.1 else NO_LANDMARK
    f.update(Observations(xy, np.full((len(xy), 2), 1e-6), np.zeros(len(xy), np.int64), label, 0.0, 1e-6))


def test_a_full_map_keeps_what_it_has_and_says_that_it_learns_nothing() -> None:
    f, points = filled(20), GRID[:30]
    for _ in range(4):
        look_at(f, points[:20])
    assert (f.size(), f.counters()["map_full"]) == (20, 0)
    before = f.landmarks().ids.tolist()
    for _ in range(4):
        look_at(f, points)
    assert f.landmarks().ids.tolist() == before
    assert f.counters()["map_full"] == 40


def test_a_loaded_map_is_never_cut() -> None:
    f = filled(20, map_of(GRID))
    for _ in range(4):
        look_at(f, np.concatenate([GRID[:5], [[9.0, 9.0]]]))
    assert f.landmarks().ids.tolist() == list(range(len(GRID)))
    assert f.counters()["map_full"] == 4


def test_newborn_landmarks_give_way_to_what_is_in_view() -> None:
    """Of those that are not, the ones seen less often first."""
    f = filled(12)
    for _ in range(4):
        look_at(f, GRID[:5])
    confirmed = f.landmarks().ids.tolist()
    look_at(f, GRID[10:14])
    look_at(f, GRID[12:16])
    for _ in range(4):
        look_at(f, GRID[12:20])
    at = f.landmarks().xy_map_m
    assert set(confirmed) <= set(f.landmarks().ids.tolist())
    assert f.size() == 12
    for p in GRID[12:16]:
        assert np.min(np.hypot(*(at - p).T)) < 1e-2, "seen twice before the map was full"
    assert f.counters()["map_full"] > 0


def test_a_room_renovated_by_a_third_is_learnt_and_the_rest_stays() -> None:
    """To and fro three times, 20 views each way."""
    robot, rng = Robot(map_of(GRID)), np.random.default_rng(SEED)
    changed = rng.permutation(len(GRID))[: len(GRID) // 3]
    kind = TYPES.copy()
    kind[changed] = (kind[changed] + rng.integers(1, 9, len(changed))) % 9
    world = replace(map_of(GRID), crossing_type=kind)
    for i in range(120):
        robot.drive(STEP_M if i // 20 % 2 else -STEP_M)
        robot.look(world, chance=0.95)
    in_view = np.all(np.abs(GRID + np.array([0.6, 0.0])) < [1.4, 0.9], axis=1)
    m = robot.filter.landmarks()
    at = {(*np.round(xy, 1).tolist(), int(k)) for xy, k in zip(m.xy_map_m, m.crossing_type, strict=True)}
    old = {(*np.round(GRID[i], 1).tolist(), int(TYPES[i])) for i in changed if in_view[i]}
    new = {(*np.round(xy, 1).tolist(), int(k)) for xy, k, v in zip(GRID, kind, in_view, strict=True) if v}
    print(f"{len(old)} of {np.count_nonzero(in_view)} changed: {len(old & at)} still there, {len(new - at)} not learnt")
    assert len(old) >= 5
    assert not old & at
    assert new <= at
    assert robot.ids() >= set(range(len(GRID))) - set(changed.tolist())


def test_at_the_rim_where_misses_do_not_count_sightings_do_not_either() -> None:
    """Half of the view is shown whole: there visibility becomes what it is, and beyond it stays what it was."""
    world = map_of(GRID, seen=10)
    robot, half = Robot(world), upkeep.inside(0.5 * SQUARE, GRID)
    rim = upkeep.inside(SQUARE, GRID) & ~half
    for _ in range(200):
        robot.look(world, chance=0.6, visible=0.5 * SQUARE)
    after = robot.filter.landmarks()
    in_rim, whole = np.isin(after.ids, np.flatnonzero(rim)), np.isin(after.ids, np.flatnonzero(half))
    assert np.count_nonzero(in_rim) >= 8
    assert np.count_nonzero(whole) >= 3
    assert np.all(after.sightings[in_rim] == 10)
    assert np.all(after.expected[in_rim] == 10)
    assert np.all(np.abs(after.visibility[whole] - 0.6) < 0.15)


CORNER = at((0.6, 0.0))


def misnamed(world: Landmarks, which: int, name: int) -> Landmarks:
    kind = world.crossing_type.copy()
    kind[which] = name
    return replace(world, crossing_type=kind)


def drive_by_two_names(robot: Robot, which: int, name: int, share: float, views: int) -> list[int]:
    """To and fro below a corner that is seen by another name in so many views; the types that the map has there."""
    rng = np.random.default_rng(SEED + 1)
    world = map_of(GRID)
    for i in range(views):
        robot.drive(STEP_M if i % 8 < 4 else -STEP_M)
        robot.look(misnamed(world, which, name) if rng.random() < share else world)
    m = robot.filter.landmarks()
    here = np.hypot(*(m.xy_map_m - GRID[which]).T) < 0.02
    return sorted(m.crossing_type[here].tolist())


@pytest.mark.parametrize("learnt", [False, True])
def test_a_mistaken_name_of_a_corner_is_no_landmark(learnt: bool) -> None:
    """Nor where the map has it from before. Before, a corner of a lamp was three landmarks after three laps."""
    which, name = CORNER, 8
    known = map_of(GRID, 30)
    if learnt:
        xy, kind = np.concatenate([GRID, GRID[[which]]]), np.append(TYPES, name)
        known = map_of(xy, 30, kind)
        known = replace(known, sightings=np.append(np.full(len(GRID), 30), 4), expected=np.full(len(xy), 30))
    assert TYPES[which] not in (JOINTS, name)
    assert drive_by_two_names(Robot(known), which, name, 0.13, 150) == [TYPES[which]]


def test_a_corner_that_is_another_one_since_is_learnt_though_the_old_one_was_seen_often() -> None:
    which, name = CORNER, 8
    assert drive_by_two_names(Robot(map_of(GRID, 1000)), which, name, 1.0, 60) == [name]


def test_two_names_that_are_seen_about_as_often_are_both_kept() -> None:
    which, name = CORNER, 8
    assert drive_by_two_names(Robot(map_of(GRID, 30)), which, name, 0.5, 150) == sorted([TYPES[which], name])


def test_a_crossing_that_showed_three_times_by_chance_is_forgotten_within_a_lap() -> None:
    robot = Robot(map_of(np.concatenate([GRID, [[0.3, 0.3]]]), 30, np.append(TYPES, 4)))
    learnt = robot.filter.landmarks()
    robot.filter.reset(
        robot.pose,
        1e-8 * np.eye(3),
        replace(learnt, sightings=np.append(learnt.sightings[:-1], 3), expected=np.empty(0, np.int64)),
    )
    views = views_until_gone(robot, map_of(GRID), len(GRID), 60)
    print(f"gone after {views} views")
    assert 10 < views <= 60


def test_a_robot_that_stands_below_something_hidden_does_not_take_it_for_chance() -> None:
    robot, lamp = Robot(map_of(GRID, 20)), at((0.0, 0.0))
    world = map_of(GRID).of(np.arange(len(GRID)) != lamp)
    assert views_until_gone(robot, world, lamp, 1000, step_m=0.0) == 1001
    assert views_until_gone(robot, map_of(GRID), lamp, 40) == 41
