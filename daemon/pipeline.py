"""The method of the paper as one visible step: a frame in, an estimate out.

No clock, I/O, logging or threads here: time comes with the frame, randomness from the Generator handed in, so a live
run, a replay and a test do the same.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import numpy as np

from ceilvo import se2
from ceilvo.calibration import Calibration
from ceilvo.config import Config
from ceilvo.daemon.integrity.states import Evidence, StateMachine
from ceilvo.daemon.odometry.visual_odometry import VisualOdometry
from ceilvo.daemon.relocalisation.filters import make_filter
from ceilvo.daemon.relocalisation.hypothesis_test import (
    Confirmation,
    can_confirm,
    contradicted,
    convincing,
    explained_at,
    rival_shifts,
)
from ceilvo.daemon.relocalisation.place_search import best_place
from ceilvo.daemon.slam.association import observe
from ceilvo.daemon.slam.pose_filter import SURE, PoseFilter
from ceilvo.daemon.vision.crossings import cross
from ceilvo.daemon.vision.line_finder import LineFinder
from ceilvo.types import (
    NO_LANDMARK,
    UNLABELLED,
    Array,
    Crossings,
    Depletion,
    Estimate,
    Frame,
    Landmarks,
    Lines,
    Motion,
    Observations,
    WheelMotion,
)

Lap = Callable[[str], None]
"""Called with a stage's name when it has ended; the caller owns the clock."""

_NS = 1e-9
_NO_GAP = Motion(np.zeros(3), np.zeros((3, 3)), 0, 0.0)
_SURE_M = 0.12
_UNSURE_M, _UNSURE_RAD = 0.15, 0.5
_SLIP_SHARE = 0.3
_REACH_M = 0.3
_JUMP_SIGMA = np.array([0.06, 0.06, 0.02])
_MUCH_BETTER = 4
_CONTRADICTIONS = 2
_VIEW_PERIOD_S = 0.1
_START_SIGMA = np.array([1e-3, 1e-3, 1e-3])


def no_lap(stage: str) -> None:
    """For callers that do not time the stages."""


@dataclass(frozen=True, slots=True)
class View:
    """What the last frame looked like to the pipeline, for pictures."""

    frame: Frame
    lines: Lines | None
    crossings: Crossings | None


