"""What happens to the robot: each condition begins at BEGIN_S, when map, wheels and gyro are known."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

BEGIN_S = 60.0
"""Driven before; chosen: 20 m and more, in which the wheels' scales are learnt."""


@dataclass(frozen=True)
class Condition:
    """From BEGIN_S on.

    Attributes:
        seconds: how long it is watched.
        slip_m, slip_share: over so much way the wheels count so much more than the robot moves.
        dark_s: so long no picture shows anything.
        bare_m: over so much way the ceiling shows nothing.
        spin_radps, spins: turns on the spot, so fast and so often.
        carried_m: it is lifted, carried so far in CARRY_S, turned, and put down.
        late_s: from the start on, pictures are stamped so much later than they were taken.
    """

    seconds: float = 30.0
    slip_m: float = 0.0
    slip_share: float = 0.0
    dark_s: float = 0.0
    bare_m: float = 0.0
    spin_radps: float = 0.0
    spins: float = 0.0
    carried_m: float = 0.0
    late_s: float = 0.0


CONDITIONS: Mapping[str, Condition] = {
    "normal": Condition(),
    "slip 20 % for 1 m": Condition(slip_m=1.0, slip_share=0.2),
    "blackout 10 s": Condition(dark_s=10.0),
    "bare stretch 8 m": Condition(seconds=40.0, bare_m=8.0),
    "fast turns 3 rad/s": Condition(spin_radps=3.0, spins=3.0),
    "carried": Condition(carried_m=2.0),
    "80 ms late camera": Condition(late_s=0.08),
}
CARRY_S = 3.0
"""Chosen: a person who lifts it, takes two steps and puts it down."""
BLUR_RADPS = 1.5
"""Turning faster blurs the picture beyond use: 10 ms of exposure are 6 px at 410 px off the axis; chosen."""
