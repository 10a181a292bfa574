"""Darkness, silence, wrong stamps, and wheels that lie."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np

from ceilvo.bench.place.faults.script import Script, Site, halt, last
from ceilvo.bench.place.robot.drive import Drive
from ceilvo.types import Array


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


def seconds_apart(d: Drive, site: Site) -> Iterator[None]:
    """A computer that is too slow: one frame in .5 to 1 s, while the robot drives on."""
    every = round(float(d.rng.uniform(0.5, 1.0)) / d.dt_s)
    d.tally.effect()
    for k in range(round(15.0 / d.dt_s)):
        d.conditions.skipped = k % every != 0
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
