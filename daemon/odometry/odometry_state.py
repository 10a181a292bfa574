"""What visual odometry remembers from frame to frame."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from ceilvo.daemon.odometry.heading_fusion import HeadingState
from ceilvo.daemon.odometry.points.lean import LeanState
from ceilvo.daemon.odometry.points.sliding_state import SlidingState
from ceilvo.types import Array, Crossings


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
