"""Which place on the map: doubts about the tracked pose, and the hypothesis that views confirm or replace.

A hypothesis must not teach the map: what it does not explain would be learnt and then confirm it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from ceilvo.calibration import Calibration
from ceilvo.config import Config
from ceilvo.daemon.odometry.dead_reckoning import Track
from ceilvo.daemon.relocalisation import view_score
from ceilvo.daemon.relocalisation.hypothesis_test import PoseHypothesis, Source, convincing
from ceilvo.daemon.relocalisation.lattice import FEWEST_LANDMARKS, tile_shifts
from ceilvo.daemon.relocalisation.place_search import search_places
from ceilvo.daemon.slam.association import associate
from ceilvo.daemon.slam.pose_filter import SURE, PoseFilter
from ceilvo.daemon.slam.spatial_index import IndexedMap
from ceilvo.se2 import wrap
from ceilvo.types import NO_LANDMARK, UNLABELLED, Array, Crossings, Landmarks, Observations, Pose

CLOSE_SIGMA_M = 0.12
"""A pose given so closely is within a fraction of any tile (2.5 sigma of half a tile of 0.6 m)."""
UNSURE_M, UNSURE_RAD = 0.15, 0.5
"""A path that may be so far off (3 sigma) may have led to another tile (half of 0.3 m) or quarter turn (30 deg)."""
SIGMAS = 3.0
"""How many standard deviations a robot can be from where it is believed."""
SLIP_FRACTION = 0.3
"""Of a blind path, what wheels may have slipped in one direction; chosen."""
REACH_M = 0.3
"""Added to how far the robot can be: half a tile of 0.6 m."""
JUMP_SIGMA = np.array([0.06, 0.06, 0.02])
"""[m, m, rad] of a pose that a search proposes: its raster is 0.1 m, its headings are the lines'."""
MUCH_BETTER = 4
"""Features that another place must explain more in one view to be tried when the hypothesis is hopeless; chosen."""
CONTRADICTIONS = 2
"""Views in a row that must contradict the map before the pose is in doubt; one may be a passing lamp."""
VIEW_PERIOD_S = 0.1
"""A standing robot that has to confirm its pose looks so often."""


@dataclass(slots=True)
class RelocaliserState:
    """All that a Relocaliser remembers besides its filter's state.

    Attributes:
        hypothesis: the pose is assumed, and this is how well; None while it is believed.
        contradictions: views in a row that contradicted the map.
        map_axis_rad: direction of the ceiling's lines in the map modulo 90 deg; None before they were seen.
    """

    hypothesis: PoseHypothesis | None = None
    contradictions: int = 0
    map_axis_rad: float | None = None


