"""What senses beside camera and wheels say of the time between two frames; a field a sense."""

from __future__ import annotations

from dataclasses import dataclass

from ceilvo.senses.beacons import LampSeen, MarkSeen, Range
from ceilvo.types import Array


@dataclass(frozen=True, slots=True)
class Turn:
    """What a gyro says of an interval, integrated over it; its bias is still in it.

    Attributes:
        turned_rad: counter-clockwise about base z, not wrapped.
        var_rad2: of its white noise; bias and scale are not in it.
        ends_rad2: variance by where the interval's ends lie in time: what it has too much the next one lacks.
        span_s: length of the interval.
        gained_mps: (2,) what accelerometers gathered along base x and y, None where there are none.
    """

    turned_rad: float
    var_rad2: float
    span_s: float
    ends_rad2: float = 0.0
    gained_mps: Array | None = None


@dataclass(frozen=True, slots=True)
class Heard:
    """Of one frame's interval; None or empty where a sense says nothing.

    Attributes:
        ranges: to radio anchors, that came in it.
        marks: in the frame at its end.
        lamps: the same; None where none were looked for.
    """

    turn: Turn | None = None
    ranges: tuple[Range, ...] = ()
    marks: tuple[MarkSeen, ...] = ()
    lamps: tuple[LampSeen, ...] | None = None


NOTHING = Heard()
"""Of a robot with camera and wheels alone."""
