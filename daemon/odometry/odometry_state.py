"""What visual odometry remembers from frame to frame."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np

from ceilvo.daemon.odometry.coasting import RecentTwists
from ceilvo.daemon.odometry.heading_fusion import HeadingState
from ceilvo.daemon.odometry.points.lean import LeanState
from ceilvo.daemon.odometry.points.sliding_state import SlidingState
from ceilvo.se2 import compose, compose_cov
from ceilvo.types import Array, Crossings

APART = 0.15
"""A view so far from another, in metres with a radian as one, misses other things; chosen: 3.5 cm further joints that
were missed are missed again in 65 of 100, lamps in 70 (bench/place/ceiling/eye.py)."""


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
        earlier: a good view before the reference, for what that misses.
        recent: twists of the last good views, of which the median goes on in a gap.
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
    earlier: EarlierView = field(default_factory=EarlierView)
    recent: RecentTwists = field(default_factory=RecentTwists)