class Pipeline:
    """Canny -> Hough -> least squares -> crossings -> motion -> particle filter -> state."""

    def __init__(self, calibration: Calibration, config: Config, rng: np.random.Generator) -> None:
        self._calibration = calibration
        self._config = config
        self._lines = LineFinder(calibration, config.features)
        self._filter: PoseFilter = make_filter(config.filter, rng)
        cfg = config.filter
        self._process = np.diag([cfg.process_xy_m**2, cfg.process_xy_m**2, cfg.process_theta_rad**2])
        self._seq = 0
        self._stamp_ns: int | None = None
        self._updated_ns: int | None = None
        self._map_axis_rad: float | None = None
        self._view: View | None = None
        self._gap = _NO_GAP
        self._blind_m = 0.0
        self._travel_m = self._turn_rad = 0.0
        self._hypothesis: Confirmation | None = None
        self._news = True
        self._contradictions = 0
        self._odom = np.zeros(3)
        self._states = StateMachine(config.states)
        self.reset()

    # -- the method

    def step(self, frame: Frame, wheels: WheelMotion | None = None, lap: Lap = no_lap) -> Estimate:
        """Take one frame of the calibrated size, in order of time."""
        dt_s = self._elapsed_s(frame.stamp_ns)
        lines = self._lines(frame.gray, self._odometry.expected(dt_s, wheels), lap)
        crossings = None if lines is None else cross(lines, self._calibration, self._config.features)
        lap("crossings")
        self._view = View(frame, lines, crossings)
        return self._follow(frame.stamp_ns, dt_s, crossings, wheels, lap)

    def follow(self, stamp_ns: int, crossings: Crossings | None, wheels: WheelMotion | None = None) -> Estimate:
        """step() from what was seen in a frame, without the frame."""
        return self._follow(stamp_ns, self._elapsed_s(stamp_ns), crossings, wheels, no_lap)

    def _follow(
        self, stamp_ns: int, dt_s: float, crossings: Crossings | None, wheels: WheelMotion | None, lap: Lap
    ) -> Estimate:
        motion = self._odometry.step(crossings, dt_s, wheels)
        lap("odometry")
        return self._fuse(stamp_ns, dt_s, motion, crossings, lap)

    def coast(self, stamp_ns: int, reason: str, wheels: WheelMotion | None = None) -> Estimate:
        """No frame came: move on by prediction, so that every output says so at once."""
        dt_s = self._elapsed_s(stamp_ns)
        motion = self._odometry.step(None, dt_s, wheels, reason)
        return self._fuse(stamp_ns, dt_s, motion, None, no_lap)

    def _fuse(self, stamp_ns: int, dt_s: float, motion: Motion, crossings: Crossings | None, lap: Lap) -> Estimate:
        self._predict(motion)
        self._odom = se2.compose(self._odom, motion.prev_from_curr)
        observations = self._observe(stamp_ns, motion, crossings)
        if observations is not None:
            if self._hypothesis is None:
                self._watch(observations)
            self._learn(observations)
            if self._hypothesis is not None and self._news:
                self._confirm(self._hypothesis, observations)
        lap("filter")
        return self._conclude(stamp_ns, dt_s, motion, crossings, observations)

    def _predict(self, motion: Motion) -> None:
        """Move the particles by what is final; predictions of a gap wait, for the next good motion replaces them."""
        gap = self._gap
        moved = se2.compose(gap.prev_from_curr, motion.prev_from_curr)
        cov = motion.cov
        unseen = gap.cov
        if not motion.ok:
            cov = unseen = se2.compose_cov(gap.prev_from_curr, gap.cov, motion.prev_from_curr, motion.cov)
        if not motion.ok:
            self._blind_m += float(np.hypot(*motion.prev_from_curr[:2]))
        if motion.ok or motion.restarted:
            self._doubt(unseen)
            self._filter.predict(replace(motion, prev_from_curr=moved, cov=cov + self._process))
            self._gap = _NO_GAP
        else:
            self._gap = replace(motion, prev_from_curr=moved, cov=cov)

    def _doubt(self, gap_cov: Array) -> None:
        """After a blind way on which the robot may have got another tile off, landmarks must confirm the pose.

        The motion that ends the gap proves nothing: on a grid it fits whole tiles and quarter turns off as well.
        """
        blind_m, self._blind_m = self._blind_m, 0.0
        drift_m = 3.0 * float(np.sqrt(max(np.linalg.eigvalsh(gap_cov[:2, :2])[-1], 0.0)))
        turned_rad = 3.0 * float(np.sqrt(max(gap_cov[2, 2], 0.0)))
        if drift_m + _SLIP_SHARE * blind_m <= _UNSURE_M and turned_rad <= _UNSURE_RAD:
            return
        carried = drift_m <= _UNSURE_M and turned_rad <= _UNSURE_RAD
        reach_m = drift_m + blind_m + _REACH_M
        if self._hypothesis is not None:
            self._hypothesis = self._hypothesis.after_gap(carried, reach_m)
            return
        if can_confirm(self._filter.landmarks()):
            why = f"{blind_m:.2f} m driven blind"
            self._end_search()
            self._hypothesis = Confirmation(sure=False, carried=carried, why=why, reach_m=reach_m)

    def _learn(self, observations: Observations) -> None:
        """A hypothesis must not teach the map: what it does not explain would be learnt and then confirm it."""
        if self._hypothesis is None:
            if not self._contradictions:
                self._filter.update(observations)
        elif self._hypothesis.sure or convincing(_matched(observations), len(observations)):
            self._filter.update(_explained(observations))

    def _watch(self, observations: Observations) -> None:
        """A view that contradicts the map teaches nothing; where the next one does too, the pose is in doubt."""
        pose, _, depletion = self._filter.estimate()
        landmarks = self._filter.landmarks()
        judged = depletion.mode_weight >= SURE and can_confirm(landmarks)
        contradicts = judged and contradicted(observations, pose, landmarks)
        self._contradictions = self._contradictions + 1 if contradicts else 0
        if self._contradictions >= _CONTRADICTIONS:
            self._hypothesis = Confirmation(sure=False, why="what is seen contradicts the map")
            self._contradictions = 0

    def _end_search(self) -> None:
        """One search at a time: the filter's own waits for labels that a hypothesis gives and takes."""
        pose, cov, depletion = self._filter.estimate()
        if depletion.mode_weight < SURE:
            self._filter.reset(pose, cov + np.diag(_JUMP_SIGMA**2), self._filter.landmarks())

    def _pose(self) -> tuple[Array, Array, Depletion]:
        """The filter's pose, carried over the gap since the last good frame."""
        pose, cov, depletion = self._filter.estimate()
        gap = self._gap
        return se2.compose(pose, gap.prev_from_curr), se2.compose_cov(pose, cov, gap.prev_from_curr, gap.cov), depletion

    def _observe(self, stamp_ns: int, motion: Motion, crossings: Crossings | None) -> Observations | None:
        """Observations of landmarks, when enough was travelled since the last ones that they are news."""
        self._travel_m += float(np.hypot(*motion.prev_from_curr[:2]))
        self._turn_rad += abs(float(motion.prev_from_curr[2]))
        if crossings is None or not len(crossings) or self._gap is not _NO_GAP:
            return None
        if self._hypothesis is not None:
            self._end_search()
        cfg = self._config.filter
        due = (
            self._updated_ns is None
            or self._travel_m >= cfg.update_travel_m
            or self._turn_rad >= np.radians(cfg.update_turn_deg)
            or (stamp_ns - self._updated_ns) * _NS >= self._view_period_s()
        )
        self._news = due
        if not due and self._hypothesis is None:
            return None
        if due:
            self._travel_m = self._turn_rad = 0.0
            self._updated_ns = stamp_ns
        pose, _, depletion = self._filter.estimate()
        if self._map_axis_rad is None:
            self._map_axis_rad = float(se2.wrap(crossings.psi_rad + float(pose[2])))
        observations = self._seen_from(pose, crossings)
        if depletion.mode_weight >= SURE or self._hypothesis is not None:
            return observations
        return replace(observations, label=np.full(len(observations), UNLABELLED))

    def _view_period_s(self) -> float:
        """How long after a view the next one is news to a robot that stands: detection errs anew in every frame."""
        h, period_s = self._hypothesis, self._config.filter.update_period_s
        return period_s if h is None or h.sure or h.found else min(_VIEW_PERIOD_S, period_s)

    def _seen_from(self, pose: Array, crossings: Crossings) -> Observations:
        """Crossings as observations of the map, were the robot at a pose."""
        return observe(
            crossings,
            self._calibration.noise,
            self._calibration.mount_xy_m,
            pose,
            self._filter.landmarks(),
            self._config.filter,
            self._map_axis_rad or 0.0,
        )

    def _confirm(self, hypothesis: Confirmation, observations: Observations) -> None:
        """Judge an assumed pose by views from places that are a little apart; once is enough to believe it."""
        pose, _, depletion = self._filter.estimate()
        landmarks, gate_m = self._filter.landmarks(), self._config.filter.association_gate_m
        others = np.zeros((0, 2)) if hypothesis.sure else rival_shifts(landmarks, self._map_axis_rad or 0.0)
        counts = explained_at(np.vstack([np.zeros((1, 2)), others]), pose, observations, landmarks, gate_m)
        place = None if hypothesis.sure else best_place(landmarks, observations, pose, hypothesis.home(pose))
        elsewhere = int(np.max(counts[1:], initial=0.0) - counts[0]) if place is None else place.rival - place.here
        seen, nis_high = len(observations), self._config.states.nis_high
        if hypothesis.weigh(counts, seen, elsewhere, depletion.nis, nis_high):
            self._hypothesis = None
            return
        better = hypothesis.better()
        rival = pose if better is None else pose + np.array([*others[better], 0.0])
        if better is not None and (place is None or place.allows(rival)):
            self._jump(hypothesis, pose, rival, landmarks)
        elif hypothesis.hopeless:
            if place is not None and elsewhere > _MUCH_BETTER and convincing(place.explained, seen):
                self._jump(hypothesis, pose, place.pose, landmarks)
            else:
                self._hypothesis = hypothesis.after_gap(hypothesis.carried)

    def _jump(self, hypothesis: Confirmation, old: Array, pose: Array, landmarks: Landmarks) -> None:
        """Try another pose: a hypothesis like any other."""
        self._filter.reset(pose, np.diag(_JUMP_SIGMA**2), landmarks)
        self._hypothesis = hypothesis.jumped(old, pose)

    def _conclude(
        self,
        stamp_ns: int,
        dt_s: float,
        motion: Motion,
        crossings: Crossings | None,
        observations: Observations | None,
    ) -> Estimate:
        pose, cov, depletion = self._pose()
        if motion.ok and dt_s > 0:
            self._twist = motion.prev_from_curr / dt_s
        seen = 0 if crossings is None else len(crossings)
        verdict = self._states.step(
            _evidence(
                stamp_ns,
                motion,
                seen,
                cov,
                depletion,
                observations,
                self._hypothesis,
                depletion.mode_weight < SURE,
            )
        )
        self._seq += 1
        return Estimate(
            seq=self._seq,
            stamp_ns=stamp_ns,
            pose=pose,
            cov=cov,
            odom=self._odom,
            twist=self._twist,
            state=verdict.state,
            quality=verdict.quality,
            reason=verdict.reason,
            motion=motion,
            depletion=depletion,
            crossings=seen,
            landmarks=len(self._filter.landmarks()),
        )

    def _elapsed_s(self, stamp_ns: int) -> float:
        dt_s = 0.0 if self._stamp_ns is None else (stamp_ns - self._stamp_ns) * _NS
        self._stamp_ns = stamp_ns
        return dt_s

    # -- what the outside may ask or tell

    @property
    def stamp_ns(self) -> int | None:
        """Time of the last step."""
        return self._stamp_ns

    @property
    def map_axis_rad(self) -> float | None:
        """Direction of the ceiling's lines in the map modulo 90 deg, once seen."""
        return self._map_axis_rad

    @property
    def view(self) -> View | None:
        """The last frame with what was found in it."""
        return self._view

    def landmarks(self) -> Landmarks:
        return self._filter.landmarks()

    def counters(self) -> Mapping[str, int]:
        """Of the filter, since the pipeline was made (particles.COUNTERS)."""
        return self._filter.counters()

    def particles(self) -> tuple[Array, Array]:
        return self._filter.particles()

    def reset(self, keep_map: bool = False) -> None:
        """Start again at the configured initial pose, with the map (the pose is then a hypothesis) or without."""
        cfg = self._config.filter
        start = np.array([cfg.initial_pose_x_m, cfg.initial_pose_y_m, np.radians(cfg.initial_pose_theta_deg)])
        known = self._filter.landmarks() if keep_map else None
        self._odometry = VisualOdometry(self._config.odometry)
        self._lines.reset()
        self._states.reset("started")
        self._odom = np.zeros(3)
        self._twist = np.zeros(3)
        self._start_at(start, np.diag(_START_SIGMA**2), known)

    def assume(self, pose: Array, cov: Array, why: str) -> None:
        """Take a pose (3,) with covariance as the new hypothesis; the map is kept, the state starts again."""
        self._start_at(pose, cov, self._filter.landmarks())
        self._states.reset(why)

    def know_map(self, landmarks: Landmarks, map_axis_rad: float, pose: Array, cov: Array) -> None:
        """Start on a map of an earlier run; the pose is a hypothesis that landmarks must confirm."""
        self._map_axis_rad = map_axis_rad
        self._start_at(pose, cov, landmarks)
        self._hypothesis = Confirmation(sure=False)  # the robot may have driven on since the pose was stored
        self._states.reset("stored map and pose, to be confirmed")

    def _start_at(self, pose: Array, cov: Array, landmarks: Landmarks | None) -> None:
        """Without landmarks nothing contradicts the pose, and the ceiling's direction is seen anew."""
        known = landmarks if landmarks is not None and len(landmarks) else None
        if known is None:
            self._map_axis_rad = None
        self._filter.reset(pose, cov, known)
        self._gap, self._blind_m, self._contradictions = _NO_GAP, 0.0, 0
        sigma_m = float(np.sqrt(np.linalg.eigvalsh(cov[:2, :2])[-1]))
        sure, reach_m = sigma_m < _SURE_M, 3.0 * sigma_m + _REACH_M
        self._hypothesis = None if known is None else Confirmation(sure, reach_m=reach_m)
        self._travel_m = self._turn_rad = 0.0
        self._updated_ns = None


