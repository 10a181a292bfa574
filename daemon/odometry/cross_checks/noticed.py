"""What wheels, gyro and delays show, as suspicions."""

from __future__ import annotations

import math

from ceilvo.daemon.odometry.cross_checks.standing import CARRY_MPS, CARRY_RADPS
from ceilvo.daemon.odometry.cross_checks.suspicion import Kind, Severity, Suspicion
from ceilvo.daemon.odometry.senses.motion_senses import Noticed
from ceilvo.daemon.odometry.senses.slip import AXES, Slip

_SLIPS = dict(zip(AXES, (Kind.SLIP_AHEAD, Kind.SLIP_SIDEWAYS, Kind.SLIP_TURNING), strict=True))
EVENTS = (*_SLIPS.values(), Kind.CARRIED, Kind.DELAY_JUMPED, Kind.MOVES)
"""Each is an event of its own when it begins."""
_CARRY_S = 1.0
"""Of being carried, that a frame in the dark may be part of."""
_JUMP_SAID_S = 5.0
"""For so long a jump of the delay is an active fault; chosen: by then it is taken out."""


def suspicions_of(noticed: Noticed, seen: bool, jumped: tuple[float, float] | None) -> list[Suspicion]:
    """All that is suspected of a frame.

    Args:
        seen: the eye measured the motion.
        jumped: size of the last jump of a delay and how long ago that was, s; None without one.
    """
    found = [_slip(s) for s in noticed.slips]
    if noticed.carried_rad is not None:
        deg = math.degrees(abs(noticed.carried_rad))
        why = f"the gyro turned by {deg:.0f} deg or jolted while the wheels stood: somebody carries the robot"
        severity = Severity.IN_DOUBT if noticed.begins and not seen else Severity.NOTED
        found.append(Suspicion(Kind.CARRIED, why, severity, CARRY_MPS * _CARRY_S, CARRY_RADPS * _CARRY_S))
    if jumped is not None and jumped[1] < _JUMP_SAID_S:
        why = f"the delay between camera and base jumped by {1e3 * jumped[0]:.0f} ms: look at the camera's driver"
        found.append(Suspicion(Kind.DELAY_JUMPED, why, Severity.DEGRADED, math.inf, math.inf))
    return found


def _slip(slip: Slip) -> Suspicion:
    unit, by = ("m", 1.0) if slip.axis != AXES[2] else ("deg", math.degrees(1.0))
    counted, moved = by * slip.counted, by * slip.moved
    why = f"wheels slip, {slip.axis}: they counted {counted:.2f} {unit}, the robot moved {moved:.2f} {unit}"
    return Suspicion(_SLIPS[slip.axis], why, Severity.NOTED)
