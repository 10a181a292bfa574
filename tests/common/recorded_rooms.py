"""Recordings of drives through one room, made of crossings, so that they are made and replayed in seconds."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from ceilvo import se2
from ceilvo.bench.place.ceiling.eye import SyntheticEye
from ceilvo.bench.refine.building import WRONG
from ceilvo.bench.refine.recorded import record
from ceilvo.bench.refine.study import Room, room, sightings
from ceilvo.calibration import Calibration
from ceilvo.daemon.refinement.calibration_field import corrected
from ceilvo.sim.rig import simulated_calibration
from ceilvo.types import Array


def believed() -> Calibration:
    """What the robot believes: focal length and k1 are off."""
    true = simulated_calibration()
    return corrected(true, WRONG * np.array([0.0, 1.0, true.camera.distortion[0], 0.0, 0.0]))


def recorded(folder: Path, seed: int, sessions: int, length_m: float, size: str = "5") -> tuple[Room, list[Path]]:
    """A hall and a recording of each session in it; each robot believes that it begins at the origin."""
    hall, true, rng = room(size, 0.6, seed, sessions, length_m), simulated_calibration(), np.random.default_rng(seed)
    paths = []
    for k, way in enumerate(hall.ways):
        eye = SyntheticEye(hall.features, true, rng.spawn(1)[0])
        path = folder / f"drive-{k}.mcap"
        record(path, sightings(eye, way, believed(), true, rng.spawn(1)[0]), believed(), np.zeros(3), 3600.0 * k)
        paths.append(path)
    return hall, paths


def cut(hall: Room, steps: int) -> Room:
    """The same with shorter ways."""
    return replace(hall, ways=tuple(w[:steps] for w in hall.ways))


def start_of(way: Array) -> Array:
    """(3,) map_from_drive: where the frame of a drive lies that believes to begin at the origin."""
    return np.asarray(se2.compose(way[0], np.zeros(3)))
