"""Where else a ceiling looks the same along a way, against a look at every place, one by one."""

from __future__ import annotations

import numpy as np
import pytest

from ceilvo.bench.place.ceiling.truth import Features, Origin, without
from ceilvo.bench.place.ceiling.twins import Twins
from ceilvo.bench.place.ceiling.worlds import Lamps, WorldSpec, make_world
from ceilvo.calibration import visible_polygon
from ceilvo.config import Features as Settings
from ceilvo.crossing_types import turned_type
from ceilvo.sim.rig import simulated_calibration
from ceilvo.types import Array

CALIBRATION = simulated_calibration(tile_m=0.6)
VIEW_M = visible_polygon(CALIBRATION, 0.0, Settings().max_view_deg)
X, Y = VIEW_M.T
RADIUS_M = np.sqrt(0.5 * abs(X @ np.roll(Y, -1) - Y @ np.roll(X, -1)) / np.pi)
"""Of a disc of the picture's area."""


def everywhere(features: Features) -> Twins:
    return Twins(features, np.ones(len(features), bool), CALIBRATION)


def way(seed: int, size_m: float, steps: int = 12) -> Array:
    """(N, 3) poses 0.3 m apart, somewhere in a room."""
    rng = np.random.default_rng(seed)
    start, heading = rng.uniform(0.3 * size_m, 0.7 * size_m, 2), rng.uniform(-np.pi, np.pi)
    ahead = 0.3 * np.arange(steps)[:, None] * np.array([np.cos(heading), np.sin(heading)])
    return np.column_stack([start + ahead, np.full(steps, heading)])


def slowly(features: Features, seen: Array, centre: Array) -> int:
    """Places that have all crossings around each of the centres (C, 2), and no others; seen: which crossings."""
    xy, kind = features.xy_map_m, features.crossing_type
    anchor, found = seen[0], []
    for turn in range(4):
        c, s = [(1, 0), (0, 1), (-1, 0), (0, -1)][turn]
        r, kinds = np.array([[c, -s], [s, c]]), turned_type(kind, -turn)
        for to in np.flatnonzero(kind == kinds[anchor]):
            moved = (xy[seen] - xy[anchor]) @ r.T + xy[to]
            apart = np.hypot(*(moved[:, None] - xy).transpose(2, 0, 1))
            has = np.all(np.any((apart < 0.05) & (kind == kinds[seen][:, None]), axis=1))
            middles = (centre - xy[anchor]) @ r.T + xy[to]
            more = [
                np.count_nonzero(np.hypot(*(xy - b).T) <= RADIUS_M)
                > np.count_nonzero(np.hypot(*(xy - a).T) <= RADIUS_M + 0.05)
                for a, b in zip(centre, middles, strict=True)
            ]
            if has and not any(more):
                found.append((turn, *moved[0]))
    places = np.array(found)
    same = np.all(np.abs(places[:, None] - places) < 0.1, axis=2)
    return len(places) - int(np.count_nonzero(np.any(np.tril(same, -1), axis=1)))


@pytest.mark.parametrize("lamps", ["raster", "sparse", "perfect"])
@pytest.mark.parametrize("seed", [3, 8])
def test_as_many_places_as_a_look_at_each_finds(lamps: Lamps, seed: int) -> None:
    world = make_world(WorldSpec("5", 0.6, lamps, seed))
    poses = way(seed, 5.0, 4)
    twins = everywhere(world.features)
    middle = VIEW_M.mean(axis=0)
    c, s = np.cos(poses[:, 2:]), np.sin(poses[:, 2:])
    centre = poses[:, :2] + np.hstack([c * middle[0] - s * middle[1], s * middle[0] + c * middle[1]])
    for n, pose in enumerate(poses):
        found = twins.passed(pose)
        apart = np.hypot(*(world.features.xy_map_m[:, None] - centre[: n + 1]).transpose(2, 0, 1))
        seen = np.flatnonzero(np.any(apart <= RADIUS_M, axis=1))
        assert found == slowly(world.features, seen, centre[: n + 1]), f"{lamps}, seed {seed}, pose {n}"


@pytest.mark.parametrize("seed", range(6))
def test_the_robots_own_place_is_always_one_and_places_only_become_fewer(seed: int) -> None:
    lamps: tuple[Lamps, ...] = ("raster", "sparse", "bare stretch")
    world = make_world(WorldSpec("20", (0.6, 1.25)[seed % 2], lamps[seed % 3], 40 + seed))
    twins, before = everywhere(world.features), np.inf
    for pose in way(seed, 20.0, 30):
        found = twins.passed(pose)
        assert found is not None and 1 <= found <= before
        before = found


def test_one_lamp_that_is_missing_tells_and_not_before_it_is_seen() -> None:
    world = make_world(WorldSpec("20", 0.6, "perfect", 5))
    f = world.features
    lamps = f.xy_map_m[f.feature_origin == Origin.LAMP]
    lamp = lamps[np.argmin(np.hypot(*(lamps - [10.0, 10.0]).T))]
    near = np.hypot(*(f.xy_map_m - lamp).T) < 1.3
    gap = without(f, np.flatnonzero(near & (f.feature_origin == Origin.LAMP)))
    ahead = np.array([[lamp[0] - 4.0 + 0.3 * n, lamp[1], 0.0] for n in range(14)])
    regular, with_gap = everywhere(f), everywhere(gap)
    found = [(regular.passed(p), with_gap.passed(p)) for p in ahead]
    assert found[0][0] is not None and found[0][0] > 4 and found[0][1] is not None and found[0][1] > 4
    assert found[-1][0] is not None and found[-1][0] > 2, "a perfect raster tells no places apart"
    assert found[-1][1] is not None and found[-1][1] <= 2, "but for half a turn about the gap"


def test_a_robot_that_was_carried_is_not_far() -> None:
    world = make_world(WorldSpec("60", 0.6, "perfect", 5))
    start = way(1, 60.0, 1)[0]
    known = np.ones(len(world.features), bool)
    near, far = (Twins(world.features, known, CALIBRATION, m).passed(start) for m in (10.0, np.inf))
    assert near is not None and far is not None and 1 < near < far / 4
