"""Which place on the map: one belief over all that are possible, weighed by every view."""

from __future__ import annotations

import numpy as np

from ceilvo.calibration import Calibration
from ceilvo.config import Config
from ceilvo.daemon.odometry.course import JUMPED
from ceilvo.daemon.odometry.dead_reckoning import Track
from ceilvo.daemon.relocalisation import doubts
from ceilvo.daemon.relocalisation.doubts import Doubt, log_odds_of_found
from ceilvo.daemon.relocalisation.evidence.admission import of_doubtful_place, of_sure_place
from ceilvo.daemon.relocalisation.evidence.coverage import VIEWS, Coverage
from ceilvo.daemon.relocalisation.evidence.sharp_view import SharpView
from ceilvo.daemon.relocalisation.evidence.view_evidence import Surroundings, ViewEvidence
from ceilvo.daemon.relocalisation.evidence.wrong_places import combined
from ceilvo.daemon.relocalisation.flipped_picture import TURNS_BACK
from ceilvo.daemon.relocalisation.floor_tracker import FloorTracker
from ceilvo.daemon.relocalisation.lattice import WATCH_M, Lattice, of_tracked, offset, rival_from_tracked, rival_poses
from ceilvo.daemon.relocalisation.not_this_map import NotThisMap
from ceilvo.daemon.relocalisation.place_belief import SPOT_M, PlaceBelief
from ceilvo.daemon.relocalisation.relocaliser_state import PlaceSearch, RelocaliserState
from ceilvo.daemon.relocalisation.survey import MapSurvey, aligned_pose, beside_tiles, better_of
from ceilvo.daemon.slam.association import associate
from ceilvo.daemon.slam.pose_filter import PoseFilter
from ceilvo.daemon.slam.schedule import UpdateSchedule
from ceilvo.daemon.vision.thinning import for_places
from ceilvo.se2 import compose, greatest_variance, inverse, transform, wrap
from ceilvo.types import Array, Crossings, Landmarks, Motion, Observations, Pose

VIEW_PERIOD_S = 0.1
"""A standing robot in doubt looks so often."""
CONTRADICTION = "what is seen contradicts the map"
SPOT_VIEWS = 5
"""Views of a spot that are weighed; their mean is what counts, and more cost time; chosen."""
STOOD_M, SHORT_S = 0.1, 1.5
"""A robot stood that would not have come further in the dark, and on a young map is where it was, unless views that fit
nothing took less than that time; chosen."""
FEWEST_VIEWS = 3
"""Views since a doubt before a place is believed again: one may be a picture that is damaged; chosen."""
SURPRISE = -3.0
"""Log-likelihood ratio of a view below which rivals of a place that was sure are weighed; 1 view in 100 (docs)."""
MOST_FOUND = 2048
"""Places that a view is found at, the likeliest, unless it tells all and another than the tracked leads; for time."""
JUMP_SIGMA = np.array([0.06, 0.06, 0.02])
"""[m, m, rad] of a rival that takes over: tiles differ by millimetres, its reach is REACH_M of evidence.py."""


