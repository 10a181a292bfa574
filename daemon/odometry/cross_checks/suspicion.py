"""What a check suspects, and how grave that is."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum, IntEnum

from ceilvo.types import Displacement


class Severity(IntEnum):
    """From harmless to grave."""

    NOTED = 0
    """Said, but the pose is as good as before."""
    DEGRADED = 1
    """The pose is usable within a bound."""
    IN_DOUBT = 2
    """The robot may have got elsewhere without anybody measuring it."""
    UNUSABLE = 3
    """The picture shows neither a motion nor a view of the place where the robot is."""


class Kind(str, Enum):
    """What is suspected; the values are the names of the counters."""

    REPEATS = "picture_repeats"
    FROZEN = "picture_frozen"
    STANDS = "picture_stands"
    MOVES = "picture_moves"
    JUMPED = "picture_jumped"
    LIFTED = "lifted"
    WHEELS_REVERSED = "wheels_reversed"
    PICTURE_TURNED = "picture_turned"
    CAMERA_TURNED = "camera_turned"
    KNOCKED = "knocked"
    LATE = "picture_late"
    DELAY_JUMPED = "delay_jumped"
    SLIP_AHEAD = "wheels_slip_ahead"
    SLIP_SIDEWAYS = "wheels_slip_sideways"
    SLIP_TURNING = "wheels_slip_turning"
    CARRIED = "carried"


@dataclass(frozen=True, slots=True)
class Suspicion:
    """One thing that is suspected now.

    Attributes:
        reason: figures, and what to do.
        jump_m, jump_rad: IN_DOUBT: how far the robot may be from its pose at most. DEGRADED: how far off the pose may
            be. inf where nobody knows.
        elsewhere: (3,) displacement in base from the pose to the other place that the evidence fits; None without one.
        period: REPEATS: how many frames before the same picture came.
    """

    kind: Kind
    reason: str
    severity: Severity
    jump_m: float = 0.0
    jump_rad: float = 0.0
    elsewhere: Displacement | None = None
    period: int = 0


@dataclass(frozen=True, slots=True)
class Suspicions:
    """All that is suspected after a frame."""

    active: tuple[Suspicion, ...] = ()

    def gravest(self, severity: Severity) -> Suspicion | None:
        """The first of exactly that severity, None without one."""
        return next((s for s in self.active if s.severity is severity), None)

    def has(self, kind: Kind) -> bool:
        return any(s.kind is kind for s in self.active)
