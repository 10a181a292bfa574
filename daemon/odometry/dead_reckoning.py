"""The path between updates: what of it is final, and what waits for the end of a gap.

While frames give no motion, predictions carry the pose. The next good motion covers the whole gap and replaces them.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

import numpy as np

from ceilvo import se2
from ceilvo.types import Array, Displacement, Motion, Pose, Twist

_NS = 1e-9
"""Seconds in a nanosecond."""


@dataclass(frozen=True, slots=True)
class Track:
    """What one frame adds to the path.

    Attributes:
        final: motion since the last final one; None while a gap lasts.
        gap: predicted motion that is not final yet; None when there is none.
        blind_m: length of the path since the last final motion, this one included.
        blind, blind_cov: (3,) and (3, 3), what prediction alone knew of the way since then, however many frames failed
            on it or did not come.
        moved_m, turned_rad: of this frame alone.
        blind_s: time since the last frame that gave a final motion; the time between two frames where none failed.
        by_wheels, watched: wheels covered all of that time, and a gyro bears out that the robot stood on them.
    """

    final: Motion | None
    gap: Motion | None
    blind_m: float
    blind: Displacement
    blind_cov: Array
    moved_m: float
    turned_rad: float
    blind_s: float
    by_wheels: bool
    watched: bool = False

    @property
    def bridged(self) -> bool:
        """Whether the view that ended it shows what one before it showed."""
        return self.final is not None and self.final.ok and not self.final.restarted

    def carry(self, pose: Pose, cov: Array) -> tuple[Pose, Array]:
        """A pose (3,) with cov (3, 3) at the last final motion, moved over the gap."""
        if self.gap is None:
            return pose, cov
        there = Pose(se2.compose(pose, self.gap.prev_from_curr))
        return there, se2.compose_cov(pose, cov, self.gap.prev_from_curr, self.gap.cov)


@dataclass(slots=True)
class DeadReckoningState:
    """All that dead reckoning remembers.

    Attributes:
        stamp_ns: of the last frame, None before the first.
        odom: (3,) odom_from_base, which no map corrects.
        twist: (3,) in base, of the last good motion.
        gap: predictions since the last final motion; None when there are none.
        blind_m, blind_s: length and time of the path in that gap.
    """

    stamp_ns: int | None = None
    odom: Pose = field(default_factory=lambda: Pose(np.zeros(3)))
    twist: Twist = field(default_factory=lambda: Twist(np.zeros(3)))
    gap: Motion | None = None
    blind_m: float = 0.0
    blind_s: float = 0.0


class DeadReckoning:
    """Adds motions up."""

    def __init__(self, process_cov: Array) -> None:
        """process_cov: (3, 3) what every final motion errs by besides its own covariance."""
        self._process_cov = process_cov
        self.state = DeadReckoningState()

    def elapsed_s(self, stamp_ns: int) -> float:
        """Time since the last frame, 0 before the first."""
        return 0.0 if self.state.stamp_ns is None else (stamp_ns - self.state.stamp_ns) * _NS

    def advance(self, stamp_ns: int, motion: Motion) -> Track:
        """Take in the motion of the frame at stamp_ns."""
        s, dt_s = self.state, self.elapsed_s(stamp_ns)
        s.stamp_ns = stamp_ns
        s.odom = Pose(se2.compose(s.odom, motion.prev_from_curr))
        gap = NO_MOTION if s.gap is None else s.gap
        moved = Displacement(se2.compose(gap.prev_from_curr, motion.prev_from_curr))
        # a good motion corrects the gap's: it is no lever for the error of the heading that was predicted
        before, step = gap.prev_from_curr, np.zeros(3) if motion.ok else motion.prev_from_curr
        blind_cov, failed_cov = motion.prior_cov, motion.cov
        if s.gap is not None:
            blind_cov, failed_cov = (se2.compose_cov(before, gap.cov, step, c) for c in (blind_cov, failed_cov))
        by_wheels, watched = gap.by_wheels and motion.by_wheels, gap.watched and motion.watched
        moved_m = math.hypot(*motion.prev_from_curr[:2].tolist())
        s.blind_m += moved_m
        s.blind_s += dt_s
        if motion.ok and s.blind_s > 0:
            s.twist = Twist(moved / s.blind_s)
        whole = replace(
            motion,
            prev_from_curr=moved,
            cov=motion.cov if motion.ok else failed_cov,
            prior_cov=blind_cov,
            by_wheels=by_wheels,
            watched=watched,
            alternatives=se2.compose(gap.prev_from_curr, motion.alternatives) if motion.doubt else motion.alternatives,
        )
        final = motion.ok or motion.restarted
        track = Track(
            final=replace(whole, cov=whole.cov + self._process_cov) if final else None,
            gap=None if final else whole,
            blind_m=s.blind_m,
            blind=moved if s.gap is None or not motion.ok else s.gap.prev_from_curr,
            blind_cov=blind_cov,
            moved_m=moved_m,
            turned_rad=abs(float(motion.prev_from_curr[2])),
            blind_s=s.blind_s,
            by_wheels=by_wheels,
            watched=watched,
        )
        s.gap = track.gap
        if final:
            self.settle()
        return track

    def settle(self) -> None:
        """Whatever is predicted in a gap no longer matters: the pose is another."""
        self.state.gap, self.state.blind_m, self.state.blind_s = None, 0.0, 0.0

    def restart(self) -> None:
        """A new odom frame; time goes on."""
        self.state = DeadReckoningState(stamp_ns=self.state.stamp_ns)


NO_MOTION = Motion(Displacement(np.zeros(3)), np.zeros((3, 3)), 0, 0.0, by_wheels=True, watched=True)