class Relocaliser:
    """Holds the filter: it decides what a view may teach it, and where it is put when the robot is elsewhere."""

    def __init__(self, filter_: PoseFilter, calibration: Calibration, config: Config) -> None:
        self.filter = filter_
        self._calibration = calibration
        self._settings = config.filter
        self._nis_high = config.states.nis_high
        self.state = RelocaliserState()

    @property
    def hypothesis(self) -> PoseHypothesis | None:
        return self.state.hypothesis

    @property
    def view_period_s(self) -> float:
        """How long after a view the next one is news to a robot that stands."""
        h, period_s = self.state.hypothesis, self._settings.update_period_s
        if h is None or h.close or h.source is Source.SEARCHED:
            return period_s
        return min(VIEW_PERIOD_S, period_s)

    def start_at(self, pose: Array, cov: Array, landmarks: Landmarks | None) -> None:
        """Begin at a pose (3,); with landmarks it is a hypothesis, without them nothing contradicts it."""
        known = landmarks if landmarks is not None and len(landmarks) else None
        self.filter.reset(pose, cov, known)
        self.state.contradictions = 0
        if known is None:
            self.state.map_axis_rad, self.state.hypothesis = None, None
            return
        sigma_m = float(np.sqrt(np.linalg.eigvalsh(cov[:2, :2])[-1]))
        source = Source.GIVEN_CLOSELY if sigma_m < CLOSE_SIGMA_M else Source.GIVEN
        self.state.hypothesis = PoseHypothesis(source, reach_m=SIGMAS * sigma_m + REACH_M)

    def load_map(self, pose: Array, cov: Array, landmarks: Landmarks, map_axis_rad: float) -> None:
        """Begin on a map of an earlier run; the robot may have driven on since the pose was stored."""
        self.state.map_axis_rad = map_axis_rad
        self.start_at(pose, cov, landmarks)
        self.state.hypothesis = PoseHypothesis(Source.GIVEN)

    def travelled(self, track: Track) -> None:
        """After a blind path on which the robot may have got another tile off, landmarks must confirm the pose.

        The motion that ends the gap proves nothing: on a grid it fits whole tiles and quarter turns off as well.
        """
        if track.final is None:
            return
        cov, blind_m = track.blind_cov, track.blind_m
        drift_m = SIGMAS * float(np.sqrt(max(np.linalg.eigvalsh(cov[:2, :2])[-1], 0.0)))
        turned_rad = SIGMAS * float(np.sqrt(max(cov[2, 2], 0.0)))
        if drift_m + SLIP_FRACTION * blind_m <= UNSURE_M and turned_rad <= UNSURE_RAD:
            return
        usable = drift_m <= UNSURE_M and turned_rad <= UNSURE_RAD
        reach_m = drift_m + blind_m + REACH_M
        if self.state.hypothesis is not None:
            self.state.hypothesis = self.state.hypothesis.after_gap(usable, reach_m)
        elif len(self.filter.landmarks()) >= FEWEST_LANDMARKS:
            self._end_search()
            self.state.hypothesis = PoseHypothesis(Source.DEAD_RECKONED if usable else Source.BLIND, reach_m, blind_m)

    def doubt(self, reach_m: float) -> None:
        """The robot may have got elsewhere, at most so far: landmarks must confirm the pose."""
        if self.state.hypothesis is None and len(self.filter.landmarks()) >= FEWEST_LANDMARKS:
            self._end_search()
            self.state.hypothesis = PoseHypothesis(Source.BLIND, reach_m + REACH_M)

    def _end_search(self) -> None:
        """One search at a time: the filter's own waits for labels that a hypothesis gives and takes."""
        pose, cov, health = self.filter.estimate()
        if health.mode_weight < SURE:
            self.filter.reset(pose, cov + np.diag(JUMP_SIGMA**2), self.filter.landmarks())

    def see(self, crossings: Crossings) -> Observations:
        """Crossings as observations of the map; their labels are left to a filter that is searching."""
        if self.state.hypothesis is not None:
            self._end_search()
        pose, _, health = self.filter.estimate()
        if self.state.map_axis_rad is None:
            self.state.map_axis_rad = float(wrap(crossings.psi_rad + float(pose[2])))
        axis, landmarks = self.state.map_axis_rad, self.filter.landmarks()
        noise, mount_xy_m = self._calibration.noise, self._calibration.mount_xy_m
        view = associate(crossings, noise, mount_xy_m, pose, landmarks, self._settings, axis)
        if health.mode_weight >= SURE or self.state.hypothesis is not None:
            return view
        return replace(view, label=np.full(len(view), UNLABELLED))

    def admit(self, view: Observations) -> Observations | None:
        """What of a view may teach the filter; None for nothing of it."""
        if self.state.hypothesis is None:
            self._watch(view)
        h = self.state.hypothesis
        if h is None:
            return None if self.state.contradictions else view
        if h.close or convincing(int(np.count_nonzero(view.label >= 0)), len(view)):
            return view.of(view.label != NO_LANDMARK)
        return None

    def _watch(self, view: Observations) -> None:
        """A view that contradicts the map teaches nothing; where the next one does too, the pose is in doubt."""
        pose, _, health = self.filter.estimate()
        landmarks, s = self.filter.landmarks(), self.state
        judged = health.mode_weight >= SURE and len(landmarks) >= FEWEST_LANDMARKS
        contradicts = judged and view_score.contradicted(view, pose, landmarks)
        s.contradictions = s.contradictions + 1 if contradicts else 0
        if s.contradictions >= CONTRADICTIONS:
            s.hypothesis, s.contradictions = PoseHypothesis(Source.CONTRADICTED), 0

    def weigh(self, view: Observations) -> Pose | None:
        """Judge an assumed pose by views from places that are a little apart; once is enough to believe it.

        Returns:
            The pose to try instead, None to go on with this one.
        """
        h = self.state.hypothesis
        if h is None:
            return None
        pose, _, health = self.filter.estimate()
        landmarks = self.filter.landmarks()
        shifts = np.zeros((0, 2)) if h.close else tile_shifts(landmarks, self.state.map_axis_rad or 0.0)
        poses = np.tile(pose, (1 + len(shifts), 1))
        poses[1:, :2] += shifts
        counts = view_score.explained(IndexedMap(landmarks), poses, view, self._settings.association_gate_m)
        place = None if h.close else search_places(landmarks, view, pose, h.region(pose))
        elsewhere = int(np.max(counts[1:], initial=0.0) - counts[0]) if place is None else place.elsewhere - place.here
        if h.weigh(counts, len(view), elsewhere, health.nis, self._nis_high):
            self.state.hypothesis = None
            return None
        better = h.better()
        alternative = Pose(pose if better is None else poses[1 + better])
        if better is not None and (place is None or place.allows(alternative)):
            return self._jump(h, pose, alternative)
        if not h.hopeless:
            return None
        if place is not None and elsewhere > MUCH_BETTER and convincing(place.explained, len(view)):
            return self._jump(h, pose, Pose(place.pose))
        self.state.hypothesis = h.after_gap()
        return None

    def _jump(self, h: PoseHypothesis, old: Array, pose: Pose) -> Pose:
        """Another pose is a hypothesis like any other."""
        self.filter.reset(pose, np.diag(JUMP_SIGMA**2), self.filter.landmarks())
        self.state.hypothesis = h.jumped(old, pose)
        return pose
