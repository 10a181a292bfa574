"""Which place on the map, with ranges and marks: they weigh places and end searches, and hold the pose within gaps.

While the place is sure and vision measures, they change nothing: ranges are learnt from, and marks are held against it.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from ceilvo import se2
from ceilvo.calibration import Calibration
from ceilvo.config import Config
from ceilvo.daemon.odometry.course import JUMPED
from ceilvo.daemon.odometry.dead_reckoning import DeadReckoningState, Track
from ceilvo.daemon.relocalisation.beacons.anchors import AnchorTable
from ceilvo.daemon.relocalisation.beacons.bridge import Bridge
from ceilvo.daemon.relocalisation.beacons.mark_poses import MarkPose, mark_pose
from ceilvo.daemon.relocalisation.beacons.range_window import Fix, find, lever
from ceilvo.daemon.relocalisation.beacons.state import BeaconState, FollowLamps, no_lamps
from ceilvo.daemon.relocalisation.beacons.trust import Trust
from ceilvo.daemon.relocalisation.doubts import UNLIKELY, Doubt
from ceilvo.daemon.relocalisation.evidence.coverage import Coverage
from ceilvo.daemon.relocalisation.evidence.view_evidence import ViewEvidence
from ceilvo.daemon.relocalisation.lattice import Lattice, rival_poses
from ceilvo.daemon.relocalisation.place_belief import LEAD_M, PlaceBelief
from ceilvo.daemon.relocalisation.relocaliser import JUMP_SIGMA, Relocaliser
from ceilvo.daemon.relocalisation.submap import rest_of
from ceilvo.daemon.relocalisation.survey import MEASURED_M
from ceilvo.daemon.slam.pose_filter import PoseFilter
from ceilvo.senses.beacons import Beacons, MarkSeen, Range
from ceilvo.senses.heard import Heard
from ceilvo.types import Array, Crossings, Ints, Landmarks, Motion, Observations, Pose

FEWEST_ANCHORS, FEWEST_RANGES = 3, 12
"""That a fix is made of; chosen: two leave two places, and a second's worth tells what is obstructed."""
REACH_LEAST_M, REACH_MOST_M = 2.0, 6.0
"""Places are listed so far around a fix, and it must bound them so well; chosen: more take too long."""
CONTRADICTED = 12.0
"""By how much less likely than the fix the tracked place must be to begin there, as a logarithm; chosen."""
FIX_WRONG = 0.02
"""Chance that the robot is elsewhere than where ranges say; chosen: all paths but two may be obstructed."""
TURN_SIGMA_RAD = 2.0
"""Of a fix's heading, which ranges from one spot do not know."""
MARK_PICTURES = 2
"""In a row that must show a mark before it ends a search: one may be a reflection; chosen."""
MARK_WRONG = 3e-5
"""Chance that a mark which two pictures show hangs elsewhere; chosen, below states.false_place_rate, so that it ends a
search; a lamp that contradicts it outweighs it."""
FIX_PERIOD_NS = MARK_AGAIN_NS = 500_000_000
"""Between two searches for a fix, for time; and pictures of a mark that lie further apart are not in a row."""
BEYOND_M, BEYOND_CELL_M = 8.0, 1.0
"""Unknown ground is looked for so far around, in such steps."""
HELD_M = 0.15
"""Standard deviation of the pose at the end of a gap, up to which a bridge says that nobody carried the robot off."""


