"""python -m ceilvo.bench.refine.lap: two laps of 270 m at 1.2 m/s through a hall, by the daemon's own steps.

Does the first close without a second landmark for what is there already, and is the second localised on the first?
Example: python -m ceilvo.bench.refine.lap --seed 1000
"""

from __future__ import annotations

import argparse
from collections import Counter
from collections.abc import Sequence

import numpy as np
from scipy.spatial import cKDTree

from ceilvo import se2
from ceilvo.bench.place.ceiling.eye import SyntheticEye
from ceilvo.bench.place.ceiling.truth import Features
from ceilvo.bench.place.ceiling.worlds import WorldSpec, make_world
from ceilvo.bench.refine.study import RATE_HZ, sightings
from ceilvo.config import Config
from ceilvo.daemon.pipeline import Pipeline
from ceilvo.sim.rig import simulated_calibration
from ceilvo.types import Array, Estimate, Landmarks, Pose

SPEED_MPS = 1.2
SIDES_M = (86.0, 50.0)
CORNER_M = 1.2
"""Radius of a corner: 1 rad/s."""
TWICE_M = 0.2
"""A landmark belongs to the true crossing nearest to it, within so much; chosen: a third of a tile."""
_SURE = np.diag([1e-6, 1e-6, 1e-6])


def main(arguments: Sequence[str] | None = None) -> int:
    """0; the figures are for people."""
    parser = argparse.ArgumentParser(prog="python -m ceilvo.bench.refine.lap", description=__doc__)
    parser.add_argument("--seed", type=int, default=1000, help="0 to 999 for tuning, 1000 and more for figures")
    parser.add_argument("--lamps", choices=("raster", "sparse"), default="sparse")
    parser.add_argument("--laps", type=int, default=2)
    a = parser.parse_args(arguments)
    world = make_world(WorldSpec("150", 0.6, a.lamps, a.seed))
    lap, calibration = around(SIDES_M, CORNER_M, SPEED_MPS / RATE_HZ), simulated_calibration()
    rng = np.random.default_rng(a.seed)
    way = np.asarray(se2.compose(world.map_from_ceiling, np.tile(lap + np.array([30.0, 20.0, 0.0]), (a.laps, 1))))
    eye = SyntheticEye(world.features, calibration, rng.spawn(1)[0])
    pipeline = Pipeline(calibration, Config(), rng.spawn(1)[0])
    pipeline.set_pose(Pose(way[0]), _SURE, "put here")
    length_m = len(lap) * SPEED_MPS / RATE_HZ
    print(f"a lap of {length_m:.0f} m at {SPEED_MPS} m/s, {a.lamps} lamps, seed {a.seed}", flush=True)
    done: list[Estimate] = []
    known = 0
    for k, seen in enumerate(sightings(eye, way, calibration, calibration, rng.spawn(1)[0])):
        done.append(pipeline.step_crossings(seen.stamp_ns, seen.crossings, seen.wheels))
        if (k + 1) % len(lap) == 0:
            landmarks = pipeline.landmarks()
            print(told(done[-len(lap) :], way[k + 1 - len(lap) : k + 1], landmarks, world.features, known), flush=True)
            known = len(landmarks)
    return 0


def around(sides_m: tuple[float, float], radius_m: float, step_m: float) -> Array:
    """(K, 3) poses along a rectangle with round corners, counter-clockwise."""
    poses, at = [], np.zeros(3)
    for side in (*sides_m, *sides_m):
        for length, turn in ((side - 2.0 * radius_m, 0.0), (0.5 * np.pi * radius_m, 0.5 * np.pi)):
            along = np.arange(0.0, length, step_m)
            twist = np.column_stack([along, np.zeros(len(along)), turn * along / length])
            poses.append(np.array([se2.compose(at, _arc(t)) for t in twist]))
            at = se2.compose(at, _arc(np.array([length, 0.0, turn])))
    return np.concatenate(poses)


def _arc(twist: Array) -> Array:
    """(3,) where a way along an arc of so much length and turn ends."""
    length, _, turn = twist
    if abs(turn) < 1e-9:
        return np.array([length, 0.0, 0.0])
    return np.array([length / turn * np.sin(turn), length / turn * (1.0 - np.cos(turn)), turn])


def told(lap: Sequence[Estimate], truth: Array, landmarks: Landmarks, features: Features, known: int) -> str:
    """Figures of a lap, at the start of which so many landmarks were known."""
    off = np.array([e.pose[:2] for e in lap]) - truth[:, :2]
    length = 1e3 * np.hypot(*off.T)
    nis = np.array([e.health.nis for e in lap if e.health.nis_dof])
    states = Counter(e.state.name for e in lap)
    return (
        f"off the truth {np.sqrt(np.mean(length**2)):.1f} mm rms, {length.max():.1f} mm at most, {length[-1]:.1f} mm "
        f"at the end; NIS per degree of freedom {np.median(nis):.3f} median, {np.quantile(nis, 0.95):.3f} in 95 %, "
        f"{nis.max():.1f} at most; {dict(states)}; {len(landmarks)} landmarks, {len(landmarks) - known} of them new, "
        f"{twice(landmarks, features)} there twice"
    )


def twice(landmarks: Landmarks, features: Features) -> int:
    """Landmarks that are of a true crossing that another one of their type is of already."""
    off, nearest = cKDTree(features.xy_map_m).query(landmarks.xy_map_m)
    which = np.column_stack([nearest, landmarks.crossing_type])[off < TWICE_M]
    return len(which) - len(np.unique(which, axis=0))


if __name__ == "__main__":
    raise SystemExit(main())
