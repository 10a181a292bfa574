"""Wheels and eye that travel or turn against each other: an axis with the wrong sign, swapped wheels, a mirror image.

Every 0.1 m or 0.1 rad gives an angle between the two displacements and a ratio of the two turns. Their likelihoods,
reversed over not, add up (CUSUM).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

from ceilvo.daemon.odometry.cross_checks.paths import Paths
from ceilvo.daemon.odometry.cross_checks.sequential import Cusum, log_normal, threshold
from ceilvo.daemon.odometry.cross_checks.stretches import Stretch, stretch
from ceilvo.daemon.odometry.cross_checks.suspicion import Kind, Severity, Suspicion

_STRETCH_M, _STRETCH_RAD = 0.1, 0.1
"""Length or turn of a stretch; chosen: far above the noise of either, and three of them are still near."""
_LEAST_SHARE = 0.3
"""Part of a stretch's length that both must have travelled; chosen: in a spin there is no direction to compare."""
_LEAST_TURN_SHARE = 0.5
"""Part of a stretch's turn that wheels must have made; chosen: the same."""
_ANGLE_SIGMA_RAD, _RATIO_SIGMA = 0.2, 0.3
"""Of a stretch when both tell the truth: 11 deg, a bump or wheels that slip sideways in a bend; a turn's scale,
skidding. Chosen wide: reversed axes are far more than 60 deg, or a ratio of -1, away."""
_REVERSED_RAD = math.radians(60.0)
"""Least angle of a reversal; chosen: an axis that is reversed in the base's odom frame shows every angle in turn."""
_MOST_RATIO = 2.0
"""Ratios of turns are counted as if within +- this; chosen: beyond it is neither."""
_STRAY = 0.01
"""Part of all stretches that may be anything: alias motions, jolts; chosen."""
_STRETCHES_BETWEEN = 1e6
"""Independent stretches between two false alarms, at least: 100 km."""
_AGREED_M, _AGREED_RAD = 20.0, 2.0 * math.pi
"""Way and turn in agreement after which wheels that were reversed count again; chosen: an axis that is reversed in the
base's odom frame agrees for as long as the robot drives along the other."""
_SIGHT_M = 1.0
"""A picture that is against the wheels within this way after a gap was turned in the gap; chosen."""

WHEELS, PICTURE = "wheels", "picture"
"""Which of the two is taken to be wrong."""


@dataclass(slots=True)
class ReversalState:
    """The stretch under way, and what earlier ones add up to.

    Attributes:
        start_s: where the stretch began, in the paths' time; None = it begins with the next frame.
        direction, turn: evidence for reversed directions of travel, and for reversed turns.
        culprit: WHEELS or PICTURE while a reversal holds, "" otherwise.
        angle_rad: of the last stretch that spoke for a reversed direction; 0 where only turns were.
        agreed_m, agreed_rad: in agreement since the last reversal.
        piece: number of vision's unbroken path.
        since_gap_m, agreed_since_gap_m: way since it began, and how much of that agreed.
    """

    start_s: float | None = None
    direction: Cusum = field(default_factory=Cusum)
    turn: Cusum = field(default_factory=Cusum)
    culprit: str = ""
    angle_rad: float = 0.0
    agreed_m: float = 0.0
    agreed_rad: float = 0.0
    piece: float = 0.0
    since_gap_m: float = 0.0
    agreed_since_gap_m: float = 0.0


