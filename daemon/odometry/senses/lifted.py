"""Wheels stand while the gyro turns: somebody carries the robot. They stand and it is quiet: the robot stands."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from ceilvo.daemon.odometry.senses.gyro import Gyro
from ceilvo.senses.heard import Turn
from ceilvo.types import WheelMotion

_STANDS_MPS, _STANDS_RADPS = 0.004, 0.006
"""Of wheels that stand; chosen: a count or two in a frame."""
_STANDS_S = 0.3
"""So long before they count as standing; chosen: pictures may come later."""
_FADES_S = 0.5
"""Time over which a turn is gathered; chosen: nobody carries a robot for less."""
_CARRIED_RAD, _SIGMAS = 0.05, 6.0
"""Turned in that time, beyond the gyro's own error: carried; chosen: 3 deg are no play of gears."""
_CARRIED_MPS = 0.4
"""The same by accelerometers; chosen: a slope of 4 deg gathers less."""
_QUIET_RAD, _QUIET_MPS = 0.008, 0.15
"""And less than this is none: .5 deg."""
_LONGEST_S = 2.0
"""Gap through which a quiet gyro vouches that nobody moved the robot; chosen: a cart may roll smoothly for longer."""


@dataclass(slots=True)
class LiftedState:
    """
    Attributes:
        stood_s: for how long the wheels have stood.
        turned_rad, gained_mps: gathered of late while they stood.
        gap_s: since the eye last measured a motion; quiet: all through it the wheels stood and gyro told no motion.
    """

    stood_s: float = 0.0
    turned_rad: float = 0.0
    gained_mps: float = 0.0
    gap_s: float = 0.0
    quiet: bool = False


class Lifted:
    """Feed it every frame with wheels and gyro; miss() the others."""

    def __init__(self) -> None:
        self.state = LiftedState()

    @property
    def stands(self) -> bool:
        """By its wheels, for a while; and nothing says that it is carried."""
        s = self.state
        return s.stood_s > _STANDS_S and abs(s.turned_rad) < _CARRIED_RAD and s.gained_mps < _CARRIED_MPS

    def miss(self) -> None:
        self.state = LiftedState()

    def step(
        self, wheels: WheelMotion, turn: Turn, gyro: Gyro, seen: bool, elapsed_s: float
    ) -> tuple[float | None, bool]:
        """By how much it was turned while the wheels stand, None where it was not; whether a gap ends here through
        which it stood."""
        s, moved = self.state, wheels.prev_from_curr
        still_m, still_rad = _STANDS_MPS * elapsed_s + 2e-4, _STANDS_RADPS * elapsed_s + 2e-4
        stands = float(np.hypot(moved[0], moved[1])) < still_m and abs(float(moved[2])) < still_rad
        s.stood_s = s.stood_s + elapsed_s if stands else 0.0
        keep = math.exp(-elapsed_s / _FADES_S) if stands else 0.0
        s.turned_rad = keep * s.turned_rad + (gyro.turned_rad(turn) if stands else 0.0)
        if turn.gained_mps is not None:
            s.gained_mps = keep * s.gained_mps + (float(np.hypot(*turn.gained_mps)) if stands else 0.0)
        sigma = math.sqrt(gyro.var_rad2(turn)) * _FADES_S / elapsed_s
        quiet = stands and abs(s.turned_rad) < _QUIET_RAD + sigma and s.gained_mps < _QUIET_MPS
        ended = seen and 0.0 < s.gap_s < _LONGEST_S and s.quiet and quiet
        s.quiet = quiet if seen else s.quiet and quiet
        s.gap_s = 0.0 if seen else s.gap_s + elapsed_s
        carried = s.stood_s > _STANDS_S and (
            abs(s.turned_rad) > max(_CARRIED_RAD, _SIGMAS * sigma) or s.gained_mps > _CARRIED_MPS
        )
        return (s.turned_rad if carried else None), ended
