"""Rides between two floors: dark in a lift, up a ramp, and lifts that a robot leaves where it came in."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.random import Generator

from ceilvo import se2
from ceilvo.bench.place.case import SETTLE_S, drive_in
from ceilvo.bench.place.ceiling.eye import PLAIN, Sight
from ceilvo.bench.place.ceiling.truth import Features, joined
from ceilvo.bench.place.ceiling.worlds import LAMPS, World, WorldSpec, landmarks_of, make_world
from ceilvo.bench.place.faults.changes import renovated
from ceilvo.bench.place.robot.drive import Drive
from ceilvo.bench.place.robot.sights import CrossingSight
from ceilvo.bench.place.robot.tally import Tally, figures, times
from ceilvo.daemon.map.map_file import StoredMap, StoredState
from ceilvo.daemon.relocalisation.floors import FloorMap, Transition, side_by_side
from ceilvo.types import Array, Crossings, Landmarks, Pose, State

WAYS = ("lift", "ramp", "not taken")
"""Dark while it rides; no gap at all; dark, and out on the same floor."""
ABOVE = ("another ceiling", "the same but for a fifth")
"""What hangs on the other floor."""
_DARK_S = 8.0
"""In the cabin; chosen: two floors of an ordinary lift."""
_RIGHT_S = 3.0
"""TRACKING on the right floor for so long ends a ride; chosen: that a wrong one shows."""
_MOST_S = 180.0
"""After a ride; chosen: three times the bar."""
_UP_M, _SHARED_M = 2.0, 4.0
"""On a ramp both maps show the same ceiling so far around its mark, and the robot is taken to be on the other floor so
far behind it; chosen: the first is past where it says that it may be, and what it sees lies within the second."""
_RENOVATED = 0.2
_NEAR_M, _FAR_M = 0.35, 4.0
"""So near a lift's middle a robot stops, so far from it it begins; chosen."""
_OFF_M, _OFF_RAD = 0.2, 0.1
"""Standard deviation of a transition as people mark it; chosen: a robot's pose in a cabin, read from a screen."""


class FloorSight(CrossingSight):
    """Looks at a ceiling that lies in a frame of its own; features_from_map: (3,)."""

    features_from_map: Array = np.zeros(3)

    def look(self, pose: Array, sight: Sight = PLAIN) -> Crossings | None:
        return super().look(np.asarray(se2.compose(self.features_from_map, pose)), sight)


