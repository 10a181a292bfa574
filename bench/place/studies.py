"""Other questions than single faults: hours of laps without any, a start anywhere, a ceiling renovated, a ride."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np

from ceilvo import se2
from ceilvo.bench.place import radio
from ceilvo.bench.place.case import SETTLE_S, drive_in, load_known, twins_of, watch
from ceilvo.bench.place.ceiling.eye import Sight
from ceilvo.bench.place.ceiling.truth import Features
from ceilvo.bench.place.ceiling.worlds import LAMPS, WorldSpec, make_world
from ceilvo.bench.place.faults.changes import HEIGHTS, NIGHT_S, renovated
from ceilvo.bench.place.rides import ride
from ceilvo.bench.place.robot.drive import Drive
from ceilvo.bench.place.robot.sights import CrossingSight
from ceilvo.bench.place.robot.tally import Tally, figures, times
from ceilvo.daemon.relocalisation.relocaliser_state import NOT_THIS_MAP
from ceilvo.types import Array, Estimate, State

LEG_S = 1800.0
"""Of laps in one room; chosen: an hour has two rooms at least."""
_LEG_SIZES = ("5", "20", "60")
STARTS_A_HALL = 20
"""Starts in one hall before the next is made; chosen: making one takes seconds."""
_START_MOST_M = 60.0
"""Driven before a start is given up; chosen: twelve times the bar."""
_RIGHT_S = 2.0
"""TRACKING for so long ends a start; chosen: that a wrong one shows."""
_HEIGHT_S = 15.0
"""Driven under a ceiling of another height; chosen: half as long again as the bar."""
_LAPS = 3
_NEAR_M = 0.05
"""A landmark so near a true crossing of its type is right; chosen: a quarter of the association gate."""
_SEEN_M = 1.2
"""Ceiling so near the robot's path was in view; chosen: half the height of the picture on the ceiling."""


@dataclass(frozen=True)
class Run:
    """One run of a study by the seed of the bench and its number.

    Attributes:
        share: of the ceiling that is renovated.
        seconds: of a leg of laps.
        size: of the hall of a start.
        anchors, noise_m, obstructed: of a start with radio, see RadioSpec.
    """

    study: str
    seed: int
    number: int
    share: float = 0.0
    seconds: float = LEG_S
    size: str = "150"
    anchors: int = 0
    noise_m: float = 0.0
    obstructed: float = 0.0


def run_study(run: Run) -> dict[str, Any]:
    """The figures of a run, as JSON can hold them."""
    cv2.setNumThreads(1)
    if run.study == "radio":
        return radio.start(run.seed, run.number, run.size, run.anchors, run.noise_m, run.obstructed)
    if run.study == "rides":
        return ride(run.seed, run.number)
    return {"laps": _laps, "start": _start, "renovated": _renovated, "heights": _heights}[run.study](run)


def _laps(run: Run) -> dict[str, Any]:
    """A leg without faults: whatever is said then is a false alarm."""
    rng = np.random.default_rng([run.seed, run.number, 1])
    size = _LEG_SIZES[run.number % len(_LEG_SIZES)]
    tile_m, lamps = float(rng.choice((0.3, 0.6, 0.625, 1.25))), LAMPS[int(rng.integers(len(LAMPS)))]
    world = make_world(WorldSpec(size, tile_m, lamps, 1000 * run.seed + run.number))
    wheels, laps = bool(rng.random() < 0.5), bool(rng.random() < 0.5)
    drive = drive_in(world, rng, wheels, 10.0, laps, float(rng.uniform(0.3, 1.0)))
    learnt = bool(rng.random() < 0.5)
    if learnt:
        drive.at_truth()
    else:
        load_known(drive, world, rng)
    settled = drive.settle(SETTLE_S)
    drive.tally = Tally()
    drive.go(run.seconds)
    about = {"size": size, "tile_m": tile_m, "lamps": lamps, "wheels": wheels, "laps": laps, "learnt": learnt}
    return about | {"settled": settled, "run": figures(drive.tally), "step_ms": times(drive.step_ms)}


def _start(run: Run) -> dict[str, Any]:
    """Anywhere in a hall whose map is known, with a stored pose that is anywhere else."""
    hall = run.number // STARTS_A_HALL
    world = make_world(WorldSpec(run.size, 0.6, "raster", 1000 * run.seed + hall))
    rng = np.random.default_rng([run.seed, run.number, 2])
    drive = drive_in(world, rng, bool(run.number % 2), 10.0, False, 0.5)
    elsewhere = np.asarray(se2.compose(world.map_from_ceiling, drive.driver.start()))
    landmarks = load_known(drive, world, rng, elsewhere)
    twins = twins_of(drive, world)
    tally = drive.tally = Tally()
    tally.over()
    kept_s, found_m = 0.0, None
    failed = None
    while kept_s < _RIGHT_S and tally.metres < _START_MOST_M and failed is None:
        try:
            estimate = drive.tick()
        except MemoryError as e:
            failed, estimate = f"out of memory: {e}", None
        watch(twins, drive)
        tracking = estimate is not None and estimate.state is State.TRACKING
        if tracking and kept_s == 0.0:
            found_m = tally.metres
        kept_s = kept_s + drive.dt_s if tracking else 0.0
    out = {"failed": failed, "landmarks": len(landmarks), "wheels": bool(run.number % 2), "run": figures(tally)}
    right = kept_s >= _RIGHT_S and not tally.wrong_s.get("TRACKING")
    return out | {"right": right, "found_m": found_m if kept_s >= _RIGHT_S else None, "step_ms": times(drive.step_ms)}


