"""Mirror images of lights slide over the ceiling, and are no part of it.

Independent truth: an image is where a straight line from the camera to the light's mirror image meets the ceiling.
"""

import numpy as np
import pytest
from drawn_crossings import crossings_at
from hypothesis import given, settings
from hypothesis import strategies as st

from ceilvo import se2
from ceilvo.calibration import Calibration
from ceilvo.config import Config, Odometry
from ceilvo.crossing_types import CORNER, JOINTS, LAMP
from ceilvo.daemon.odometry.heights.odometry import HeightsOdometry
from ceilvo.daemon.pipeline import Pipeline
from ceilvo.daemon.replay.snapshot import freeze, restore, snapshot_json
from ceilvo.sim.rig import simulated_calibration, simulated_camera
from ceilvo.types import Array, Crossings, Ints, Motion

STEP_S = 1.0 / 30.0
SIGMA_M = 0.0005
VIEW_M = 1.6
COARSE = 12.0
"""Places are 6 mm off: a quarter of a pixel of a fisheye 4.5 m below."""
STANDS = 45
"""Frames before the robot drives off."""
BEND = np.array([0.0166, 0.0, 0.004])
"""0.5 m/s round a bend of 4 m: where points alone tell, glints were 6 mm a frame off, within what a point may be."""
LIGHTS = np.stack(np.meshgrid(np.arange(-6.0, 7.0, 1.1), np.arange(-6.0, 7.0, 1.1)), -1).reshape(-1, 2)


class Room:
    """What a robot sees at a pose: what is on the ceiling, and the images of lights so far below it."""

    def __init__(
        self,
        calibration: Calibration,
        at: Array,
        kind: Ints,
        lights: Array,
        below_m: float,
        seed: int,
        coarse: float = 1.0,
    ) -> None:
        """coarse: how many times further off features are than a usual camera has them, and as far in view."""
        print(f"seed {seed}")
        self._calibration, self._rng, self._coarse = calibration, np.random.default_rng(seed), coarse
        self._at, self._kind, self._lights, self._below_m = at, kind, lights, below_m

    def seen(self, pose: Array) -> tuple[Crossings, Array]:
        """Features, and (N,) whether each is an image."""
        height, mount = self._calibration.ceiling_height_m, self._calibration.mount_xy_m
        camera = se2.transform(pose, mount[None])[0]
        # seen from the camera the mirrored light is height + below_m up
        images = camera + (self._lights - camera) * height / (height + self._below_m)
        at = np.concatenate([self._at, images])
        kind = np.concatenate([self._kind, np.full(len(images), LAMP)])
        near = np.max(np.abs(at - camera), axis=1) < VIEW_M * self._coarse
        xy, sigma_m = se2.transform(se2.inverse(pose), at[near]), SIGMA_M * self._coarse
        xy = xy + self._rng.normal(0.0, sigma_m, xy.shape)
        return crossings_at(xy, kind[near], sigma_m), (np.arange(len(at)) >= len(self._at))[near]


def _step(odometry: HeightsOdometry, crossings: Crossings) -> tuple[Motion, Crossings]:
    expected = odometry.expected(STEP_S)
    placed = odometry.placed(crossings, expected)
    assert placed is not None
    motion = odometry.step(placed, STEP_S)
    odometry.learn(motion, placed)
    return motion, placed


def _drive(room: Room, calibration: Calibration, frames: int, move: Array = BEND) -> tuple[float, float]:
    """How far the added-up motions are off at most, m, and the share of images among what was used after a second."""
    odometry, pose, path = HeightsOdometry(Odometry(), calibration), np.zeros(3), np.zeros(3)
    off, used, images = 0.0, 0, 0
    for k in range(frames):
        crossings, image = room.seen(pose)
        motion, placed = _step(odometry, crossings)
        path = se2.compose(path, motion.prev_from_curr)
        off = max(off, float(np.hypot(*(path - pose)[:2])))
        if k > STANDS + 30:
            kept = np.any(np.all(crossings.xy_base_m[:, None] == placed.xy_base_m, axis=2), axis=1)
            used, images = used + int(np.count_nonzero(kept)), images + int(np.count_nonzero(kept & image))
        if k >= STANDS:
            pose = se2.compose(pose, move)
    return off, images / max(used, 1)


def _corners(seed: int, every_m: float) -> Array:
    """Places all over the room, a few in view."""
    at = np.arange(-6.0, 6.5, every_m)
    grid = np.stack(np.meshgrid(at, at), -1).reshape(-1, 2)
    return grid + np.random.default_rng(seed).uniform(-0.2 * every_m, 0.2 * every_m, grid.shape)


