"""A filter that may be somewhere else: lost poses, kidnapping, and the tiles of a periodic ceiling."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ceilvo.bench.recovery import view_score
from ceilvo.bench.recovery.pose_hypotheses import PoseHypotheses
from ceilvo.bench.recovery.tile_slips import (
    SLIP_CHANCE,
    SLIP_CHANCE_2_SIGMA,
    SLIP_CHANCE_3_SIGMA,
    SLIP_CHANCE_MAPPING,
    LatticeBelief,
    neighbours,
    periods,
)
from ceilvo.daemon.slam.association import independent, usable
from ceilvo.daemon.slam.joint_filter import JointFilter
from ceilvo.daemon.slam.pose_filter import chi_square_bounds, normalised, systematic
from ceilvo.daemon.slam.spatial_index import IndexedMap
from ceilvo.types import UNLABELLED, Array, FilterHealth, Ints, Landmarks, Motion, Observations

SURE = 0.9
"""A pose with a smaller FilterHealth.mode_weight is one hypothesis among several, and experiments do not call it
TRACKING; chosen. The daemon asks its belief over places instead (relocaliser.sure)."""
CARRIED_AWAY = 1e-3
"""Chance that a robot whose view does not fit is somewhere else; the view then speaks for itself; chosen."""
QUIET_UPDATES = 20
"""After alternatives have lost, for so long features that nothing explains call for no new ones: the map may lack
them."""
FEWEST_TO_SEARCH = 3
"""A map of fewer landmarks is not searched."""
FEWEST_PERIODIC = 12
"""A map of fewer landmarks shows no period."""
GROWN = 1.25
"""The period is looked for anew once the map has grown by this factor."""


@dataclass(slots=True)
class LatticeWatch:
    """The belief in shifts, with the map and its size that they were found on."""

    size: int
    map: IndexedMap
    belief: LatticeBelief


@dataclass(slots=True)
class RecoveringState:
    """All that a RecoveringFilter remembers.

    Attributes:
        tracker: of the filter that tracks.
        refused: updates in a row most of whose features were refused.
        surprised: updates in a row with innovations beyond 2 sigma.
        chance: that the pose is a tile further than at the last view.
        settled: update at which alternatives last lost.
        lattice: belief in shifts by whole tiles, None before a period was looked for.
        search: poses that are weighed because tracking was lost; None while it tracks.
        alternatives: poses that are weighed beside the tracked one.
    """

    tracker: Any
    refused: int = 0
    surprised: int = 0
    chance: float = SLIP_CHANCE
    settled: int = 0
    lattice: LatticeWatch | None = None
    search: PoseHypotheses | None = None
    alternatives: PoseHypotheses | None = None


class RecoveringFilter:
    """Tracks; on a known map weighs alternatives to its pose beside it; lost, searches."""

    def __init__(self, tracker: JointFilter) -> None:
        self._tracker = tracker
        self._settings = tracker.settings
        self._memory = RecoveringState(tracker.state)

    @property
    def state(self) -> RecoveringState:
        self._memory.tracker = self._tracker.state
        return self._memory

    @state.setter
    def state(self, state: RecoveringState) -> None:
        self._memory, self._tracker.state = state, state.tracker

    def reset(self, pose: Array, cov: Array, landmarks: Landmarks | None = None, known: bool = False) -> None:
        self._tracker.reset(pose, cov, landmarks, known)
        self._memory = RecoveringState(self._tracker.state)
        if not np.all(np.isfinite(cov)):
            self._begin_search()

    def jump(self, pose: Array, cov: Array) -> None:
        self._tracker.jump(pose, cov)
        self._memory = RecoveringState(self._tracker.state)

    def forget(self, ids: Ints, newborn: bool = False) -> None:
        self._tracker.forget(ids, newborn)

    def next_id(self) -> int:
        return self._tracker.next_id()

    def carry(self, first_id: int, there_from_here: Array) -> Landmarks:
        return self._tracker.carry(first_id, there_from_here)

    def predict(self, motion: Motion) -> None:
        self._tracker.predict(motion)
        for poses in (self._memory.search, self._memory.alternatives):
            if poses is not None:
                poses.move(motion)

    def estimate(self) -> tuple[Array, Array, FilterHealth]:
        health = self._tracker.estimate()[2]
        pose, cov, weight = self._dominant()
        if self._memory.search is not None:
            health = replace(health, nis=0.0, nis_dof=0)
        return pose, cov, replace(health, mode_weight=weight * health.mode_weight)

    def size(self) -> int:
        return self._tracker.size()

    def landmarks(self) -> Landmarks:
        return self._tracker.landmarks()

    def landmarks_near(self, xy_m: Array, reach_m: float) -> tuple[Ints, Landmarks]:
        return self._tracker.landmarks_near(xy_m, reach_m)

    def particles(self) -> tuple[Array, Array]:
        search, n = self._memory.search, self._settings.particles
        if search is not None and len(search):
            pick = systematic(normalised(search.log_weight), np.random.default_rng(0), n)
            return search.mean[pick], np.full(n, 1.0 / n)
        return self._tracker.particles()

    def counters(self) -> Mapping[str, int]:
        return self._tracker.counters()

    def _dominant(self) -> tuple[Array, Array, float]:
        """Pose, covariance and weight of the dominant mode."""
        m, joint = self._memory, self._tracker.state.joint
        pose, cov = joint.pose.copy(), joint.pose_cov.copy()
        if m.search is not None:
            found = m.search.best() if len(m.search) else (pose, cov)
            return *found, m.search.weight() * m.search.agreed
        sure = 1.0 if m.lattice is None else float(m.lattice.belief.weight[0])
        if m.alternatives is not None and len(m.alternatives):
            sure, there = m.alternatives.weight_at(pose), m.alternatives.weight()
            if there > max(sure, 0.5):
                return *m.alternatives.best(), there * m.alternatives.agreed
        return pose, cov, sure * (1.0 - max(m.refused - 1, 0) / self._settings.lost_updates)

    def update(self, obs: Observations, learnt_from: int = 0) -> None:
        """Track; or, lost, search the map until one pose is left."""
        m, state = self._memory, self._tracker.state
        counters = state.counters
        if m.search is None:
            pose, cov = state.joint.pose.copy(), state.joint.pose_cov.copy()
            matched, refused = counters["observations"], counters["outliers"]
            self._tracker.update(obs, learnt_from)
            matched, refused = counters["observations"] - matched, counters["outliers"] - refused
            m.chance = self._chance_of_slip()
            self._watch_loss(obs, matched, matched - refused)
            if m.search is None:
                self._watch_lattice(obs)
                self._watch_alternatives(obs, pose, cov)
            return
        counters["updates"] += 1
        m.search.update(usable(obs, self._tracker.size()), state.rng)
        if m.search.found:
            self._continue_from(m.search)
            counters["recoveries"] += 1

    def _continue_from(self, poses: PoseHypotheses) -> None:
        m = self._memory
        self._tracker.jump(*poses.best())
        m.search, m.alternatives, m.lattice, m.refused = None, None, None, 0

    def _watch_alternatives(self, obs: Observations, pose: Array, cov: Array) -> None:
        """When a view does not fit a known map: poses that the view allows, weighed beside the predicted one.

        They are dropped once the tracked pose has won; one that has won takes its place.
        """
        m, state = self._memory, self._tracker.state
        if state.known is None:
            return
        obs, reach_m = usable(obs, self._tracker.size()), self._settings.association_gate_m
        if m.alternatives is not None:
            m.alternatives.update(obs, state.rng)
        elif self._suspicious(state.known, obs):
            m.alternatives = PoseHypotheses.on(state.known, reach_m, pose)
            m.alternatives.challenge(obs, pose, cov, CARRIED_AWAY, state.rng)
        if m.alternatives is None or (m.alternatives.agreed < 1.0 and len(m.alternatives)):
            return
        if m.alternatives.found and m.alternatives.weight_at(state.joint.pose) < 0.5:
            periodic = m.lattice is not None and len(m.lattice.belief.shifts) > 1
            state.counters["tile_slips" if periodic else "recoveries"] += 1
            self._continue_from(m.alternatives)
        else:
            m.alternatives, m.lattice, m.settled = None, None, state.now

    def _suspicious(self, known: IndexedMap, obs: Observations) -> bool:
        """Whether the pose may be another: what matched is far off or refused, or too much has no landmark."""
        m, state = self._memory, self._tracker.state
        elsewhere = m.lattice is not None and m.lattice.belief.weight[0] < SURE
        if m.refused or m.chance > SLIP_CHANCE or elsewhere:
            return True
        quiet = state.now - m.settled <= QUIET_UPDATES
        reach_m = self._settings.association_gate_m
        return not quiet and view_score.unexplained(known, state.joint.pose, obs, reach_m)

    def _watch_loss(self, obs: Observations, matched: int, believed: int) -> None:
        """Count updates that contradict the map; too many in a row begin a search.

        Of a map in the making, features that nobody labelled may be new: those that lie at a landmark count.
        """
        m, learning = self._memory, self._tracker.state.known is None
        labelled = int(np.count_nonzero((obs.label >= 0) | (obs.label == UNLABELLED) & (not learning)))
        if labelled or matched:
            m.refused = m.refused + 1 if 2 * believed < max(labelled, matched) else 0
        if m.refused >= self._settings.lost_updates and self._tracker.size() >= FEWEST_TO_SEARCH:
            self._begin_search()

    def _begin_search(self) -> None:
        m, state = self._memory, self._tracker.state
        known = state.known or IndexedMap(self.landmarks())
        m.search = PoseHypotheses.on(known, self._settings.association_gate_m)
        m.refused, m.lattice, m.alternatives = 0, None, None
        state.counters["searches"] += 1

    def _chance_of_slip(self) -> float:
        """That the pose is a tile further than at the last view, from the NIS of this one."""
        m, state = self._memory, self._tracker.state
        dof = state.nis_dof - 2
        if dof <= 0:
            return SLIP_CHANCE
        m.surprised = m.surprised + 1 if state.trimmed_nis > chi_square_bounds(dof, 2.0)[1] else 0
        if not m.surprised:
            return SLIP_CHANCE
        if state.known is None:
            return SLIP_CHANCE_MAPPING
        if m.surprised > 1 or state.trimmed_nis > chi_square_bounds(dof, 3.0)[1]:
            return SLIP_CHANCE_3_SIGMA
        return SLIP_CHANCE_2_SIGMA

    def _watch_lattice(self, obs: Observations) -> None:
        """Belief in this tile against its neighbours, where association was left to the filter."""
        m, state = self._memory, self._tracker.state
        free = obs.label == UNLABELLED
        size = self._tracker.size()
        if not np.any(free) or size < FEWEST_PERIODIC:
            return
        if m.lattice is None or size > GROWN * m.lattice.size:
            known = state.known or IndexedMap(self.landmarks())
            m.lattice = LatticeWatch(size, known, LatticeBelief.at_home(neighbours(periods(known.landmarks))))
        known, belief = m.lattice.map, m.lattice.belief
        if len(belief.shifts) < 2:
            return
        poses = np.tile(state.joint.pose, (len(belief.shifts), 1))
        poses[:, :2] += belief.shifts
        seen = obs.of(free)
        k = len(seen)
        inflation = k / independent(k, self._settings.feature_independence, 0.0)
        score = view_score.log_likelihood(known, poses, seen, self._settings.association_gate_m, inflation)
        belief.weigh(score, m.chance)
        if state.known is None:
            belief.settle()