def _renovated(run: Run) -> dict[str, Any]:
    """Switched off, the ceiling changed, switched on on the spot: pose, and the map after three laps."""
    rng = np.random.default_rng([run.seed, run.number, 3])
    world = make_world(
        WorldSpec("5", float(rng.choice((0.6, 0.625))), LAMPS[run.number % 2], 1000 * run.seed + run.number)
    )
    drive = drive_in(world, rng, bool(rng.random() < 0.5), 10.0, True, 0.5)
    load_known(drive, world, rng)
    settled = drive.settle(SETTLE_S)
    drive.go(60.0)
    stored = drive.stored()
    assert isinstance(drive.camera, CrossingSight)
    features = renovated(world, run.share, rng)
    drive.camera.use(features)
    drive.begin_anew()
    if stored is not None:
        drive.load(*stored, ago_s=NIGHT_S)
    tally = drive.tally = Tally()
    tally.over()
    lap_m = 2.0 * float(np.sum(drive.driver.high - drive.driver.low))
    path, last_tracking_s, not_this_map_s = [], 0.0, None
    while tally.metres < _LAPS * lap_m and tally.seconds < _LAPS * lap_m / 0.1:
        estimate = drive.tick()
        path.append(drive.pose[:2])
        if estimate is not None and estimate.state is State.TRACKING:
            last_tracking_s = tally.seconds
        if not_this_map_s is None and _says_not_this_map(estimate):
            not_this_map_s = tally.seconds
    out = {"settled": settled, "share": run.share, "last_tracking_s": last_tracking_s, "run": figures(tally)}
    out |= {"not_this_map_s": not_this_map_s, "tile_m": world.spec.tile_m, "lamps": world.spec.lamps}
    return out | map_figures(drive, features, np.array(path)) | {"step_ms": times(drive.step_ms)}


def _heights(run: Run) -> dict[str, Any]:
    """Switched off, and on with the calibration of another camera's height: what is said, and whether the map stays."""
    rng = np.random.default_rng([run.seed, run.number, 5])
    size, ratio = _LEG_SIZES[run.number // len(HEIGHTS) % 2], HEIGHTS[run.number % len(HEIGHTS)]
    tile_m, lamps = float(rng.choice((0.3, 0.6, 0.625, 1.25))), LAMPS[int(rng.integers(len(LAMPS)))]
    world = make_world(WorldSpec(size, tile_m, lamps, 1000 * run.seed + run.number))
    drive = drive_in(world, rng, bool(rng.random() < 0.5), 10.0, bool(rng.random() < 0.5), float(rng.uniform(0.3, 1.0)))
    load_known(drive, world, rng)
    settled = drive.settle(SETTLE_S)
    stored = drive.stored()
    drive.begin_anew()
    drive.conditions.sight = Sight(scale=ratio)
    out = {"ratio": ratio, "size": size, "tile_m": tile_m, "lamps": lamps, "settled": settled and stored is not None}
    if stored is None:
        return out
    landmarks, axis_rad, pose = stored
    drive.load(landmarks, axis_rad, pose, NIGHT_S)
    tally, not_this_map_s = Tally(), None
    drive.tally = tally
    while tally.seconds < _HEIGHT_S:
        estimate = drive.tick()
        if not_this_map_s is None and _says_not_this_map(estimate):
            not_this_map_s = tally.seconds
    kept = drive.estimator.map()[0]
    same = len(kept) == len(landmarks) and bool(np.all(kept.xy_map_m == landmarks.xy_map_m))
    return out | {"not_this_map_s": not_this_map_s, "kept": same, "run": figures(tally)}


def _says_not_this_map(estimate: Estimate | None) -> bool:
    return estimate is not None and estimate.reason.startswith(NOT_THIS_MAP)


def map_figures(drive: Drive, features: Features, path: Array) -> dict[str, float]:
    """Of the true crossings above the path, those that the map has, and of its landmarks there, those that are true."""
    assert isinstance(drive.camera, CrossingSight)
    landmarks, _ = drive.estimator.map()
    path = path[:: max(1, len(path) // 500)]
    plain = drive.camera.eye.missed < 0.5
    true = _above(features.xy_map_m, path) & plain
    held = _above(landmarks.xy_map_m, path)
    known = _matches(features.xy_map_m[true], features.crossing_type[true], landmarks.xy_map_m, landmarks.crossing_type)
    right = _matches(landmarks.xy_map_m[held], landmarks.crossing_type[held], features.xy_map_m, features.crossing_type)
    return {
        "map_recall": float(np.mean(known)) if len(known) else 0.0,
        "map_precision": float(np.mean(right)) if len(right) else 0.0,
    }


def _above(xy: Array, path: Array) -> Any:
    if not len(xy):
        return np.zeros(0, bool)
    return np.hypot(*(xy[:, None] - path[None]).transpose(2, 0, 1)).min(axis=1) < _SEEN_M


def _matches(xy: Array, kind: Any, others: Array, other_kind: Any) -> Any:
    if not len(xy) or not len(others):
        return np.zeros(len(xy), bool)
    apart = np.hypot(*(xy[:, None] - others[None]).transpose(2, 0, 1))
    return np.any((apart < _NEAR_M) & (kind[:, None] == other_kind[None]), axis=1)
