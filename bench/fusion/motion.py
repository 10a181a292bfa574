"""What wheels and gyro learn and bridge, by odometry and cross-checks alone: many drives in little time.

python -m ceilvo.bench.fusion.motion --count 100         drives for each figure, seeds 1000, 1001, ...
python -m ceilvo.bench.fusion.motion --only hour         hours of drives in which nothing slips
"""

from __future__ import annotations

import argparse
import json
import math
import sys
import zlib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console

from ceilvo import se2
from ceilvo.bench.cross_checks.drives import Eye
from ceilvo.bench.fusion.conditions import BEGIN_S, Condition
from ceilvo.bench.fusion.devices import TRACK_M, WheelsDevice
from ceilvo.bench.fusion.lateness import NONE, Lateness
from ceilvo.bench.fusion.robot import TICK_S, Moment, Ride
from ceilvo.bench.fusion.said import Said
from ceilvo.bench.fusion.senses import SENSES, Device
from ceilvo.bench.place.ceiling.worlds import World, WorldSpec, make_world
from ceilvo.bench.results.bars import Bar, as_json, table
from ceilvo.config import Config
from ceilvo.daemon.odometry.cross_checks.checks import CrossChecks
from ceilvo.daemon.odometry.cross_checks.suspicion import Kind
from ceilvo.daemon.odometry.visual_odometry import VisualOdometry
from ceilvo.files import write_atomic
from ceilvo.senses.prediction import predicted
from ceilvo.sim.rig import simulated_calibration
from ceilvo.tasks.workers import Workers, each
from ceilvo.types import Array, Displacement, Estimate, FilterHealth, Motion, Pose, State, Twist

_FRAME_TICKS = 7
"""As in the rest of this bench."""
_HALL, _ROOM = (make_world(WorldSpec(size, 0.6, "raster", 1)) for size in ("20", "5"))
"""To drive in; the ceiling that is seen is endless. In the room it turns every few seconds."""
_LATE_S, _LATE_WITHIN_S = 0.08, 0.01
"""Delays of the camera, evenly about: the issue's 80 +- 10 ms."""
_JUMP_S = 0.05
"""By which a delay jumps; chosen: a frame or two more in a camera's queue."""
_FOUND_S, _SCALE_M = 30.0, 20.0
"""Time and way after which delay and scales must be known."""
SLIPS = {Kind.SLIP_AHEAD, Kind.SLIP_SIDEWAYS, Kind.SLIP_TURNING}
_AGE_S = 0.1
"""Of a pose when it reaches a base: exposure, a frame period, a step and the line."""
_HOUR_S = 3600.0
_LEG_S = 600.0


@dataclass
class Frame:
    """After one frame: what was driven and seen so far, and the error (3,) and cov (3, 3) of the way
    since the last sight, in base at that."""

    moment: Moment
    way_m: float
    blind_m: float
    error: Array
    cov: Array
    kinds: set[Kind]
    checks: CrossChecks


class Drive:
    """One robot with these senses, and a camera whose stamps are late."""

    def __init__(
        self, seed: int, condition: Condition, senses: Sequence[str], late: Lateness = NONE, world: World = _HALL
    ) -> None:
        self._seed, self._condition, self._late = seed, condition, late
        config = Config()
        for name in senses:
            config = SENSES[name].configured(config, world)
        self.devices: list[Device] = [SENSES[n].device(world, config, self._rng(n)) for n in senses]
        self.checks, self._odometry = CrossChecks(config), VisualOdometry(config.odometry)
        self._room = world.room
        self._eye = Eye(simulated_calibration(), self._rng("eye"))

    def _rng(self, name: str) -> np.random.Generator:
        return np.random.default_rng([self._seed, zlib.crc32(name.encode())])

    def frames(self) -> Iterator[Frame]:
        ride = Ride(self._room, np.zeros(3), self._condition, self._rng("ride"))
        way_m, blind_m, seen_at, reckoned, cov = 0.0, 0.0, np.zeros(3), np.zeros(3), np.zeros((3, 3))
        before_ns: int | None = None
        late_rng, most_ticks = self._rng("late"), math.ceil(self._late.most_s / TICK_S)
        recent: list[Moment] = []
        for k, moment in enumerate(ride):
            for device in self.devices:
                device.live(moment)
            recent = [*recent[-most_ticks:], moment] if most_ticks else [moment]
            step_m = float(np.hypot(*moment.moved[:2]))
            way_m, blind_m = way_m + step_m, blind_m + step_m
            if k % _FRAME_TICKS:
                continue
            said, shown = Said(), _between(recent, self._late.of(moment.time_s, late_rng) / TICK_S)
            elapsed_s = 0.0 if before_ns is None else 1e-9 * (moment.ns - before_ns)
            for device in self.devices if before_ns is not None else ():
                device.tell(before_ns, moment.ns, said)  # type: ignore[arg-type]
            before_ns = moment.ns
            crossings = None if shown.dark or shown.bare else self._eye.see(shown.pose)
            usable = self.checks.admit(crossings, said.wheels, elapsed_s, said.heard)
            motion = self._odometry.step(usable.crossings, elapsed_s, usable.wheels, "dark", usable.turn)
            found = self.checks.step(moment.ns, crossings, motion, said.wheels, elapsed_s, said.heard)
            if motion.ok:
                seen_at, reckoned, cov, blind_m = shown.pose, np.zeros(3), np.zeros((3, 3)), 0.0
            else:
                cov = se2.compose_cov(reckoned, cov, motion.prev_from_curr, motion.cov)
                reckoned = se2.compose(reckoned, motion.prev_from_curr)
            error = reckoned - se2.between(seen_at, shown.pose)
            error[2] = se2.wrap(float(error[2]))
            yield Frame(moment, way_m, blind_m, error, cov, {s.kind for s in found.active}, self.checks)


