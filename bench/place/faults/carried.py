"""Robots that are carried, pushed, turned or restarted."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from ceilvo import se2
from ceilvo.bench.place.faults.script import Script, Site, carry, goes_on, halt, tiles_away
from ceilvo.bench.place.robot.drive import Drive


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


def towed(d: Drive, site: Site) -> Iterator[None]:
    """In the dark on its own wheels, which turn and say so."""
    yield from halt(d)
    d.conditions.dark, d.conditions.lifted = True, False
    ahead = np.array([float(d.rng.uniform(0.5, 1.5)), 0.0, float(d.rng.uniform(-1.0, 1.0))])
    to = np.asarray(se2.compose(d.room_pose, ahead))
    to[:2] = np.clip(to[:2], d.driver.low, d.driver.high)
    yield from carry(d, to, 4.0)
    d.conditions.dark, d.conditions.lifted = False, True
    d.tally.effect()
    yield from goes_on(d)


def wheels_in_the_air(d: Drive, site: Site) -> Iterator[None]:
    """Carried 1 or 2 tiles in the dark while its wheels drive on."""
    yield from halt(d)
    d.conditions.dark = True
    d.conditions.slip = lambda true: np.array([0.3 * d.dt_s, 0.0, 0.1 * d.dt_s])
    yield from carry(d, tiles_away(d, site, int(d.rng.integers(1, 3))), float(d.rng.uniform(1.0, 3.0)))
    d.conditions.dark, d.conditions.slip = False, None
    d.tally.effect()
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


def restart(elsewhere: bool, ago_s: float | None = None) -> Script:
    """Switched off and on, carried in between or not; ago_s: for how long, else for seconds."""

    def script(d: Drive, site: Site) -> Iterator[None]:
        yield from halt(d)
        stored = d.stored()
        if elsewhere:
            yield from carry(d, d.driver.start(), 0.1)
        d.begin_anew()
        if stored is not None:
            d.load(*stored, ago_s=ago_s)
        d.tally.effect()
        d.tally.over()
        yield from goes_on(d)

    return script
