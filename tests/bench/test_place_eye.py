"""The bench's fast eye: against rendered frames through the real finder, and against its own true crossings."""

from __future__ import annotations

from functools import partial

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ceilvo import se2
from ceilvo.bench.place.ceiling.eye import EyeNoise, Sight, SyntheticEye
from ceilvo.bench.place.ceiling.eye_check import compare
from ceilvo.bench.place.ceiling.truth import Features, Origin, features_of, joined, without
from ceilvo.bench.place.ceiling.worlds import MAP_SIGMA_M, SIZES_M, WorldSpec, landmarks_of, make_world
from ceilvo.bench.place.robot.sights import CrossingSight, PictureSight
from ceilvo.config import Config
from ceilvo.daemon.slam.association import associate
from ceilvo.daemon.slam.spatial_index import landmarks_near
from ceilvo.daemon.vision.finder.crossing_finder import CrossingFinder
from ceilvo.sim.rig import simulated_calibration
from ceilvo.sim.world import World
from ceilvo.sim.world import WorldSpec as RoomSpec
from ceilvo.types import Crossings, Frame, Landmarks

PERFECT = EyeNoise(
    (0.0,) * 4, outlier=0.0, standing_px=0.0, psi_rad=0.0, tilt_rad=0.0, line_missed=(0.0,) * 4, missed_most=(0.0,) * 4,
    flickers=0.0, confused=0.0, clutter=0.0,
)  # fmt: skip
CALIBRATION = simulated_calibration()
HALL = WorldSpec("20", 0.6, "raster", 1)


@pytest.fixture(scope="module")
def room() -> World:
    return World(RoomSpec(seed=3))


@pytest.fixture(scope="module")
def room_features(room: World) -> Features:
    return features_of(room.ceiling.layout, np.zeros(3))


def eye(features: Features, noise: EyeNoise | None = None, seed: int = 1) -> SyntheticEye:
    return SyntheticEye(features, CALIBRATION, np.random.default_rng(seed), noise)


def look(e: SyntheticEye, pose: np.ndarray, sight: Sight | None = None) -> Crossings:
    seen = e.look(pose, sight or Sight())
    assert seen is not None
    return seen


def map_of(features: Features) -> Landmarks:
    return landmarks_of(features, np.zeros(len(features)), np.random.default_rng(2))


def found(room: World, gray: np.ndarray) -> Crossings:
    seen = CrossingFinder(room.calibration, Config().features)(Frame(1, 1, gray), None)
    assert seen is not None
    return seen


@settings(max_examples=40, deadline=None)
@given(st.floats(2.0, 18.0), st.floats(2.0, 18.0), st.floats(-3.14, 3.14))
def test_a_perfect_view_is_explained_by_the_map_wherever_the_robot_looks_from(x: float, y: float, theta: float) -> None:
    world = make_world(HALL)
    pose = np.array([*se2.transform(world.map_from_ceiling, np.array([[x, y]]))[0], theta])
    seen = look(eye(world.features, PERFECT), pose)
    assert -0.25 * np.pi <= seen.psi_rad < 0.25 * np.pi
    landmarks, axis = map_of(world.features), world.features.axis_rad
    noise, mount = CALIBRATION.noise, CALIBRATION.mount_xy_m
    view = associate(seen, noise, mount, pose, partial(landmarks_near, landmarks), Config().filter, axis)
    assert np.all(view.label >= 0)
    off = se2.transform(pose, seen.xy_base_m) - landmarks.xy_map_m[view.label]
    assert np.abs(off).max() < 6.0 * MAP_SIGMA_M
    assert abs(se2.wrap(view.heading_rad - theta)) < 1e-9


def test_what_it_makes_is_what_the_finder_finds_on_rendered_frames() -> None:
    real, made = compare(seed=7, frames=60)
    assert made["recall GRID %"] == pytest.approx(real["recall GRID %"], abs=4.0)
    assert made["recall LAMP %"] == pytest.approx(real["recall LAMP %"], abs=15.0)
    assert real["of them right type GRID %"] > 98.0
    assert real["recall GRID %"] > 94.0
    assert made["crossings a frame"] == pytest.approx(real["crossings a frame"], rel=0.35)
    for name in ("line GRID error, middle 68 %, px", "common shift rms mm", "psi rms mrad"):
        assert 0.3 < made[name] / real[name] < 3.0
    for name in ("line GRID error a frame apart, correlation", "common shift a frame apart, correlation"):
        assert made[name] > 0.7 and real[name] > 0.7


def test_mirrored_and_turned_views_are_those_of_such_pictures(room: World, room_features: Features) -> None:
    rng = np.random.default_rng(1)
    pictures = PictureSight(room.renderer, room.calibration, rng)
    crossings = CrossingSight(eye(room_features), room.calibration, rng)
    pose = room.truth_at(12.0)
    gray = pictures.look(pose)
    seen = found(room, gray)
    for name in ("mirrored", "turned"):
        real, made = found(room, getattr(pictures, name)(gray)), getattr(crossings, name)(seen)
        assert np.hypot(*(made.xy_base_m - seen.xy_base_m).T).max() > 0.5
        apart = np.hypot(*(real.xy_base_m[:, None] - made.xy_base_m[None]).transpose(2, 0, 1))
        nearest = apart.argmin(axis=1)
        assert np.mean(apart.min(axis=1) < 0.02) > 0.9  # the lens' distortion is not symmetric
        assert np.mean(real.crossing_type == made.crossing_type[nearest]) > 0.8
        assert real.psi_rad == pytest.approx(made.psi_rad, abs=2e-3)


