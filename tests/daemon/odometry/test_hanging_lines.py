"""All lines hang below the calibrated height: fixtures on the ceiling move past slower and say so.

Independent truth: what is at a height is seen where a straight line through it from the camera meets the calibrated
plane.
"""

from dataclasses import replace

import numpy as np
import pytest
from drawn_crossings import crossings_at
from hypothesis import given, settings
from hypothesis import strategies as st

from ceilvo import se2
from ceilvo.calibration import LEVEL_CEILING
from ceilvo.config import Config, Features, Odometry
from ceilvo.crossing_types import JOINTS
from ceilvo.daemon.odometry.heights.odometry import HeightsOdometry
from ceilvo.daemon.odometry.points.fixtures import part_of_way
from ceilvo.daemon.pipeline import Pipeline
from ceilvo.daemon.replay.snapshot import freeze, restore, snapshot_json
from ceilvo.daemon.vision.finder.crossing_finder import CrossingFinder
from ceilvo.sim.ceiling.spec import CeilingSpec
from ceilvo.sim.rig import simulated_calibration
from ceilvo.sim.world import World, WorldSpec
from ceilvo.types import Array, CeilingLines, Crossings, Frame

STEP_S = 1.0 / 30.0
MOVE = np.array([0.02, 0.0, 0.002])
VIEW_M = 1.6
GRID = np.arange(-6.0, 12.1, 0.6)
CALIBRATION = simulated_calibration()


class Hall:
    """A grid of lines at one height, fixtures at another, both as a robot that knows neither sees them."""

    def __init__(self, lines_low_m: float, fixtures_low_m: float, fixtures: int, seed: int) -> None:
        print(f"seed {seed}")
        height = CALIBRATION.ceiling_height_m
        self._near = [height / (height - low) for low in (lines_low_m, fixtures_low_m)]
        self._rng = np.random.default_rng(seed)
        every = int(fixtures * (18.0 / (2.0 * VIEW_M)) ** 2)
        self._fixtures = self._rng.uniform(-6.0, 12.0, (every, 2))

    def _seen(self, at: Array, pose: Array, near: float) -> Array:
        camera = se2.transform(pose, CALIBRATION.mount_xy_m[None])[0]
        return np.asarray(se2.transform(se2.inverse(pose), camera + near * (at - camera)))

    def seen(self, pose: Array) -> Crossings:
        tiles = np.stack(np.meshgrid(GRID, GRID), -1).reshape(-1, 2)
        xy, vents = self._seen(tiles, pose, self._near[0]), self._seen(self._fixtures, pose, self._near[1])
        xy, vents = (v[np.max(np.abs(v), axis=1) < VIEW_M] for v in (xy, vents))
        xy = xy + self._rng.normal(0.0, 3e-4, xy.shape)
        view = crossings_at(xy, JOINTS, 3e-4, float(-pose[2]), 1e-4)
        lines = CeilingLines(np.zeros(0, np.int64), np.zeros(0), np.zeros(0), np.zeros(0, np.int64))
        return replace(view, lines=lines, fixtures_m=vents + self._rng.normal(0.0, 1e-3, vents.shape))


def _drive(hall: Hall, frames: int = 45) -> tuple[HeightsOdometry, float, list[str]]:
    """The odometry, by how much the last ten motions are too long, and what was said frame by frame."""
    odometry, pose, said, moved = HeightsOdometry(Odometry(), CALIBRATION), np.zeros(3), [], 0.0
    for k in range(frames):
        view = hall.seen(pose)
        if not odometry.wants_fixtures:
            view = replace(view, fixtures_m=None)
        placed = odometry.placed(view, odometry.expected(STEP_S))
        motion = odometry.step(placed, STEP_S)
        odometry.learn(motion, placed)
        said.append(odometry.suspicion)
        moved += float(np.hypot(*motion.prev_from_curr[:2])) if k >= frames - 10 else 0.0
        pose = se2.compose(pose, MOVE)
    return odometry, moved / (10.0 * float(np.hypot(*MOVE[:2]))), said


@pytest.mark.parametrize(("low_m", "seed"), [(0.2, 1), (0.4, 2), (0.6, 3), (0.9, 4)])
def test_lines_that_all_hang_lower_are_known_to_after_a_few_decimetres(low_m: float, seed: int) -> None:
    odometry, too_long, said = _drive(Hall(low_m, 0.0, 10, seed))
    first = next(k for k, text in enumerate(said) if text)
    drops = odometry.heights.drops_m
    print(f"{low_m} m: said after {first} frames of 2 cm, {drops}, way {too_long:.3f} times the true one")
    assert first <= 15
    assert len(drops) == 1 and abs(drops[0] - low_m) < 0.05
    assert abs(too_long - 1.0) < 0.03, "it was as much too long as the lines are nearer"
    assert "calibrat" in said[-1]


@pytest.mark.parametrize("seed", [5, 6, 7])
@pytest.mark.parametrize(("low_m", "fixtures"), [(0.0, 20), (0.3, 20), (0.0, 0)])
def test_fixtures_at_the_lines_height_or_lower_say_nothing(low_m: float, fixtures: int, seed: int) -> None:
    odometry, too_long, said = _drive(Hall(0.0, low_m, fixtures, seed))
    assert not any(said) and not odometry.heights.several
    assert abs(too_long - 1.0) < 0.01


