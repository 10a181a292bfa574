"""What a Relocaliser remembers."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from ceilvo.daemon.relocalisation.doubts import OFF_MAP, Doubt, Reach
from ceilvo.daemon.relocalisation.evidence.coverage import Coverage
from ceilvo.daemon.relocalisation.evidence.unmapped import Unmapped
from ceilvo.daemon.relocalisation.flipped_picture import FlippedPicture
from ceilvo.daemon.relocalisation.not_this_map import UNLISTED, NotThisMapState
from ceilvo.daemon.relocalisation.place_belief import PlaceBelief
from ceilvo.daemon.relocalisation.submap import turned_cov
from ceilvo.daemon.relocalisation.survey import MapSurvey
from ceilvo.daemon.slam.pose_filter import PoseFilter
from ceilvo.daemon.slam.schedule import ScheduleState
from ceilvo.json_values import MAX_ID
from ceilvo.types import Array

USUAL_WEIGHT = 0.05
"""Of one view's crossings in those of a usual one; chosen: two seconds at 10 Hz."""
VIEW_M = 0.005
"""Standard deviation of where a view puts the robot, with what lens and tilt are off by; chosen, see bench-vision."""
AMBIGUOUS = "ambiguous"
"""Begins the reason while several places of the map are likely."""
NOT_THIS_MAP = "not this map"
"""Begins the reason while the robot is most likely where the map does not know, see not_this_map.py."""
MAPPED_APART = "new ground is mapped apart; drive by odom, which goes on unbroken, not by the map pose"
"""Ends the reason while there is a submap, see submap.py: what an application may rely on."""
FRESH_SPOTS = 12
"""While the place is sure, ground that was looked at from more spots ago, 3 m, is new again; chosen."""
ALIKE = 0.05
"""Share of the belief from which a place is named among those that look alike; chosen."""


