"""A ceiling that slopes, drawn by hand: where the stage puts its crossings against where they are over the floor."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
import pytest
from drawn_crossings import crossings_at

from ceilvo import se2
from ceilvo.crossing_types import crossing_type_of
from ceilvo.daemon.odometry.heights.similarity import of_views
from ceilvo.daemon.odometry.heights.slope import HEIGHT_UNKNOWN, Slope
from ceilvo.daemon.odometry.heights.tiles import seen_high
from ceilvo.sim.rig import simulated_calibration
from ceilvo.types import Array, Crossings, Displacement, Motion

CALIBRATION = simulated_calibration()
HIGH_M = CALIBRATION.ceiling_height_m
MOUNT = CALIBRATION.mount_xy_m
TILE_M, REACH_M, NOISE_M = 0.6, 1.3, 0.0002
SEED = 5
STEEP = float(np.tan(np.radians(5.0)))
NO_SIZE = simulated_calibration(tile_m=None)


@dataclass(frozen=True)
class Room:
    """A tiled ceiling over the floor, and a robot in it.

    Attributes:
        rise: (2,) of the ceiling in a metre of map; high_m: above the map's origin.
        lean: (2,) of the robot, as a rise in base that looks the same.
    """

    rise: Array
    high_m: float = HIGH_M
    lean: Array = field(default_factory=lambda: np.zeros(2))

    def seen(self, pose: Array, rng: np.random.Generator) -> tuple[Crossings, Array]:
        """What the joint fit makes of a view from a pose (3,), and where that is over the floor, in base."""
        camera = se2.transform(pose, MOUNT[None])[0]
        k = np.arange(-20, 21) * TILE_M
        grid = np.column_stack([v.ravel() for v in np.meshgrid(k, k)])
        over_m = self.high_m + grid @ self.rise
        ray = (grid - camera) @ se2.rotation(float(pose[2])) / over_m[:, None]
        near = np.max(np.abs(ray), axis=1) < REACH_M / HIGH_M
        ray, true = ray[near], se2.transform(se2.inverse(pose), grid[near])
        tilt = self.rise @ se2.rotation(float(pose[2])) + self.lean
        # the robot's lean turns rays away, the fit turns all back that looks like a tilt
        fitted = _turned(ray, _back(tilt) @ np.linalg.inv(_back(self.lean)))
        level = fitted * HIGH_M + rng.normal(0.0, NOISE_M, ray.shape)
        groove = np.zeros(len(ray), np.int64)
        psi_rad, tilt_rad = float(se2.wrap(-float(pose[2]))), np.array([-tilt[1], tilt[0]])
        crossings = crossings_at(
            MOUNT + level, crossing_type_of(groove, groove), 1e-3, psi_rad, 1e-4, tilt_rad=tilt_rad
        )
        return crossings, true


def _back(rise: Array) -> Array:
    """(3, 3) by which kernel.project() turns rays (x, y, 1) back that a rise of (2,) seems to tilt."""
    x, y = rise.tolist()
    return np.array([[1.0, 0.0, x], [0.0, 1.0, y], [-x, -y, 1.0]])


def _turned(ray: Array, by: Array) -> Array:
    """(N, 2) rays (x, y, 1) under (3, 3)."""
    turned = np.column_stack([ray, np.ones(len(ray))]) @ by.T
    return np.asarray(turned[:, :2] / turned[:, 2:])


def drive(slope: Slope, room: Room, poses: list[Array], several: bool = False) -> list[float]:
    """Largest error of a crossing in each frame, m."""
    rng = np.random.default_rng(SEED)
    off = []
    for k, pose in enumerate(poses):
        crossings, true = room.seen(pose, rng)
        moved = np.zeros(3) if k == 0 else se2.between(poses[k - 1], pose)
        placed = slope.placed(crossings, moved)
        assert placed is not None
        off.append(float(np.max(np.hypot(*(placed.xy_base_m - true).T))))
        slope.learn(Motion(Displacement(moved), 1e-6 * np.eye(3), len(placed), 0.0, restarted=k == 0), several)
    return off


def lap(heading_rad: float = 0.0) -> list[Array]:
    """A stand, a straight of 1.2 m and a bend of a quarter turn."""
    poses = [np.array([0.0, 0.0, heading_rad])] * 6
    for turn in (*[0.0] * 30, *[0.05] * 31):
        poses.append(np.asarray(se2.compose(poses[-1], np.array([0.04, 0.0, turn]))))
    return poses


@pytest.mark.parametrize("rise", [(STEEP, 0.0), (0.0, STEEP), (-STEEP, 0.0), (0.0, 0.03)])
def test_crossings_of_a_slope_are_put_where_they_are(rise: tuple[float, float]) -> None:
    slope = Slope(CALIBRATION)
    off = drive(slope, Room(np.array(rise)), lap())
    print(f"seed {SEED}: rise {rise}, errors {off[0]:.4f} m at first, {max(off[45:]):.4f} m, {slope.state.used}")
    assert off[0] > 0.05
    assert max(off[45:]) < 0.008  # what rises little, and only across the way, shows in the bend
    assert slope.state.used is not None
    assert np.max(np.abs(slope.state.used.rise - rise)) < 0.002
    assert slope.suspicion == ""


@pytest.mark.parametrize("high_m", [0.94 * HIGH_M, 1.05 * HIGH_M])
def test_tiles_tell_the_height_where_the_robot_began(high_m: float) -> None:
    slope = Slope(CALIBRATION)
    off = drive(slope, Room(np.array([0.0, STEEP]), high_m), lap())
    print(f"seed {SEED}: {off[-1]:.4f} m, {slope.state.used}")
    assert slope.state.used is not None
    assert abs(slope.state.used.high - high_m / HIGH_M) < 0.004
    assert max(off[10:]) < 0.012


def test_tiles_of_another_size_are_no_height() -> None:
    """Below a step with tiles of .6 m, in a room that was calibrated by tiles of .5 m, a rise of .7 deg that was a
    mistake was believed at once, for it was to explain a ceiling a fifth lower: 0.6 m off, in TRACKING. Here by tiles
    of .53 m, which are read so at once."""
    slope = Slope(simulated_calibration(tile_m=0.53))
    drive(slope, Room(np.array([0.012, 0.0])), lap())
    print(f"seed {SEED}: {slope.state.used}")
    assert slope.state.used is None or abs(slope.state.used.high - 1.0) < 0.03
    assert not slope.state.by_tiles


def test_where_heights_are_known_they_explain_how_views_grow() -> None:
    slope = Slope(CALIBRATION)
    drive(slope, Room(np.array([0.012, 0.0])), lap(), several=True)
    assert slope.state.used is None
    drive(slope, Room(np.array([0.012, 0.0])), lap())
    assert slope.state.used is not None


def test_without_tiles_it_is_said_that_the_height_is_not_known() -> None:
    slope = Slope(NO_SIZE)
    drive(slope, Room(np.array([0.0, STEEP]), 0.94 * HIGH_M), lap())
    assert slope.suspicion == HEIGHT_UNKNOWN


def test_one_level_ceiling_is_left_alone() -> None:
    slope, rng = Slope(CALIBRATION), np.random.default_rng(SEED)
    drive(slope, Room(np.zeros(2)), lap())
    assert slope.state.used is None
    crossings, _ = Room(np.zeros(2)).seen(np.zeros(3), rng)
    assert slope.placed(crossings, None) is crossings
    assert slope.reference() is None


@pytest.mark.parametrize("seed", range(8))
def test_a_robot_that_rocks_by_two_degrees_is_under_no_slope(seed: int) -> None:
    slope, rng = Slope(CALIBRATION), np.random.default_rng(seed)
    start, rate = rng.uniform(0.0, 2.0 * np.pi, 2), rng.uniform(0.5, 2.0, 2)
    poses = lap()
    for k, pose in enumerate(poses):
        lean = np.tan(np.radians(2.0)) * np.sin(start + 2.0 * np.pi * rate * k / 30.0)
        crossings, _ = Room(np.zeros(2), lean=lean).seen(pose, rng)
        moved = np.zeros(3) if k == 0 else se2.between(poses[k - 1], pose)
        slope.placed(crossings, moved)
        slope.learn(Motion(Displacement(moved), 1e-6 * np.eye(3), len(crossings), 0.0, restarted=k == 0))
    print(f"seed {seed}: {slope.state.used}")
    assert slope.state.used is None


def test_a_camera_that_was_pushed_is_under_no_slope() -> None:
    """It leans by 4 deg as it drives and turns, which no ceiling does."""
    slope = Slope(CALIBRATION)
    off = drive(slope, Room(np.zeros(2), lean=np.array([0.07, 0.0])), lap(0.4))
    print(f"seed {SEED}: {off[-1]:.4f} m, {slope.state.used}")
    assert slope.state.used is not None
    assert np.max(np.abs(slope.state.used.rise)) < 0.003
    assert off[-1] < 0.010


def test_where_the_slope_ends_it_is_noticed() -> None:
    slope, rng = Slope(NO_SIZE), np.random.default_rng(SEED)
    poses = lap()
    drive(slope, Room(np.array([STEEP, 0.0])), poses)
    ended = []
    for pose in [poses[-1]] * 12:
        crossings, _ = Room(np.zeros(2)).seen(pose, rng)
        slope.placed(crossings, np.zeros(3))
        slope.learn(Motion(Displacement(np.zeros(3)), 1e-6 * np.eye(3), len(crossings), 0.0))
        ended.append(slope.state.ended)
    assert not ended[0]
    assert ended[-1]


@pytest.mark.parametrize("ratio", [0.93, 1.0, 1.08])
def test_the_height_by_tiles_among_lines_of_other_things(ratio: float) -> None:
    rng = np.random.default_rng(SEED)
    joints = (0.13 + TILE_M * np.arange(-2, 3)) / ratio + rng.normal(0.0, NOISE_M, 5)
    other = rng.uniform(-1.0, 1.0, 2)
    found = seen_high(np.concatenate([joints, other]), np.array([5.0] * 5 + [1.0] * 2), TILE_M, 1.0)
    assert found is not None
    assert abs(found[0] - ratio) < 0.002


def test_lines_that_do_not_stand_at_whole_tiles_tell_no_height() -> None:
    at = np.array([-0.9, -0.55, -0.1, 0.31, 0.62, 1.1])
    assert seen_high(at, np.ones(6), 0.25, 1.0) is None
    assert seen_high(at[:3], np.ones(3), TILE_M, 1.0) is None


def rows(way_m: float, beside_m: float, rng: np.random.Generator) -> Crossings:
    """Ends of two lamps 1.55 m apart in a row, double edges and all, from so far along it; the further end is seen so
    far beside where it is."""
    ends = np.array([-0.93, 0.62 + beside_m]) - way_m
    xy = np.column_stack([v.ravel() for v in np.meshgrid(ends, [0.23, 0.26, 0.37, 0.4])])
    xy = xy + rng.normal(0.0, NOISE_M, xy.shape)
    groove = np.zeros(len(xy), np.int64)
    return crossings_at(MOUNT + xy, crossing_type_of(groove, groove), 1e-3, psi_sigma_rad=1e-4)


@pytest.mark.parametrize(
    "fewest_lines, plausible, slopes", [(6, 0.3, False), (6, np.inf, False), (0, 0.3, False), (0, np.inf, True)]
)
def test_an_edge_in_place_of_its_neighbour_is_no_slope(
    fewest_lines: int, plausible: float, slopes: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Eight crossings of two places: taken for a scale, as they were, they told one to a twentieth of a per cent.

    Either rule alone refuses it, and without both it is one.
    """
    monkeypatch.setattr("ceilvo.daemon.odometry.heights.similarity._FEWEST_LINES", fewest_lines)
    monkeypatch.setattr("ceilvo.daemon.odometry.heights.slope._PLAUSIBLE", plausible)
    slope, rng, step_m = Slope(NO_SIZE), np.random.default_rng(SEED), 0.02
    for k in range(20):
        crossings = rows(k * step_m, -0.016 if k > 3 else 0.0, rng)
        moved = np.array([step_m if k else 0.0, 0.0, 0.0])
        slope.placed(crossings, moved)
        slope.learn(Motion(Displacement(moved), 1e-6 * np.eye(3), len(crossings), 0.0, restarted=k == 0))
    print(f"seed {SEED}: {slope.state.used}")
    assert (slope.state.used is not None) == slopes