def test_a_look_that_finds_nothing_is_a_look() -> None:
    odometry, pose, looks, hall = HeightsOdometry(Odometry(), CALIBRATION), np.zeros(3), 0, Hall(0.0, 0.0, 0, 10)
    for _ in range(100):
        wanted = odometry.wants_fixtures
        view = hall.seen(pose) if wanted else replace(hall.seen(pose), fixtures_m=None)
        placed = odometry.placed(view, odometry.expected(STEP_S))
        odometry.learn(odometry.step(placed, STEP_S), placed)
        pose, looks = se2.compose(pose, MOVE), looks + wanted
    print(f"{looks} looks in 2 m")
    assert 1 <= looks <= 4


def test_nothing_is_said_any_more_once_lines_tell_heights_or_a_map_is_loaded() -> None:
    odometry, _, said = _drive(Hall(0.4, 0.0, 10, 11))
    assert said[-1]
    odometry.know(LEVEL_CEILING, np.zeros(3))
    assert not odometry.suspicion
    odometry.state.fixtures.slower = 0.2
    assert odometry.suspicion
    odometry.heights.state.levels.found(1.2, 0.01)
    placed = odometry.placed(None, None)
    odometry.learn(odometry.step(placed, STEP_S), placed)
    assert "slower" not in odometry.suspicion


def test_three_fixtures_are_too_few_to_found_a_height() -> None:
    assert not _drive(Hall(0.4, 0.0, 2, 8))[0].heights.several


@settings(max_examples=60, deadline=None)
@given(
    part=st.floats(0.08, 0.45),
    heading=st.floats(-3.1, 3.1),
    way_m=st.floats(0.13, 0.55),
    others=st.integers(0, 4),
    seed=st.integers(0, 1000),
)
def test_the_part_is_found_whatever_the_way_and_some_others(
    part: float, heading: float, way_m: float, others: int, seed: int
) -> None:
    rng = np.random.default_rng(seed)
    way = way_m * np.array([np.cos(heading), np.sin(heading)])
    before = rng.uniform(-2.0, 2.0, (8 + others, 2))
    moved = np.where(np.arange(len(before)) < 8, part, 0.0)[:, None] * way
    now = rng.permutation(before + moved + rng.normal(0.0, 5e-4, before.shape))
    assert abs(part_of_way(before, now, way) - part) < 0.02


@settings(max_examples=60, deadline=None)
@given(heading=st.floats(-3.1, 3.1), way_m=st.floats(0.13, 0.55), seed=st.integers(0, 1000))
def test_fixtures_that_do_not_move_with_the_camera_or_are_others_say_nothing(
    heading: float, way_m: float, seed: int
) -> None:
    rng = np.random.default_rng(seed)
    way = way_m * np.array([np.cos(heading), np.sin(heading)])
    before = rng.uniform(-2.0, 2.0, (20, 2))
    assert part_of_way(before, before + rng.normal(0.0, 1e-3, before.shape), way) == 0.0
    assert part_of_way(before[:6], rng.uniform(-2.0, 2.0, (6, 2)), way) == 0.0


@pytest.mark.parametrize("seed", [11, 12])
def test_fixtures_are_what_a_ceiling_shows_beside_its_lines(seed: int) -> None:
    print(f"seed {seed}")
    ceiling = CeilingSpec(lamp_every=(4, 3), vents=12, spots=40)
    world = World(WorldSpec(seed=seed, ceiling=ceiling), CALIBRATION)
    world.start(0)
    finder, frame = CrossingFinder(CALIBRATION, Features()), Frame(0, 10**9, world.frame_at(1.0))
    without = finder(frame, None)
    seen = CrossingFinder(CALIBRATION, Features())(frame, None, fixtures=True)
    assert seen is not None and seen.fixtures_m is not None
    assert without is not None and without.fixtures_m is None
    joints = seen.xy_base_m[seen.crossing_type == JOINTS]
    apart = np.hypot(*(seen.fixtures_m[:, None] - joints).transpose(2, 0, 1))
    print(f"{len(seen.fixtures_m)} fixtures, {1e3 * apart.min():.0f} mm from a crossing of joints at least")
    assert len(seen.fixtures_m) >= 3
    assert apart.min() > 0.015
    np.testing.assert_array_equal(seen.xy_base_m, without.xy_base_m)


def test_what_was_seen_of_fixtures_goes_with_a_snapshot_and_older_ones_are_read() -> None:
    pipeline, hall = Pipeline(CALIBRATION, Config(), np.random.default_rng(0)), Hall(0.4, 0.0, 10, 9)
    for k in range(5):
        pipeline.step_crossings(10**9 + round(k * STEP_S * 1e9), hall.seen(k * MOVE))
    tree = snapshot_json(freeze(pipeline), "pfcf")
    again = Pipeline(CALIBRATION, Config(), np.random.default_rng(0))
    restore(again, tree)
    kept, read = pipeline.odometry.state.fixtures, again.odometry.state.fixtures
    assert len(kept.at)
    np.testing.assert_array_equal(read.at, kept.at)
    del tree["state"]["odometry"]["fixtures"]
    restore(again, tree)
    assert not len(again.odometry.state.fixtures.at)
