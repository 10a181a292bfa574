"""Does a step of the daemon take longer on a large map, and what does a landmark cost? Through the daemon's own path.

python -m ceilvo.bench.place steps --seconds 120 --seed 1000

One robot drives laps of 2 m on ground that its loaded map knows, another one from there on over ground that nobody has
mapped. Each has two daemons, one with the 100 landmarks there and one with 100,000, that see the same views and take
turns frame by frame. What they see is the synthetic eye's, so a step here has no share of vision, which asks no map.
"""

from __future__ import annotations

import gc
import tracemalloc
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from rich.table import Table

from ceilvo import se2
from ceilvo.bench.place.case import SETTLE_S, drive_in
from ceilvo.bench.place.ceiling.eye import SyntheticEye
from ceilvo.bench.place.ceiling.worlds import SIZES_M, World, WorldSpec, landmarks_of, make_world
from ceilvo.bench.place.robot.drive import Drive
from ceilvo.bench.place.robot.tally import Tally, figures, times
from ceilvo.bench.results.bars import Bar
from ceilvo.bench.speed.filter_load import GROWTH
from ceilvo.errors import CeilvoError
from ceilvo.sim.rig import simulated_calibration
from ceilvo.types import Array, Landmarks, Pose

COUNTS = (100, 100_000)
"""Landmarks of the two maps, issue 12's."""
MOST_BYTES = 200.0
"""A landmark of all that the daemon remembers, issue 12's bar."""
HALLS = ("150", 0.6)
"""Size and tiles (m) of the halls; two of them have 110,000 landmarks, a view shows 34 crossings."""
NEW_GROUND_M = 14.0
"""So far around the first landmarks nothing is mapped where the robot maps; the way below reaches 11.3 m."""
_KNOWN_M, _LAP_M = 0.9, 8.0
"""The robot stays within so much of the middle along both axes: 100 landmarks lie within 3 m and a view shows 1.6 m;
where it maps, laps have sides of twice that."""
_RATE_HZ, _SPEED_MPS = 10.0, 0.5
"""Of the camera and the robot; chosen: as in most cases of this bench."""
_WARM_S = 6.0
"""Driven before steps count; chosen: caches are warm, and a robot that maps has left what it knew."""
_DRIVES = {"known map": 0.0, "mapping": NEW_GROUND_M}
Result = dict[str, Any]


@dataclass(frozen=True)
class Site:
    """A hall, the map of it and of what is beside it, and (N,) how far landmarks are from the hall's middle."""

    world: World
    landmarks: Landmarks
    away_m: Array

    @staticmethod
    def of(size: str, tile_m: float, seed: int) -> Site:
        """Two halls whose grid goes on from one to the other; the robot is in the first."""
        worlds = [make_world(WorldSpec(size, tile_m, "raster", seed, hung)) for hung in (seed, seed + 1)]
        rng = np.random.default_rng([seed, 6])
        here, beside = (landmarks_of(w.features, _missed(w), rng) for w in worlds)
        aside_m = tile_m * round(SIZES_M[size][0] / tile_m)
        turn = se2.rotation(float(worlds[0].map_from_ceiling[2]))
        beside = replace(beside, ids=len(here) + beside.ids, xy_map_m=beside.xy_map_m + turn @ [aside_m, 0.0])
        columns = ("ids", "xy_map_m", "cov_m2", "crossing_type", "sightings")
        both = Landmarks(*(np.concatenate([getattr(here, c), getattr(beside, c)]) for c in columns))
        middle = se2.transform(Pose(worlds[0].map_from_ceiling), _middle(worlds[0])[None])
        return Site(worlds[0], both, np.hypot(*(both.xy_map_m - middle).T))

    def known(self, first: int, count: int, bare_m: float) -> Landmarks:
        """So many landmarks: the nearest to the middle, and after the first ones those further off than a distance."""
        order = np.argsort(self.away_m)
        rest = order[first:]
        which = np.concatenate([order[:first], rest[self.away_m[rest] > bare_m]])[:count]
        if len(which) < count:
            raise CeilvoError(f"steps: there are {len(which):,} landmarks for a map, expected {count:,}")
        return self.landmarks.of(np.sort(which))

    def drive(self, seed: int) -> Drive:
        """A robot in the middle, with a daemon that knows nothing yet."""
        drive = drive_in(self.world, np.random.default_rng([seed, 7]), True, _RATE_HZ, True, _SPEED_MPS)
        drive.room_pose = np.append(_middle(self.world), 0.0)
        self.stay_within(drive, _KNOWN_M)
        return drive

    def stay_within(self, drive: Drive, reach_m: float) -> None:
        """Laps around the middle, so far from it along both axes at most, from where the robot is."""
        middle = _middle(self.world)
        drive.driver.low, drive.driver.high = middle - reach_m, middle + reach_m
        drive.driver.anew(drive.room_pose[:2])


