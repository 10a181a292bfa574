"""What happens to robots, as scripts: each is a walk through the conditions of a drive, a yield a frame.

effect() marks the moment from which on the daemon could know; where a script does not, its end is that moment.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Literal

import numpy as np

from ceilvo import se2
from ceilvo.bench.place.ceiling.worlds import World
from ceilvo.bench.place.robot.drive import Drive
from ceilvo.types import Array

Script = Callable[[Drive, "Site"], Iterator[None]]
MapFrom = Literal["any", "fresh"]


@dataclass(frozen=True)
class Site:
    """What a script knows of the place: the side of a tile, and all of it where its crossings are made."""

    tile_m: float
    world: World | None = None


@dataclass(frozen=True)
class Kind:
    """A fault.

    Attributes:
        wheels: with and without which of them it makes sense.
        pictures: it can be done to pictures as well as to crossings.
        map: known, or the robot has only begun to map.
    """

    script: Script
    wheels: tuple[bool, ...] = (True, False)
    pictures: bool = False
    map: MapFrom = "any"


def last(d: Drive, seconds: float) -> Iterator[None]:
    """So long."""
    for _ in range(max(1, round(seconds / d.dt_s))):
        yield


def carry(d: Drive, to: Array, seconds: float) -> Iterator[None]:
    """By hand to a pose (3,) in the room; it then stands there."""
    start = d.room_pose
    way = se2.between(start, to)
    steps = max(1, round(seconds / d.dt_s))
    for k in range(1, steps + 1):
        d.conditions.carried = np.asarray(se2.compose(start, way * (k / steps))) if k < steps else to
        yield
    d.driver.anew(to[:2])


def halt(d: Drive) -> Iterator[None]:
    """Brakes, and stands for a moment."""
    d.conditions.speed = 0.0
    yield from last(d, 2.5)
    d.driver.stop()


def tiles_away(d: Drive, site: Site, tiles: int) -> Array:
    """(3,) a pose so many whole tiles away along, across or diagonally, in the room; fewer where it has no room."""
    ways = d.rng.permutation(np.array([[1, 0], [-1, 0], [0, 1], [0, -1], [1, 1], [1, -1], [-1, 1], [-1, -1]]))
    for n in range(tiles, 0, -1):
        for way in ways:
            to = d.room_pose[:2] + n * site.tile_m * way
            if np.all(to >= d.driver.low - 0.5) and np.all(to <= d.driver.high + 0.5):
                return np.array([*to, d.room_pose[2]])
    return np.array([*(d.room_pose[:2] + site.tile_m * ways[0]), d.room_pose[2]])


def goes_on(d: Drive) -> Iterator[None]:
    """At once, or after a wait."""
    if d.rng.random() < 0.5:
        yield from last(d, float(d.rng.uniform(1.0, 4.0)))
    d.conditions.speed = 1.0
