"""What the daemon claims of its pose against the truth.

- tracking: share of frames in TRACKING, and their worst pose; usable: the same in TRACKING or DEGRADED.
- usable of the way: the same share of what was driven while two points were in view: features of the ceiling, crossings
  or others, that odometry and filter took from that frame. Standing counts nothing.
- wrong pose: seconds in TRACKING or DEGRADED more than `WRONG_M` or `WRONG_RAD` off.
- beyond 3 sigma: share of poses in TRACKING whose position is further off than three of their own standard deviations:
  a squared distance, in units of their covariance, that chi squared exceeds as seldom as a normal error is further off.
  All frames in TRACKING count, from the first one on.
- gaps: what odometry predicted while frames failed, in units of the covariance that it gave to that, at the last of
  them: before vision gives a motion again, or odometry begins anew from a view that it could not tie to the last one.
"""

from __future__ import annotations

import math

import numpy as np

from ceilvo import se2
from ceilvo.bench.place.robot.tally import WRONG_M, WRONG_RAD
from ceilvo.bench.vision.metrics import percent
from ceilvo.types import GOOD, Array, Estimate, Motion, State

_BEYOND = 0.0027
"""Chance that a normal error is beyond three standard deviations."""
_BEYOND_CHI2 = -2.0 * math.log(_BEYOND)
"""Chi squared with 2 degrees of freedom exceeds it as seldom: 11.8."""
_TWO_POINTS = 2
"""Features that tell a pose, where it is known which they are; the issue's."""


class TrackingScore:
    """The poses that are claimed, against the truth."""

    def __init__(self, start: Array, frame_s: float) -> None:
        """start: (3,) true pose of the first frame; frame_s: from frame to frame."""
        self._start = np.array(start, np.float64)
        self._frame_s = frame_s
        self._frames = self._wrong = 0
        self._errors_m: dict[State, list[float]] = {state: [] for state in GOOD}
        self._squared: list[float] = []  # of positions in TRACKING, in units of their covariance
        self._before = self._start
        self._way_m = self._pointed_m = self._pointed_good_m = 0.0

    def add(self, estimate: Estimate, true: Array) -> None:
        """One frame's estimate, which begins at the origin, and the true pose (3,) at its time."""
        self._frames += 1
        off = estimate.pose - se2.between(self._start, true)
        off_m, good = math.hypot(off[0], off[1]), estimate.state in GOOD
        step_m, self._before = math.hypot(*(true - self._before)[:2]), true
        self._way_m += step_m
        if estimate.crossings >= _TWO_POINTS:
            self._pointed_m += step_m
            self._pointed_good_m += step_m * good
        if good:
            self._errors_m[estimate.state].append(off_m)
            self._wrong += off_m > WRONG_M or abs(se2.wrap(float(off[2]))) > WRONG_RAD
        if estimate.state is State.TRACKING:
            self._squared.append(float(off[:2] @ np.linalg.solve(estimate.cov[:2, :2], off[:2])))

    def figures(self) -> dict[str, float]:
        """Those of what there was none of are left out."""
        tracking, squared = self._errors_m[State.TRACKING], np.array(self._squared)
        usable = tracking + self._errors_m[State.DEGRADED]
        out = {
            "tracking_pct": percent(len(tracking), self._frames - len(tracking)),
            "tracking_worst_mm": 1e3 * max(tracking, default=0.0),
            "usable_pct": percent(len(usable), self._frames - len(usable)),
            "usable_worst_mm": 1e3 * max(usable, default=0.0),
            "wrong_pose_s": self._frame_s * self._wrong,
        }
        if self._way_m > 0.0:
            out["two_points_way_pct"] = 100.0 * self._pointed_m / self._way_m
        if self._pointed_m > 0.0:
            out["usable_way_pct"] = 100.0 * self._pointed_good_m / self._pointed_m
        if len(squared):
            out["beyond_3_sigma_pct"] = 100.0 * float(np.mean(squared > _BEYOND_CHI2))
            out["pose_nees"] = float(squared.mean()) / 2.0
        return out


class GapScore:
    """What was predicted while vision gave no motion, against the truth, once it sees again."""

    def __init__(self) -> None:
        self._from: Array | None = None  # true pose at the last good view
        self._moved, self._cov = np.zeros(3), np.zeros((3, 3))
        self._open: float | None = None
        self.nees: list[float] = []

    def add(self, motion: Motion, true: Array) -> None:
        """One frame's motion and the true pose (3,) at its time."""
        if motion.ok or motion.restarted:
            if self._open is not None:
                self.nees.append(self._open)
            self._from, self._open = true, None
            self._moved, self._cov = np.zeros(3), np.zeros((3, 3))
        elif self._from is not None:
            self._cov = se2.compose_cov(self._moved, self._cov, motion.prev_from_curr, motion.cov)
            self._moved = se2.compose(self._moved, motion.prev_from_curr)
            off = self._moved - se2.between(self._from, true)
            off[2] = se2.wrap(float(off[2]))
            self._open = float(off @ np.linalg.solve(self._cov, off)) / 3.0

    def figures(self) -> dict[str, float]:
        """Without a gap that ended there is no mean."""
        out = {"gaps": float(len(self.nees))}
        return out | {"gap_nees": float(np.mean(self.nees))} if self.nees else out