@dataclass(frozen=True, slots=True)
class PlaceSearch:
    """What the last look through the whole map gave.

    Attributes:
        places: that the view can be from; complete: all of them, see place_index.Candidates.
        false_alarm_probability: chance that a wrong place of such a map explains as much as the best of them.
    """

    places: int
    complete: bool
    false_alarm_probability: float


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
        given: somebody said where the robot is; else the map begins at its first view.
        map_axis_rad: direction of the ceiling's lines in the map modulo 90 deg; None before they were seen.
        looked: ground that views have shown since the last doubt, or of late, each spot counted once; spots: how many.
        spot_m: (V, 2) corners in map of what the last view that was weighed looked at.
        submap_from: id from which on landmarks were learnt in doubt, see submap.py; None while the place is sure.
        apart: something was learnt so.
        gap_cov, gap_at_m: (3, 3) m and rad, of the tracked pose before it was moved onto the tiles that are seen, and
            (2,) where. Which tiles they are it does not say, so that much is open until the place is sure.
        leads: of the doubt that is not settled yet, see Doubt.
        survey: of the map, to find a place on it.
        schedule: when a view is news.
        not_this_map: whether the robot is on the map at all.
        grave: the doubt was not small when it began, so that the pose is not used before the place is sure.
        doubted_m: way since a view and the one before it gave a small doubt.
        listed: all places where the robot may be were listed one by one; what the index leaves out is none of them.
        searched: since the doubt a view told all places of the map that it can be from, and all of them were listed.
        unlisted: share of what the belief has of ground that is not known which is of places of the map.
        unmapped: what the map lacks while the place is sure.
        search: the last one of this doubt.
        reach: where hands can have brought the robot since the place was sure.
        picture: whether it is flipped on its way from the camera.
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
    given: bool = False
    map_axis_rad: float | None = None
    looked: Coverage = field(default_factory=Coverage)
    spots: int = 0
    spot_m: Array = field(default_factory=lambda: np.zeros((0, 2)))
    submap_from: int | None = None
    apart: bool = False
    gap_cov: Array = field(default_factory=lambda: np.zeros((3, 3)))
    gap_at_m: Array = field(default_factory=lambda: np.zeros(2))
    leads: Array = field(default_factory=lambda: np.zeros((0, 3)))
    survey: MapSurvey = field(default_factory=MapSurvey)
    schedule: ScheduleState = field(default_factory=ScheduleState)
    not_this_map: NotThisMapState = field(default_factory=NotThisMapState)
    grave: bool = False
    doubted_m: float = np.inf
    listed: bool = False
    searched: bool = False
    unlisted: float = 0.0
    unmapped: Unmapped = field(default_factory=Unmapped)
    search: PlaceSearch | None = None
    reach: Reach = field(default_factory=Reach)
    picture: FlippedPicture = field(default_factory=FlippedPicture)

    @property
    def sure(self) -> bool:
        """Whether the tracked place may be called good."""
        return self.pending is None and self.reason == ""

    @property
    def learnt_from(self) -> int:
        """Least id of the landmarks that a view may teach something: in doubt of the place those of the submap only."""
        if self.sure:
            return 0
        return MAX_ID if self.submap_from is None else self.submap_from

    @property
    def doubt(self) -> str:
        """Why the place is not sure, for people; "" while it is."""
        if self.sure:
            return ""
        why = self.pending.reason if self.pending is not None else self.reason
        why = f"{why}, or the ceiling was changed meanwhile" if self.belief.changed_odds > 0.0 else why
        why = f"{why}; {MAPPED_APART}" if self.apart else why
        if turned_rad := self.picture.turned_rad:
            return f"the picture turned by {np.degrees(turned_rad):+.0f} deg at once: a flipped picture? {why}"
        scale = self.not_this_map.scale if self.pending is None else 0.0
        if scale != 0.0:
            than = f"{100.0 * abs(scale):.0f} % {'larger' if scale > 0.0 else 'smaller'} than its own"
            return f"{NOT_THIS_MAP}: tiles are {than}, as with a calibration of another height; {why}"
        if self.not_this_map.said:
            ground_m2 = self.not_this_map.ground.shown_m2
            return f"{NOT_THIS_MAP}: nowhere does it show these {ground_m2:.0f} m2 of ceiling; {why}"
        alike = int(np.count_nonzero(self.belief.shares()[0] >= ALIKE))
        if self.pending is None and alike > 1:
            return f"{AMBIGUOUS}: {alike} places of the map look like this one; {why}"
        return f"to be confirmed by landmarks: {why}"

    def arrive(self) -> None:
        """What is seen again from another spot is worth less: the same lamp twice is not two lamps."""
        if not self.belief.at_another_spot:
            return
        self.belief.leave_spot()
        self.looked.show(self.spot_m)
        self.spots += 1
        if self.sure and self.spots > FRESH_SPOTS:
            self.looked, self.spots = Coverage(), 0

    def open_submap(self, filter_: PoseFilter) -> None:
        """What a filter learns from now on is apart. What it was about to learn is of neither side of the doubt."""
        if self.submap_from is None:
            filter_.forget(np.empty(0, np.int64), newborn=True)
            self.submap_from = filter_.next_id()

    def close_submap(self) -> None:
        """The place is another one or sure: what is learnt from now on is of the map, no search is asked for, and what
        hands did before is over."""
        self.submap_from, self.apart, self.gap_cov, self.search = None, False, np.zeros((3, 3)), None
        self.reach = Reach()

    def doubt_unknown(self, doubt: Doubt, unknown: float, changed: float) -> None:
        """Something happened after which no listed place may be right, see PlaceBelief.doubt_unknown."""
        before = self.belief.unknown
        self.belief.doubt_unknown(unknown, changed)
        new = -np.expm1(before - self.belief.unknown)
        self.unlisted += new * (doubt.unlisted / (doubt.unlisted + OFF_MAP) - self.unlisted)

    def were_listed(self, whole: bool) -> None:
        """A view told places of the map that it can be from, the whole map's if whole, but for what the belief cut:
        then ground that is not known is hardly on the map."""
        self.searched &= not self.belief.cut
        if whole and not self.belief.cut:
            self.searched, of_map = True, self.unlisted
            self.belief.unknown += float(np.log1p(-(1.0 - UNLISTED) * of_map))
            self.unlisted = UNLISTED * of_map / (1.0 - (1.0 - UNLISTED) * of_map)
        self.belief.cut = not (self.searched or self.listed)

    def likeness_is_a_guess(self, place: int) -> NDArray[np.bool_]:
        """(P,) places beside which nobody knows how alike the ceiling is at another: all where no hand brought the
        robot there; where it is tracked, on a map of a few lamps."""
        out = np.full(len(self.belief), bool(self.reach.beyond(self.belief.places[place, None])[0]))
        out[0] |= self.survey.few
        return out

    def gap_opens(self, pose: Array, cov: Array) -> None:
        """The tracked pose (3,) was moved onto tiles; before it was known by a covariance (3, 3) only."""
        self.gap_cov, self.gap_at_m = self.left_open(pose) + cov, pose[:2].copy()

    def left_open(self, pose: Array) -> Array:
        """(3, 3) by which the tracked pose (3,) may be off as the gaps of this doubt left it."""
        return turned_cov(self.gap_cov, pose[:2] - self.gap_at_m)

    @property
    def gap_sigma_m(self) -> float:
        """How far off the tracked pose may be as the gaps of this doubt left it, unless somebody moved the robot."""
        return float(np.sqrt(max(np.linalg.eigvalsh(self.gap_cov[:2, :2])[-1], 0.0) + VIEW_M**2))

    def shown(self, crossings: int) -> None:
        """One more view with a motion showed so many."""
        self.usual += USUAL_WEIGHT * (crossings - self.usual)
