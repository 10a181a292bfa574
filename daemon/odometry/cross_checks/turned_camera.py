"""A camera that is turned against the wheels' direction of travel: bumped, or mounted anew. The heading is wrong by as
much, for ever, and nothing that the camera sees says so.

Straight stretches of 0.25 m each give an angle. "Above 4 deg" is tested against "below 1.5 deg" (CUSUM), on both sides.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

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
"""Over which the angle that is said is averaged; chosen: 3 m."""


@dataclass(slots=True)
class Side:
    """Evidence for a camera that is turned to one side, with the mean angle of the stretches that speak for it."""

    evidence: Cusum = field(default_factory=Cusum)
    mean_rad: float = 0.0
    stretches: int = 0


@dataclass(slots=True)
class TurnedCameraState:
    """The stretch under way (start_s in the paths' time; None = it begins with the next frame), and both sides."""

    start_s: float | None = None
    left: Side = field(default_factory=Side)
    right: Side = field(default_factory=Side)


class TurnedCamera:
    """Feed it every frame; it takes its stretches from the paths."""

    def __init__(self) -> None:
        self.state = TurnedCameraState()

    def step(self, paths: Paths, late_s: float, reversed_: bool) -> list[Suspicion]:
        """After a frame was added to the paths.

        Args:
            late_s: as in stretch().
            reversed_: wheels and picture are against each other, so that their angle says nothing finer.
        """
        s = self.state
        if reversed_:
            self.state = TurnedCameraState()
        elif not len(paths) or not paths.good[-1]:
            s.start_s = None
        else:
            found = stretch(paths, s.start_s, late_s)
            if found is None or found.way_m >= _STRETCH_M or abs(found.turned_rad) >= _STRETCH_RAD:
                s.start_s = float(paths.time_s[-1])
                if found is not None:
                    self._weigh(found)
        return [_said(side.mean_rad) for side in (self.state.left, self.state.right) if side.evidence.alarm]

    def _weigh(self, found: Stretch) -> None:
        angle_rad = found.angle_rad
        whole = found.way_m >= _STRETCH_M and found.seen_m >= _SEEN_SHARE * found.way_m
        if not whole or abs(found.turned_rad) >= _STRETCH_RAD or abs(angle_rad) > _REVERSED_RAD:
            return
        variance = _SIGMA_RAD**2 + found.var_xy_m2 / found.way_m**2
        for side, sign in ((self.state.left, 1.0), (self.state.right, -1.0)):
            off = sign * angle_rad - 0.5 * (_RIGHT_RAD + _TURNED_RAD)
            log_ratio = (_TURNED_RAD - _RIGHT_RAD) / variance * off  # of two normal densities
            _add(side, min(max(log_ratio, -_MOST_LOG_RATIO), _MOST_LOG_RATIO), angle_rad)


def _add(side: Side, log_ratio: float, angle_rad: float) -> None:
    side.evidence.add(log_ratio, threshold(_STRETCHES_BETWEEN))
    if not side.evidence.alarm and side.evidence.total == 0.0:
        side.stretches = 0
        return
    side.stretches = min(side.stretches + 1, _MEAN_STRETCHES)
    side.mean_rad += (angle_rad - side.mean_rad) / side.stretches


def _said(mean_rad: float) -> Suspicion:
    why = (
        f"the picture moves {math.degrees(mean_rad):+.1f} deg off the wheels' direction: the camera was bumped, or the "
    )
    advice = "wheels slide; the heading is off by as much, run `calib mount`"
    return Suspicion(Kind.CAMERA_TURNED, why + advice, Severity.DEGRADED, jump_rad=abs(mean_rad))
