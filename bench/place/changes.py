"""Ceilings that are changed while nobody looks, and the list of all faults."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from ceilvo.bench.place import faults
from ceilvo.bench.place.drive import Drive
from ceilvo.bench.place.eye import Sight
from ceilvo.bench.place.faults import Kind, Script, Site
from ceilvo.bench.place.sights import CrossingSight
from ceilvo.bench.place.truth import Features, Origin, features_of, joined, without
from ceilvo.bench.place.worlds import World, make_world

SHARE = 0.3
"""Of a room that is renovated, issue's."""
_OTHER = 500_000
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
    """The robot is switched off, the ceiling is changed, and it is switched on where it stood."""

    def script(d: Drive, site: Site) -> Iterator[None]:
        yield from faults.halt(d)
        stored = d.stored()
        camera = d.camera
        assert isinstance(camera, CrossingSight)
        camera.use(renovated(_world(site), share, d.rng))
        d.begin_anew()
        if stored is not None:
            d.load(*stored)
        d.tally.effect()
        yield from faults.goes_on(d)

    return script


def other_floor(d: Drive, site: Site) -> Iterator[None]:
    """By lift: the same grid with other lamps, and back after 20 s."""
    camera = d.camera
    assert isinstance(camera, CrossingSight)
    home = camera.eye.features
    yield from faults.halt(d)
    d.conditions.dark = True
    yield from faults.last(d, 5.0)
    world = _world(site)
    camera.use(make_world(replace(world.spec, hung=world.spec.seed + _OTHER)).features)
    d.conditions.dark = False
    yield from faults.goes_on(d)
    yield from faults.last(d, 20.0)
    yield from faults.halt(d)
    d.conditions.dark = True
    yield from faults.last(d, 5.0)
    camera.use(home)
    d.conditions.dark = False
    d.tally.effect()
    yield from faults.goes_on(d)


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


def _scaled(d: Drive, site: Site) -> tuple[Sight, float]:
    step_m = float(d.rng.choice([-0.4, 0.4]))
    return Sight(scale=2.2 / (2.2 + step_m)), float(d.rng.uniform(10.0, 45.0))


def _bumped(d: Drive, site: Site) -> tuple[Sight, float]:
    yaw = float(d.rng.choice([-1.0, 1.0]) * d.rng.uniform(5.5, 8.0))
    return Sight(yaw_rad=float(np.radians(yaw))), 20.0


def _dirty(d: Drive, site: Site) -> tuple[Sight, float]:
    return Sight(ghosts_m=d.rng.uniform(-1.0, 1.0, (8, 2))), 20.0


def _ramp(d: Drive, site: Site) -> tuple[Sight, float]:
    tilt = float(d.rng.uniform(1.0, 3.0))
    way = d.rng.uniform(-np.pi, np.pi)
    shift = 2.2 * np.tan(np.radians(tilt)) * np.array([np.cos(way), np.sin(way)])
    return Sight(shift_m=(float(shift[0]), float(shift[1]))), 5.0


KINDS: dict[str, Kind] = {
    "carried 1 tile dark": Kind(faults.carried_tiles((1,), True)),
    "carried 2 tiles dark": Kind(faults.carried_tiles((2,), True)),
    "carried 5 tiles dark": Kind(faults.carried_tiles((5,), True)),
    "carried 8 tiles dark": Kind(faults.carried_tiles((8,), True)),
    "carried 1 to 5 tiles light": Kind(faults.carried_tiles((1, 2, 5), False)),
    "snatched": Kind(faults.snatched),
    "pushed": Kind(faults.pushed),
    "carried anywhere dark": Kind(faults.anywhere(True)),
    "carried anywhere light": Kind(faults.anywhere(False)),
    "turned 90 deg": Kind(faults.turned_quarter),
    "spun in the dark": Kind(faults.spun_dark),
    "ring of 2": Kind(faults.ring(2), pictures=True),
    "ring of 4": Kind(faults.ring(4), pictures=True),
    "frozen with noise": Kind(faults.frozen, pictures=True),
    "every frame twice": Kind(faults.twice, pictures=True),
    "pictures late": Kind(faults.late, pictures=True),
    "mirrored": Kind(faults.mirrored, pictures=True),
    "upside down": Kind(faults.upside_down, pictures=True),
    "stale now and then": Kind(faults.stale_now_and_then, pictures=True),
    "camera bumped": Kind(faults.sight(_bumped), wheels=(True,), pictures=True),
    "ceiling step": Kind(faults.sight(_scaled)),
    "lamps off": Kind(faults.sight(lambda d, site: (Sight(blind=(int(Origin.LAMP),)), 30.0))),
    "half the lamps gone": Kind(half_the_lamps),
    "dirty lens": Kind(faults.sight(_dirty)),
    "ramp": Kind(faults.sight(_ramp)),
    "faint": Kind(faults.sight(lambda d, site: (Sight(recall=0.4), 10.0))),
    "people": Kind(faults.people),
    "dark turning, fresh map": Kind(faults.dark_turning, wheels=(False,), map="fresh"),
    "dark drive": Kind(faults.dark_drive, pictures=True),
    "blackouts": Kind(faults.blackouts, pictures=True),
    "silent, changing speed": Kind(faults.no_frames(True)),
    "gap, changing speed": Kind(faults.no_frames(False)),
    "half the frames": Kind(faults.dropped),
    "stamps behind": Kind(faults.stamps_behind),
    "stamps jump": Kind(faults.stamps_jump),
    "wheels backwards": Kind(faults.wheels_say(faults.scaled(-1.0, 1.0)), wheels=(True,)),
    "wheels turn flipped": Kind(faults.wheels_say(faults.scaled(1.0, -1.0)), wheels=(True,)),
    "wheels 6 % long": Kind(faults.wheels_say(faults.scaled(1.06, 1.0), dark_s=3.0), wheels=(True,)),
    "wheels stuck": Kind(faults.wheels_say(faults.scaled(0.0, 0.0), dark_s=1.0), wheels=(True,)),
    "wheels late": Kind(faults.wheels_late, wheels=(True,)),
    "slip in yaw": Kind(faults.wheels_say(faults.turning(0.5), 2.0, 2.0), wheels=(True,)),
    "over-run": Kind(faults.wheels_say(faults.scaled(1.9, 1.0), 2.0, 2.0), wheels=(True,)),
    "loss": Kind(faults.wheels_say(faults.scaled(0.1, 1.0), 2.0, 2.0), wheels=(True,)),
    "reset, map kept": Kind(faults.reset_map_kept),
    "pose a tile off": Kind(faults.pose_a_tile_off),
    "restart here": Kind(faults.restart(False)),
    "restart elsewhere": Kind(faults.restart(True)),
    "30 % renovated": Kind(over_night(SHARE)),
    "another building": Kind(over_night(1.0)),
    "other floor": Kind(other_floor),
}
