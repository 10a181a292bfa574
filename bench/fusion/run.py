"""Drives of one outfit, one for each condition, and what their estimates were worth against the truth."""

from __future__ import annotations

import copy
import zlib
from collections.abc import Iterable, Iterator
from dataclasses import asdict, dataclass, fields
from typing import Any

import cv2
import numpy as np

from ceilvo import se2
from ceilvo.bench.fusion.conditions import BEGIN_S, CONDITIONS
from ceilvo.bench.fusion.robot import TICK_S, Moment, Ride
from ceilvo.bench.fusion.said import Said
from ceilvo.bench.fusion.senses import OUTFITS, SENSES
from ceilvo.bench.place.ceiling.eye import SyntheticEye
from ceilvo.bench.place.ceiling.worlds import WorldSpec, landmarks_of, make_world
from ceilvo.bench.place.robot.tally import CLAIMED, WRONG_M, WRONG_RAD
from ceilvo.config import Config
from ceilvo.daemon.pipeline import Pipeline
from ceilvo.daemon.relocalisation.doubts import JUST_NOW_S
from ceilvo.senses.beacons import Beacons
from ceilvo.sim.rig import simulated_calibration
from ceilvo.types import Array, Crossings, Estimate, Pose

_FRAME_TICKS = 7
"""Between frames: 14 Hz; chosen: what counts is told, and runs take half the time of 30 Hz."""
_START_SIGMA = np.diag([1e-6, 1e-6, 1e-6])
"""m^2, m^2, rad^2 of the pose that the drive begins at."""
_NO_LINES = "no lines found"


@dataclass(frozen=True)
class Case:
    """Names of an outfit and of conditions before which the drive is the same, and the seed, which is the same world
    and way for all outfits."""

    outfit: str
    conditions: tuple[str, ...]
    seed: int


def alike(names: Iterable[str]) -> list[tuple[str, ...]]:
    """Conditions by what the drive before them is like."""
    out: dict[float, list[str]] = {}
    for name in names:
        out.setdefault(CONDITIONS[name].late_s, []).append(name)
    return [tuple(those) for those in out.values()]


def as_key(case: Case) -> dict[str, Any]:
    return asdict(case)


def from_key(key: Any) -> Case:
    return Case(key["outfit"], tuple(key["conditions"]), key["seed"])


def run_case(case: Case) -> dict[str, Any]:
    """The figures of a case by condition, as JSON can hold them. What is before the conditions is driven once."""
    cv2.setNumThreads(1)
    before = Drive(case.outfit, case.conditions[0], case.seed)
    before.begin()
    out = {}
    for name in case.conditions:
        drive = copy.deepcopy(before)
        drive.meet(name)
        out[name] = _figures(list(drive.rows()))
    return out


@dataclass
class Row:
    """One frame: time since the condition began, error (3,) in map, its NEES per degree of freedom, and more."""

    time_s: float
    error: Array
    nees: float
    claimed: bool
    way_m: float
    blind: bool
    estimate: Estimate


