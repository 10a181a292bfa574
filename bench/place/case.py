"""One fault in one room with one robot, drawn from a seed: settle, fault, and what comes of it."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import asdict, dataclass
from typing import Any

import cv2
import numpy as np

from ceilvo.bench.place.changes import KINDS
from ceilvo.bench.place.drive import Drive
from ceilvo.bench.place.eye import SyntheticEye
from ceilvo.bench.place.faults import Kind, Site
from ceilvo.bench.place.robot import Driver
from ceilvo.bench.place.sights import CrossingSight, PictureSight
from ceilvo.bench.place.tally import Tally
from ceilvo.bench.place.worlds import LAMPS, TILES_M, WorldSpec, landmarks_of, make_world
from ceilvo.config import Config
from ceilvo.sim import world as simulated
from ceilvo.sim.ceiling.spec import CeilingSpec
from ceilvo.sim.motion import LapSpec
from ceilvo.sim.rig import simulated_calibration
from ceilvo.types import State

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
_SETTLE_S, _SETTLED_S = 60.0, 3.0
"""A loaded map's pose must be confirmed within, and stay so; chosen."""
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
    settled = _settle(drive)
    about |= {"settled": settled, "before": _figures(drive.tally)}
    if settled:
        drive.step_ms.clear()
        _fault(drive, kind.script(drive, site))
        about |= {"fault": _figures(drive.tally), "step_ms": _times(drive.step_ms)}
    return about


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
    calibration = simulated_calibration(tile_m=tile_m)
    driver = Driver(world.room, laps, speed_mps, rng)
    camera = CrossingSight(SyntheticEye(world.features, calibration, rng), calibration, rng)
    drive = Drive(camera, calibration, driver, world.map_from_ceiling, driver.start(), wheels, rate_hz, Config(), rng)
    learnt = kind.map == "fresh" or (size == "5" and rng.random() < 0.5)
    if learnt:
        drive.at_truth()
        _drive(drive, _FRESH_S if kind.map == "fresh" else _LEARN_S)
    else:
        drive.load(landmarks_of(world.features, camera.eye.missed, rng), world.features.axis_rad)
    about = {"size": size, "tile_m": tile_m, "lamps": lamps, "rate_hz": rate_hz, "laps": laps, "speed_mps": speed_mps}
    return drive, Site(tile_m, world), about | {"map": "learnt" if learnt else "loaded", "eye": "crossings"}


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
    _drive(drive, _LEARN_S)
    about = {"size": "5", "tile_m": tile_m, "lamps": "rendered", "rate_hz": 10.0, "laps": laps, "speed_mps": speed_mps}
    return drive, Site(tile_m), about | {"map": "learnt", "eye": "pictures"}


def _drive(drive: Drive, seconds: float) -> None:
    for _ in range(round(seconds / drive.dt_s)):
        drive.tick()


def _settle(drive: Drive) -> bool:
    """Until TRACKING for a while; whether that came."""
    good_s = 0.0
    for _ in range(round(_SETTLE_S / drive.dt_s)):
        estimate = drive.tick()
        good_s = good_s + drive.dt_s if estimate is not None and estimate.state is State.TRACKING else 0.0
        if good_s >= _SETTLED_S:
            return True
    return False


def _fault(drive: Drive, script: Iterator[None]) -> None:
    drive.tally = tally = Tally()
    for _ in script:
        drive.tick()
    tally.over()
    if not tally.marked:
        tally.effect()
    for _ in range(round(_AFTER_MOST_S / drive.dt_s)):
        drive.tick()
        if tally.seconds - (tally.over_s or 0.0) > _AFTER_S and tally.recovered_s is not None:
            break


def _figures(t: Tally) -> dict[str, Any]:
    return {
        "seconds": round(t.seconds, 3),
        "state_s": _rounded(t.state_s),
        "wrong_s": _rounded(t.wrong_s),
        "worst_m": _rounded(t.worst_m),
        "worst_rad": _rounded(t.worst_rad),
        "alarms": t.false_alarms,
        "say_s": t.say_s,
        "waited": t.effect_s is not None,
        "recovered_s": t.recovered_s,
        "recovered_m": t.recovered_m,
        "reasons": t.reasons[-40:],
    }


def _rounded(values: dict[str, float]) -> dict[str, float]:
    return {k: round(v, 4) for k, v in values.items()}


def _times(ms: list[float]) -> dict[str, float]:
    return {
        "median": float(np.median(ms)),
        "p99": float(np.quantile(ms, 0.99)),
        "max": float(np.max(ms)),
        "sum_s": 1e-3 * sum(ms),
    }
