"""Ceilings that are changed while nobody looks."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace

import numpy as np

from ceilvo.bench.place.ceiling.eye import Sight
from ceilvo.bench.place.ceiling.truth import Features, Origin, features_of, joined, without
from ceilvo.bench.place.ceiling.worlds import World, make_world
from ceilvo.bench.place.faults.script import Script, Site, goes_on, halt, last
from ceilvo.bench.place.robot.drive import Drive
from ceilvo.bench.place.robot.sights import CrossingSight

SHARE = 0.3
"""Of a room that is renovated, issue's."""
NIGHT_S = 8.0 * 3600.0
"""For which a robot is switched off while its ceiling is changed."""
HEIGHTS = (0.8, 0.9, 0.95, 1.05, 1.1, 1.2)
"""Height of the ceiling in a calibration over that with which the map was made."""
_OTHER = 10**9
"""Added to a world's seed for another ceiling; chosen: far from other worlds' seeds."""


def half_the_lamps(d: Drive, site: Site) -> Iterator[None]:
    """Every second crossing of lamps is gone for good."""
    camera = d.camera
    assert isinstance(camera, CrossingSight)
    f = camera.eye.features
    lamps = np.flatnonzero(f.feature_origin == Origin.LAMP)
    camera.use(without(f, lamps[d.rng.random(len(lamps)) < 0.5]))
    d.tally.effect()
    yield


def over_night(share: float) -> Script:
    """A part of the ceiling is another one."""
    return _switched_off(lambda world, d: renovated(world, share, d.rng))


def other_height(d: Drive, site: Site) -> Iterator[None]:
    """Switched off, and on with the calibration of another camera's height; after 15 s the right one is put back."""
    yield from halt(d)
    stored = d.stored()
    d.begin_anew()
    d.conditions.sight = Sight(scale=float(d.rng.choice(HEIGHTS)))
    if stored is not None:
        d.load(*stored, ago_s=NIGHT_S)
    d.tally.effect()
    yield from goes_on(d)
    yield from last(d, 15.0)
    d.conditions.sight = Sight()
    d.restart()
    d.tally.over()


def rehung() -> Script:
    """All lamps and vents hang elsewhere in the same grid."""
    return _switched_off(lambda world, d: _other_lamps(world))


def _other_lamps(world: World) -> Features:
    return make_world(replace(world.spec, hung=world.spec.seed + _OTHER)).features


def _switched_off(changed: Callable[[World, Drive], Features]) -> Script:
    """The robot is switched off for a night, the ceiling is changed, and it is switched on where it stood."""

    def script(d: Drive, site: Site) -> Iterator[None]:
        yield from halt(d)
        stored = d.stored()
        camera = d.camera
        assert isinstance(camera, CrossingSight)
        camera.use(changed(_world(site), d))
        d.begin_anew()
        if stored is not None:
            d.load(*stored, ago_s=NIGHT_S)
        d.tally.effect()
        d.tally.over()
        yield from goes_on(d)

    return script


def other_floor(d: Drive, site: Site) -> Iterator[None]:
    """By lift: the same grid with other lamps, and back after 20 s."""
    camera = d.camera
    assert isinstance(camera, CrossingSight)
    home = camera.eye.features
    yield from halt(d)
    d.conditions.dark = True
    yield from last(d, 5.0)
    camera.use(_other_lamps(_world(site)))
    d.conditions.dark = False
    yield from goes_on(d)
    yield from last(d, 20.0)
    yield from halt(d)
    d.conditions.dark = True
    yield from last(d, 5.0)
    camera.use(home)
    d.conditions.dark = False
    d.tally.effect()
    yield from goes_on(d)


def _world(site: Site) -> World:
    if site.world is None:
        raise ValueError("this fault needs a ceiling whose crossings are made, not pictures")
    return site.world


def renovated(world: World, share: float, rng: np.random.Generator) -> Features:
    """A part of the room with a grid and lamps of another room; 1 is all of it."""
    other = make_world(replace(world.spec, seed=world.spec.seed + _OTHER)).layout
    features = features_of(other, world.map_from_ceiling, world.room)
    if share >= 1.0:
        return features
    x0, y0, x1, y1 = world.room
    side = np.sqrt(share) * np.array([x1 - x0, y1 - y0])
    low = rng.uniform([x0, y0], np.array([x1, y1]) - side)
    return joined(world.features, features, world.map_from_ceiling, low, low + side)
