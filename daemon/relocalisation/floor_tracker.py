"""Which floor a robot is on; it may have got to another where it was at a lift or a ramp, and is not there any more."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from ceilvo.daemon.odometry.course import JUMPED
from ceilvo.daemon.relocalisation.doubts import Doubt
from ceilvo.daemon.relocalisation.floors import Floors, Transition
from ceilvo.types import Array

AT_M, LEFT_M = 1.0, 1.5
"""A robot so near a transition is in it, one so far off has left it; chosen: half a lift's cabin, and a half more."""


@dataclass(slots=True)
class FloorTrackerState:
    """What a FloorTracker remembers.

    Attributes:
        floors: of the map, where it has several; poses and landmarks of the filter are in their common frame.
        inside: the transition that the robot was last at, None since it has left it.
    """

    floors: Floors = field(default_factory=Floors)
    inside: Transition | None = None


class FloorTracker:
    """Follows the tracked pose, which goes on over the old floor after a ride: the cabin's ceiling rides along."""

    def __init__(self) -> None:
        self.state = FloorTrackerState()

    @property
    def floors(self) -> Floors:
        return self.state.floors

    def name_at(self, pose: Array) -> str:
        """The floor that a pose (3,) of their frame is on; "" where the map has only one."""
        here = self.floors.at(pose)
        return "" if here is None else here.name

    def step(self, pose: Array, gap: bool) -> Doubt | None:
        """After a frame.

        Args:
            pose: (3,) tracked, in the frame of the floors.
            gap: vision came back after it saw nothing, or nothing that fits.
        """
        s, floors = self.state, self.floors
        here = floors.transition_at(pose, AT_M)
        if here is not None:
            s.inside = here
            return self._doubt(floors, here, pose) if gap else None
        if s.inside is None or _near(floors, s.inside, pose):
            return None
        left, s.inside = s.inside, None
        return self._doubt(floors, left, pose)

    @staticmethod
    def _doubt(floors: Floors, at: Transition, pose: Array) -> Doubt | None:
        leads = floors.leads(at, pose)
        if not len(leads):
            return None
        return Doubt(f"{at.kind} {at.name}", elsewhere=JUMPED, reach_m=np.inf, leads=leads)


def _near(floors: Floors, at: Transition, pose: Array) -> bool:
    there = floors.transition_at(pose, LEFT_M)
    return there is not None and there.name == at.name
