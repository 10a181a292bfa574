"""Cameras that repeat themselves, turn round, get dirty, or have somebody in front of them."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace

import numpy as np

from ceilvo.bench.place.ceiling.eye import Sight
from ceilvo.bench.place.faults.script import Script, Site, last
from ceilvo.bench.place.robot.drive import Drive


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