def measured(site: Site, counts: tuple[int, int], seconds: float, seed: int) -> list[Result]:
    """A row for each drive and map."""
    rows = []
    for name, bare_m in _DRIVES.items():
        pair = [_settled(site, site.known(counts[0], count, bare_m), seed) for count in counts]
        if bare_m:
            for drive in pair:
                site.stay_within(drive, _LAP_M)
        _by_turns(pair, _WARM_S)
        began = [drive.pipeline.filter.size() for drive in pair]
        for drive in pair:
            drive.tally = Tally()
            drive.step_ms.clear()
        _by_turns(pair, seconds)
        for count, size, drive in zip(counts, began, pair, strict=True):
            row = {"drive": name, "loaded": count, "began": size, "ended": drive.pipeline.filter.size()}
            mean = float(np.mean(drive.step_ms))
            rows.append(row | {"step_ms": times(drive.step_ms) | {"mean": mean}, "run": figures(drive.tally)})
    return rows


def remembered(site: Site, counts: tuple[int, int], seed: int) -> dict[str, float]:
    """Bytes a landmark on a loaded map: what a daemon holds that is sure of its place, and the most that there was at
    once while it loaded it, with what was read. What the small map takes is taken off both."""
    (few_held, few_peak), (many_held, many_peak) = (_traced(site, counts[0], count, seed) for count in counts)
    more = counts[1] - counts[0]
    return {"held": (many_held - few_held) / more, "loading": (many_peak - few_peak) / more}


def bars(rows: list[Result], bytes_: dict[str, float]) -> list[Bar]:
    """The issue's; it sets none for what loading takes for a moment."""
    out = []
    for name in dict.fromkeys(r["drive"] for r in rows):
        few, many = (r for r in rows if r["drive"] == name)
        for figure in ("median", "p99"):
            ratio = many["step_ms"][figure] / few["step_ms"][figure]
            what = f"{name}: {figure} of a step with {many['loaded']:,} landmarks / {few['loaded']:,}"
            out.append(Bar(what, ratio, f"{ratio:.2f}", high=GROWTH))
    held = bytes_["held"]
    out.append(Bar("bytes a landmark of all that is remembered", held, f"{held:.0f}", high=MOST_BYTES))
    return out


def table(rows: list[Result], bytes_: dict[str, float]) -> Table:
    title = "bytes a landmark: {held:.0f} remembered, {loading:.0f} at most while loading".format(**bytes_)
    columns = ("drive", "landmarks loaded", "at the begin", "at the end", "TRACKING %", "ms a step, median")
    out = Table(*columns, "mean", "p99", "max", caption=title)
    for r in rows:
        t, run = r["step_ms"], r["run"]
        tracking = 100.0 * run["state_s"].get("TRACKING", 0.0) / run["seconds"]
        ms = (f"{t[k]:.2f}" for k in ("median", "mean", "p99", "max"))
        out.add_row(r["drive"], *(f"{r[k]:,}" for k in ("loaded", "began", "ended")), f"{tracking:.1f}", *ms)
    return out


def _missed(world: World) -> Array:
    """(N,) share of the frames in which each crossing of a hall is not seen."""
    calibration = simulated_calibration(tile_m=world.spec.tile_m)
    return SyntheticEye(world.features, calibration, np.random.default_rng(0)).missed


def _middle(world: World) -> Array:
    """(2,) in the hall's own frame."""
    return np.asarray(0.5 * (np.array(world.room[:2]) + world.room[2:]))


def _settled(site: Site, landmarks: Landmarks, seed: int) -> Drive:
    """A robot whose daemon is sure of its place on a loaded map."""
    drive = site.drive(seed)
    drive.load(landmarks, site.world.features.axis_rad)
    _settle(drive, len(landmarks))
    return drive


def _settle(drive: Drive, count: int) -> None:
    """Until the daemon is sure of its place on a map of so many landmarks."""
    if not drive.settle(SETTLE_S):
        raise CeilvoError(f"steps: no TRACKING within {SETTLE_S:g} s on a map of {count}; try another seed")


def _by_turns(pair: list[Drive], seconds: float) -> None:
    """Both drive so long; who is first changes from frame to frame."""
    for k in range(round(seconds * _RATE_HZ)):
        for drive in pair[:: 1 - 2 * (k % 2)]:
            drive.tick()


def _traced(site: Site, first: int, count: int, seed: int) -> tuple[int, int]:
    """Bytes that are held once a robot is sure on a map of so many landmarks, and at most while it was loaded."""
    drive = site.drive(seed)
    gc.collect()
    tracemalloc.start()
    try:
        drive.load(site.known(first, count, 0.0), site.world.features.axis_rad)
        peak = tracemalloc.get_traced_memory()[1]
        _settle(drive, count)
        gc.collect()
        return tracemalloc.get_traced_memory()[0], peak
    finally:
        tracemalloc.stop()