def _between(recent: list[Moment], ticks: float) -> Moment:
    """What there was so many steps ago, which may be a part of one."""
    share = math.ceil(ticks) - ticks
    k = max(len(recent) - 1 - math.ceil(ticks), 0)
    first, after = recent[k], recent[min(k + 1, len(recent) - 1)]
    return replace(first, pose=np.asarray(se2.compose(first.pose, share * se2.between(first.pose, after.pose))))


def scales(seed: int) -> dict[str, Any]:
    """Error of what is learnt of the wheels after 20 m, its normalised square, and error before."""
    drive = Drive(seed, Condition(), ("wheels",))
    device = drive.devices[0]
    assert isinstance(device, WheelsDevice)
    true = np.array([*(device.scales - 1.0), device.track_m / TRACK_M - 1.0])
    for f in drive.frames():
        if f.way_m >= _SCALE_M:
            break
    s = drive.checks.senses.wheels.state
    off = s.off - true
    return {"off": off.tolist(), "before": true.tolist(), "nees": float(off @ np.linalg.solve(s.cov, off)) / 3.0}


def delay(seed: int, senses: Sequence[str] = ("wheels",), jitter: bool = False) -> dict[str, Any]:
    """Error of the delay after 30 s; None where none was found.

    Args:
        jitter: every picture has a delay of its own, evenly about _LATE_S; otherwise every drive has one.
    """
    mean_s = float(np.random.default_rng([seed, 1]).uniform(_LATE_S - _LATE_WITHIN_S, _LATE_S + _LATE_WITHIN_S))
    late = Lateness(_LATE_S, _LATE_WITHIN_S) if jitter else Lateness(mean_s)
    drive = Drive(seed, Condition(), senses, late, _ROOM)
    for f in drive.frames():
        if f.moment.time_s >= _FOUND_S:
            break
    off_s, sigma_s = _delay_off(drive, late.mean_s)
    return {"late_s": late.mean_s, "off_s": off_s, "sigma_s": sigma_s}


def _delay_off(drive: Drive, late_s: float) -> tuple[float | None, float | None]:
    """Error of the delay that is used now, and its standard deviation; None where none is."""
    known_s, sigma_s = drive.checks.senses.wheels_late
    return (known_s - late_s, sigma_s) if np.isfinite(sigma_s) else (None, None)


def delay_jumps(seed: int, senses: Sequence[str] = ("wheels", "gyro")) -> dict[str, Any]:
    """Time from a jump of the delay until it is said, what was said before it, and the error 30 s after it."""
    late, false, said_s = Lateness(_LATE_S, then_s=_LATE_S + _JUMP_S, then_at_s=BEGIN_S), 0, None
    drive = Drive(seed, Condition(seconds=_FOUND_S), senses, late, _ROOM)
    for f in drive.frames():
        said, now_s = Kind.DELAY_JUMPED in f.kinds, f.moment.time_s
        false += said and now_s < BEGIN_S
        said_s = now_s - BEGIN_S if said and now_s >= BEGIN_S and said_s is None else said_s
    off_s, sigma_s = _delay_off(drive, late.then_s)
    return {"said_s": said_s, "false": false, "off_s": off_s, "sigma_s": sigma_s}