def _explained(observations: Observations) -> Observations:
    o, known = observations, observations.label != NO_LANDMARK
    return replace(o, xy_base_m=o.xy_base_m[known], var_m2=o.var_m2[known], kind=o.kind[known], label=o.label[known])


def _matched(observations: Observations) -> int:
    return int(np.count_nonzero(observations.label >= 0))


def _evidence(
    stamp_ns: int,
    motion: Motion,
    crossings: int,
    cov: Array,
    depletion: Depletion,
    observations: Observations | None,
    hypothesis: Confirmation | None,
    searching: bool,
) -> Evidence:
    unconfirmed = "" if hypothesis is None else hypothesis.why or "assumed"
    return Evidence(
        stamp_ns=stamp_ns,
        motion_ok=motion.ok,
        failure=motion.failure or "",
        inliers=motion.inliers,
        crossings=crossings,
        position_sigma_m=float(np.sqrt(max(np.linalg.eigvalsh(cov[:2, :2])[-1], 0.0))),
        heading_sigma_rad=float(np.sqrt(max(cov[2, 2], 0.0))),
        nis=depletion.nis if depletion.nis_dof else 1.0,
        nis_dof=depletion.nis_dof if observations is not None else 0,
        ess_ratio=depletion.ess / max(depletion.particles, 1),
        landmarks_matched=0 if observations is None else _matched(observations),
        relocalising=searching or (hypothesis is not None and not hypothesis.carried),
        unconfirmed=unconfirmed,
    )
