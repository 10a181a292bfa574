"""The method of the paper as one page: a frame in, an estimate out.

No clock, I/O, logging or threads here: time comes with the frame, randomness from the Generator handed in, so a live
run, a replay and a test do the same.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from ceilvo import se2
from ceilvo.calibration import LEVEL_CEILING, Calibration, CeilingShape
from ceilvo.config import Config
from ceilvo.daemon.integrity.states import Evidence, StateMachine, StateMachineState
from ceilvo.daemon.odometry.cross_checks.checks import CrossChecks, CrossChecksState
from ceilvo.daemon.odometry.cross_checks.suspicion import Kind, Severity, Suspicions
from ceilvo.daemon.odometry.dead_reckoning import DeadReckoning, DeadReckoningState, Track
from ceilvo.daemon.odometry.heights.by_map import map_here
from ceilvo.daemon.odometry.heights.heights_state import HeightsState
from ceilvo.daemon.odometry.heights.odometry import HeightsOdometry
from ceilvo.daemon.odometry.heights.slope import SlopeState
from ceilvo.daemon.odometry.odometry_state import VisualOdometryState
from ceilvo.daemon.relocalisation import doubts
from ceilvo.daemon.relocalisation.beacons.lamps.stage import Lamps
from ceilvo.daemon.relocalisation.beacons.relocaliser import BeaconRelocaliser
from ceilvo.daemon.relocalisation.beacons.state import BeaconState
from ceilvo.daemon.relocalisation.doubts import Doubt
from ceilvo.daemon.relocalisation.filters import make_filter
from ceilvo.daemon.relocalisation.floor_tracker import FloorTrackerState
from ceilvo.daemon.relocalisation.floors import Floors
from ceilvo.daemon.relocalisation.not_this_map import MAP_RIGHT
from ceilvo.daemon.relocalisation.relocaliser_state import RelocaliserState
from ceilvo.daemon.relocalisation.submap import rest_of
from ceilvo.daemon.slam.pose_filter import PoseFilter
from ceilvo.daemon.vision.finder.crossing_finder import CrossingFinder, OnStageDone, ignore
from ceilvo.daemon.vision.finder.line_finder import LineFinderState
from ceilvo.senses.heard import NOTHING, Heard
from ceilvo.types import Array, Crossings, Estimate, Frame, Landmarks, Motion, Observations, Pose, WheelMotion

START_SIGMA = np.array([1e-3, 1e-3, 1e-3])
"""[m, m, rad] of the configured start; a millimetre, because the map begins there by definition."""
NO_LINES = "no lines found"


@dataclass(slots=True)
class PipelineState:
    """All that a pipeline remembers, stage by stage; `filter` is of the filter that the configuration names."""

    seq: int
    vision: LineFinderState
    odometry: VisualOdometryState
    dead_reckoning: DeadReckoningState
    relocaliser: RelocaliserState
    filter: Any
    states: StateMachineState
    checks: CrossChecksState = field(default_factory=CrossChecksState)
    heights: HeightsState = field(default_factory=HeightsState)
    floors: FloorTrackerState = field(default_factory=FloorTrackerState)
    beacons: BeaconState = field(default_factory=BeaconState)
    slope: SlopeState = field(default_factory=SlopeState)


class Pipeline:
    """Frame -> crossings -> motion -> path -> belief -> state.

    Attributes:
        seen: crossings of the last step, as odometry and filter took them.
    """

    def __init__(self, calibration: Calibration, config: Config, rng: np.random.Generator) -> None:
        settings = config.filter
        process = np.diag([settings.process_xy_m**2, settings.process_xy_m**2, settings.process_theta_rad**2])
        self.config = config
        self.vision = CrossingFinder(calibration, config.features)
        self.odometry = HeightsOdometry(config.odometry, calibration)
        self.dead_reckoning = DeadReckoning(process)
        self.relocaliser = BeaconRelocaliser(make_filter(settings, rng), calibration, config)
        self.relocaliser.follow_lamps = Lamps(self.relocaliser, calibration, config).followed
        self.odometry.ask_map = lambda expected: map_here(
            self.filter, self.relocaliser.state.map_axis_rad, self.dead_reckoning.state.gap, expected
        )
        self.states = StateMachine(config.states)
        self.checks = CrossChecks(config)
        self.seq = 0
        self.seen: Crossings | None = None
        self.reset()

    def step(
        self,
        frame: Frame,
        wheels: WheelMotion | None = None,
        on_stage_done: OnStageDone = ignore,
        heard: Heard = NOTHING,
    ) -> Estimate:
        """Take one frame of the calibrated size, in order of time."""
        rolls, elapsed_s = self.vision.rolls, self.dead_reckoning.elapsed_s(frame.stamp_ns)
        told = self.checks.told(wheels, elapsed_s, heard)
        expected = self.odometry.expected(elapsed_s, told.wheels, told.turn)
        twist = self.odometry.expected_twist(elapsed_s, told.wheels, told.turn) if rolls else None
        heights = self.odometry.heights
        hint = None if heights.wants_whole_look else expected
        flickers, fixtures = self.odometry.wants_points, self.odometry.wants_fixtures
        crossings = self.vision(frame, hint, on_stage_done, twist, heights.several, flickers, fixtures)
        return self.step_crossings(frame.stamp_ns, crossings, wheels, on_stage_done, heard=heard)

    def step_crossings(
        self,
        stamp_ns: int,
        crossings: Crossings | None,
        wheels: WheelMotion | None = None,
        on_stage_done: OnStageDone = ignore,
        missing: str = NO_LINES,
        heard: Heard = NOTHING,
    ) -> Estimate:
        """step() from what was seen in a frame; without crossings, why they are missing."""
        elapsed_s = self.dead_reckoning.elapsed_s(stamp_ns)
        usable = self.checks.admit(crossings, wheels, elapsed_s, heard)
        expected = self.odometry.expected(elapsed_s, usable.wheels, usable.turn)
        placed = self.odometry.placed(usable.crossings, expected)
        motion = self.odometry.step(placed, elapsed_s, usable.wheels, usable.missing or missing, usable.turn)
        placed = self.odometry.learn(motion, placed)
        suspicions = self.checks.step(stamp_ns, crossings, motion, wheels, elapsed_s, heard)
        stands = suspicions.has(Kind.STANDS)  # frozen, or the robot stands on slipping wheels: no news of the place
        self.seen = crossings = None if placed is None else self.odometry.directed(placed)
        misplaced = self.odometry.misplaced
        odd_ceiling, rocking = self.odometry.suspicion, self.odometry.rocking
        on_stage_done("odometry")
        track = self.dead_reckoning.advance(stamp_ns, motion)
        self.relocaliser.followed(self.dead_reckoning.state, track, 0 if crossings is None else len(crossings), heard)
        self.relocaliser.follow_lamps(self.dead_reckoning.state, track, heard.lamps)
        if len(misplaced) and track.gap is None:
            self.relocaliser.forget_near(misplaced)
        jump = suspicions.gravest(Severity.IN_DOUBT)
        if jump is not None:
            self.relocaliser.suspect(jump.reason, jump.jump_m)
        came_back = track.final is not None and self.relocaliser.state.pending is not None
        tracker = self.relocaliser.floor_tracker
        ride = tracker.step(self.filter.estimate()[0], came_back) if tracker.floors else None
        if ride is not None:
            self.relocaliser.raise_doubt(ride)
        view = None
        if crossings is not None and len(crossings) and track.gap is None and not stands:
            view = self.relocaliser.look(stamp_ns, crossings)
        on_stage_done("filter")
        seen = 0 if crossings is None else len(crossings)
        return self._estimate(stamp_ns, motion, track, seen, view, suspicions, odd_ceiling, rocking)

    def _estimate(
        self,
        stamp_ns: int,
        motion: Motion,
        track: Track,
        crossings: int,
        view: Observations | None,
        suspicions: Suspicions,
        odd_ceiling: str,
        rocking: str,
    ) -> Estimate:
        pose, cov, health = self.filter.estimate()
        landmarks = self.filter.size()
        self.odometry.slope.state.here = pose if self.relocaliser.sure and track.gap is None else None
        pose, cov = self.checks.corrected(*self.relocaliser.carry(track, Pose(pose), cov))
        path = self.dead_reckoning.state
        degraded, jump = (suspicions.gravest(severity) for severity in (Severity.DEGRADED, Severity.IN_DOUBT))
        floor, pose, cov = self.relocaliser.floor_tracker.floors.on_floor(pose, cov)
        in_doubt = self.relocaliser.doubt
        if jump is not None and not in_doubt:  # a map that has only begun tells no place from another
            in_doubt, elsewhere = jump.reason, 1.0
        else:
            elsewhere = self.elsewhere if in_doubt and not self.relocaliser.state.grave else 1.0
        evidence = Evidence(
            stamp_ns=stamp_ns,
            motion_ok=motion.ok,
            failure=motion.failure or "",
            inliers=int(min(motion.inliers, motion.apart)),
            crossings=crossings,
            position_sigma_m=math.sqrt(max(se2.greatest_variance(cov[:2, :2]), 0.0)),
            heading_sigma_rad=math.sqrt(max(float(cov[2, 2]), 0.0)),
            nis=health.nis if health.nis_dof else 1.0,
            nis_dof=health.nis_dof if view is not None else 0,
            ess_ratio=health.ess / max(health.particles, 1),
            landmarks_matched=0 if view is None else int(np.count_nonzero(view.label >= 0)),
            in_doubt=in_doubt,
            elsewhere=elsewhere,
            suspected=odd_ceiling if degraded is None else degraded.reason,
            rocking=rocking,
        )
        verdict = self.states.step(evidence)
        self.seq += 1
        return Estimate(
            seq=self.seq,
            stamp_ns=stamp_ns,
            pose=pose,
            cov=cov,
            odom=path.odom,
            twist=path.twist,
            state=verdict.state,
            quality=verdict.quality,
            reason=verdict.reason,
            motion=motion,
            health=health,
            crossings=crossings,
            landmarks=landmarks,
            floor=floor,
        )

    # -- what the outside may ask or say

    @property
    def filter(self) -> PoseFilter:
        return self.relocaliser.filter

    @property
    def elsewhere(self) -> float:
        """Probability that the robot is at another place than the tracked one, for a run that begins where this ends.

        While the place is in doubt no less than when that began: what was seen since would be counted twice. While it
        is said that this is not the map, as likely as that.
        """
        s = self.relocaliser.state
        off_map = 1.0 - MAP_RIGHT if s.not_this_map.said else 0.0
        return max(s.belief.doubt(), s.began, 0.0 if s.pending is None else s.pending.elsewhere, off_map)

    def landmarks(self) -> Landmarks:
        """All floors of the map, without what was learnt in doubt of the place: that lies right to the robot only."""
        return rest_of(self.filter.landmarks(), self.relocaliser.state.submap_from)

    @property
    def state(self) -> PipelineState:
        """All that is remembered; setting it continues from there, in a pipeline of the same configuration."""
        return PipelineState(
            self.seq,
            self.vision.state,
            self.odometry.state,
            self.dead_reckoning.state,
            self.relocaliser.state,
            self.filter.state,
            self.states.state,
            self.checks.state,
            self.odometry.heights.state,
            self.relocaliser.floor_tracker.state,
            self.relocaliser.beacons,
            self.odometry.slope.state,
        )

    @state.setter
    def state(self, state: PipelineState) -> None:
        self.seq, self.vision.state, self.odometry.state = state.seq, state.vision, state.odometry
        self.dead_reckoning.state = state.dead_reckoning
        self.relocaliser.state, self.filter.state, self.states.state = state.relocaliser, state.filter, state.states
        self.checks.state, self.odometry.heights.state = state.checks, state.heights
        self.odometry.slope.state = state.slope
        self.relocaliser.floor_tracker.state = state.floors
        self.relocaliser.beacons = state.beacons

    def reset(self, keep_map: bool = False) -> None:
        """Start again at the configured initial pose, with the map (the pose is then a hypothesis) or without.

        That pose is on the home floor; a new map is of one floor.
        """
        cfg = self.config.filter
        start = np.array([cfg.initial_pose_x_m, cfg.initial_pose_y_m, np.radians(cfg.initial_pose_theta_deg)])
        known, ceiling = None, LEVEL_CEILING
        if keep_map:
            known, ceiling = self.landmarks(), self.odometry.ceiling(self.filter.estimate()[0])
        doubt = Doubt("the pose was reset", np.diag(START_SIGMA**2), doubts.RESET_WRONG, np.inf)
        self.odometry.state = VisualOdometryState()
        self.vision.state = LineFinderState()
        self.dead_reckoning.restart()
        self.relocaliser.start_at(start, np.diag(START_SIGMA**2), known, doubt)
        self.relocaliser.state.given = bool(np.any(start))
        tracker = self.relocaliser.floor_tracker
        tracker.state = FloorTrackerState(tracker.floors if keep_map else Floors())
        self.states.reset("started")
        self.checks.restart()
        self.odometry.know(ceiling, start)

    def set_pose(self, pose: Pose, cov: Array, reason: str, floor: str = "") -> None:
        """Take a pose (3,) with covariance as the new hypothesis; the map is kept, the state starts again.

        Args:
            floor: that it is on; "" for the one that the robot is on.

        Raises:
            KeyError: there is no such floor.
        """
        tracker = self.relocaliser.floor_tracker
        if tracker.floors:
            pose, cov = tracker.floors.in_frame(floor or tracker.name_at(self.filter.estimate()[0]), pose, cov)
        tracker.state = FloorTrackerState(tracker.floors)
        doubt = Doubt(reason, cov, doubts.GIVEN_WRONG, np.inf)
        self.relocaliser.start_at(pose, cov, self.landmarks(), doubt)
        self.relocaliser.state.given = True
        self._begin(reason)

    def load_map(
        self,
        landmarks: Landmarks,
        map_axis_rad: float,
        pose: Pose,
        cov: Array,
        ago_s: float = math.inf,
        elsewhere: float = 0.0,
        floors: Floors | None = None,
        ceiling: CeilingShape = LEVEL_CEILING,
    ) -> None:
        """Start on a map of an earlier run; the pose is to be confirmed.

        Args:
            ago_s: since the pose was stored; inf where nobody knows.
            elsewhere: that run's own.
            floors: of the map, in whose common frame all else is; None for one.
            ceiling: its shape, on that map.
        """
        self.odometry.know(ceiling, pose)
        self.relocaliser.floor_tracker.state = FloorTrackerState(floors or Floors())
        doubt = doubts.of_stored(cov, ago_s, elsewhere)
        self.relocaliser.load_map(pose, cov, landmarks, map_axis_rad, doubt)
        self._begin("stored map and pose, to be confirmed")

    def _begin(self, reason: str) -> None:
        self.dead_reckoning.settle()
        self.states.reset(reason)
