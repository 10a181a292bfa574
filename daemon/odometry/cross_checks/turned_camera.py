"""A camera that is turned against the wheels' direction of travel: bumped, or mounted anew.

The heading would be wrong by as much for ever, and nothing that the camera sees says so. Straight stretches of 0.25 m
each give an angle. "Above 4 deg" is tested against "below 1.5 deg" (CUSUM), on both sides. A picture that turns at once
while the wheels do not is suspected at once; a metre later it is known whether the robot was turned or its camera.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np

from ceilvo.daemon.odometry.cross_checks.paths import Paths
from ceilvo.daemon.odometry.cross_checks.sequential import Cusum, threshold
from ceilvo.daemon.odometry.cross_checks.stretches import Stretch, stretch
from ceilvo.daemon.odometry.cross_checks.suspicion import Kind, Severity, Suspicion

_STRETCH_M, _STRETCH_RAD = 0.25, 0.06
"""Length of a stretch and its largest turn; chosen: in bends an error of the camera's place on the robot, or of the
wheels' centre, turns the direction too (2 cm at 0.4 m radius: 3 deg)."""
_SEEN_SHARE = 0.3
"""Part of it that the eye must have travelled; chosen: in a spin there is no direction to compare."""
_RIGHT_RAD, _TURNED_RAD = math.radians(1.5), math.radians(4.0)
"""Angles that are fine, and that are too much; chosen: `calib mount` finds the yaw to 0.1 deg, but wheels of unequal
size and a slope take a robot a degree off its own direction."""
_SIGMA_RAD = math.radians(1.0)
"""Of a stretch's angle besides the wheels' own covariance; chosen: as uneven floors do."""
_MOST_LOG_RATIO = 3.0
"""Of one stretch; chosen: one jolt must not decide."""
_REVERSED_RAD = math.radians(60.0)
"""Beyond it is another check's; as there."""
_STRETCHES_BETWEEN = 1e6
"""Independent stretches between two false alarms, at least: 250 km."""
_MEAN_STRETCHES = 12
"""Over which the angle is averaged; chosen: 3 m."""
YAW_SIGMA_RAD = math.radians(1.0)
"""Standard deviation of that angle; chosen: it is compared with what a slope or worn tyres do."""
_KNOCK_RAD = 0.04
"""Least turn of the picture against the wheels at once that is a knock; chosen: 2.3 deg, far above its noise."""
_KNOCK_RADPS, _KNOCK_GAP_RADPS = 0.7, 0.3
"""Least rate of it, from frame to frame and over frames that fit nothing. Chosen: wheels that slip in yaw turn a robot
by some 0.5 rad/s, but steadily."""
_KNOCK_S = 0.6
"""Longest time that a knock takes; chosen: odometry finds its way again within 8 frames."""
_KNOCK_SHARE = 0.5
"""Part of the wheels' turn meanwhile that they may have lost: they slip most in bends; chosen."""
_KNOCK_LAGS = 7
"""Lags that are tried: a late picture shows another part of what the wheels turned."""
_KNOCK_SIGMAS = 6.0
"""Of the wheels' heading, likewise."""
_KNOCK_STRETCHES = 4
"""Straight stretches that tell a knocked robot from a knocked camera; chosen: 1 m, their mean is known to 0.7 deg."""
_IN_DOUBT_RAD = math.radians(5.0)
"""A heading that may be further off must not be used; chosen."""


@dataclass(slots=True)
class Side:
    """Evidence for a camera that is turned to one side, with the mean angle of the stretches that speak for it."""

    evidence: Cusum = field(default_factory=Cusum)
    mean_rad: float = 0.0
    stretches: int = 0


@dataclass(slots=True)
class TurnedCameraState:
    """What the last stretches left.

    Attributes:
        start_s: where the stretch under way began, in the paths' time; None = it begins with the next frame.
        left, right: evidence for either side.
        knock_rad: how far the picture turned against the wheels in a knock that is not explained yet; 0 without one.
        knock_mean_rad, knock_stretches: mean angle of the straight stretches since, and their number.
    """

    start_s: float | None = None
    left: Side = field(default_factory=Side)
    right: Side = field(default_factory=Side)
    knock_rad: float = 0.0
    knock_mean_rad: float = 0.0
    knock_stretches: int = 0


