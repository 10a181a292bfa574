"""All that lamps of known place leave behind."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from ceilvo.daemon.relocalisation.beacons.trust import TrustState
from ceilvo.types import Array

SPOT_COLUMNS = 6
MISSING = 20
"""Pictures in a row without a light where a lamp should be, after which that is said; chosen: two seconds or more."""


@dataclass(slots=True)
class LampState:
    """
    Attributes:
        spots: (N, 6) lights that were seen of late, in odom: how often, where the camera was (2,), by how much further
            off they lie if they hang at the ceiling (2,), both means; and how far the robot had come when last.
        way_m: that the robot has come; odom: (3,) then.
        missed: pictures in a row that should have shown a lamp, by name.
        chance: that the lamps which the place rests on lie so by chance; 1 where it rests on none.
    """

    trust: TrustState = field(default_factory=TrustState)
    spots: Array = field(default_factory=lambda: np.zeros((0, SPOT_COLUMNS)))
    way_m: float = 0.0
    odom: Array | None = None
    missed: dict[str, int] = field(default_factory=dict)
    chance: float = 1.0

    def forget(self) -> None:
        """What was seen on the way, which is at another place now."""
        self.spots, self.odom, self.chance = np.zeros((0, SPOT_COLUMNS)), None, 1.0

    def learnt(self) -> dict[str, list[str]]:
        """For people, by name."""
        missing = sorted(name for name, times in self.missed.items() if times >= MISSING)
        return {"ignored": sorted(self.trust.wrong), "missing": missing}

    def take_news(self) -> list[str]:
        out, self.trust.news = self.trust.news, []
        return out
