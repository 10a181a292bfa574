"""How far the pose can be trusted, and why: a state machine without a clock (docs/states.md).

Time comes with the evidence. Every change of state has exactly one reason. Thresholds for entering and leaving a
condition differ and counts must agree, so evidence that hovers at a threshold does not make the state flap.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

from ceilvo.config import States
from ceilvo.daemon.relocalisation.doubts import UNLIKELY
from ceilvo.daemon.relocalisation.relocaliser_state import AMBIGUOUS, MAPPED_APART, NOT_THIS_MAP
from ceilvo.types import State

LEAVE_RATIO = 0.8
"""A condition entered beyond a threshold is left only within this fraction of it; chosen (docs/states.md)."""
ESS_REFERENCE = 0.1
"""Effective sample sizes below this fraction of the particles lower the quality; chosen (docs/states.md)."""
_ESS_WEIGHT = 0.2
"""By this at most; chosen: sigma and NIS matter more."""
_NIS_CAP = 2.0
"""Times nis_lost, what one update counts in the mean NIS at most; chosen: the mean comes back from a wild one."""
_FEW_TIMES = 2
"""Times tracking_frames, frames with few inliers after which a start is DEGRADED: two lamps in view are never more;
chosen: few prove as much in twice the time."""
_SLIGHT = ("sigma", "heading", "rocking", "inliers")
"""With nothing worse than these a start ends in DEGRADED, which promises a pose within a bound of its own."""
_OPEN = ("far", "turned")
"""What no motion puts right: a start that may be off by so much waits for somebody who says where it is."""
BOUND_SIGMAS = 3.0
"""What DEGRADED promises of a pose holds for so many standard deviations: 99.7 % of one axis."""
UNUSABLE = (State.INIT, State.LOST, State.RELOCALISING)
"""States in which the pose must not be used; their quality is 0."""


@dataclass(frozen=True, slots=True)
class Evidence:
    """What one frame shows of the pose.

    Attributes:
        stamp_ns: the frame's.
        motion_ok, failure: whether vision gave a motion; if not, why.
        inliers, crossings: correspondences used, and crossings seen.
        position_sigma_m, heading_sigma_rad: of the pose, not finite = unknown.
        nis: mean normalised innovation squared per degree of freedom (1 when the filter is consistent).
        nis_dof: its degrees of freedom; 0 = the landmarks were not used on this frame.
        ess_ratio: effective sample size over the number of particles.
        landmarks_matched: observations that a landmark explained; needed to confirm a relocalisation.
        in_doubt: why the robot may be at another place than the pose says, "" while that is less likely than
            states.false_place_rate.
        elsewhere: how likely it is, where it may be and a small doubt began it.
        suspected: what picture, wheels and stamps say against each other, "" for nothing.
        rocking: by how much the pose may be off because nothing tells the robot's tilt, for people; "" where that is
            little.
    """

    stamp_ns: int
    motion_ok: bool
    failure: str
    inliers: int
    crossings: int
    position_sigma_m: float
    heading_sigma_rad: float
    nis: float = 1.0
    nis_dof: int = 0
    ess_ratio: float = 1.0
    landmarks_matched: int = 0
    in_doubt: str = ""
    elsewhere: float = 1.0
    suspected: str = ""
    rocking: str = ""


@dataclass(frozen=True, slots=True)
class Verdict:
    """State, quality in [0, 1], the one reason for being in this state, and whether this frame changed it."""

    state: State
    quality: float
    reason: str
    changed: bool


@dataclass(slots=True)
class Votes:
    """A condition that holds once `need` votes more came for it than against it, and until all are taken back."""

    count: int = 0
    holds: bool = False

    def add(self, bad: bool, good: bool, need: int) -> None:
        self.count = min(max(self.count + int(bad) - int(good), 0), need)
        if self.count in (0, need):
            self.holds = self.count == need


@dataclass(slots=True)
class StateMachineState:
    """What the frames so far left.

    Attributes:
        current, reported: state now, and at the end of the last step.
        cause, reason: why it is this one, as a short key and as text.
        conditions: those that hold, by key, with their texts.
        nis_high, nis_lost: whether NIS is above the thresholds of DEGRADED and LOST.
        nis_mean: smoothed NIS per degree of freedom.
        vision_score: in [0, 1], fading without vision.
        stamp_ns, vision_ns: the last frame's, and of the last one with a motion.
        good_frames, vision_frames: in a row, without anything bad and with a motion.
        steady_frames: in a row, with nothing worse than _SLIGHT.
        confirmed: landmarks have matched since the pose was last given up.
    """

    current: State = State.INIT
    reported: State = State.INIT
    cause: str = ""
    reason: str = "starting"
    conditions: dict[str, str] = field(default_factory=dict)
    nis_high: Votes = field(default_factory=Votes)
    nis_lost: Votes = field(default_factory=Votes)
    nis_mean: float = 1.0
    vision_score: float = 0.0
    stamp_ns: int | None = None
    vision_ns: int | None = None
    good_frames: int = 0
    vision_frames: int = 0
    steady_frames: int = 0
    confirmed: bool = False


class StateMachine:
    """Feed it every frame's evidence in order; it is deterministic and knows no time but the stamps."""

    def __init__(self, config: States) -> None:
        self._cfg = config
        self.state = StateMachineState()

    def reset(self, reason: str) -> None:
        """Back to INIT (a pose was set from outside, or the map was dropped); the next step reports the change."""
        self._enter(State.INIT, "reset", reason)
        self._drop_evidence()

    def step(self, evidence: Evidence) -> Verdict:
        s = self.state
        self._update(evidence)
        if self._gives_up(evidence):
            self._drop_evidence()
        state, cause, reason = self._decide(evidence)
        if state is not s.current or cause not in ("", s.cause):
            self._enter(state, cause, reason)
        changed = s.current is not s.reported
        s.reported = s.current
        return Verdict(s.current, self._quality(evidence), s.reason, changed)

    def _enter(self, state: State, cause: str, reason: str) -> None:
        self.state.current, self.state.cause, self.state.reason = state, cause, reason

    def _drop_evidence(self) -> None:
        """Innovations and good frames of a pose that is no longer believed say nothing about the next one."""
        s = self.state
        s.nis_high, s.nis_lost = Votes(), Votes()
        s.nis_mean = 1.0
        s.conditions.clear()
        s.good_frames = s.steady_frames = 0
        s.confirmed = False

    def _update(self, e: Evidence) -> None:
        """Update the conditions that hold, the counts and the smoothed scores with this frame."""
        cfg, s = self._cfg, self.state
        elapsed_s = 0.0 if s.stamp_ns is None else max(e.stamp_ns - s.stamp_ns, 0) / 1e9
        s.stamp_ns = e.stamp_ns
        if e.motion_ok or s.vision_ns is None:
            s.vision_ns = e.stamp_ns
        s.vision_frames = s.vision_frames + 1 if e.motion_ok else 0
        if e.motion_ok:  # without a motion the failure is the better reason
            n = cfg.degraded_inliers
            text = f"{e.inliers} inliers of {e.crossings} crossings, fewer than {n}"
            self._set("inliers", e.inliers < n, e.inliers * LEAVE_RATIO >= n, text)
        self._set_above("sigma", e.position_sigma_m, cfg.degraded_sigma_m, "position sigma {:.3f} m, above {:g} m")
        heading_deg = math.degrees(e.heading_sigma_rad)
        self._set_above("heading", heading_deg, cfg.degraded_heading_deg, "heading sigma {:.2f} deg, above {:g} deg")
        self._set_above("lost_sigma", e.position_sigma_m, cfg.lost_sigma_m, "position sigma {:.3f} m, above {:g} m")
        far_m, far_deg = BOUND_SIGMAS * e.position_sigma_m, BOUND_SIGMAS * heading_deg
        self._set_above("far", far_m, cfg.degraded_within_m, "position only within {:.2f} m, not {:g} m")
        self._set_above("turned", far_deg, cfg.degraded_within_deg, "heading only within {:.1f} deg, not {:g} deg")
        self._set("suspected", bool(e.suspected), not e.suspected, e.suspected)
        self._set("in doubt", bool(e.in_doubt), not e.in_doubt, e.in_doubt)
        self._set("rocking", bool(e.rocking), not e.rocking, e.rocking)
        self._update_nis(e)
        spike = e.nis_dof > 0 and not e.nis <= cfg.nis_high
        s.good_frames = s.good_frames + 1 if e.motion_ok and not s.conditions and not spike else 0
        steady = e.motion_ok and set(s.conditions) <= set(_SLIGHT) and not spike
        s.steady_frames = s.steady_frames + 1 if steady else 0
        s.confirmed |= not e.in_doubt and e.landmarks_matched > 0
        hold = math.exp(-elapsed_s / cfg.dead_reckoning_s) if cfg.dead_reckoning_s > 0 else 0.0
        now = _score(cfg.degraded_inliers, e.inliers) if e.motion_ok else 0.0
        s.vision_score = max(now, s.vision_score * hold)

    def _update_nis(self, e: Evidence) -> None:
        cfg, s = self._cfg, self.state
        if e.nis_dof > 0:
            nis = e.nis if math.isfinite(e.nis) else math.inf
            s.nis_high.add(nis > cfg.nis_high, nis < LEAVE_RATIO * cfg.nis_high, cfg.nis_frames)
            s.nis_lost.add(nis > cfg.nis_lost, nis < LEAVE_RATIO * cfg.nis_lost, cfg.nis_frames)
            s.nis_mean += (min(nis, _NIS_CAP * cfg.nis_lost) - s.nis_mean) / cfg.nis_frames
        text = f"NIS per degree of freedom {e.nis:.1f}, above {{:g}} for {cfg.nis_frames} updates"
        for name, votes, limit in (("nis", s.nis_high, cfg.nis_high), ("lost_nis", s.nis_lost, cfg.nis_lost)):
            self._set(name, votes.holds, not votes.holds, text.format(limit))

    def _set_above(self, name: str, value: float, limit: float, text: str) -> None:
        """A condition entered above the limit; a value that is not a number is above it."""
        enter = not value <= limit
        self._set(name, enter, value < LEAVE_RATIO * limit, text.format(value, limit) if enter else "")

    def _set(self, name: str, enter: bool, leave: bool, text: str) -> None:
        if enter:
            self.state.conditions.setdefault(name, text)
        elif leave:
            self.state.conditions.pop(name, None)

    def _decide(self, e: Evidence) -> tuple[State, str, str]:
        """The state that this frame calls for, with its cause and reason; cause "" keeps the standing reason."""
        cfg, s = self._cfg, self.state
        state = s.current
        if self._gives_up(e) and not self._blind(e):
            cause = next((c for c in (AMBIGUOUS, NOT_THIS_MAP) if e.in_doubt.startswith(c)), "in doubt")
            cause += ", apart" if e.in_doubt.endswith(MAPPED_APART) else ""
            return State.RELOCALISING, cause, e.in_doubt
        lost = self._first_cause("lost_nis") if state is State.INIT else self._first_cause("lost_nis", "lost_sigma")
        if lost:
            return State.LOST, lost, s.conditions[lost]
        enough = s.good_frames >= cfg.tracking_frames
        if state in (State.INIT, State.RELOCALISING):
            sure = state is State.INIT or s.confirmed
            times = 1 if set(s.conditions) == {"rocking"} else _FEW_TIMES  # which says how far off, not whether right
            if sure and not enough and s.steady_frames >= times * cfg.tracking_frames and s.conditions:
                slight = self._first_cause(*_SLIGHT)
                return State.DEGRADED, slight, s.conditions[slight]
            far = self._first_cause(*_OPEN)
            if far and state is State.INIT and s.vision_frames >= cfg.tracking_frames:
                return state, far, f"{s.conditions[far]}; say where it is (cmd/initial_pose)"
            return (State.TRACKING, "good", self._good_reason()) if enough and sure else (state, "", "")
        far = self._first_cause(*_OPEN)
        if not e.motion_ok:
            return self._without_vision(e, bool(far))
        if far:
            return State.DEAD_RECKONING, far, s.conditions[far]
        if state is State.DEAD_RECKONING and s.vision_frames < cfg.tracking_frames:
            return state, "", ""
        if enough or (state is State.TRACKING and not s.conditions):
            return State.TRACKING, "" if state is State.TRACKING else "good", self._good_reason()
        cause = self._first_cause("in doubt", "nis", "suspected", *_SLIGHT)
        if cause:
            return State.DEGRADED, cause, s.conditions[cause]
        return State.DEGRADED, "" if state is State.DEGRADED else "recovering", "recovering: too few good frames so far"

    def _gives_up(self, e: Evidence) -> bool:
        """Whether the place is too doubtful for the pose to be used; one that was not usable waits until it is sure."""
        return bool(e.in_doubt) and (e.elsewhere >= UNLIKELY or self.state.current in UNUSABLE)

    def _blind(self, e: Evidence) -> bool:
        """Whether vision went out while the place was sure; whether it still is, is asked when vision is back.

        A pose that is worse than any that may be used is asked at once.
        """
        out_s = (e.stamp_ns - (self.state.vision_ns or 0)) / 1e9
        sure = self.state.current in (State.TRACKING, State.DEGRADED, State.DEAD_RECKONING)
        bounded = e.position_sigma_m <= self._cfg.lost_sigma_m
        return sure and bounded and not e.motion_ok and out_s > self._cfg.dead_reckoning_s

    def _without_vision(self, e: Evidence, far: bool) -> tuple[State, str, str]:
        out_s = (e.stamp_ns - (self.state.vision_ns or 0)) / 1e9
        why = e.failure or "no motion"
        kept = self.state.current is State.DEAD_RECKONING
        if e.crossings >= self._cfg.degraded_inliers and not kept:  # seen, and not where the robot should be
            return State.DEAD_RECKONING, "blind", f"no motion from this frame: {why}"
        # DEGRADED cannot promise anything of a frame that shows nothing: a robot that is carried off moves 0.4 m in it.
        if far or kept or out_s > self._cfg.dead_reckoning_s or e.crossings == 0:
            return State.DEAD_RECKONING, "" if kept else "blind", f"no vision for {out_s:.2f} s: {why}"
        return State.DEGRADED, "missed", f"no motion from this frame: {why}"

    def _first_cause(self, *names: str) -> str:
        return next((n for n in names if n in self.state.conditions), "")

    def _good_reason(self) -> str:
        n = self._cfg.tracking_frames
        return f"{n} good frame{'s' if n > 1 else ''} in a row"

    def _quality(self, e: Evidence) -> float:
        """Product of scores, each 1/2 at its DEGRADED threshold and falling as its evidence gets worse."""
        if self.state.current in UNUSABLE:
            return 0.0
        cfg = self._cfg
        sigma = _score(e.position_sigma_m, cfg.degraded_sigma_m)
        heading = _score(math.degrees(e.heading_sigma_rad), cfg.degraded_heading_deg)
        nis = _score(self.state.nis_mean, cfg.nis_high)
        ess = 1.0 - _ESS_WEIGHT + _ESS_WEIGHT * _ess_score(e.ess_ratio)
        return sigma * heading * nis * self.state.vision_score * ess


def _ess_score(ratio: float) -> float:
    """In [0, 1], 0 for what is not finite."""
    return min(max(ratio, 0.0) / ESS_REFERENCE, 1.0) if math.isfinite(ratio) else 0.0


def _score(value: float, reference: float) -> float:
    """1 / (1 + (value / reference)^2), 0 for what is not finite."""
    if not (math.isfinite(value) and reference > 0):
        return 0.0
    return 1.0 / (1.0 + (value / reference) ** 2)