class Reversal:
    """Feed it every frame; it takes its stretches from the paths."""

    def __init__(self) -> None:
        self.state = ReversalState()

    def step(self, paths: Paths, late_s: float) -> list[Suspicion]:
        """After a frame was added to the paths; late_s as in stretch()."""
        s = self.state
        if not len(paths) or not paths.good[-1]:
            s.start_s = None
            return self._held()
        if paths.piece[-1] != s.piece:
            s.piece, s.since_gap_m, s.agreed_since_gap_m = float(paths.piece[-1]), 0.0, 0.0
        found = stretch(paths, s.start_s, late_s)
        if found is None or found.way_m >= _STRETCH_M or abs(found.turned_rad) >= _STRETCH_RAD:
            s.start_s = float(paths.time_s[-1])
            if found is not None:
                self._weigh(found)
        return self._held()

    def _weigh(self, found: Stretch) -> None:
        """Add a stretch's evidence for and against a reversal."""
        s, limit = self.state, threshold(_STRETCHES_BETWEEN)
        direction = _direction_log_ratio(found)
        turn = _turn_log_ratio(found)
        if direction > 0.0:
            s.angle_rad = found.angle_rad
        if direction < 0.0 and turn <= 0.0:
            s.agreed_m += found.way_m
            s.agreed_since_gap_m += found.way_m
        if turn < 0.0:
            s.agreed_rad += abs(found.turned_rad)
        s.since_gap_m += found.way_m
        raised = [s.direction.reaches(direction, limit), s.turn.reaches(turn, limit)]
        if any(raised):
            s.culprit = s.culprit or self._suspect()
            s.agreed_m = s.agreed_rad = 0.0
        elif self._agrees_again():
            s.culprit = ""

    def _suspect(self) -> str:
        """A picture is turned or mirrored from one frame to the next, which breaks vision's path; an axis is not."""
        s = self.state
        in_the_gap = s.piece > 0.0 and s.since_gap_m < _SIGHT_M and s.agreed_since_gap_m == 0.0
        return PICTURE if in_the_gap and s.agreed_m > _SIGHT_M else WHEELS

    def _agrees_again(self) -> bool:
        s = self.state
        if s.culprit == PICTURE:
            return s.agreed_m > _SIGHT_M
        return s.agreed_m > _AGREED_M and s.agreed_rad > _AGREED_RAD

    def _held(self) -> list[Suspicion]:
        s = self.state
        deg = math.degrees(s.angle_rad)
        if s.culprit == WHEELS:
            why = (
                f"the picture moves {deg:.0f} deg off the wheels"
                if s.angle_rad
                else "the picture turns against the wheels"
            )
            advice = "wheels are not used; check signs and sides of the base's odometry, then `calib mount`"
            return [Suspicion(Kind.WHEELS_REVERSED, f"{why}: {advice}", Severity.DEGRADED)]
        if s.culprit == PICTURE:
            why = f"since a gap the picture moves {deg:.0f} deg off the wheels, or turns against them"
            advice = "it is turned or mirrored; check the camera's settings"
            return [Suspicion(Kind.PICTURE_TURNED, f"{why}: {advice}", Severity.IN_DOUBT, math.inf, math.pi)]
        return []


def _direction_log_ratio(found: Stretch) -> float:
    """Log of the likelihoods of a reversal over an angle near 0, each with its share of strays; 0 says nothing."""
    if min(found.way_m, found.seen_m) < _LEAST_SHARE * _STRETCH_M:
        return 0.0
    angle_rad, anything = found.angle_rad, _STRAY / (2.0 * math.pi)
    reversed_ = 1.0 / (2.0 * (math.pi - _REVERSED_RAD)) if abs(angle_rad) > _REVERSED_RAD else 0.0
    near = math.exp(log_normal(angle_rad, 0.0, _ANGLE_SIGMA_RAD))
    return math.log(((1.0 - _STRAY) * reversed_ + anything) / ((1.0 - _STRAY) * near + anything))


def _turn_log_ratio(found: Stretch) -> float:
    """The same of a turn's ratio: -1 over 1."""
    if abs(found.turned_rad) < _LEAST_TURN_SHARE * _STRETCH_RAD:
        return 0.0
    ratio = min(max(float(found.eye[2]) / found.turned_rad, -_MOST_RATIO), _MOST_RATIO)
    against, along = (math.exp(log_normal(ratio, mean, _RATIO_SIGMA)) for mean in (-1.0, 1.0))
    anything = _STRAY / (2.0 * _MOST_RATIO)
    return math.log(((1.0 - _STRAY) * against + anything) / ((1.0 - _STRAY) * along + anything))