def ride(seed: int, number: int) -> dict[str, Any]:
    """The figures of one ride, as JSON can hold them."""
    rng = np.random.default_rng([seed, number, 4])
    way, above = WAYS[number % 3], ABOVE[number // 3 % 2]
    size, tile_m = str(rng.choice(("20", "60"))), float(rng.choice((0.6, 0.625)))
    spec = WorldSpec(size, tile_m, LAMPS[int(rng.integers(2))], 1000 * seed + number)
    below = make_world(spec)
    other = _above(below, above, rng)
    drive = drive_in(below, rng, bool(rng.random() < 0.5), 10.0, False, float(rng.uniform(0.4, 1.0)))
    assert isinstance(drive.camera, CrossingSight)
    drive.camera.__class__ = FloorSight
    lift_m = _lift(drive, rng)
    if way == "ramp":
        other = joined(other, below.features, below.map_from_ceiling, lift_m - _SHARED_M, lift_m + _SHARED_M)
    upstairs = np.array([*rng.uniform(-50.0, 50.0, 2), rng.uniform(-np.pi, np.pi)])
    _know(drive, below, other, upstairs, lift_m, rng)
    settled = drive.settle(SETTLE_S)
    drive.driver.head_for(lift_m)
    while np.hypot(*(drive.room_pose[:2] - lift_m)) > _NEAR_M:
        drive.tick()
    _take(drive, way, other, upstairs, lift_m)
    tally = drive.tally = Tally()
    tally.over()
    wanted = "ground" if way == "not taken" else "first"
    kept_s = 0.0
    while kept_s < _RIGHT_S and tally.seconds < _MOST_S:
        estimate = drive.tick()
        right = estimate is not None and estimate.state is State.TRACKING and estimate.floor == wanted
        kept_s = kept_s + drive.dt_s if right else 0.0
    found = kept_s >= _RIGHT_S
    about = {"way": way, "above": above, "size": size, "tile_m": tile_m, "settled": settled, "found": found}
    about |= {"found_s": tally.seconds - kept_s if found else None, "found_m": tally.metres if found else None}
    return about | {"run": figures(tally), "step_ms": times(drive.step_ms)}


def _above(below: World, above: str, rng: Generator) -> Features:
    if above == ABOVE[1]:
        return renovated(below, _RENOVATED, rng)
    spec = below.spec
    hung = int(rng.integers(1, 10**6))
    return make_world(WorldSpec(spec.size, spec.tile_m, spec.lamps, spec.seed, hung)).features


def _lift(drive: Drive, rng: Generator) -> Array:
    """(2,) in the room, not where the robot begins."""
    while True:
        at = rng.uniform(drive.driver.low, drive.driver.high)
        if np.hypot(*(at - drive.room_pose[:2])) > _FAR_M:
            return np.asarray(at)


def _know(drive: Drive, below: World, other: Features, upstairs: Array, lift_m: Array, rng: Generator) -> None:
    """The daemon begins with the maps of both floors, each in its own frame; upstairs: (3,) its map_from_below."""
    assert isinstance(drive.camera, CrossingSight)
    ground = landmarks_of(below.features, drive.camera.eye.missed, rng)
    drive.camera.use(other)
    first = landmarks_of(other, drive.camera.eye.missed, rng)
    drive.camera.use(below.features)
    at = np.asarray(se2.compose(drive.map_from_room, np.array([*lift_m, 0.0])))
    sides = [Transition("lift 1", "lift", *(se2.compose(by, at) + _mistake(rng))) for by in (np.zeros(3), upstairs)]
    axes = below.features.axis_rad, other.axis_rad + float(upstairs[2])
    whole, floors = side_by_side(
        [
            FloorMap("ground", ground, axes[0], (sides[0],)),
            FloorMap("first", _moved(first, upstairs), axes[1], (sides[1],)),
        ]
    )
    state = StoredState(Pose(drive.pose), np.diag([1e-6] * 3), State.TRACKING, 0)
    drive.estimator.load_map(StoredMap(whole, axes[0]), state, floors)


def _mistake(rng: Generator) -> Array:
    return np.asarray(rng.standard_normal(3) * [_OFF_M, _OFF_M, _OFF_RAD])


def _moved(landmarks: Landmarks, by: Array) -> Landmarks:
    turn = se2.rotation(float(by[2]))
    ids, xy, cov = landmarks.ids, se2.transform(Pose(by), landmarks.xy_map_m), turn @ landmarks.cov_m2 @ turn.T
    return Landmarks(ids, xy, cov, landmarks.crossing_type, landmarks.sightings)


def _take(drive: Drive, way: str, other: Features, upstairs: Array, lift_m: Array) -> None:
    """Ride, and come out; the cabin does not turn."""
    assert isinstance(drive.camera, FloorSight)
    if way != "ramp":
        drive.conditions.dark, drive.conditions.speed = True, 0.0
        drive.go(_DARK_S)
        drive.conditions.dark, drive.conditions.speed = False, 1.0
    if way == "ramp":
        while np.hypot(*(drive.room_pose[:2] - lift_m)) < _UP_M:
            drive.tick()
    if way != "not taken":
        drive.camera.use(other)
        drive.camera.features_from_map = np.asarray(se2.inverse(upstairs))
        drive.map_from_room = np.asarray(se2.compose(upstairs, drive.map_from_room))
