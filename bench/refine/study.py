"""Halls, driven through several times by the daemon with a calibration that is off, and refined."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from ceilvo import se2
from ceilvo.bench.place.ceiling.eye import SyntheticEye
from ceilvo.bench.place.ceiling.truth import Features
from ceilvo.bench.place.ceiling.worlds import WorldSpec, make_world
from ceilvo.bench.place.robot.driver import Base
from ceilvo.bench.refine.building import Hall, MapError, error, sweep
from ceilvo.calibration import Calibration, in_base
from ceilvo.config import Config
from ceilvo.daemon.map.key_poses import KeyPoses
from ceilvo.daemon.odometry.rigid import rigid_motion
from ceilvo.daemon.pipeline import Pipeline
from ceilvo.daemon.refinement.key_pose_taker import KeyPoseTaker
from ceilvo.daemon.relocalisation.doubts import JUST_NOW_S
from ceilvo.daemon.replay.inputs import Sighting
from ceilvo.sim.rig import simulated_calibration
from ceilvo.types import Array, Crossings, Estimate, Ints, Landmarks, Pose

SPEED_MPS, RATE_HZ = 0.8, 15.0
_SURE = np.diag([1e-6, 1e-6, 1e-6])
_TRUE_M = 0.2
"""A landmark belongs to the true crossing of its type nearest to it, within so much; chosen: a third of a tile."""
_ROUNDS = 10
"""Of laying a map on the truth by nearest neighbours; chosen: four do."""


@dataclass(frozen=True)
class Room:
    """True crossings in map, and paths of the sessions (K, 3) in map."""

    features: Features
    ways: tuple[Array, ...]


def room(size: str, tile_m: float, seed: int, sessions: int, length_m: float) -> Room:
    """A hall of bench.place with lamps and vents; every session drives some length_m through all of it."""
    world = make_world(WorldSpec(size, tile_m, "raster", seed))
    hall = (Hall(0.0, 0.0, world.room[2], world.room[3]),)
    ways = (_way(hall, length_m, (s + 0.5) / sessions) for s in range(sessions))
    return Room(world.features, tuple(se2.compose(world.map_from_ceiling, w) for w in ways))


def _way(halls: tuple[Hall, ...], length_m: float, share: float) -> Array:
    """The sweep whose lanes are as far apart as it takes for the length."""
    step_m = SPEED_MPS / RATE_HZ
    lanes = np.linspace(2.0, 30.0, 57)
    ways = [sweep(halls, step_m, float(lane), share) for lane in lanes]
    return min(ways, key=lambda w: abs(len(w) * step_m - length_m))


def drive(pipeline: Pipeline, sightings: Iterable[Sighting], session: str) -> KeyPoses:
    """One session through the daemon's own steps."""
    taker = KeyPoseTaker(session)
    for seen in sightings:
        estimate = pipeline.step_crossings(seen.stamp_ns, seen.crossings, seen.wheels)
        taker.add(pipeline, estimate, seen.crossings)
    return taker.taken()


def sightings(
    eye: SyntheticEye, way: Array, believed: Calibration, true: Calibration, rng: np.random.Generator
) -> Iterator[Sighting]:
    """What a robot with wheels sees along a way (K, 3), placed by the calibration that it believes."""
    base, before, before_ns = Base(rng), way[0], None
    for k, pose in enumerate(way):
        stamp_ns, seen = 10**9 + round(1e9 * k / RATE_HZ), eye.look(pose)
        base.turned(se2.between(before, pose), stamp_ns)
        crossings = None if seen is None else bent(seen, true, believed)
        yield Sighting(stamp_ns, crossings, base.between(before_ns, stamp_ns))
        before, before_ns = pose, stamp_ns


def bent(seen: Crossings, true: Calibration, believed: Calibration) -> Crossings:
    """Crossings as a robot places them that believes another calibration."""
    level = np.column_stack([seen.xy_base_m, np.ones(len(seen))]) @ true.level_from_ceiling.T
    raw = true.level_view.to_raw(level[:, :2] / level[:, 2:])
    xy, uv = in_base(believed, raw), believed.level_view.from_raw(raw)
    good = np.flatnonzero(np.isfinite(xy).all(axis=1))
    return replace(seen, xy_base_m=xy, uv_px=uv).of(good)


def mapped(
    b: Room, believed: Calibration, config: Config, seed: int, progress: Callable[[str], None]
) -> tuple[list[KeyPoses], Landmarks, float]:
    """All sessions one after the other, each on the map of those before."""
    true = simulated_calibration()
    rng = np.random.default_rng(seed)
    sessions = []
    pipeline = Pipeline(believed, config, rng.spawn(1)[0])
    for number, way in enumerate(b.ways):
        eye = SyntheticEye(b.features, true, rng.spawn(1)[0])
        if number:
            known, axis = pipeline.landmarks(), pipeline.relocaliser.state.map_axis_rad or 0.0
            pipeline = Pipeline(believed, config, rng.spawn(1)[0])
            pipeline.load_map(known, axis, Pose(way[0]), _SURE, ago_s=JUST_NOW_S)
        else:
            pipeline.set_pose(Pose(way[0]), _SURE, "put here")
        seen = sightings(eye, way, believed, true, rng.spawn(1)[0])
        sessions.append(drive(pipeline, seen, f"simulated/{number}"))
        progress(f"session {number}: {len(sessions[-1])} key poses, {len(pipeline.landmarks())} landmarks")
    return sessions, pipeline.landmarks(), pipeline.relocaliser.state.map_axis_rad or 0.0


def localised(
    eye: SyntheticEye,
    way: Array,
    known: Landmarks,
    axis_rad: float,
    truth_from_map: Array,
    calibration: Calibration,
    config: Config,
    rng: np.random.Generator,
) -> list[Estimate]:
    """Every estimate of a drive (K, 3) on a known map that lies so on the truth, begun where the robot is."""
    pipeline = Pipeline(calibration, config, rng.spawn(1)[0])
    start = se2.compose(se2.inverse(truth_from_map), way[0])
    pipeline.load_map(known, axis_rad, Pose(np.asarray(start)), _SURE, ago_s=JUST_NOW_S)
    seen = sightings(eye, way, calibration, simulated_calibration(), rng.spawn(1)[0])
    return [pipeline.step_crossings(s.stamp_ns, s.crossings, s.wheels) for s in seen]


def error_of(landmarks: Landmarks, truth_m: Array) -> tuple[MapError, int]:
    """Against the true crossings (N, 2) nearest to them, and how many landmarks have none."""
    _, used, nearest = onto_truth(landmarks, truth_m)
    off = error(landmarks.xy_map_m[used], truth_m[nearest[used]])
    return off, int(np.count_nonzero(~used))


def onto_truth(landmarks: Landmarks, truth_m: Array) -> tuple[Array, NDArray[np.bool_], Ints]:
    """How a map lies on true crossings (N, 2), (3,), which landmarks are of one (L,), and of which (L,)."""
    own, tree = landmarks.xy_map_m, cKDTree(truth_m)
    motion, laid = np.zeros(3), own
    for _ in range(_ROUNDS):
        off, nearest = tree.query(laid)
        used = off < _TRUE_M
        motion = rigid_motion(own[used], truth_m[nearest[used]])
        laid = se2.transform(motion, own)
    return motion, used, nearest
