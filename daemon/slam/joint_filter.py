"""A filter with one joint map: association and the life of landmarks; an update rule does the arithmetic."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any, Protocol

import numpy as np

from ceilvo.config import Filter
from ceilvo.daemon.odometry.matching import mutual_nearest
from ceilvo.daemon.slam import upkeep
from ceilvo.daemon.slam.association import (
    MOST_FEATURES,
    VAR_FLOOR,
    independent,
    near_landmarks,
    spread_out,
    usable,
)
from ceilvo.daemon.slam.conditional import Bools, View
from ceilvo.daemon.slam.joint_map import JointMap
from ceilvo.daemon.slam.pose_filter import COUNTERS, checked_motion
from ceilvo.daemon.slam.spatial_index import IndexedMap, unpacked
from ceilvo.errors import CeilvoError
from ceilvo.se2 import transform
from ceilvo.types import NO_LANDMARK, UNLABELLED, Array, FilterHealth, Ints, Landmarks, Motion, Observations

ALL_LABELS = 1 << 60
"""More landmarks than any map has: labels of the joint map are not bounded by those that are shown."""


@dataclass(frozen=True, slots=True)
class Innovations:
    """How far a view was from what was predicted.

    Attributes:
        inliers: (K,) features that were believed.
        nis, nis_dof: mean normalised innovation squared per degree of freedom, and those degrees.
        trimmed_nis: the same without the feature that is furthest off.
    """

    inliers: Bools
    nis: float
    nis_dof: int
    trimmed_nis: float = 0.0


@dataclass(slots=True)
class JointFilterState:
    """All that a JointFilter remembers.

    Attributes:
        rng: the filter's only source of randomness.
        joint: pose and map.
        known: a map that is not learnt; the joint map then has no landmarks.
        now: updates since the last reset.
        nis, nis_dof, trimmed_nis: of the last view, see Innovations.
        counters: see pose_filter.COUNTERS.
        rule: of the update rule.
        weighed_at: (3,) where the last view was from that said which landmarks are gone.
    """

    rng: np.random.Generator
    joint: JointMap
    known: IndexedMap | None = None
    now: int = 0
    nis: float = 0.0
    nis_dof: int = 0
    trimmed_nis: float = 0.0
    counters: dict[str, int] = field(default_factory=lambda: dict.fromkeys(COUNTERS, 0))
    rule: Any = None
    weighed_at: Array | None = None


class UpdateRule(Protocol):
    """How a view changes pose and map."""

    def fresh(self, rng: np.random.Generator) -> Any:
        """The state of the rule after a reset."""

    def move(self, state: JointFilterState, motion: Motion) -> None:
        """The pose moves by a motion; the rule moves it."""

    def jumped(self, state: JointFilterState) -> None:
        """The pose is another; the path to it says nothing."""

    def absorb(self, state: JointFilterState, view: View, rows: Ints) -> Innovations:
        """Update pose and map with a view; rows of the joint state of its landmarks."""

    def particles(self, state: JointFilterState) -> tuple[Array, Array]:
        """As PoseFilter.particles()."""

    def curve(self, state: JointFilterState) -> tuple[float, float]:
        """Effective sample size and residual of the last fit, see FilterHealth."""

    def certainty(self, state: JointFilterState) -> float:
        """Weight of the mode that is reported, see FilterHealth.mode_weight."""


class JointFilter:
    """A PoseFilter of an update rule."""

    def __init__(self, settings: Filter, rng: np.random.Generator, rule: UpdateRule) -> None:
        self.settings = settings
        self._rule = rule
        self._state = JointFilterState(rng, JointMap.at(np.zeros(3), np.zeros((3, 3))))
        self._summary: Landmarks | None = None
        self.reset(np.zeros(3), np.zeros((3, 3)))

    @property
    def state(self) -> JointFilterState:
        return self._state

    @state.setter
    def state(self, state: JointFilterState) -> None:
        self._state = state
        self._state.counters = dict.fromkeys(COUNTERS, 0) | state.counters  # older states lack the later ones
        self._summary = None

    def reset(self, pose: Array, cov: Array, landmarks: Landmarks | None = None, known: bool = False) -> None:
        found = landmarks if landmarks is not None and len(landmarks) else None
        somewhere = bool(np.all(np.isfinite(cov)))
        if not somewhere and found is None:
            raise CeilvoError("filter: the pose is not known and there is no map; give a finite covariance or a map")
        cov = np.asarray(cov, np.float64) if somewhere else np.eye(3)  # 1 m, 1 rad; chosen, see PoseFilter.reset
        joint = JointMap.at(np.asarray(pose, np.float64), cov)
        before = self._state
        self._state = JointFilterState(before.rng, joint, counters=before.counters)
        if found is not None and known:
            self._state.known = IndexedMap(found)
        elif found is not None:
            joint.load(found)
        self._state.rule = self._rule.fresh(before.rng)
        self._summary = None

    def predict(self, motion: Motion) -> None:
        self._rule.move(self._state, checked_motion(motion))

    def jump(self, pose: Array, cov: Array) -> None:
        self._state.joint.put_pose(pose, cov)
        self._rule.jumped(self._state)

    def forget(self, ids: Ints, newborn: bool = False) -> None:
        if self._state.known is None:
            upkeep.forget(self._state.joint, ids, newborn)
            self._summary = None

    def next_id(self) -> int:
        return self._state.joint.next_id if self._state.known is None else self._state.known.next_id

    def carry(self, first_id: int, there_from_here: Array) -> Landmarks:
        if self._state.known is not None:
            return self._state.known.landmarks.of(np.empty(0, np.int64))
        self._summary = None
        return upkeep.carry(self._state.joint, first_id, there_from_here)

    def update(self, obs: Observations, learnt_from: int = 0) -> None:
        """Associate, absorb, then births and deaths of landmarks."""
        state = self._state
        obs = usable(obs, self.size())
        state.now += 1
        state.counters["updates"] += 1
        obs = self._associated(obs)
        matched = np.flatnonzero(obs.label >= 0)
        used = self._used(obs, matched)
        found = self._rule.absorb(state, self._view(obs, used, learnt_from), self._rows(obs.label[used]))
        state.nis, state.nis_dof, state.trimmed_nis = found.nis, found.nis_dof, found.trimmed_nis
        believed = used[found.inliers]
        if len(used) < len(matched):
            believed = np.concatenate([believed, self._also_there(obs, np.setdiff1d(matched, used))])
        self._count(len(matched), len(believed))
        if state.known is None:
            state.joint.seen_at[obs.label[matched]] = state.now
            self._keep_up(obs, obs.label[believed], len(matched), learnt_from)
            birth_sightings = self.settings.birth_sightings
            state.counters["refused"] += upkeep.settle(state.joint, state.now, birth_sightings, learnt_from)
            unknown = np.flatnonzero(obs.label == NO_LANDMARK)
            if len(unknown) and state.joint.next_id >= learnt_from:
                self._be_born(obs, unknown, learnt_from)
            state.joint.bound()
        self._summary = None

    def _used(self, obs: Observations, matched: Ints) -> Ints:
        """A bounded number of the matched features, spread over the view.

        Landmarks in the window come first: the others would come in as if they knew nothing of the pose's error, and
        the filter would take its own drift for evidence.
        """
        if len(matched) <= MOST_FEATURES:
            return matched
        held = np.zeros(len(matched), bool)
        if self._state.known is None:
            held = self._state.joint.slot[obs.label[matched]] >= 0
        first, rest = matched[held], matched[~held]
        first = first[spread_out(obs.xy_base_m[first], MOST_FEATURES, self._state.now)]
        rest = rest[spread_out(obs.xy_base_m[rest], MOST_FEATURES - len(first), self._state.now)]
        return np.sort(np.concatenate([first, rest]))

    def _also_there(self, obs: Observations, which: Ints) -> Ints:
        """Features that the update was not made with and that are where their landmarks are."""
        j, labels = self._state.joint, obs.label[which]
        known = self._state.known
        at, cov = (
            (j.xy(labels), j.packed(labels))
            if known is None
            else (known.landmarks.xy_map_m[labels], known.packed[labels])
        )
        chi2 = near_landmarks(obs.of(which), j.pose, j.pose_cov, at, unpacked(cov))
        return which[chi2 <= self.settings.gate_chi2]

    def _keep_up(self, obs: Observations, seen: Ints, matched: int, learnt_from: int) -> None:
        """Count what was seen and what should have been; drop what is gone, or one that is there twice.

        A view most of whose features were refused says something of the pose, not of what is missing, and so does one
        from a place where not all may be learnt.
        """
        state, j = self._state, self._state.joint
        tells = 2 * len(seen) >= matched and not learnt_from
        seen = seen[j.ids[seen] >= learnt_from]
        missed = upkeep.count(j, seen, obs.visible_m if tells else obs.visible_m[:0])
        gone, names = np.empty(0, np.int64), np.empty(0, np.int64)
        if state.weighed_at is None or np.hypot(*(j.pose - state.weighed_at)[:2]) > upkeep.APART_M:
            gone, state.weighed_at = upkeep.gone(j, seen, missed), j.pose.copy()
            names = np.setdiff1d(upkeep.mistaken_names(j, missed[missed < j.size]), gone)
        if len(gone) or len(names):
            state.counters["faded"] += int(np.count_nonzero(gone < j.size))
            state.counters["merges"] += len(names)
            j.forget(np.concatenate([gone, names]))
            return
        pair = upkeep.duplicates(j, seen[:MOST_FEATURES], state.now, self.settings.association_gate_m)
        if pair is not None and min(j.ids[list(pair)]) >= learnt_from:
            state.counters["merges"] += int(j.merge(*pair, self.settings.gate_chi2, learnt_from))

    def _be_born(self, obs: Observations, which: Ints, learnt_from: int) -> None:
        state, j, cfg = self._state, self._state.joint, self.settings
        which = which[spread_out(obs.xy_base_m[which], MOST_FEATURES, state.now)]
        which = upkeep.fresh(j, obs, which, cfg.association_gate_m)
        over = min(len(j) + len(which) - cfg.max_landmarks, len(which))
        if over > 0:
            which = which[: len(which) - over + upkeep.make_room(j, over, state.now, learnt_from)]
            state.counters["map_full"] += over
        if len(which):
            j.give_birth(obs.xy_base_m[which], obs.var_m2[which], obs.crossing_type[which], state.now)
            state.counters["births"] += len(which)
            state.counters["refused"] += upkeep.settle(j, state.now, cfg.birth_sightings, learnt_from)

    def _count(self, matched: int, inliers: int) -> None:
        c = self._state.counters
        c["observations"] += matched
        c["outliers"] += matched - inliers
        c["rejected_updates"] += int(2 * inliers < matched)

    def estimate(self) -> tuple[Array, Array, FilterHealth]:
        joint, state = self._state.joint, self._state
        ess, residual = self._rule.curve(state)
        sure = self._rule.certainty(state)
        health = FilterHealth(self.settings.particles, ess, None, residual, state.nis, state.nis_dof, sure)
        return joint.pose.copy(), joint.pose_cov.copy(), health

    def particles(self) -> tuple[Array, Array]:
        return self._rule.particles(self._state)

    def size(self) -> int:
        return self._state.joint.size if self._state.known is None else len(self._state.known)

    def landmarks(self) -> Landmarks:
        if self._state.known is not None:
            return self._state.known.landmarks
        if self._summary is None:
            self._summary = self._state.joint.summary(np.arange(self.size()))
        return self._summary

    def landmarks_near(self, xy_m: Array, reach_m: float) -> tuple[Ints, Landmarks]:
        j = self._state.joint
        if self._state.known is not None:
            return self._state.known.landmarks_near(xy_m, reach_m)
        labels = upkeep.near_points(j, xy_m, reach_m)
        labels = labels[labels < j.size]
        return labels, j.summary(labels)

    def counters(self) -> Mapping[str, int]:
        return dict(self._state.counters)

    # -- association

    def _associated(self, obs: Observations) -> Observations:
        """With landmarks for what has none: unconfirmed ones, or any for what the filter shall label itself."""
        label, known = obs.label.copy(), self._state.known
        gate = min(self.settings.association_gate_m, obs.reach_m)
        free = np.flatnonzero(label == UNLABELLED if known is not None else label < 0)
        label[label < 0] = NO_LANDMARK
        xy = transform(self._state.joint.pose, obs.xy_base_m[free])
        if known is not None:
            near = known.near(xy, gate)
            at, kind = known.landmarks.xy_map_m[near], known.landmarks.crossing_type[near]
        else:
            near = upkeep.near_points(self._state.joint, xy, gate)
            if not np.any(obs.label == UNLABELLED):
                near = near[near >= self._state.joint.size]
            near = near[~np.isin(near, label)]
            at, kind = self._state.joint.xy(near), self._state.joint.kinds(near)
        seen, which = mutual_nearest(xy, obs.crossing_type[free], at, kind, gate)
        label[free[seen]] = near[which]
        return usable(replace(obs, label=label), ALL_LABELS)

    def _view(self, obs: Observations, matched: Ints, learnt_from: int) -> View:
        labels, held = obs.label[matched], np.zeros(0, bool)
        if self._state.known is not None:
            at, joint = self._state.known.landmarks.xy_map_m[labels], np.zeros((3 + 2 * len(labels),) * 2)
            joint[:3, :3] = self._state.joint.pose_cov
            for i, block in enumerate(self._state.known.landmarks.cov_m2[labels]):
                joint[3 + 2 * i : 5 + 2 * i, 3 + 2 * i : 5 + 2 * i] = block
        else:
            self._state.joint.bring_in(labels)
            rows = np.concatenate([np.arange(3), self._state.joint.rows(labels)])
            at, joint = self._state.joint.xy(labels), self._state.joint.cov[np.ix_(rows, rows)]
            held = self._state.joint.held(learnt_from)
        var = obs.var_m2[matched]
        k = max(len(matched), 1)
        correlation = obs.common_var_m2 / float(np.mean(var)) if len(matched) else 0.0
        inflation = k / independent(k, self.settings.feature_independence, correlation)
        var_heading = obs.heading_var_rad2 if np.isfinite(obs.heading_rad) and obs.heading_var_rad2 > 0 else np.inf
        var_heading = max(var_heading, VAR_FLOOR)
        return View(obs.xy_base_m[matched], var, at, joint, obs.heading_rad, var_heading, inflation, held)

    def _rows(self, labels: Ints) -> Ints:
        return np.empty(0, np.int64) if self._state.known is not None else self._state.joint.rows(labels)
