"""What happens to robots, as scripts: each is a walk through the conditions of a drive, a yield a frame.

effect() marks the moment from which on the daemon could know; where a script does not, its end is that moment.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from ceilvo import se2
from ceilvo.bench.place.drive import Drive
from ceilvo.bench.place.eye import Sight
from ceilvo.bench.place.worlds import World
from ceilvo.types import Array, Pose

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


# -- carried


def carried_tiles(tiles: tuple[int, ...], dark: bool) -> Script:
    def script(d: Drive, site: Site) -> Iterator[None]:
        yield from halt(d)
        to = tiles_away(d, site, int(d.rng.choice(tiles)))
        d.conditions.dark = dark
        yield from carry(d, to, float(d.rng.uniform(1.0, 3.0)))
        d.conditions.dark = False
        d.tally.effect()
        yield from goes_on(d)

    return script


def snatched(d: Drive, site: Site) -> Iterator[None]:
    """Moved 1 or 2 tiles within .1 to .3 s while the camera runs."""
    yield from halt(d)
    yield from carry(d, tiles_away(d, site, int(d.rng.integers(1, 3))), float(d.rng.uniform(0.1, 0.3)))
    d.tally.effect()
    yield from goes_on(d)


def pushed(d: Drive, site: Site) -> Iterator[None]:
    """1 or 2 tiles in the light, at a pace that the eye can follow."""
    yield from halt(d)
    d.tally.effect()
    yield from carry(d, tiles_away(d, site, int(d.rng.integers(1, 3))), float(d.rng.uniform(1.5, 4.0)))
    yield from goes_on(d)


def anywhere(dark: bool) -> Script:
    def script(d: Drive, site: Site) -> Iterator[None]:
        yield from halt(d)
        d.conditions.dark = dark
        yield from carry(d, d.driver.start(), float(d.rng.uniform(2.0, 8.0)))
        d.conditions.dark = False
        d.tally.effect()
        yield from goes_on(d)

    return script


def turned_quarter(d: Drive, site: Site) -> Iterator[None]:
    """By 90 deg within .3 s in the light."""
    yield from halt(d)
    turn = float(d.rng.choice([-0.5, 0.5])) * np.pi
    yield from carry(d, np.asarray(se2.compose(d.room_pose, np.array([0.0, 0.0, turn]))), 0.3)
    d.tally.effect()
    yield from goes_on(d)


def spun_dark(d: Drive, site: Site) -> Iterator[None]:
    """By 90 or 180 deg on the spot in the dark."""
    yield from halt(d)
    turn = float(d.rng.choice([-0.5, 0.5, 1.0])) * np.pi
    d.conditions.dark = True
    yield from carry(d, np.asarray(se2.compose(d.room_pose, np.array([0.0, 0.0, turn]))), 2.0)
    d.conditions.dark = False
    d.tally.effect()
    yield from goes_on(d)


# -- pictures


def ring(buffers: int) -> Script:
    def script(d: Drive, site: Site) -> Iterator[None]:
        """The camera repeats its last buffers."""
        kept = list(d.kept)[-buffers:]
        count = 0

        def picture(seen: object) -> object:
            nonlocal count
            count += 1
            return kept[count % len(kept)]

        d.conditions.picture = picture
        d.tally.effect()
        yield from last(d, float(d.rng.uniform(8.0, 20.0)))
        d.conditions.picture = None

    return script


def frozen(d: Drive, site: Site) -> Iterator[None]:
    """One picture with a bit of noise."""
    kept = d.kept[-1]
    d.conditions.picture = lambda seen: d.camera.again(kept)
    d.tally.effect()
    yield from last(d, float(d.rng.uniform(8.0, 20.0)))
    d.conditions.picture = None


def twice(d: Drive, site: Site) -> Iterator[None]:
    """Every picture comes twice, with stamps of its own and a bit of noise."""
    state = {"k": 0, "seen": d.kept[-1]}

    def picture(seen: object) -> object:
        state["k"] = int(state["k"]) + 1
        if int(state["k"]) % 2:
            state["seen"] = seen
            return seen
        return d.camera.again(state["seen"])

    d.conditions.picture = picture
    d.tally.effect()
    yield from last(d, 20.0)
    d.conditions.picture = None


def late(d: Drive, site: Site) -> Iterator[None]:
    """Pictures .3 s old with the stamps of now."""
    behind = round(0.3 / d.dt_s)
    d.conditions.picture = lambda seen: d.kept[max(len(d.kept) - 1 - behind, 0)]
    d.tally.effect()
    yield from last(d, 20.0)
    d.conditions.picture = None


def mirrored(d: Drive, site: Site) -> Iterator[None]:
    d.conditions.picture = d.camera.mirrored
    d.tally.effect()
    yield from last(d, float(d.rng.uniform(1.0, 8.0)))
    d.conditions.picture = None


def upside_down(d: Drive, site: Site) -> Iterator[None]:
    d.conditions.picture = d.camera.turned
    d.tally.effect()
    yield from last(d, float(d.rng.uniform(1.0, 8.0)))
    d.conditions.picture = None


def stale_now_and_then(d: Drive, site: Site) -> Iterator[None]:
    """One picture in seven is an old one."""

    def picture(seen: object) -> object:
        return d.kept[int(d.rng.integers(len(d.kept)))] if d.rng.random() < 0.15 else seen

    d.conditions.picture = picture
    d.tally.effect()
    yield from last(d, float(d.rng.uniform(2.0, 8.0)))
    d.conditions.picture = None


def sight(make: Callable[[Drive, Site], tuple[Sight, float]]) -> Script:
    """A sight that is spoilt for some seconds."""

    def script(d: Drive, site: Site) -> Iterator[None]:
        d.conditions.sight, seconds = make(d, site)
        d.tally.effect()
        yield from last(d, seconds)
        d.conditions.sight = Sight()

    return script


def people(d: Drive, site: Site) -> Iterator[None]:
    """Heads and boxes in front of the camera, which come and go."""
    discs = np.column_stack([d.rng.uniform(-1.5, 1.5, (4, 2)), d.rng.uniform(0.3, 0.9, 4)])
    way = np.column_stack([d.rng.uniform(-0.4, 0.4, (4, 2)), np.zeros(4)]) * d.dt_s
    d.tally.effect()
    for _ in range(round(15.0 / d.dt_s)):
        discs = discs + way
        discs[:, :2] = (discs[:, :2] + 2.0) % 4.0 - 2.0
        d.conditions.sight = replace(Sight(), hidden=discs)
        yield
    d.conditions.sight = Sight()


# -- darkness, silence, stamps


def dark_turning(d: Drive, site: Site) -> Iterator[None]:
    """2 s of darkness while driving and turning."""
    yield from until_turning(d)
    d.conditions.dark = True
    d.tally.effect()
    yield from last(d, 2.0)
    d.conditions.dark = False


def until_turning(d: Drive) -> Iterator[None]:
    for _ in range(round(20.0 / d.dt_s)):
        if d.turn_radps > 0.3:
            return
        yield


def blackouts(d: Drive, site: Site) -> Iterator[None]:
    d.tally.effect()
    for _ in range(6):
        d.conditions.dark = True
        yield from last(d, float(d.rng.uniform(0.1, 1.0)))
        d.conditions.dark = False
        yield from last(d, float(d.rng.uniform(0.3, 3.0)))


def dark_drive(d: Drive, site: Site) -> Iterator[None]:
    d.conditions.dark = True
    d.tally.effect()
    yield from last(d, float(d.rng.uniform(3.0, 10.0)))
    d.conditions.dark = False


def no_frames(silent: bool) -> Script:
    def script(d: Drive, site: Site) -> Iterator[None]:
        """For 1.75 to 2 s while the robot stops or speeds up."""
        stops = d.rng.random() < 0.5
        if not stops:
            yield from halt(d)
        d.conditions.silent, d.conditions.skipped = silent, not silent
        d.conditions.speed = 0.0 if stops else 1.0
        d.tally.effect()
        yield from last(d, float(d.rng.uniform(1.75, 2.0)))
        d.conditions.silent = d.conditions.skipped = False
        d.conditions.speed = 1.0

    return script


def dropped(d: Drive, site: Site) -> Iterator[None]:
    """Half of the frames."""
    d.tally.effect()
    for _ in range(round(20.0 / d.dt_s)):
        d.conditions.skipped = bool(d.rng.random() < 0.5)
        yield
    d.conditions.skipped = False


def stamps_behind(d: Drive, site: Site) -> Iterator[None]:
    d.conditions.clock = 0.8
    d.tally.effect()
    yield from last(d, 20.0)
    d.conditions.clock = 1.0


def stamps_jump(d: Drive, site: Site) -> Iterator[None]:
    """By 1 s, once."""
    d.conditions.stamp_jump_ns = 10**9
    d.tally.effect()
    yield from last(d, 1.0)


# -- wheels


def wheels_say(make: Callable[[Drive], Callable[[Array], Array]], seconds: float = 20.0, dark_s: float = 0.0) -> Script:
    def script(d: Drive, site: Site) -> Iterator[None]:
        d.conditions.slip = make(d)
        d.conditions.dark = dark_s > 0.0
        d.tally.effect()
        yield from last(d, dark_s)
        d.conditions.dark = False
        yield from last(d, seconds)
        d.conditions.slip = None

    return script


def wheels_late(d: Drive, site: Site) -> Iterator[None]:
    d.conditions.wheels_late_s = 0.25
    d.tally.effect()
    yield from last(d, 20.0)
    d.conditions.wheels_late_s = 0.0


def scaled(x: float, theta: float) -> Callable[[Drive], Callable[[Array], Array]]:
    return lambda d: lambda true: true * np.array([x, 1.0, theta])


def turning(radpm: float) -> Callable[[Drive], Callable[[Array], Array]]:
    """Wheels that slip to one side."""
    return lambda d: lambda true: true + np.array([0.0, 0.0, radpm * abs(float(true[0]))])


# -- somebody


def reset_map_kept(d: Drive, site: Site) -> Iterator[None]:
    d.estimator.reset(keep_map=True)
    d.tally.effect()
    yield


def pose_a_tile_off(d: Drive, site: Site) -> Iterator[None]:
    off = tiles_away(d, site, 1)
    pose = Pose(np.asarray(se2.compose(d.map_from_room, off)))
    d.estimator.set_pose(pose, np.array([0.03, 0.03, 0.02]), "a pose was given")
    d.tally.effect()
    yield


def restart(elsewhere: bool) -> Script:
    def script(d: Drive, site: Site) -> Iterator[None]:
        yield from halt(d)
        stored = d.stored()
        if elsewhere:
            yield from carry(d, d.driver.start(), 0.1)
        d.begin_anew()
        if stored is not None:
            d.load(*stored)
        d.tally.effect()
        yield from goes_on(d)

    return script