def held_level(pose: Array, lean: Array, sigma_rad: float, rng: np.random.Generator) -> Crossings:
    """A level ceiling seen by a robot that leans and does not know; most crossings are to one side of the camera."""
    camera = se2.transform(pose, MOUNT[None])[0]
    k = np.arange(-30, 31) * 0.3
    grid = np.column_stack([v.ravel() for v in np.meshgrid(k, k)])
    ray = (grid - camera) @ se2.rotation(float(pose[2])) / HIGH_M
    ray = ray[(np.abs(ray[:, 0] - 0.35) < 0.25) & (np.abs(ray[:, 1]) < 0.4)]
    level = _turned(ray, np.linalg.inv(_back(lean))) * HIGH_M + rng.normal(0.0, NOISE_M, ray.shape)
    groove = np.zeros(len(ray), np.int64)
    seen = crossings_at(MOUNT + level, crossing_type_of(groove, groove), 1e-3, psi_sigma_rad=1e-4)
    return replace(seen, tilt_sigma_rad=np.full(2, sigma_rad))


def test_a_scale_of_two_views_is_as_wrong_as_tilts_that_are_not_known_make_it() -> None:
    """Tilts of .15 deg scale what is to one side of the camera; the ceiling is level."""
    rng, sigma_rad, off = np.random.default_rng(SEED), float(np.radians(0.15)), []
    way = np.array([0.12, 0.0, 0.0])
    for _ in range(200):
        key, here = (held_level(pose, rng.normal(0.0, sigma_rad, 2), sigma_rad, rng) for pose in (np.zeros(3), way))
        found = of_views(key, here, way, MOUNT, HIGH_M)
        if found is not None:
            off.append((found.scale - 1.0) / found.sigma)
    print(f"seed {SEED}: {len(off)} scales, {np.std(off):.2f} of what they claim, {np.max(np.abs(off)):.1f} at most")
    assert len(off) > 150
    assert np.std(off) < 1.2
    assert np.max(np.abs(off)) < 4.5