class BeaconRelocaliser(Relocaliser):
    """A Relocaliser that is told of ranges and marks, or of none: then it is that one. bridge: within a gap."""

    def __init__(self, filter_: PoseFilter, calibration: Calibration, config: Config) -> None:
        super().__init__(filter_, calibration, config)
        self._tag_m = np.array([config.beacons.tag_x_m, config.beacons.tag_y_m, config.beacons.tag_z_m])
        self._noise_m = config.beacons.noise_m
        self.bridge, self._trust = Bridge(), Trust()
        self._beacons = BeaconState()
        self.follow_lamps: FollowLamps = no_lamps
        self._crossings: Crossings

    @property
    def beacons(self) -> BeaconState:
        self._beacons.bridge, self._beacons.trust = self.bridge.state, self._trust.state
        return self._beacons

    @beacons.setter
    def beacons(self, state: BeaconState) -> None:
        self._beacons, self.bridge.state, self._trust.state = state, state.bridge, state.trust

    # -- what it is told

    def know(self, beacons: Beacons) -> None:
        """From now on."""
        self.beacons = BeaconState(AnchorTable.of(beacons.anchors, self._noise_m), replace(beacons, anchors=()))

    def beacons_learnt(self) -> Mapping[str, object]:
        """For people, by name; nothing where there are no beacons."""
        b, out = self._beacons, dict[str, object]()
        if b.anchors.names:
            anchors = {a.name: {"offset_m": a.offset_m, "sigma_m": a.offset_sigma_m} for a in b.anchors.anchors()}
            out["ranges"] = {"heard": b.heard, "taken": b.taken, "noise_m": b.anchors.noise_m, "anchors": anchors}
        if b.marks.marks:
            out["marks"] = {"ignored": sorted(self._trust.state.wrong)}
        return out | ({"lamps": b.lamps.learnt()} if b.marks.lamps else {})

    def take_news(self) -> list[str]:
        """What happened that somebody should read, each once."""
        return self._trust.take_news() + self._beacons.lamps.take_news()

    # -- what happens to the robot

    def start_at(self, pose: Array, cov: Array, landmarks: Landmarks | None, doubt: Doubt | None = None) -> None:
        super().start_at(pose, cov, landmarks, doubt)
        b = self._beacons
        b.window.clear()
        b.located, b.wide, b.fix_ns = False, True, 0
        b.lamps.forget()
        self.bridge.end()

    def raise_doubt(self, doubt: Doubt, lost: bool = False) -> None:
        super().raise_doubt(doubt, lost)
        b = self._beacons
        if self.state.pending is not None and doubt.elsewhere >= UNLIKELY:
            b.window.clear()
            b.lamps.forget()
            b.located, b.wide = False, b.wide or doubt.elsewhere >= JUMPED

    def followed(self, path: DeadReckoningState, track: Track, crossings: int, heard: Heard) -> None:
        """travelled(), with what was heard on that part of the way."""
        b = self._beacons
        self.travelled(track, crossings)
        if not b.anchors.names and b.marks == Beacons():
            return
        which, range_m, tags = self._placed(path, heard.ranges)
        if track.gap is not None:
            self._move_bridge(track)
        elif self.bridge.lives:
            self._end_bridge(track)
        if len(which):
            self._take_ranges(which, range_m, tags, path.odom)
        self._take_marks(heard.marks, path.stamp_ns or 0, track.gap)
        b.odom, b.stamp_ns = np.array(path.odom), path.stamp_ns or 0

    def _placed(self, path: DeadReckoningState, heard: tuple[Range, ...]) -> tuple[Ints, Array, Array]:
        """Rows of anchors (N,), ranges (N,) and where the tag was then in odom (N, 2), of what was heard."""
        b = self._beacons
        b.heard += len(heard)
        row = {name: i for i, name in enumerate(b.anchors.names)}
        known = [r for r in heard if r.anchor in row]
        b.taken += len(known)
        now_ns, before = path.stamp_ns or 0, path.odom if b.odom is None else b.odom
        span_ns = max(now_ns - b.stamp_ns, 1) if b.odom is not None else 1
        step = se2.between(before, path.odom)
        tags = np.empty((len(known), 2))
        for i, r in enumerate(known):
            share = float(np.clip((r.stamp_ns - b.stamp_ns) / span_ns, 0.0, 1.0))
            tags[i] = lever(np.asarray(se2.compose(before, share * step)), self._tag_m[:2])
        which = np.array([row[r.anchor] for r in known], np.int64)
        return which, np.array([r.range_m for r in known], np.float64), tags

    # -- within a gap

    def _move_bridge(self, track: Track) -> None:
        assert track.gap is not None
        pose, cov, _ = self.filter.estimate()
        self.bridge.move(pose, cov, track.gap, self._beacons.anchors, self._tag_m)

    def _end_bridge(self, track: Track) -> None:
        """Where vision did not tie the end of the gap to its beginning, the bridge's pose is the better one."""
        final, s = track.final, self.state
        if final is not None and final.restarted and self.bridge.helps:
            pose, cov, _ = self.filter.estimate()
            start = np.asarray(se2.compose(pose, se2.inverse(final.prev_from_curr)))
            self.bridge.move(start, cov, final, self._beacons.anchors, self._tag_m)
            pose, cov = self.bridge.pose
            self.filter.jump(pose, cov)
            if s.pending is not None:
                sure = float(np.sqrt(se2.greatest_variance(cov[:2, :2]))) < HELD_M
                elsewhere = min(s.pending.elsewhere, FIX_WRONG if sure else 1.0)
                s.pending = replace(s.pending, cov=cov, elsewhere=elsewhere)
        self.bridge.end()

    def carry(self, track: Track, pose: Pose, cov: Array) -> tuple[Pose, Array]:
        """The filter's pose (3,) with covariance (3, 3), moved over a gap; one that must not be used yet with the
        covariance of the gap before it, too."""
        if self.bridge.lives and self.bridge.helps and track.gap is not None:
            return self.bridge.pose
        return track.carry(pose, cov + self.state.left_open(pose) if self.state.grave else cov)

    # -- ranges

    def _take_ranges(self, which: Ints, range_m: Array, tags_odom_m: Array, odom: Array) -> None:
        b = self._beacons
        b.window.add(tags_odom_m, which, range_m)
        pose = self.filter.estimate()[0]
        if self.bridge.lives:
            here = lever(odom, self._tag_m[:2])
            turn = se2.rotation(se2.wrap(float(self.bridge.state.mean[2] - odom[2])))
            self.bridge.hear(b.anchors, self._tag_m, which, range_m, (tags_odom_m - here) @ turn.T)
        elif self.sure:
            tags = se2.transform(Pose(se2.compose(pose, se2.inverse(odom))), tags_odom_m)
            b.anchors.learn(which, tags, float(self._tag_m[2]), range_m)

    def observed(self, crossings: Crossings) -> Observations:
        self._crossings = crossings
        return super().observed(crossings)

    def _begin_at_fix(self) -> None:
        """Search around where ranges say that the robot is, unless the search is there already."""
        b, seen = self._beacons, self._crossings
        if len(b.window.anchors) < FEWEST_ANCHORS or len(b.window) < FEWEST_RANGES or b.odom is None:
            return
        b.fix_ns = b.stamp_ns
        headings = np.linspace(0.0, 1.75 * np.pi, 8)
        if self.state.map_axis_rad is not None and seen.directed:
            headings = self.state.map_axis_rad - seen.psi_rad + np.linspace(0.0, 1.5 * np.pi, 4)
        fix = find(b.window, b.anchors, float(self._tag_m[2]), b.odom, headings)
        if fix is None:
            return
        reach_m = max(REACH_LEAST_M, fix.reach_m + 1.0, 4.0 * float(np.sqrt(np.max(np.diagonal(fix.cov)))))
        if reach_m > REACH_MOST_M:
            return
        best = float(np.max(self._range_likelihood(rival_poses(self.state.belief.places, self.filter.estimate()[0]))))
        belief, lost = self.state.belief, b.wide and not b.located
        if not lost and not belief.cut and best > fix.log_likelihood - CONTRADICTED:
            return
        self._claim(fix, reach_m, seen)

    def _claim(self, fix: Fix, reach_m: float, crossings: Crossings) -> None:
        """The robot is around a fix, with tiles on tiles; how likely each place there is the ranges say later."""
        s = self.state
        reason = s.reason if s.pending is None else s.pending.reason
        self._put(np.asarray(fix.pose))
        view = super().observed(crossings)
        near = rest_of(self.filter.landmarks_near(fix.pose[None, :2], reach_m + MEASURED_M)[1], s.submap_from)
        lattice = Lattice.of(near, s.map_axis_rad or 0.0)
        if lattice is not None:
            self.filter.jump(Pose(lattice.aligned(fix.pose, view)), np.diag(JUMP_SIGMA**2))
        sigma = 0.25 * reach_m
        s.belief, s.views = PlaceBelief(), 0
        s.pending = Doubt(reason, np.diag([sigma**2, sigma**2, TURN_SIGMA_RAD**2]), FIX_WRONG)
        s.reason = reason
        self._beacons.located = True

    def _range_likelihood(self, poses: Array) -> Array:
        b = self._beacons
        assert b.odom is not None
        return b.window.log_likelihood(b.anchors, float(self._tag_m[2]), b.odom, poses)

    def _search(self, view: Observations, pose: Array, evidence: ViewEvidence) -> Array:
        return pose if self._beacons.located else super()._search(view, pose, evidence)

    def _weigh(self, view: Observations) -> bool:
        b, s = self._beacons, self.state
        before = self.filter.estimate()[0]
        if len(b.window) and not self.sure and b.stamp_ns - b.fix_ns >= FIX_PERIOD_NS:
            self._begin_at_fix()
        moved = bool(np.any(self.filter.estimate()[0] != before))
        if moved:
            view = super().observed(self._crossings)
        changed = super()._weigh(view) or moved
        self._tell()
        if b.settled >= 0:
            self._trust.after_search(b.settled, s.surprised)
            b.settled = -1
        return changed

    def _arrive(self) -> None:
        """Places that are found now are weighed among what was seen; what ranges say is added to all of them again."""
        super()._arrive()
        belief = self.state.belief
        if not self.sure and np.any(belief.told):
            belief.tell(np.zeros(len(belief)), 0.0)

    def _tell(self) -> None:
        b, belief = self._beacons, self.state.belief
        if not len(b.window) or b.odom is None or self.sure or np.any(belief.told):
            return
        pose = self.filter.estimate()[0]
        places = self._range_likelihood(rival_poses(belief.places, pose))
        top = float(np.max(places))
        belief.tell(places - top, self._beyond(pose) - top)

    def _decided(self, pose: Array) -> bool:
        self._tell()
        belief = self.state.belief
        best = int(np.argmax(belief.weights()[0]))
        if self._beacons.located and belief.told[best] - belief.told[0] > CONTRADICTED:
            # the tracked place is out of the question, so nothing that passes by speaks against it
            belief.leader, belief.led_m = belief.places[best].copy(), LEAD_M
        doubtful = not self.sure
        if self._beacons.wide and not self._beacons.located and self._beacons.fix_ns == 0 and np.any(belief.told):
            return False  # ranges have begun to come: first they say where to look
        decided = super()._decided(pose)
        if self.sure and doubtful:
            # what the ranges have said is settled
            belief.told, belief.told_unknown = np.zeros(len(belief)), 0.0
            self._beacons.window.clear()
            self._beacons.located = self._beacons.wide = False
        return decided

    def _beyond(self, pose: Array) -> float:
        """Log-likelihood of the ranges at the best place on ground that the map does not know."""
        axis = np.arange(-BEYOND_M, BEYOND_M + BEYOND_CELL_M, BEYOND_CELL_M)
        at = pose[:2] + np.stack(np.meshgrid(axis, axis), axis=-1).reshape(-1, 2)
        at = at[~self.state.survey.coverage.knows(at)]
        turns = pose[2] + 0.5 * np.pi * np.arange(4)
        if not len(at):
            at = pose[:2] + BEYOND_M * np.column_stack([np.cos(turns), np.sin(turns)])
        poses = np.column_stack([np.repeat(at, 4, axis=0), np.tile(turns, len(at))])
        return float(np.max(self._range_likelihood(poses)))

    # -- marks

    def _take_marks(self, seen: tuple[MarkSeen, ...], stamp_ns: int, gap: Motion | None) -> None:
        known = {m.number: m for m in self._beacons.marks.marks} if seen else {}
        for one in seen:
            mark = known.get(one.number)
            said = None if mark is None else mark_pose(self._calibration, mark, one.corners_px)
            if said is not None:
                self._take_mark(said, stamp_ns, gap)

    def _take_mark(self, mark: MarkPose, stamp_ns: int, gap: Motion | None) -> None:
        b = self._beacons
        in_a_row = b.shown == mark.number and stamp_ns - b.shown_ns <= MARK_AGAIN_NS
        b.shown, b.shown_ns, b.shown_times = mark.number, stamp_ns, b.shown_times + 1 if in_a_row else 1
        if self.sure and not self.bridge.lives:
            pose, cov, _ = self.filter.estimate()
            self._trust.hold(mark, pose, cov)
        elif not self._trust.believed(mark):
            return
        elif self.sure:
            if self._trust.fits(mark, *self.bridge.pose) or not self.bridge.state.marks:
                if self._trust.hold(mark, *self.bridge.pose):
                    self.bridge.see(mark)
            else:
                self._trust.contradict(mark, list(self.bridge.state.marks))
                self.bridge.widen(mark)
        elif b.shown_times >= MARK_PICTURES and not self._trust.doubted(mark):
            self.begin_anew_at(mark.pose, mark.cov, f"mark {mark.number}", MARK_WRONG, gap)
            b.settled = mark.number
            if gap is not None:
                self.bridge.see(mark)

    def begin_anew_at(self, pose: Array, cov: Array, what: str, wrong: float, gap: Motion | None) -> None:
        """The robot is at a pose (3,) with cov (3, 3), as what was seen says, but for the chance `wrong`."""
        b, s = self._beacons, self.state
        start = pose if gap is None else np.asarray(se2.compose(pose, se2.inverse(gap.prev_from_curr)))
        self._put(start)
        self.filter.jump(Pose(start), cov)
        s.belief, s.reason, s.began, s.surprised = PlaceBelief(), "", 0.0, False
        # what the ceiling shows may still speak against it
        s.pending = Doubt(what, cov, wrong) if gap is None else None
        s.looked, s.spots, s.leads = Coverage(), 0, np.zeros((0, 3))
        b.window.clear()
        b.located = b.wide = False
        self.bridge.end()
        if gap is not None:
            self.bridge.move(start, cov, gap, b.anchors, self._tag_m)