def slip(seed: int) -> dict[str, Any]:
    """Time from the slip's begin until it is said; what was said before it is false."""
    false, begun = 0, False
    condition = Condition(slip_m=1.0, slip_share=0.2, seconds=6.0)
    since_s: float | None = None
    for f in Drive(seed, condition, ("wheels",)).frames():
        now, slips = f.moment.time_s, f.kinds & SLIPS
        moving = abs(float(f.moment.moved[0])) > 0.1 * TICK_S
        if now < BEGIN_S:
            false += bool(slips) and not begun
            begun = bool(slips)
        elif since_s is None and moving and f.moment.slip:
            since_s = now
        if since_s is not None and Kind.SLIP_AHEAD in slips:
            return {"said_s": now - since_s, "false": false}
    return {"said_s": None, "false": false}


def blackout(seed: int, senses: Sequence[str] = ("wheels", "gyro")) -> dict[str, Any]:
    """Error at the end of ten seconds in the dark, as a share of the way, its heading, and its normalised square."""
    last: Frame | None = None
    for f in Drive(seed, Condition(dark_s=10.0, seconds=10.0), senses).frames():
        last = f
    assert last is not None
    error = last.error
    nees = float(error @ np.linalg.solve(last.cov, error)) / 3.0
    return {"way_m": last.blind_m, "off_m": float(np.hypot(*error[:2])), "off_rad": abs(float(error[2])), "nees": nees}


def ahead(seed: int) -> dict[str, Any]:
    """Error of a right pose that is _AGE_S old: as it is, moved on by its twist, and by the wheels."""
    rng = np.random.default_rng([seed, 2])
    wheels = WheelsDevice(rng)
    moments: list[Moment] = []
    off: dict[str, list[float]] = {"as it is": [], "twist": [], "wheels": []}
    for k, moment in enumerate(Ride(_HALL.room, np.zeros(3), Condition(seconds=0.0), rng)):
        wheels.live(moment)
        moments = [*moments[-round(_AGE_S / TICK_S) - 1 :], moment]
        if k % _FRAME_TICKS or moment.time_s < 2.0:
            continue
        before, old = moments[-round(_AGE_S / TICK_S) - 2], moments[-round(_AGE_S / TICK_S) - 1]
        twist = Twist(se2.mean_twist(se2.between(before.pose, old.pose), TICK_S))
        last = _estimate(old, twist)
        told = wheels.track.aside(old.ns, moment.ns)
        for name, pose in (
            ("as it is", old.pose),
            ("twist", predicted(last, moment.ns)[0]),
            ("wheels", predicted(last, moment.ns, told)[0]),
        ):
            off[name].append(float(np.hypot(*(pose - moment.pose)[:2])))
    return {name: _rms(np.array(values)) for name, values in off.items()}


def _estimate(moment: Moment, twist: Twist) -> Estimate:
    pose, motion = Pose(moment.pose), Motion(Displacement(np.zeros(3)), np.eye(3), 10, 0.0)
    health = FilterHealth(0, 0.0, None, 0.0, 1.0, 0)
    return Estimate(1, moment.ns, pose, 1e-8 * np.eye(3), pose, twist, State.TRACKING, 1.0, "", motion, health, 0, 0)


def hour(seed: int) -> dict[str, Any]:
    """False slips in ten minutes."""
    count, on = 0, False
    for f in Drive(seed, Condition(seconds=_LEG_S - BEGIN_S), ("wheels", "gyro")).frames():
        slips = bool(f.kinds & (SLIPS | {Kind.CARRIED, Kind.DELAY_JUMPED}))
        count, on = count + (slips and not on), slips
    return {"false": count}


STUDIES: dict[str, Callable[[int], dict[str, Any]]] = {
    "scales": scales,
    "delay, wheels": delay,
    "delay, wheels and gyro": partial(delay, senses=("wheels", "gyro")),
    "delay jitters, wheels": partial(delay, jitter=True),
    "delay jitters, wheels and gyro": partial(delay, senses=("wheels", "gyro"), jitter=True),
    "jump of the delay": delay_jumps,
    "slip": slip,
    "blackout, wheels": partial(blackout, senses=("wheels",)),
    "blackout, wheels and gyro": blackout,
    "ahead": ahead,
    "hour": hour,
}