@pytest.mark.parametrize(
    ("seed", "kind", "every_m"), [(1, CORNER, 1.3), (2, CORNER, 1.3), (3, CORNER, 1.3), (4, LAMP, 1.2), (5, LAMP, 1.2)]
)
def test_more_images_than_corners_or_lamps_do_not_carry_the_motion(seed: int, kind: int, every_m: float) -> None:
    """Of lamps alone the images are those that move past slower."""
    calibration = simulated_calibration()
    at = _corners(seed, every_m)
    room = Room(calibration, at, np.full(len(at), kind), LIGHTS, 1.4, seed)
    off, images = _drive(room, calibration, 240)
    print(f"{1e3 * off:.1f} mm off after 4 m, {100 * images:.1f} % of what was used were images")
    assert off < 0.03
    assert images < 0.02


@pytest.mark.parametrize("seed", [18, 19, 20])
def test_images_below_a_high_ceiling_in_a_coarse_picture_are_left_out_as_well(seed: int) -> None:
    """A fisheye 4.5 m below, 22 mm of ceiling in a pixel: places are four times as far off and more."""
    calibration = simulated_calibration(simulated_camera("fisheye"), ceiling_height_m=4.5)
    at = _corners(seed, 4.0)
    room = Room(calibration, at, np.full(len(at), CORNER), LIGHTS, 2.8, seed, COARSE)
    off, images = _drive(room, calibration, 240)
    print(f"{1e3 * off:.1f} mm off after 4 m, {100 * images:.1f} % of what was used were images")
    assert off < 0.1
    assert images < 0.05


def test_a_light_on_the_robot_is_left_out_as_well() -> None:
    calibration = simulated_calibration()
    lamps = _corners(6, 1.2)
    odometry, pose = HeightsOdometry(Odometry(), calibration), np.zeros(3)
    room = Room(calibration, lamps, np.full(len(lamps), LAMP), np.zeros((0, 2)), 1.0, 6)
    for k in range(STANDS + 90):
        crossings, _ = room.seen(pose)
        with_image = crossings_at(
            np.vstack([crossings.xy_base_m, [[0.3, 0.4]]]), np.append(crossings.crossing_type, LAMP), SIGMA_M
        )
        _, placed = _step(odometry, with_image)
        pose = se2.compose(pose, BEND) if k >= STANDS else pose
    assert not np.any(np.all(placed.xy_base_m == [0.3, 0.4], axis=1))
    assert len(placed) >= len(crossings) - 1


@settings(max_examples=15, deadline=None)
@given(
    below_m=st.floats(0.6, 2.7),
    heading=st.floats(-3.1, 3.1),
    turn=st.floats(-0.01, 0.01),
    seed=st.integers(0, 1000),
)
def test_lights_of_any_depth_and_ways_in_any_direction(below_m: float, heading: float, turn: float, seed: int) -> None:
    calibration = simulated_calibration()
    corners = _corners(seed, 0.9)
    room = Room(calibration, corners, np.full(len(corners), CORNER), LIGHTS, below_m, seed)
    move = np.array([0.0166 * np.cos(heading), 0.0166 * np.sin(heading), turn])
    off, images = _drive(room, calibration, 90, move)
    share = below_m / (calibration.ceiling_height_m + below_m)
    least = 6.0 * share * 0.0166  # five measurements tell, and until then a majority of images may carry the motion
    print(f"{below_m:.2f} m below: {1e3 * off:.1f} mm off")
    assert off < least + 0.01
    assert images < 0.05


def _leaning(calibration: Calibration, xy_base_m: Array, tilt_rad: Array) -> Array:
    """Where points of the ceiling (N, 2) seem to be to a robot that leans and does not know."""
    height, mount = calibration.ceiling_height_m, calibration.mount_xy_m
    x, y = ((xy_base_m - mount) / height).T
    a, b = tilt_rad
    depth = 1.0 - a * x - b * y
    return mount + height * np.column_stack([(x + a) / depth, (y + b) / depth])


@pytest.mark.parametrize("seed", [8, 13, 14])
@pytest.mark.parametrize("speed", [0.0, 0.2, 1.0])
@pytest.mark.parametrize(("stretched", "lean_deg"), [(1.02, 0.0), (0.98, 0.0), (1.0, 0.3), (1.0, 2.0)])
def test_nothing_slides_under_a_lens_that_is_off_or_where_the_robot_rocks(
    stretched: float, lean_deg: float, speed: float, seed: int
) -> None:
    """Two per cent of scale at the rim, or leans that nothing tells: lamps stay the ceiling's."""
    calibration = simulated_calibration()
    lamps = _corners(seed, 0.9)
    odometry, pose = HeightsOdometry(Odometry(), calibration), np.zeros(3)
    room = Room(calibration, lamps, np.full(len(lamps), LAMP), np.zeros((0, 2)), 1.0, seed)
    for k in range(200):
        crossings, _ = room.seen(pose)
        lean = np.radians(lean_deg) * np.array([np.sin(0.12 * k), np.cos(0.07 * k)])
        radius2 = np.sum(crossings.xy_base_m**2, axis=1, keepdims=True)
        lens = 1.0 + (stretched - 1.0) * radius2 / VIEW_M**2
        xy = _leaning(calibration, crossings.xy_base_m * lens, lean)
        _, placed = _step(odometry, crossings_at(xy, crossings.crossing_type, SIGMA_M))
        assert len(placed) == len(crossings), f"frame {k}"
        pose = se2.compose(pose, 2.0 * speed * BEND)