class Relocaliser:
    """Holds the filter: it decides what a view may teach it, and where it is put when the robot is elsewhere."""

    def __init__(self, filter_: PoseFilter, calibration: Calibration, config: Config) -> None:
        self.filter = filter_
        self._calibration = calibration
        self._settings = config.filter
        self._rate, self._lost_sigma_m = config.states.false_place_rate, config.states.lost_sigma_m
        self._sharp = SharpView(calibration, config.features.max_view_deg)
        self._schedule = UpdateSchedule(config.filter)
        self.floor_tracker = FloorTracker()
        self._on_map = NotThisMap()
        self.state = RelocaliserState()

    @property
    def state(self) -> RelocaliserState:
        self._state.schedule, self._state.not_this_map = self._schedule.state, self._on_map.state
        return self._state

    @state.setter
    def state(self, state: RelocaliserState) -> None:
        self._state, self._schedule.state, self._on_map.state = state, state.schedule, state.not_this_map

    # -- what it says

    @property
    def sure(self) -> bool:
        """Whether the tracked place may be called good."""
        return self.state.sure

    @property
    def doubt(self) -> str:
        """Why the place is not sure, for people; "" while it is."""
        return self.state.doubt

    @property
    def times_said(self) -> dict[str, int]:
        """How often it was said that this is not the map, and that the picture is flipped."""
        return {"not_this_map": self._on_map.state.times, "picture_flipped": self.state.picture.times}

    def start_at(self, pose: Array, cov: Array, landmarks: Landmarks | None, doubt: Doubt | None = None) -> None:
        """Begin at a pose (3,); with landmarks it is a claim that views must bear out."""
        known = landmarks if landmarks is not None and len(landmarks) else None
        s = self.state
        self.filter.reset(pose, cov, known)
        self._schedule.restart()
        self._on_map.end()
        s.belief, s.began, s.views, s.gapped, s.jumped = PlaceBelief(), 0.0, 0, False, 0.0
        s.close_submap()
        s.leads, s.searched = np.zeros((0, 3)), False
        s.survey.measured_m = s.doubted_m = np.inf
        s.picture.forget()
        if known is None:
            self.state = RelocaliserState()
            return
        s.pending, s.grave = doubt, doubt is not None
        s.reason = "" if doubt is None else doubt.reason

    def load_map(self, pose: Array, cov: Array, landmarks: Landmarks, map_axis_rad: float, doubt: Doubt) -> None:
        """Begin on a map of an earlier run, with what is doubted of its pose (3,)."""
        self.start_at(pose, cov, landmarks, doubt)
        self.state.map_axis_rad = map_axis_rad
        self.survey_map()

    def survey_map(self) -> None:
        """Survey a map that came without."""
        self.state.survey = MapSurvey.of(self.filter.landmarks(), self.state.map_axis_rad or 0.0)

    def travelled(self, track: Track, crossings: int) -> None:
        """The robot went on; a gap in what vision measured of its way is a doubt."""
        s = self.state
        s.belief.moved(track.moved_m, track.turned_rad)
        self._schedule.travelled(track.moved_m, track.turned_rad)
        s.survey.measured_m += track.moved_m
        s.doubted_m += track.moved_m
        if track.gap is not None:
            jumped = track.gap.doubt if doubts.shows_a_jump(crossings, s.usual) else 0.0
            s.gapped, s.jumped = True, max(s.jumped, jumped)
        else:
            s.shown(crossings)
        if (final := track.final) is None:
            return
        s.picture.follow(track)
        gapped, jumped, s.gapped, s.jumped = s.gapped or track.blind_s > doubts.LIFT_S, s.jumped, False, 0.0
        if track.blind_s > doubts.LIFT_S and not (s.given or self.filter.size()):
            return self._begin_here(final)
        if not gapped and final.doubt == 0.0:
            return self.filter.predict(final)
        expected = compose(self.filter.estimate()[0], track.blind)
        self.filter.predict(final)
        if self.sure and not gapped and self._rate <= final.doubt < doubts.UNLIKELY:
            s.doubted_m = 0.0
        lost = float(np.hypot(*track.blind[:2])) > STOOD_M or (not track.bridged and track.blind_s < SHORT_S)
        self.raise_doubt(doubts.of_track(track, final, jumped, expected, self.filter.estimate()[0]), lost)

    def _begin_here(self, final: Motion) -> None:
        """One that was told nothing sees the ceiling for the first time: how it got here is no question of the map."""
        pose, cov, _ = self.filter.estimate()
        self.start_at(compose(pose, final.prev_from_curr), cov, None)

    def suspect(self, reason: str, reach_m: float) -> None:
        """Something says that the robot may have got elsewhere, at most so far since that began."""
        self.raise_doubt(doubts.of_suspicion(reason, reach_m, self.state.pending))

    def raise_doubt(self, doubt: Doubt, lost: bool = False) -> None:
        """What may have happened since the last view; lost: a young map is doubted, too, where it left little known."""
        s = self.state
        if s.pending is not None:
            doubt = doubts.both(s.pending, doubt)
        lost = lost and greatest_variance(doubt.cov[:2, :2]) > self._lost_sigma_m**2 and self.filter.size() > 0
        if (lost or s.survey.coverage.area_m2 > self._sharp.young_m2) and not doubts.negligible(doubt, self._rate):
            s.pending, s.grave = doubt, s.grave or doubt.elsewhere >= doubts.UNLIKELY

    def look(self, stamp_ns: int, crossings: Crossings) -> Observations | None:
        """Weigh what is seen, teach the filter what may be learnt from it; the view, None when it is no news.

        Where a view shows that the robot is elsewhere, the filter is put there.
        """
        s, crossings = self.state, self.tells(crossings)
        period_s = min(self._settings.update_period_s, np.inf if self.sure else VIEW_PERIOD_S)
        if not len(crossings) or not self._schedule.due(stamp_ns, period_s):
            return None
        view = self.observed(crossings)
        if self._weigh(self._sharp.of(view)):
            view = self.observed(crossings)
        admitted = self._admitted(view)
        if admitted is not None:
            self.filter.update(admitted, s.learnt_from)
            s.apart |= s.submap_from is not None and bool(np.any(admitted.label < 0))
            if self.sure and not self.state.surprised and len(self._sharp.visible_m):
                s.survey.learnt(self.filter, self._sharp.shown(crossings, view), view.crossing_type)
        return view

    def forget_near(self, misplaced_m: Array) -> None:
        """Crossings were taken to be at points (N, 2) in base, and are elsewhere."""
        self.state.survey.forget_near(self.filter, misplaced_m, self._sharp.visible_m)

    def tells(self, crossings: Crossings) -> Crossings:
        """What of a view tells places."""
        return for_places(crossings, self._calibration.level_view.focal_px)

    def observed(self, crossings: Crossings) -> Observations:
        s = self.state
        pose, cov, _ = self.filter.estimate()
        axis = float(wrap(crossings.psi_rad + float(pose[2]))) if s.map_axis_rad is None else s.map_axis_rad
        s.map_axis_rad = axis if crossings.directed else s.map_axis_rad
        noise, mount_xy_m, near = self._calibration.noise, self._calibration.mount_xy_m, self.filter.landmarks_near
        visible = self._sharp.visible_m if crossings.complete else None
        return associate(crossings, noise, mount_xy_m, pose, near, self._settings, axis, visible, cov)

    def _weigh(self, view: Observations) -> bool:
        """Add what a view says to the belief; True when the filter was put where it says that the robot is."""
        s = self.state
        self._arrive()
        # lines that were mistaken gave a small doubt, and would count again from the same spot
        again = s.doubted_m < SPOT_M and not s.grave
        if again or (s.pending is None and s.belief.spot_views >= SPOT_VIEWS):
            return False
        before = self.filter.estimate()[0]
        reach_m = s.survey.watched_m if s.pending is None else s.pending.search_m
        around = s.survey.around(self.filter, view, before, reach_m, s.map_axis_rad or 0.0, s.submap_from)
        evidence = ViewEvidence(view, around, np.ones(len(view)), s.unmapped.scale)
        if self.sure and not s.belief.spot_views:
            s.unmapped.learn(*evidence.lacking(before))
        if s.pending is not None:
            self._instantiate(s.pending, view, around, evidence)
        pose = self.filter.estimate()[0]
        s.surprised = bool(combined(evidence.log_ratio(pose[None]))[0] < SURPRISE)
        if len(s.belief) == 1 and s.surprised:
            self._instantiate(Doubt(CONTRADICTION, reach_m=WATCH_M), view, around, evidence)
        elif self.sure and not s.belief.spot_views:
            s.belief.watch(s.survey.watched(around, pose, view))
        if not self.sure and not s.belief.spot_views:
            before_search, pose = pose, self._search(view, pose, evidence)
            if pose is not before_search:
                self._on_map.put_right(before_search, pose, s.survey.weigher(around))
            if self._on_map.asks and len(view.visible_m):
                likeliest = int(np.argmax(s.belief.weights()[0]))
                self._on_map.take(view, pose, s.belief.places, not s.belief.cut, s.survey.weigher(around), likeliest)
        evidence.take(self._worth(view))
        poses, grid = rival_poses(s.belief.places, pose), s.survey.index.grid
        ratio = s.survey.log_ratio(evidence, poses, pose)
        s.belief.weigh(ratio, lambda i: (evidence.unmapped(poses, poses[i], grid), s.likeness_is_a_guess(i)))
        s.views, s.spot_m = s.views + 1, transform(Pose(pose), self._sharp.looked_at(view))
        return self._decided(pose) or bool(np.any(pose != before))

    def _arrive(self) -> None:
        self.state.arrive()

    def _worth(self, view: Observations) -> Array:
        """(K,) of features; on new ground of a sure place they say nothing: rivals on old ground would gain."""
        at, s = transform(Pose(self.filter.estimate()[0]), view.xy_base_m), self.state
        known = np.minimum(s.survey.coverage.views(at, view.crossing_type) / VIEWS, 1.0) if self.sure else 1.0
        return np.asarray(known / (1.0 + s.looked.views(at)))

    def _instantiate(self, doubt: Doubt, view: Observations, around: Surroundings, evidence: ViewEvidence) -> None:
        """List the places where the robot may be after what happened, and how likely each is."""
        s = self.state
        if doubt.elsewhere >= JUMPED:
            s.belief.renew()
        s.looked, s.spots, s.leads = Coverage(), 0, doubt.leads if len(doubt.leads) else s.leads
        expected = pose = self.filter.estimate()[0]
        centre = expected + doubt.centre
        s.reach.take(doubt, expected)
        lattice, here, tile_m = Lattice.of(around.landmarks, s.map_axis_rad or 0.0), np.zeros(3), np.zeros(2)
        if lattice is not None:
            if doubt.unmeasured:
                pose = aligned_pose(lattice, expected, view, evidence)
                s.gap_opens(pose, doubt.cov)
                self.filter.jump(Pose(pose), np.diag(JUMP_SIGMA**2))
            rivals = lattice.rivals(pose, view, max(doubt.search_m, lattice.watched_m), turned=True)
            off = offset(rival_poses(rivals, pose), centre)
            here, tile_m = offset(pose, centre), lattice.tile_m
            s.belief.add(rivals, doubt.log_odds(off, here, tile_m))
        back = s.picture.doubted(doubt, s.began == 0.0, centre, pose, self._calibration.mount_xy_m)
        s.belief.add(back, np.full(len(back), np.log(TURNS_BACK)))
        unknown, changed = doubt.off_map(here, tile_m)
        if changed > -np.inf:
            s.belief.may_stand(beside_tiles(expected, pose), changed)
        if doubt.elsewhere >= doubts.UNLIKELY:
            s.searched = False
            listed_m = max(doubt.search_m, WATCH_M if lattice is None else lattice.watched_m)
            known = float(evidence.known(expected[None])[0])
            self._on_map.doubt(doubt, expected, view, lattice, s.survey.coverage, known, listed_m, s.belief.stood)
        s.doubt_unknown(doubt, unknown, changed)
        bounded = lattice is not None and doubt.bounded(lattice.reach_m(doubts.ANYWHERE_M))
        s.listed = bounded and (s.listed or s.began == 0.0)
        s.belief.cut = not (s.searched or s.listed)
        s.pending = None
        s.began = max(s.began, s.belief.doubt())
        if s.belief.doubt() >= self._rate:
            s.reason, s.views = doubt.reason, 0 if doubt.elsewhere >= doubts.UNLIKELY else FEWEST_VIEWS - 1
            s.open_submap(self.filter)

    def _search(self, view: Observations, pose: Array, evidence: ViewEvidence) -> Array:
        """List places of the map that this view can be from; the tracked pose (3,), moved onto its own where near."""
        s = self.state
        found = s.survey.index.candidates(view)
        wrong = float(np.min(found.false_alarm_probability[:1], initial=1.0))
        s.search = PlaceSearch(len(found), found.complete, wrong)
        whole = found.complete and not s.searched and (len(found) <= MOST_FOUND or s.belief.led_by_another)
        s.belief.cut = False
        poses = s.survey.index.refined(found.pose if whole else found.pose[:MOST_FOUND], view)
        places = rival_from_tracked(poses, pose)
        within, late = ~s.reach.beyond(places, doubts.FASTER), s.searched and s.spots > 0
        poses, places, odds = poses[within], places[within], s.belief.unknown - s.belief.settled[0]
        odds = odds + log_odds_of_found(poses, pose, s.leads, s.survey.coverage.area_m2, late)
        s.belief.add(places, odds, late)
        s.were_listed(whole)
        own = np.flatnonzero(of_tracked(places))
        if not len(own):
            return pose
        moved = s.grave or s.reason == CONTRADICTION  # else the way is known but for whole tiles
        there = better_of(evidence, pose, poses[own[0]], JUMP_SIGMA[0] if moved else s.gap_sigma_m)
        if there is pose:
            return pose
        if s.belief.led_by_another:  # which stays where it is
            s.belief.places[1:] = rival_from_tracked(rival_poses(s.belief.places, pose), there)[1:]
        s.belief.again(float(odds[own[0]]))
        self.filter.jump(Pose(there), np.diag(JUMP_SIGMA**2))
        return np.asarray(self.filter.estimate()[0])

    def _decided(self, pose: Array) -> bool:
        s = self.state
        refused = self._on_map.refuses  # then no place of it is likely enough, whatever the belief has of this one
        winner = s.belief.winner(self._rate) if s.views >= FEWEST_VIEWS and not refused else None
        if winner is not None:
            told = s.listed or len(s.leads) or s.picture.turned_rad or s.belief.beats_all(winner)
            winner = winner if told and s.picture.turns_back(s.belief.places[winner]) else None
        if winner is not None:
            s.looked, s.spots, s.leads = Coverage(), 0, np.zeros((0, 3))
            self._put(s.belief.jump(winner, pose))
        if s.belief.doubt() >= self._rate or refused or s.picture.turned_rad:
            s.reason = s.reason or CONTRADICTION
            s.open_submap(self.filter)
        elif s.views >= FEWEST_VIEWS:
            s.reason, s.began, s.grave, s.searched, s.leads = "", 0.0, False, False, np.zeros((0, 3))
            s.belief.changed = -np.inf
            s.close_submap()
            s.belief.forget()
            self._on_map.end()
        return winner is not None

    def _put(self, found: Array) -> None:
        """The robot is at a pose (3,); what was learnt in doubt comes along."""
        self._on_map.end()
        s, cov, first_id = self.state, np.diag(JUMP_SIGMA**2), self.state.submap_from
        s.close_submap()
        tracked = self.filter.estimate()[0]
        s.picture.found(found, tracked)
        if first_id is not None:
            s.survey.index.sync(self.filter.carry(first_id, compose(found, inverse(tracked))))
        self.filter.jump(Pose(found), cov)

    def _admitted(self, view: Observations) -> Observations | None:
        """What of a view may teach the filter; None for nothing of it."""
        pose, s = self.filter.estimate()[0], self.state
        if self.sure and not s.surprised:
            return of_sure_place(view, pose, s.survey.coverage, self.filter.landmarks_near)
        near, led = self.filter.landmarks_near, s.belief.led_by_another
        return of_doubtful_place(view, pose, s.survey.coverage, s.submap_from is not None, near, led)
