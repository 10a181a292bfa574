"""Crossings that come and go from frame to frame: where lines are laid through the dashes of hexagons, say.

Some of hundreds move alike by chance, and points tell the way better. How many of each are seen again where the motion
puts them is counted all the time. Lines still tell direction and tilt.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from ceilvo import se2
from ceilvo.crossing_types import LINE_CROSSINGS
from ceilvo.types import Array, Crossings, Motion

_FRAMES = 10.0
"""Frames that shares are taken over; chosen: a third of a second at 30 Hz."""
_FEWEST = 3
"""Features of a kind in both frames, and frames with those, before their share counts; chosen."""
_FLICKERS, _STEADY = 0.6, 0.85
"""Share of the crossings that are seen again, below which points are looked for as well, and above which crossings are
steady again. Measured over 4 to 8 s (seed 221), median and least: tiles .90 to .96 and .82, joints of 2 and 3 levels
.88 and .82, grilles .83 and .64, fibre tiles with bars .78 and .73; drawn hexagons .35 to .58 and .16, one .72 and .65;
points .78 to .98."""
_AGREE = 0.75
"""Of the crossings, where so many bear out a motion all are taken to be seen again, and not compared; chosen."""
_MANY = 60.0
"""Crossings of a frame, in the mean, that flicker in crowds: among fewer those that move alike are found; chosen."""
_BETTER = 0.15
"""By so much more of the points are seen again, where they are taken instead; chosen."""
_ENOUGH = 12
"""Points that do without crossings; chosen, as for motion: a few more than squares that suffice."""
_SIGMAS, _LEAST_M, _MOST_M = 3.0, 0.004, 0.03
"""How far from its place a feature is seen again, in standard deviations of both, at least and at most; chosen."""


@dataclass(frozen=True, slots=True)
class Places:
    """Where features are in base: (N, 2) m, and (N,) the standard deviation of each."""

    xy_m: Array
    sigma_m: Array

    @staticmethod
    def of(crossings: Crossings, which: NDArray[np.bool_]) -> Places:
        return Places(crossings.xy_base_m[which], np.sqrt(np.trace(crossings.cov_base_m2[which], axis1=1, axis2=2)))

    def __len__(self) -> int:
        return len(self.xy_m)


NOTHING = Places(np.zeros((0, 2)), np.zeros(0))


@dataclass(slots=True)
class FlickerState:
    """What is remembered.

    Attributes:
        lines, points: of the last frame, all its crossings and the points that odometry took.
        frames: (2,) that shares are by, up to _FRAMES, of crossings and of points.
        again: (2,) share of each that is seen again.
        count: crossings of a frame.
        flickers: crossings do, so points are to be looked for though lines cross often.
        by_points: these are taken instead of crossings.
    """

    lines: Places = NOTHING
    points: Places = NOTHING
    frames: Array = field(default_factory=lambda: np.zeros(2))
    again: Array = field(default_factory=lambda: np.ones(2))
    count: float = 0.0
    flickers: bool = False
    by_points: bool = False


def steady(s: FlickerState, crossings: Crossings | None) -> Crossings | None:
    """The features of a frame that motion is by: its points alone where crossings flicker and there are enough."""
    if crossings is None or not s.by_points:
        return crossings
    if _points(crossings) < _ENOUGH:
        return crossings
    return replace(crossings.of(crossings.crossing_type >= LINE_CROSSINGS), lines=None)


def learn(
    s: FlickerState, seen: Crossings | None, taken: Crossings | None, motion: Motion, reference: Crossings | None
) -> None:
    """What the motion says about the features that were seen in a frame, and those that odometry took.

    Where it failed none of the crossings is seen again, and of the points nothing is known: they are tried in the next
    frame, where the reference that motion is measured against has enough of them.
    """
    before = s.lines, s.points
    s.lines = NOTHING if seen is None else Places.of(seen, seen.crossing_type < LINE_CROSSINGS)
    s.points = NOTHING if taken is None else Places.of(taken, taken.crossing_type >= LINE_CROSSINGS)
    if motion.restarted:
        return
    if _shared(s.lines, before[0]):
        agree = motion.ok and motion.inliers >= _AGREE * len(s.lines)
        _count(s, 0, 1.0 if agree else _again(s.lines, before[0], motion) if motion.ok else 0.0)
        s.count += (len(s.lines) - s.count) / s.frames[0]
    if _shared(s.points, before[1]) and motion.ok:
        _count(s, 1, _again(s.points, before[1], motion))
    (lines, points), known = s.again.tolist(), s.frames >= _FEWEST
    s.flickers = bool(known[0] and lines < (_STEADY if s.flickers else _FLICKERS) and s.count > _MANY)
    better = points > lines + (0.0 if s.by_points else _BETTER)
    tried = not motion.ok and not s.by_points and _points(reference) >= _ENOUGH
    s.by_points = bool(s.flickers and (better if known[1] else tried))


def _points(crossings: Crossings | None) -> int:
    return 0 if crossings is None else int(np.count_nonzero(crossings.crossing_type >= LINE_CROSSINGS))


def _shared(now: Places, before: Places) -> bool:
    return min(len(now), len(before)) >= _FEWEST


def _count(s: FlickerState, kind: int, again: float) -> None:
    s.frames[kind] = min(s.frames[kind] + 1.0, _FRAMES)
    s.again[kind] += (again - s.again[kind]) / s.frames[kind]


def _again(now: Places, before: Places, motion: Motion) -> float:
    """Share of features of now that lie on some of those before."""
    there = se2.transform(motion.prev_from_curr, now.xy_m)
    apart = np.hypot(*(there[:, None] - before.xy_m).transpose(2, 0, 1))
    reach = np.clip(_SIGMAS * (now.sigma_m[:, None] + before.sigma_m), _LEAST_M, _MOST_M)
    return float(np.mean(np.any(apart < reach, axis=1)))
