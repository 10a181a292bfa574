"""One fault in one room with one robot, drawn from a seed: settle, fault, and what comes of it."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import asdict, dataclass
from typing import Any

import cv2
import numpy as np

from ceilvo.bench.place.ceiling.eye import SyntheticEye
from ceilvo.bench.place.ceiling.twins import Twins
from ceilvo.bench.place.ceiling.worlds import LAMPS, TILES_M, World, WorldSpec, in_map, landmarks_of, make_world
from ceilvo.bench.place.faults.kinds import CARRIED_KINDS, KINDS
from ceilvo.bench.place.faults.script import Kind, Site
from ceilvo.bench.place.robot.drive import Drive
from ceilvo.bench.place.robot.driver import Driver
from ceilvo.bench.place.robot.sights import CrossingSight, PictureSight
from ceilvo.bench.place.robot.tally import Tally, figures, times
from ceilvo.config import Config
from ceilvo.sim import world as simulated
from ceilvo.sim.ceiling.spec import CeilingSpec
from ceilvo.sim.motion import LapSpec
from ceilvo.sim.rig import simulated_calibration
from ceilvo.types import Array, Landmarks

SIZES, _SIZE_SHARES = ("5", "20", "60", "150"), (0.4, 0.3, 0.2, 0.1)
"""Of the rooms, and how often each is drawn; chosen: a hall costs more and its faults are the same."""
_HALL_TILES_M = TILES_M[1:]
"""Tiles of the largest hall: with the smallest it would have 170,000 crossings."""
_RATES_HZ, _RATE_SHARES = (10.0, 30.0), (0.8, 0.2)
_SPEEDS_MPS = (0.3, 1.0)
_LEARN_S = 90.0
"""Drive before the fault where the map is learnt; chosen: three laps of a room of 5 m."""
_FRESH_S = 6.0
"""The same where it has only begun."""
SETTLE_S = 60.0
"""A loaded map's pose must be confirmed within; chosen."""
CARRIED_WITHIN_M = 10.0
"""So far a robot that was carried is from where it was; five tiles of the largest along both axes are 8.8 m."""
_AFTER_S, _AFTER_MOST_S = 20.0, 90.0
"""Watched after a fault at least, and at most until the robot is found again; chosen: the bars are 10 m and 15 s."""


@dataclass(frozen=True)
class Case:
    """A fault by its kind (of KINDS), the seed of the bench and its number in it."""

    kind: str
    seed: int
    number: int
    sizes: tuple[str, ...] = SIZES


def cases(kinds: tuple[str, ...], count: int, seed: int, sizes: tuple[str, ...]) -> list[Case]:
    """So many, kind after kind."""
    return [Case(kinds[i % len(kinds)], seed, i, sizes) for i in range(count)]


def as_key(case: Case) -> dict[str, Any]:
    return asdict(case)


def from_key(key: Any) -> Case:
    return Case(key["kind"], key["seed"], key["number"], tuple(key["sizes"]))


def run_case(case: Case) -> dict[str, Any]:
    """The figures of a case, as JSON can hold them."""
    cv2.setNumThreads(1)
    kind = KINDS[case.kind]
    rng = np.random.default_rng([case.seed, case.number])
    wheels = bool(rng.choice(kind.wheels))
    pictures = kind.pictures and bool(rng.random() < 0.5)
    drive, site, about = _with_pictures(rng, wheels) if pictures else _with_crossings(case, kind, rng, wheels)
    about |= {"kind": case.kind, "wheels": wheels, "seed": case.seed, "number": case.number}
    about |= {"settled": False, "failed": None}
    try:
        settled = drive.settle(SETTLE_S)
        about |= {"settled": settled, "before": figures(drive.tally)}
        if settled:
            drive.step_ms.clear()
            twins = twins_of(drive, site.world, CARRIED_WITHIN_M) if case.kind in CARRIED_KINDS else None
            _fault(drive, kind.script(drive, site), twins)
    except MemoryError as e:
        about["failed"] = f"out of memory: {e}"
    key = "fault" if about["settled"] else "before"
    return about | {key: figures(drive.tally), "step_ms": times(drive.step_ms)}