class TurnedCamera:
    """Feed it every frame; it takes its stretches from the paths."""

    def __init__(self) -> None:
        self.state = TurnedCameraState()

    @property
    def yaw_rad(self) -> float:
        """From the wheels' direction of travel to the eye's, where that is known to be too much; else 0."""
        return next((s.mean_rad for s in (self.state.left, self.state.right) if s.evidence.alarm), 0.0)

    def step(self, paths: Paths, late_s: float, lag_s: float, reversed_: bool) -> list[Suspicion]:
        """After a frame was added to the paths.

        Args:
            late_s: as in stretch().
            lag_s: by how much the picture may lag behind the wheels.
            reversed_: wheels and picture are against each other, so that their angle says nothing finer.
        """
        s = self.state
        if reversed_:
            self.state = TurnedCameraState()
        elif not len(paths) or not paths.good[-1]:
            s.start_s = None
        else:
            self._knock(paths, lag_s)
            found = stretch(paths, s.start_s, late_s)
            if found is None or found.way_m >= _STRETCH_M or found.bend_rad >= _STRETCH_RAD:
                s.start_s = float(paths.time_s[-1])
                if found is not None:
                    self._weigh(found)
        return self._held()

    def _knock(self, paths: Paths, lag_s: float) -> None:
        """Whether the picture turned since it was last measured, and the wheels did not."""
        s, before = self.state, np.flatnonzero(paths.good[:-1] > 0.0)
        if not len(before):
            return
        row, now_s = int(before[-1]), float(paths.time_s[-1])
        gap_s = now_s - float(paths.time_s[row])
        if gap_s > _KNOCK_S:
            return
        ends = np.array([now_s, now_s - gap_s])[:, None] - np.linspace(0.0, lag_s, _KNOCK_LAGS)
        told_rad = -np.diff(paths.wheels_at(ends)[..., 2], axis=0)[0]
        offs_rad = float(paths.eye[-1, 2] - paths.eye[row, 2]) - told_rad
        off_rad = float(offs_rad[np.argmin(np.abs(offs_rad))])
        sigma_rad = math.sqrt(paths.wheel_variance(float(paths.time_s[row]), now_s)[1])
        rate = _KNOCK_RADPS if row == len(paths) - 2 else _KNOCK_GAP_RADPS
        slip_rad = _KNOCK_SHARE * float(np.max(np.abs(told_rad)))
        if abs(off_rad) > max(_KNOCK_RAD, _KNOCK_SIGMAS * sigma_rad, rate * gap_s, slip_rad):
            s.knock_rad, s.knock_mean_rad, s.knock_stretches = s.knock_rad + off_rad, 0.0, 0
            s.start_s = None

    def _weigh(self, found: Stretch) -> None:
        angle_rad = found.angle_rad
        whole = found.way_m >= _STRETCH_M and found.seen_m >= _SEEN_SHARE * found.way_m
        if not whole or found.bend_rad >= _STRETCH_RAD or abs(angle_rad) > _REVERSED_RAD:
            return
        self._explain_knock(angle_rad)
        variance = _SIGMA_RAD**2 + found.var_xy_m2 / found.way_m**2
        for side, sign in ((self.state.left, 1.0), (self.state.right, -1.0)):
            off = sign * angle_rad - 0.5 * (_RIGHT_RAD + _TURNED_RAD)
            log_ratio = (_TURNED_RAD - _RIGHT_RAD) / variance * off  # of two normal densities
            _add(side, min(max(log_ratio, -_MOST_LOG_RATIO), _MOST_LOG_RATIO), angle_rad)

    def _explain_knock(self, angle_rad: float) -> None:
        """A camera that was turned by the knock sees the robot travel the other way off; a robot that was, does not."""
        s, yaw_rad = self.state, self.yaw_rad
        if not s.knock_rad:
            return
        s.knock_stretches += 1
        s.knock_mean_rad += (angle_rad - s.knock_mean_rad) / s.knock_stretches
        if s.knock_stretches < _KNOCK_STRETCHES:
            return
        if abs(s.knock_mean_rad - yaw_rad + s.knock_rad) < abs(s.knock_mean_rad - yaw_rad):
            turned = Side(Cusum(alarm=abs(s.knock_mean_rad) > _RIGHT_RAD), s.knock_mean_rad, s.knock_stretches)
            s.left, s.right = (turned, Side()) if s.knock_mean_rad > 0.0 else (Side(), turned)
        s.knock_rad = 0.0

    def _held(self) -> list[Suspicion]:
        yaw_rad, knock_rad = self.yaw_rad, self.state.knock_rad
        found = []
        if yaw_rad:
            why = (
                f"the picture moves {math.degrees(yaw_rad):+.1f} deg off the wheels' direction: the camera was bumped, "
            )
            advice = "or the wheels slide; the heading is corrected by as much, run `calib mount`"
            found.append(Suspicion(Kind.CAMERA_TURNED, why + advice, Severity.DEGRADED, jump_rad=3.0 * YAW_SIGMA_RAD))
        if knock_rad:
            severity = Severity.IN_DOUBT if abs(knock_rad) > _IN_DOUBT_RAD else Severity.DEGRADED
            why = f"the picture turned by {math.degrees(knock_rad):+.1f} deg at once, the wheels did not: the robot or "
            found.append(Suspicion(Kind.KNOCKED, why + "its camera was knocked", severity, jump_rad=abs(knock_rad)))
        return found


def _add(side: Side, log_ratio: float, angle_rad: float) -> None:
    side.evidence.add(log_ratio, threshold(_STRETCHES_BETWEEN))
    if not side.evidence.alarm and side.evidence.total == 0.0:
        side.stretches = 0
        return
    side.stretches = min(side.stretches + 1, _MEAN_STRETCHES)
    side.mean_rad += (angle_rad - side.mean_rad) / side.stretches