def main(arguments: Sequence[str] | None = None) -> int:
    p = argparse.ArgumentParser(
        prog="motion", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    p.add_argument("--count", type=int, default=20, help="drives a figure (%(default)s); 6 for the hour")
    p.add_argument("--first", type=int, default=1000, help="the first seed; lower ones are for tuning (%(default)s)")
    p.add_argument("--only", default="", help="studies whose name begins so")
    p.add_argument("--jobs", type=int, default=1)
    p.add_argument("--out", type=Path, default=Path("build/bench"))
    a = p.parse_args(arguments)
    a.out.mkdir(parents=True, exist_ok=True)
    for name, study in STUDIES.items():
        if name.startswith(a.only):
            count = round(_HOUR_S / _LEG_S) if name == "hour" else a.count
            rows = [r for _, r in each(study, range(a.first, a.first + count), Workers(a.jobs))]
            bars = _bars(name, rows)
            Console(width=120).print(table(bars, f"{name}, {count} drives"))
            text = json.dumps({"first": a.first, "bars": as_json(bars), "rows": rows}, indent=1)
            write_atomic(a.out / f"fusion_{name.replace(', ', '_').replace(' ', '_')}.json", text + "\n")
    return 0


def _bars(name: str, rows: list[dict[str, Any]]) -> list[Bar]:
    def column(key: str) -> Array:
        return np.array([np.nan if r[key] is None else r[key] for r in rows], np.float64)

    def quantile(key: str, share: float) -> float:
        return float(np.quantile(np.where(np.isnan(column(key)), np.inf, np.abs(column(key))), share))

    if name == "scales":
        off = np.abs([r["off"] for r in rows])
        p95 = 100.0 * float(np.quantile(off[:, :2], 0.95))
        return [
            Bar("wheels' scales after 20 m, % off, rms", r := 100.0 * _rms(off[:, :2]), f"{r:.3f}", high=0.2),
            Bar("the same, 95 %", p95, f"{p95:.3f}"),
            Bar("track, % off, rms", r := 100.0 * _rms(off[:, 2]), f"{r:.3f}"),
            Bar("NEES/3", r := float(column("nees").mean()), f"{r:.2f}", 0.5, 1.5),
        ]
    if name.startswith("delay"):
        found = column("off_s")[~np.isnan(column("off_s"))]
        return [
            Bar("found within 30 s, of all", r := len(found) / len(rows), f"{r:.2f}", low=0.95),
            Bar("ms off, rms", r := 1e3 * _rms(found), f"{r:.2f}", high=3.0),
            Bar("ms off, 95 %", r := 1e3 * quantile("off_s", 0.95), f"{r:.2f}"),
            Bar(
                "error over its sigma, rms",
                r := _rms(found / column("sigma_s")[~np.isnan(column("sigma_s"))]),
                f"{r:.2f}",
            ),
        ]
    if name.startswith("jump"):
        off = column("off_s")[~np.isnan(column("off_s"))]
        return [
            Bar("said within 30 s, of all", r := float(np.mean(~np.isnan(column("said_s")))), f"{r:.2f}", low=0.95),
            Bar("s, median", r := quantile("said_s", 0.5), f"{r:.1f}"),
            Bar("s, 95 %", r := quantile("said_s", 0.95), f"{r:.1f}"),
            Bar("false before", r := float(column("false").sum()), f"{r:.0f} in {len(rows)} min", high=0.0),
            Bar("ms off 30 s after it, rms", r := 1e3 * _rms(off), f"{r:.2f}", high=3.0),
        ]
    if name == "slip":
        said = column("said_s")
        return [
            Bar("said within .5 s, of 100", r := 100.0 * float(np.mean(said <= 0.5)), f"{r:.0f}", low=95.0),
            Bar("s, median", r := quantile("said_s", 0.5), f"{r:.2f}"),
            Bar("false before", r := float(column("false").sum()), f"{r:.0f} in {len(rows)} min", high=0.0),
        ]
    if name == "ahead":
        return [Bar(f"mm off, {key}", r := 1e3 * _rms(column(key)), f"{r:.1f}") for key in rows[0]]
    if name == "hour":
        return [Bar("false slips in an hour", r := float(column("false").sum()), f"{r:.0f}", high=0.0)]
    share, deg = 100.0 * column("off_m") / column("way_m"), np.degrees(column("off_rad"))
    return [
        Bar("% of the way, rms", r := _rms(share), f"{r:.2f}", high=1.0),
        Bar("% of the way, 95 %", r := float(np.quantile(share, 0.95)), f"{r:.2f}"),
        Bar("deg, rms", r := _rms(deg), f"{r:.2f}", high=1.0),
        Bar("NEES/3", r := float(column("nees").mean()), f"{r:.2f}", 0.5, 1.5),
    ]


def _rms(values: Array) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


if __name__ == "__main__":
    sys.exit(main())