def test_a_robot_that_stands_sees_nearly_the_same_again_and_one_that_drives_does_not() -> None:
    e, pose = eye(make_world(HALL).features), np.array([8.0, 8.0, 0.3])
    first, again = look(e, pose), look(e, pose)
    assert abs(len(first) - len(again)) <= 3
    apart = np.hypot(*(first.xy_base_m[:, None] - again.xy_base_m[None]).transpose(2, 0, 1)).min(axis=1)
    assert 0.0 < np.median(apart) < 1e-4
    errors = []
    for k in range(40):
        at = pose + np.array([0.5 * k % 4, 0.1 * k, 0.0])
        exact = se2.transform(se2.inverse(at), e.features.xy_map_m)
        seen = look(e, at)
        errors.append(np.median(np.hypot(*(seen.xy_base_m[:, None] - exact[None]).transpose(2, 0, 1)).min(axis=1)))
    assert np.mean(errors) > 1e-4


def test_spoilt_sights_show_what_they_say() -> None:
    world = make_world(HALL)
    e, pose = eye(world.features, PERFECT), np.array([9.0, 9.0, 0.0])
    plain = look(e, pose)
    bumped = look(e, pose, Sight(yaw_rad=0.1))
    assert se2.wrap(4.0 * (plain.psi_rad - bumped.psi_rad - 0.1)) == pytest.approx(0.0, abs=1e-9)
    high = look(e, pose, Sight(scale=0.5))
    assert len(high) > 2 * len(plain)
    raw = CALIBRATION.level_view.to_raw(high.uv_px)
    assert raw.min() > 0.0 and np.all(raw < [640, 480]) and raw[:, 0].max() > 600.0
    lamps = look(e, pose, Sight(blind=(int(Origin.LAMP),)))
    assert 0 < len(lamps) < len(plain)
    hidden = look(e, pose, Sight(hidden=np.array([[0.0, 0.0, 1.0]])))
    assert np.hypot(*hidden.xy_base_m.T).min() > 1.0
    ghosts = np.array([[0.11, 0.22]])
    assert np.hypot(*(look(e, pose, Sight(ghosts_m=ghosts)).xy_base_m - ghosts[0]).T).min() == 0.0
    assert e.look(pose, Sight(recall=0.0)) is None
    assert e.look(np.array([-50.0, 0.0, 0.0])) is None


def test_crossings_near_a_place_are_all_there_and_stay_so_when_some_are_taken_out() -> None:
    f = make_world(HALL).features
    thinned = without(f, np.arange(0, len(f), 3))
    for g in (f, thinned):
        at = np.array([7.3, 5.1])
        near = set(g.near(at, 2.0).tolist())
        assert set(np.flatnonzero(np.hypot(*(g.xy_map_m - at).T) <= 2.0).tolist()) <= near
        assert len(near) < 0.3 * len(g)
    assert len(thinned) == len(f) - len(np.arange(0, len(f), 3))


def test_a_renovated_part_is_of_the_other_ceiling_and_the_rest_is_not() -> None:
    a, b = make_world(HALL), make_world(WorldSpec("20", 0.625, "sparse", 2))
    low, high = np.array([5.0, 5.0]), np.array([12.0, 12.0])
    rest = features_of(b.layout, a.map_from_ceiling, b.room)
    both = joined(a.features, rest, a.map_from_ceiling, low, high)
    at = se2.transform(se2.inverse(a.map_from_ceiling), both.xy_map_m)
    inside = np.all((at > low) & (at < high), axis=1)
    for which, source in ((inside, rest), (~inside, a.features)):
        apart = [np.hypot(*(source.xy_map_m - xy).T).min() for xy in both.xy_map_m[which]]
        assert len(apart) > 0 and max(apart) < 1e-9


def test_rooms_hang_what_is_asked_for() -> None:
    bare = make_world(WorldSpec("60", 0.6, "bare stretch", 4))
    x = np.sort(np.array([p.rect[0] for p in bare.layout.panels]))
    assert np.diff(x).max() > 8.5
    raster, sparse = (make_world(WorldSpec("60", 0.6, lamps, 4)).layout.lamps for lamps in ("raster", "sparse"))
    places = len(raster[0].rect) and 100 * 100 / 12
    assert 0.78 * places < len(raster) < 0.92 * places
    pitch = np.unique(np.round(np.diff(np.unique([p.rect[0] for p in raster])), 6))
    assert np.allclose(pitch, 4 * 0.6)
    assert len(sparse) < 0.4 * len(raster)


def test_the_largest_hall_has_the_landmarks_that_are_asked_for() -> None:
    world = make_world(WorldSpec("150", 0.6, "raster", 1))
    landmarks = map_of(world.features)
    assert len(landmarks) > 30_000
    assert tuple(world.room[2:]) == SIZES_M["150"]
    off = landmarks.xy_map_m - world.features.xy_map_m
    assert np.std(off) == pytest.approx(MAP_SIGMA_M, rel=0.05)