def test_a_lamp_under_a_glossy_ceiling_counts_once_it_is_known_not_to_slide() -> None:
    calibration = simulated_calibration()
    corners = _corners(9, 0.9)
    odometry, pose = HeightsOdometry(Odometry(), calibration), np.zeros(3)
    room = Room(calibration, corners, np.full(len(corners), CORNER), LIGHTS, 1.4, 9)
    for k in range(STANDS + 60):
        _step(odometry, room.seen(pose)[0])
        pose = se2.compose(pose, BEND) if k >= STANDS else pose
    assert odometry.state.sliding.glossy
    lamp, taken = se2.transform(pose, np.array([[0.5, 0.3]])), []
    for _ in range(20):
        crossings, _ = room.seen(pose)
        own = se2.transform(se2.inverse(pose), lamp)
        kinds = np.append(crossings.crossing_type, LAMP)
        _, placed = _step(odometry, crossings_at(np.vstack([crossings.xy_base_m, own]), kinds, SIGMA_M))
        taken.append(bool(np.any(np.all(placed.xy_base_m == own, axis=1))))
        pose = se2.compose(pose, BEND)
    assert not taken[0] and taken[-1], taken


@pytest.mark.parametrize("seed", [15, 16, 17])
def test_images_that_come_in_where_lines_sufficed_do_not_carry_the_motion(seed: int) -> None:
    """Blur of a bend leaves few crossings, so lamps are looked for, and more images are found than crossings."""
    calibration = simulated_calibration()
    tiles = _corners(seed, 1.2)
    odometry, pose, path = HeightsOdometry(Odometry(), calibration), np.zeros(3), np.zeros(3)
    room = Room(calibration, tiles, np.full(len(tiles), JOINTS), LIGHTS, 1.4, seed)
    for k in range(STANDS + 90):
        crossings, image = room.seen(pose)
        seen = crossings.of(~image) if k < STANDS + 30 else crossings
        motion, _ = _step(odometry, seen)
        path = se2.compose(path, motion.prev_from_curr)
        off = float(np.hypot(*(path - pose)[:2]))
        if k == STANDS + 30:
            assert np.count_nonzero(image) > np.count_nonzero(~image)
        pose = se2.compose(pose, 2.0 * BEND) if k >= STANDS else pose
    print(f"{1e3 * off:.1f} mm off after 3 m")
    assert odometry.state.sliding.glossy
    assert off < 0.01


def test_true_lamps_that_come_in_where_lines_sufficed_count_within_half_a_second() -> None:
    calibration = simulated_calibration()
    at = np.concatenate([_corners(18, 1.2), _corners(19, 0.9)])
    kind = np.repeat([JOINTS, LAMP], [len(_corners(18, 1.2)), len(_corners(19, 0.9))])
    odometry, pose = HeightsOdometry(Odometry(), calibration), np.zeros(3)
    room = Room(calibration, at, kind, np.zeros((0, 2)), 1.0, 18)
    for k in range(STANDS + 45):
        crossings, _ = room.seen(pose)
        seen = crossings.of(crossings.crossing_type == JOINTS) if k < STANDS + 30 else crossings
        _, placed = _step(odometry, seen)
        pose = se2.compose(pose, BEND) if k >= STANDS else pose
    assert len(placed) == len(crossings)


def test_crossings_of_lines_alone_are_not_followed() -> None:
    calibration = simulated_calibration()
    tiles = _corners(10, 0.6)
    odometry, pose = HeightsOdometry(Odometry(), calibration), np.zeros(3)
    room = Room(calibration, tiles, np.full(len(tiles), JOINTS), np.zeros((0, 2)), 1.0, 10)
    for _ in range(5):
        _step(odometry, room.seen(pose)[0])
        pose = se2.compose(pose, BEND)
    assert not len(odometry.state.sliding)


def test_what_is_followed_goes_with_a_snapshot_and_older_ones_are_read() -> None:
    calibration = simulated_calibration()
    corners = _corners(11, 0.9)
    room = Room(calibration, corners, np.full(len(corners), CORNER), LIGHTS, 1.4, 11)
    pipeline, pose = Pipeline(calibration, Config(), np.random.default_rng(0)), np.zeros(3)
    for k in range(STANDS + 40):
        pipeline.step_crossings(10**9 + round(k * STEP_S * 1e9), room.seen(pose)[0])
        pose = se2.compose(pose, BEND) if k >= STANDS else pose
    tree = snapshot_json(freeze(pipeline), "pfcf")
    again = Pipeline(calibration, Config(), np.random.default_rng(0))
    restore(again, tree)
    kept, read = pipeline.odometry.state.sliding, again.odometry.state.sliding
    assert kept.glossy and read.glossy and np.any(kept.slides)
    np.testing.assert_array_equal(read.sums, kept.sums)
    del tree["state"]["odometry"]["sliding"]
    restore(again, tree)
    assert not len(again.odometry.state.sliding)
