"""Fixtures that move past slower than the lines do: then all lines are of what hangs below the calibrated height.

Lamps in rows below a plain ceiling, or a truss, may be all that shows lines. These tell no heights apart, and the way
comes out as much too long as they are nearer. Vents, detectors and stains on the ceiling itself say so: things hang
from a ceiling, so what moves past slowest is at its height. Lamps are not asked, for a mirror image of one moves past
slower than any ceiling.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from ceilvo import se2
from ceilvo.types import Array, Crossings, Motion

_LOOKS, _EVERY_M, _REST_M = 10, 0.05, 6.0
"""Looks at the start and after each rest, how far apart they are, and how far a rest takes the robot; chosen: a look
costs 8 ms of a frame of 2.6."""
_FEW_COUNT = 4
"""Looks that one counts for which shows too few fixtures; chosen: three of them end a burst."""
_LEAST_M, _MOST_M = 0.12, 0.6
"""Way between two looks that are compared; chosen: at 2.2 m a height .2 m lower moves a fixture by 1.3 cm."""
_ACROSS_M = 0.02
"""How far beside the camera's way a fixture may have moved; chosen, as lines may (heights/tracks.py)."""
_SLOWER, _SLOWEST = 0.05, 0.5
"""Part of the camera's way that fixtures move with it, from which on lines are lower, and at most; chosen: 11 cm at
2.2 m, more than a lens may be off, and half of the height."""
_ALIKE, _ALIKE_M = 0.03, 0.006
"""Fixtures move alike whose parts of the way differ by less, and by less than that over the way; chosen: a pixel of a
fisheye below 3 m is 10 mm."""
_FEWEST, _MAJORITY = 4, 0.6
"""How many do at least, and of all that may; chosen."""
_TWICE = 0.02
"""Two looks in a row that differ by less say it; chosen."""
SIGMA = 0.01
"""Standard deviation of the ratio that is told so; chosen: the level is measured anew once lines of both are seen."""


@dataclass(slots=True)
class FixturesState:
    """What is remembered.

    Attributes:
        pose: (3,) of the robot, from where odometry began.
        at: (N, 2) places of fixtures as if they were as high as the lines; look: (N,) of which look each is.
        cameras: (L, 2) where the camera was at each look.
        looks: left before a rest.
        since_m: way since the last look.
        slower: part of the way that the last look told; 0 for none.
        hang_m: how far below the calibrated height all lines were taken to be, of one m; 0 where they are not, or where
            a line at the calibrated height was seen since.
    """

    pose: Array = field(default_factory=lambda: np.zeros(3))
    at: Array = field(default_factory=lambda: np.zeros((0, 2)))
    look: Array = field(default_factory=lambda: np.zeros(0))
    cameras: Array = field(default_factory=lambda: np.zeros((0, 2)))
    looks: int = _LOOKS
    since_m: float = 0.0
    slower: float = 0.0
    hang_m: float = 0.0

    @property
    def due(self) -> bool:
        """Whether the next frame is to be looked at for fixtures."""
        return self.since_m >= (_EVERY_M if self.looks else _REST_M)


def learn(s: FixturesState, seen: Crossings | None, motion: Motion, mount_xy_m: Array) -> float:
    """What a frame says: the ratio of calibrated over true height of all lines, 1 where that is not told.

    A look that finds nothing is one, too: else every frame below a bare ceiling would be.
    """
    s.pose = se2.compose(s.pose, motion.prev_from_curr)
    s.since_m += float(np.hypot(*motion.prev_from_curr[:2]))
    if not motion.ok:
        _begin(s)
    if seen is None or seen.fixtures_m is None or not motion.ok:
        return 1.0
    if not s.looks:
        _begin(s)
    camera = se2.transform(s.pose, mount_xy_m[None])[0]
    now = se2.transform(s.pose, seen.fixtures_m)
    slower = _told(s, now, camera)
    s.at, s.look = np.vstack([s.at, now]), np.append(s.look, np.full(len(now), float(len(s.cameras))))
    s.cameras, s.since_m = np.vstack([s.cameras, camera]), 0.0
    s.looks = s.looks - 1 if len(now) >= _FEWEST else max(s.looks - _FEW_COUNT, 0)
    again = slower > 0.0 and s.slower > 0.0 and abs(slower - s.slower) < _TWICE
    if not again:
        s.slower = slower
        return 1.0
    s.hang_m = 0.5 * (slower + s.slower)
    _begin(s)
    return 1.0 / (1.0 - s.hang_m)


def said(s: FixturesState, height_m: float) -> str:
    """What is wrong with the ceiling, for people, "" for nothing; height_m: the calibrated one."""
    if s.hang_m:
        return (
            f"all lines seem to hang {s.hang_m * height_m:.2f} m below the calibrated height, for vents and the like "
            "move past slower; if it is that of the lines, calibrate the ceiling's"
        )
    return "vents and the like move past slower than all lines: these may hang lower" if s.slower else ""


def _begin(s: FixturesState) -> None:
    s.at, s.look, s.cameras = np.zeros((0, 2)), np.zeros(0), np.zeros((0, 2))
    s.looks, s.since_m, s.slower = _LOOKS, 0.0, 0.0


def _told(s: FixturesState, now: Array, camera: Array) -> float:
    """What part of the way fixtures moved since the earliest look that is not too far off; 0 where they did not."""
    way = camera - s.cameras
    length = np.hypot(*way.T)
    good = np.flatnonzero((length >= _LEAST_M) & (length <= _MOST_M))
    if not len(good):
        return 0.0
    which = int(good[np.argmax(length[good])])
    return part_of_way(s.at[s.look == which], now, way[which])


def part_of_way(before: Array, now: Array, way_m: Array) -> float:
    """The part of the camera's way (2,) that points (N, 2) and (M, 2), on fixed axes, moved with it; 0 where it is
    little, or few move alike, or many another part."""
    length = float(np.hypot(*way_m))
    moved = now[:, None] - before
    along = moved @ way_m / length**2
    across = np.abs(moved[..., 0] * way_m[1] - moved[..., 1] * way_m[0]) / length
    i, j = np.nonzero((across < _ACROSS_M) & (np.abs(along) < _SLOWEST))
    part = along[i, j]
    if not len(part):
        return 0.0
    near = np.abs(part[:, None] - part) < _ALIKE + _ALIKE_M / length
    best = near[int(np.argmax(np.count_nonzero(near, axis=1)))]
    alike, others = (min(len(np.unique(i[w])), len(np.unique(j[w]))) for w in (best, ~best))
    told = float(np.median(part[best]))
    return told if alike >= _FEWEST and alike >= _MAJORITY * (alike + others) and told > _SLOWER else 0.0
