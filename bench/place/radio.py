"""Start anywhere in a hall with lamps on a perfect raster, which the eye alone cannot tell apart, with anchors."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from rich.table import Table

from ceilvo import se2
from ceilvo.bench.place.case import drive_in, load_known
from ceilvo.bench.place.ceiling.worlds import WorldSpec, make_world
from ceilvo.bench.place.robot.tally import Tally, figures, times
from ceilvo.bench.place.tables import median, share_bar
from ceilvo.bench.results.bars import Bar
from ceilvo.senses.beacons import Beacons
from ceilvo.senses.heard import Heard
from ceilvo.sim.radio import Radio, RadioSpec, in_corners, surveyed
from ceilvo.types import Array, State

TAG_M = (0.2, 0.1, 0.5)
"""Where the module sits on the robot; chosen: not above the middle, so that turning on the spot shows."""
BAR_S = 5.0
"""Issue 18."""
_WATCHED_S = 20.0
_SURVEY_M = 0.05
"""Standard deviation of the anchors' places in the file."""
_HALLS = 10
"""Starts in one hall."""


def start(seed: int, number: int, size: str, anchors: int, noise_m: float, obstructed: float) -> dict[str, Any]:
    """A start, with a stored pose that is anywhere else."""
    world = make_world(WorldSpec(size, 0.6, "perfect", 1000 * seed + number // _HALLS))
    rng = np.random.default_rng([seed, number, 7])
    drive = drive_in(world, rng, bool(number % 2), 10.0, False, 0.5)
    low, high = np.array(world.room[:2]), np.array(world.room[2:])
    true = in_corners(low, high, anchors, rng)
    in_map = tuple(_moved(a, world.map_from_ceiling) for a in true)
    spec = RadioSpec(noise_m=noise_m, obstructed=obstructed)
    radio = Radio(in_map, spec, rng.spawn(1)[0])
    beacons = replace(drive.config.beacons, tag_x_m=TAG_M[0], tag_y_m=TAG_M[1], tag_z_m=TAG_M[2], noise_m=noise_m)
    drive.config = replace(drive.config, beacons=beacons)
    drive.begin_anew()
    if anchors:
        drive.pipeline.relocaliser.know(Beacons(surveyed(in_map, _SURVEY_M, rng)))
        drive.senses = lambda stamp_ns: Heard(ranges=radio.ranges(stamp_ns, tag_at(drive.pose)))
    elsewhere = np.asarray(se2.compose(world.map_from_ceiling, drive.driver.start()))
    load_known(drive, world, rng, elsewhere)
    tally = drive.tally = Tally()
    tally.over()
    found_s, right_s = None, 0.0
    while tally.seconds < _WATCHED_S:
        estimate = drive.tick()
        tracking = estimate is not None and estimate.state is State.TRACKING
        found_s = tally.seconds if tracking and found_s is None else found_s
        right_s += drive.dt_s if tracking else 0.0
    out = {"found_s": found_s, "tracking_s": right_s, "run": figures(tally)}
    return out | {"wheels": bool(number % 2), "step_ms": times(drive.step_ms)}


def tag_at(pose: Array) -> Array:
    """(3,) of the module of a robot at a pose (3,)."""
    return np.array([*(pose[:2] + se2.rotation(float(pose[2])) @ np.array(TAG_M[:2])), TAG_M[2]])


def _moved(anchor: Any, map_from_room: Array) -> Any:
    x, y = se2.transform(map_from_room, np.array([[anchor.x_m, anchor.y_m]]))[0].tolist()
    return replace(anchor, x_m=x, y_m=y)


def table(results: list[dict[str, Any]]) -> Table:
    out = Table("wheels", "starts", "found", "s, median", "s, worst", "wrong s", "TRACKING s of 20", "ms", "p99")
    for wheels in (False, True):
        group = [r for r in results if r["wheels"] is wheels]
        found = [r["found_s"] for r in group if r["found_s"] is not None]
        wrong = sum(sum(r["run"]["wrong_s"].values()) for r in group)
        cells = [str(len(group)), str(len(found)), median(found), f"{max(found, default=np.nan):.1f}", f"{wrong:.1f}"]
        cells += [median([r["tracking_s"] for r in group])]
        cells += [median([r["step_ms"][k] for r in group]) for k in ("median", "p99")]
        out.add_row("yes" if wheels else "no", *cells)
    return out


def bars(results: list[dict[str, Any]]) -> list[Bar]:
    right = [r["found_s"] is not None and r["found_s"] <= BAR_S and not r["run"]["wrong_s"] for r in results]
    return [
        share_bar("right within 5 s, share", right, 1.0),
        share_bar("never wrong, share", [not r["run"]["wrong_s"] for r in results], 1.0),
    ]