class Drive:
    """The robot, its senses and the daemon. Whatever is at random has a generator of its own by name."""

    def __init__(self, outfit: str, condition: str, seed: int) -> None:
        self._seed = seed
        world = make_world(WorldSpec("20", 0.6, "raster", seed))
        calibration = simulated_calibration(tile_m=world.spec.tile_m)
        config, named = Config(), OUTFITS[outfit]
        for name in named:
            config = SENSES[name].configured(config, world)
        self.devices = [SENSES[name].device(world, config, self._rng(name)) for name in named]
        self._eye = SyntheticEye(world.features, calibration, self._rng("eye"))
        self._ride = Ride(world.room, world.map_from_ceiling, CONDITIONS[condition], self._rng("ride"))
        self.pipeline = Pipeline(calibration, config, self._rng("pipeline"))
        told = [d.beacons for d in self.devices]
        known = (tuple(b for t in told for b in getattr(t, f.name)) for f in fields(Beacons))
        if any(t != Beacons() for t in told):
            self.pipeline.relocaliser.know(Beacons(*known))
        self._known = landmarks_of(world.features, self._eye.missed, self._rng("map")), world.features.axis_rad
        self._before_ns: int | None = None
        self._way_m, self._ticks = 0.0, 0
        self._recent: list[Moment] = []

    def _rng(self, name: str) -> np.random.Generator:
        return np.random.default_rng([self._seed, zlib.crc32(name.encode())])

    def begin(self) -> None:
        """Drive until the condition begins; meet() may name another one then."""
        for moment in self._ride:
            self._row(moment)
            if self._ride.begins:
                return

    def meet(self, condition: str) -> None:
        """What happens from now on is another condition's, with pictures as late."""
        assert CONDITIONS[condition].late_s == self._ride.condition.late_s
        self._ride.condition = CONDITIONS[condition]

    def rows(self) -> Iterator[Row]:
        """Of every frame from the condition's begin on."""
        for moment in self._ride:
            row = self._row(moment)
            if row is not None and moment.time_s > BEGIN_S:
                yield row

    def _row(self, moment: Moment) -> Row | None:
        """A step of the simulation; None where there was no frame."""
        late_ticks, k = round(self._ride.condition.late_s / TICK_S), self._ticks
        self._ticks += 1
        for device in self.devices:
            device.live(moment)
        self._recent = [*self._recent[-late_ticks:], moment] if late_ticks else [moment]
        self._way_m += float(np.hypot(*moment.moved[:2])) if moment.time_s > BEGIN_S else 0.0
        if k == 0:
            self.pipeline.load_map(*self._known, Pose(moment.pose), _START_SIGMA, ago_s=JUST_NOW_S)
        if k % _FRAME_TICKS:
            return None
        said = Said()
        for device in self.devices if self._before_ns is not None else ():
            device.tell(self._before_ns, moment.ns, said)  # type: ignore[arg-type]
        seen = self._seen(self._recent[0])
        estimate = self.pipeline.step_crossings(moment.ns, seen, said.wheels, missing=_NO_LINES, heard=said.heard)
        self._before_ns = moment.ns
        return _row(moment, estimate, self._way_m, seen is None)

    def _seen(self, moment: Moment) -> Crossings | None:
        return None if moment.dark or moment.bare else self._eye.look(moment.pose)


def _row(moment: Moment, estimate: Estimate, way_m: float, blind: bool) -> Row:
    error = estimate.pose - moment.pose
    error[2] = se2.wrap(float(error[2]))
    nees = float(error @ np.linalg.solve(estimate.cov, error)) / 3.0
    return Row(moment.time_s - BEGIN_S, error, nees, estimate.state in CLAIMED, way_m, blind, estimate)


def _figures(rows: list[Row]) -> dict[str, Any]:
    off_m = np.array([np.hypot(r.error[0], r.error[1]) for r in rows])
    off_rad = np.abs([r.error[2] for r in rows])
    claimed = np.array([r.claimed for r in rows])
    wrong = (off_m > WRONG_M) | (off_rad > WRONG_RAD)
    frame_s = _FRAME_TICKS * TICK_S
    blind = [k for k, r in enumerate(rows) if r.blind]
    out = {
        "rms_m": float(np.sqrt(np.mean(off_m**2))),
        "rms_rad": float(np.sqrt(np.mean(off_rad**2))),
        "max_m": float(off_m.max()),
        "nees": float(np.mean([r.nees for r in rows])),
        "wrong_s": frame_s * int(np.count_nonzero(wrong & claimed)),
        "claimed_s": frame_s * int(np.count_nonzero(claimed)),
        "end_m": float(off_m[-1]),
    }
    if blind:
        last = blind[-1]
        out |= {"blind_m": float(off_m[last]), "blind_rad": float(off_rad[last]), "blind_way_m": rows[last].way_m}
        out |= {"blind_nees": rows[last].nees}
    return out