def _with_crossings(
    case: Case, kind: Kind, rng: np.random.Generator, wheels: bool
) -> tuple[Drive, Site, dict[str, Any]]:
    shares = np.array([s for name, s in zip(SIZES, _SIZE_SHARES, strict=True) if name in case.sizes])
    size = str(rng.choice([name for name in SIZES if name in case.sizes], p=shares / shares.sum()))
    tile_m = float(rng.choice(_HALL_TILES_M if size == SIZES[-1] else TILES_M))
    lamps = LAMPS[int(rng.integers(len(LAMPS)))]
    world = make_world(WorldSpec(size, tile_m, lamps, 1000 * case.seed + case.number))
    rate_hz = float(rng.choice(_RATES_HZ, p=_RATE_SHARES))
    laps, speed_mps = bool(rng.random() < 0.5), float(rng.uniform(*_SPEEDS_MPS))
    drive = drive_in(world, rng, wheels, rate_hz, laps, speed_mps)
    learnt = kind.map == "fresh" or (size == "5" and rng.random() < 0.5)
    if learnt:
        drive.at_truth()
        drive.go(_FRESH_S if kind.map == "fresh" else _LEARN_S)
    else:
        load_known(drive, world, rng)
    about = {"size": size, "tile_m": tile_m, "lamps": lamps, "rate_hz": rate_hz, "laps": laps, "speed_mps": speed_mps}
    return drive, Site(tile_m, world), about | {"map": "learnt" if learnt else "loaded", "eye": "crossings"}


def drive_in(
    world: World, rng: np.random.Generator, wheels: bool, rate_hz: float, laps: bool, speed_mps: float
) -> Drive:
    """A robot at random in a room, with a daemon that knows nothing yet."""
    calibration = simulated_calibration(tile_m=world.spec.tile_m)
    driver = Driver(world.room, laps, speed_mps, rng)
    camera = CrossingSight(SyntheticEye(world.features, calibration, rng), calibration, rng)
    return Drive(camera, calibration, driver, world.map_from_ceiling, driver.start(), wheels, rate_hz, Config(), rng)


def load_known(drive: Drive, world: World, rng: np.random.Generator, pose: Array | None = None) -> Landmarks:
    """The daemon begins with the room's map and a pose (3,), else the right one; returns the map."""
    assert isinstance(drive.camera, CrossingSight)
    landmarks = landmarks_of(world.features, drive.camera.eye.missed, rng)
    drive.load(landmarks, world.features.axis_rad, pose)
    return landmarks


def _with_pictures(rng: np.random.Generator, wheels: bool) -> tuple[Drive, Site, dict[str, Any]]:
    tile_m, speed_mps = float(rng.choice(TILES_M[:3])), float(rng.uniform(*_SPEEDS_MPS))
    spec = simulated.WorldSpec(
        seed=int(rng.integers(1, 10**6)), lap=LapSpec(room_m=5.0), ceiling=CeilingSpec(tile_m=tile_m)
    )
    world = simulated.World(spec)
    laps = bool(rng.random() < 0.5)
    driver = Driver((0.0, 0.0, 5.0, 5.0), laps, speed_mps, rng)
    camera = PictureSight(world.renderer, world.calibration, rng)
    drive = Drive(camera, world.calibration, driver, np.zeros(3), driver.start(), wheels, 10.0, Config(), rng)
    drive.at_truth()
    drive.go(_LEARN_S)
    about = {"size": "5", "tile_m": tile_m, "lamps": "rendered", "rate_hz": 10.0, "laps": laps, "speed_mps": speed_mps}
    return drive, Site(tile_m), about | {"map": "learnt", "eye": "pictures"}


def twins_of(drive: Drive, world: World | None, within_m: float = np.inf) -> Twins | None:
    """Of the map that a robot under a ceiling made of crossings can know."""
    if world is None or not isinstance(drive.camera, CrossingSight):
        return None
    return Twins(world.features, in_map(drive.camera.eye.missed), drive.calibration, within_m)


def watch(twins: Twins | None, drive: Drive) -> None:
    """Mark the moment from which the robot's place can be told."""
    if twins is not None and drive.tally.told_s is None and twins.passed(drive.pose) == 1:
        drive.tally.told()


def _fault(drive: Drive, script: Iterator[None], twins: Twins | None = None) -> None:
    drive.tally = tally = Tally()
    for _ in script:
        drive.tick()
    if tally.over_s is None:
        tally.over()
    if not tally.marked:
        tally.effect()
    ended_s = tally.seconds
    for _ in range(round(_AFTER_MOST_S / drive.dt_s)):
        drive.tick()
        watch(twins, drive)
        if tally.seconds - ended_s > _AFTER_S and tally.recovered_s is not None:
            break
