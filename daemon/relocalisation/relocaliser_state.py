"""What a Relocaliser remembers."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from ceilvo.daemon.relocalisation.doubts import Doubt
from ceilvo.daemon.relocalisation.evidence.coverage import Coverage
from ceilvo.daemon.relocalisation.evidence.unmapped import Unmapped
from ceilvo.daemon.relocalisation.not_this_map import NotThisMapState
from ceilvo.daemon.relocalisation.place_belief import PlaceBelief
from ceilvo.daemon.relocalisation.survey import MapSurvey
from ceilvo.daemon.slam.schedule import ScheduleState
from ceilvo.types import Array

USUAL_WEIGHT = 0.05
"""Of one view's crossings in those of a usual one; chosen: two seconds at 10 Hz."""


@dataclass(slots=True)
class RelocaliserState:
    """All that a Relocaliser remembers besides its filter's state.

    Attributes:
        belief: over places.
        pending: what may have happened since the last view that could be weighed.
        reason: why the place is in doubt, "" while it is not; began: chance of being elsewhere when that began.
        views: weighed since the last doubt.
        surprised: the last of them speaks against the tracked place.
        gapped: frames gave no motion of late; jumped: probability that somebody moved the robot, by those of them that
            had crossings which no motion explained.
        usual: crossings of a view of late.
        map_axis_rad: direction of the ceiling's lines in the map modulo 90 deg; None before they were seen.
        looked: ground that views have shown since the last doubt, or of late, each spot counted once; spots: how many.
        submap_from: id from which on landmarks were learnt in doubt, see submap.py; None while the place is sure.
        leads: of the doubt that is not settled yet, see Doubt.
        survey: of the map, to find a place on it.
        schedule: when a view is news.
        not_this_map: whether the robot is on the map at all.
        grave: the doubt was not small when it began, so that the pose is not used before the place is sure.
        doubted_m: way since a view and the one before it gave a small doubt.
        listed: all places where the robot may be were listed one by one; what the index leaves out is none of them.
        unmapped: what the map lacks while the place is sure.
    """

    belief: PlaceBelief = field(default_factory=PlaceBelief)
    pending: Doubt | None = None
    reason: str = ""
    began: float = 0.0
    views: int = 0
    surprised: bool = False
    gapped: bool = False
    jumped: float = 0.0
    usual: float = 0.0
    map_axis_rad: float | None = None
    looked: Coverage = field(default_factory=Coverage)
    spots: int = 0
    submap_from: int | None = None
    leads: Array = field(default_factory=lambda: np.zeros((0, 3)))
    survey: MapSurvey = field(default_factory=MapSurvey)
    schedule: ScheduleState = field(default_factory=ScheduleState)
    not_this_map: NotThisMapState = field(default_factory=NotThisMapState)
    grave: bool = False
    doubted_m: float = np.inf
    listed: bool = False
    unmapped: Unmapped = field(default_factory=Unmapped)

    def shown(self, crossings: int) -> None:
        """One more view with a motion showed so many."""
        self.usual += USUAL_WEIGHT * (crossings - self.usual)
