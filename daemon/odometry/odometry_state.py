"""What visual odometry remembers from frame to frame."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np

from ceilvo.daemon.odometry.coasting import RecentTwists
from ceilvo.daemon.odometry.heading_fusion import HeadingState
from ceilvo.daemon.odometry.lines.across import AcrossState
from ceilvo.daemon.odometry.points.fixtures import FixturesState
from ceilvo.daemon.odometry.points.flicker import FlickerState
from ceilvo.daemon.odometry.points.lean import LeanState
from ceilvo.daemon.odometry.points.sliding_state import SlidingState
from ceilvo.daemon.odometry.points.turning import TWIST, Turning
from ceilvo.daemon.odometry.registration import Registration
from ceilvo.se2 import compose, compose_cov
from ceilvo.types import Array, Crossings

APART = 0.15
"""A view so far from another, in metres with a radian as one, misses other things; chosen: 3.5 cm further joints that
were missed are missed again in 65 of 100, lamps in 70 (bench/place/ceiling/eye.py)."""

_USUAL_FRAMES = 45.0
"""Frames that the usual number is the mean over: 1.5 s at 30 Hz; chosen."""
_MOST_USUAL = 0.4
"""Fraction of crossings without agreement that never becomes usual; chosen: a tile too far leaves about so many."""
_SIDEWAYS_M2PS2, _PRESUMED_S = 0.3**2, 0.05
"""Mean square of the speed sideways of a robot of which nothing is known, and what that weighs in seconds of driving;
chosen: some bases drive sideways at will, most never do."""
_DRIVEN_S = 120.0
"""Driving that counts; chosen."""
_SLIPS_MPS = 0.005
"""Of any base, whatever was seen so far; chosen: a hundredth of half a metre a second, or a camera .6 deg askew."""
_DRIVES_MPS = 0.05
"""A slower robot tells nothing of it; chosen."""


@dataclass(frozen=True, slots=True)
class EarlierView:
    """A good view some way before the reference, and one nearer that takes its place in time.

    Attributes:
        crossings: of that view, None while there is none so far; at: (3,) earlier_from_ref.
        cov: (3, 3) of at, by the motions between.
        near, near_at, near_cov: the same of the nearer one.
    """

    crossings: Crossings | None = None
    at: Array = field(default_factory=lambda: np.zeros(3))
    near: Crossings | None = None
    near_at: Array = field(default_factory=lambda: np.zeros(3))
    cov: Array = field(default_factory=lambda: np.zeros((3, 3)))
    near_cov: Array = field(default_factory=lambda: np.zeros((3, 3)))

    def then(self, moved: Array, moved_cov: Array, reference: Crossings) -> EarlierView:
        """After the reference has moved on, by old_from_new (3,)."""
        at, near_at = compose(self.at, moved), compose(self.near_at, moved)
        near_cov = compose_cov(self.near_at, self.near_cov, moved, moved_cov)
        if self.near is None or math.hypot(near_at[0], near_at[1]) + abs(float(near_at[2])) > APART:
            return EarlierView(self.near, near_at, reference, cov=near_cov)
        cov = compose_cov(self.at, self.cov, moved, moved_cov)
        return EarlierView(self.crossings, at, self.near, near_at, cov, near_cov)

    @property
    def views(self) -> list[tuple[Crossings, Array, Array]]:
        """Those that there are, the nearer one first, each with earlier_from_ref (3,) and its covariance (3, 3)."""
        both = (self.near, self.near_at, self.near_cov), (self.crossings, self.at, self.cov)
        return [(view, at, cov) for view, at, cov in both if view is not None]


@dataclass(slots=True)
class VisualOdometryState:
    """What the next frame is registered to.

    Attributes:
        reference: crossings of the last good frame, None before the first.
        ref_from_prev: (3,) [m, m, rad] predicted motion from it to the previous frame; 0 when that is the reference.
        since_ref_s: time from it to the previous frame.
        failed_frames: in a row that had crossings, but none that fit the reference.
        by_hand: probability that somebody moved the robot, by what the likeliest of these showed.
        twist: (3,) [m/s, m/s, rad/s] in base, of the last good step.
        twist_known: whether there was one since odometry last began anew.
        heading: difference between the rotations of lines and points.
        held_s: length of the previous frame, where lines told its rotation though no motion was measured; 0 else.
        ref_cov: (3, 3) of ref_from_prev.
        twist_span_s: time over which the twist was measured.
        since_twist_s: time from its end to the previous frame.
        by_wheels: wheels have covered all since the reference.
        refused: (3,) ref_from_prev of the previous frame, when that was a motion that no robot makes; else None.
        disagreeing: usual fraction of the crossings that both frames must show but do not agree.
        special_disagreeing: the same of those of all types but the commonest.
        twist_change: (3,) [m/s, m/s, rad/s] of the twist from the step before to the last.
        lean: how far a robot that rocks may be off, where only points tell its motion.
        sliding: features that are followed to see whether they are the ceiling's.
        flicker: how many features are seen again.
        fixtures: what moves past slower than all lines.
        earlier: a good view before the reference, for what that misses.
        recent: twists of the last good views, of which the median goes on in a gap.
        turning: of the reference, where a single point laid it.
        across: lines of views without a motion.
        sideways_m2ps2, driven_s: mean square of the speed sideways, over so long a time in which the robot drove.
    """

    reference: Crossings | None = None
    ref_from_prev: Array = field(default_factory=lambda: np.zeros(3))
    since_ref_s: float = 0.0
    failed_frames: int = 0
    by_hand: float = 0.0
    twist: Array = field(default_factory=lambda: np.zeros(3))
    twist_known: bool = False
    heading: HeadingState = field(default_factory=HeadingState)
    held_s: float = 0.0
    ref_cov: Array = field(default_factory=lambda: np.zeros((3, 3)))
    twist_span_s: float = 0.0
    since_twist_s: float = 0.0
    by_wheels: bool = True
    refused: Array | None = None
    disagreeing: float = 0.1
    special_disagreeing: float = 0.2
    twist_change: Array = field(default_factory=lambda: np.zeros(3))
    lean: LeanState = field(default_factory=LeanState)
    sliding: SlidingState = field(default_factory=SlidingState)
    flicker: FlickerState = field(default_factory=FlickerState)
    fixtures: FixturesState = field(default_factory=FixturesState)
    earlier: EarlierView = field(default_factory=EarlierView)
    recent: RecentTwists = field(default_factory=RecentTwists)
    turning: Turning | None = None
    across: AcrossState = field(default_factory=AcrossState)
    sideways_m2ps2: float = _SIDEWAYS_M2PS2
    driven_s: float = _PRESUMED_S

    def measured(self, twist: Array, var: Array, span_s: float, known: bool) -> None:
        """A view told a twist (3,) with variances (3,), the mean over span_s; known: no other is as likely."""
        self.twist_change, self.twist, self.twist_span_s = twist - self.twist, twist, span_s
        self.twist_known, self.since_twist_s = known, 0.0
        self.recent = self.recent.then(twist, var, span_s) if known else RecentTwists()

    @property
    def sideways_mps(self) -> float:
        """Standard deviation of the speed sideways."""
        return math.hypot(math.sqrt(self.sideways_m2ps2), _SLIPS_MPS)

    def drove(self, twist: Array, span_s: float) -> None:
        """How fast the robot drives sideways, with one more twist (3,) that was measured."""
        if math.hypot(*twist[:2].tolist()) < _DRIVES_MPS:
            return
        self.driven_s = min(self.driven_s + span_s, _DRIVEN_S)
        self.sideways_m2ps2 += (float(twist[1]) ** 2 - self.sideways_m2ps2) * span_s / self.driven_s

    def turned(self, turning: Turning, step_s: float) -> None:
        """The twist while a single point holds the position."""
        self.turning, self.recent = turning, RecentTwists()
        self.measured(turning.mean[TWIST].copy(), turning.twist_var, step_s, True)

    def agreed(self, place: Registration) -> None:
        """How many crossings usually do not agree, with those of one more view."""
        self.disagreeing += (_missing(place.agreeing, place.expected) - self.disagreeing) / _USUAL_FRAMES
        special = _missing(place.special, place.special_expected)
        self.special_disagreeing += (special - self.special_disagreeing) / _USUAL_FRAMES


def _missing(agreeing: int, expected: float) -> float:
    """Fraction of the crossings that do not agree, as far as that may be usual."""
    return min(max(1.0 - agreeing / max(expected, 1.0), 0.0), _MOST_USUAL)
