"""Poses that are said and not seen: a reset, a command, the configuration, the one that was stored. Wrong and right."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np

from ceilvo import se2
from ceilvo.bench.place.faults.script import Script, Site, carry, halt, last, tiles_away
from ceilvo.bench.place.robot.drive import Drive
from ceilvo.daemon.map.map_file import StoredMap
from ceilvo.types import Array, Pose

Claim = Callable[[Drive, Site], None]
_MOST_TILES = 8
"""A wrong place is up to so many tiles off; chosen: across a room."""
_SIGMA_RAD = 0.15
"""Of a heading that is given, where the command names none (docs/zenoh.md)."""
_STANDS_S = 10.0
"""A robot that stands does so for this long after it was told; chosen: longer than a view of one spot can help."""
_AGAIN_S, _TIMES = 2.0, 15
"""Between claims of somebody who does not wait, and how many there are; chosen."""
_UNTIL_RESTART_S = (0.5, 8.0)
"""From a claim to a restart; chosen: before most claims are confirmed or refused."""


def reset_map_kept(d: Drive, site: Site) -> Iterator[None]:
    """With the pose that is configured by default."""
    d.estimator.reset(keep_map=True)
    d.tally.effect()
    yield


def pose_a_tile_off(d: Drive, site: Site) -> Iterator[None]:
    _give(d, tiles_away(d, site, 1), 0.03, 0.02)
    d.tally.effect()
    yield


def told(claim: Claim) -> Script:
    def script(d: Drive, site: Site) -> Iterator[None]:
        """Half of the robots stand, the others drive on. Times count from the claim on."""
        stands = d.rng.random() < 0.5
        if stands:
            yield from halt(d)
        claim(d, site)
        d.tally.effect()
        d.tally.over()
        if stands:
            yield from last(d, _STANDS_S)
            d.conditions.speed = 1.0

    return script


def told_again(claim: Claim) -> Script:
    def script(d: Drive, site: Site) -> Iterator[None]:
        """Time after time, to a robot that was carried whole tiles in the dark before."""
        yield from halt(d)
        d.conditions.dark = True
        yield from carry(d, _elsewhere(d, site, turned=False), 2.0)
        d.conditions.dark = False
        d.conditions.speed = 1.0
        d.tally.effect()
        for _ in range(_TIMES):
            claim(d, site)
            yield from last(d, _AGAIN_S)

    return script


def told_and_restarted(claim: Claim) -> Script:
    def script(d: Drive, site: Site) -> Iterator[None]:
        """What was stored of a claim that nothing had confirmed is no better than the claim."""
        claim(d, site)
        d.tally.effect()
        yield from last(d, float(d.rng.uniform(*_UNTIL_RESTART_S)))
        d.restart()
        d.tally.over()

    return script


def given_a_tile_off(sigma_m: float) -> Claim:
    return lambda d, site: _give(d, tiles_away(d, site, 1), sigma_m)


def given_turned(d: Drive, site: Site) -> None:
    """By 90 or 180 deg on the spot."""
    turn = float(d.rng.choice([-0.5, 0.5, 1.0])) * np.pi
    _give(d, np.asarray(se2.compose(d.room_pose, np.array([0.0, 0.0, turn]))), 0.11)


def given_right(d: Drive, site: Site) -> None:
    """But for some centimetres, as a person gives it."""
    off = np.array([0.05, 0.05, 0.03]) * d.rng.standard_normal(3)
    _give(d, np.asarray(se2.compose(d.room_pose, off)), 0.11)


def reset_to(pose: Callable[[Drive, Site], Array]) -> Claim:
    """cmd/reset of a robot whose configuration names a pose (3,) in the room."""

    def claim(d: Drive, site: Site) -> None:
        d.configure(np.asarray(se2.compose(d.map_from_room, pose(d, site))))
        d.estimator.reset(keep_map=True)

    return claim


def started_at(pose: Callable[[Drive, Site], Array]) -> Claim:
    """Started with the map but without a stored pose, so at the configured one, (3,) in the room."""

    def claim(d: Drive, site: Site) -> None:
        landmarks, axis_rad = d.estimator.map()
        d.configure(np.asarray(se2.compose(d.map_from_room, pose(d, site))))
        d.begin_anew()
        if axis_rad is not None:
            d.estimator.load_map(StoredMap(landmarks, axis_rad), None)

    return claim


def relocalise(d: Drive, site: Site) -> None:
    d.estimator.relocalise()


def here(d: Drive, site: Site) -> Array:
    return d.room_pose


def elsewhere(d: Drive, site: Site) -> Array:
    """Whole tiles and quarter turns off: what looks most like the right place."""
    return _elsewhere(d, site, turned=True)


def _elsewhere(d: Drive, site: Site, turned: bool) -> Array:
    there = tiles_away(d, site, int(d.rng.integers(1, _MOST_TILES + 1)))
    quarters = int(d.rng.integers(4)) if turned else 0
    return np.array([*there[:2], se2.wrap(float(there[2]) + 0.5 * np.pi * quarters)])


def _give(d: Drive, pose: Array, sigma_m: float, sigma_rad: float = _SIGMA_RAD) -> None:
    """A pose (3,) in the room, as cmd/initial_pose gives it."""
    given = Pose(np.asarray(se2.compose(d.map_from_room, pose)))
    d.estimator.set_pose(given, np.array([sigma_m, sigma_m, sigma_rad]), "a pose was given")
