"""A joint filter that may be somewhere else: lost poses, kidnapping, and the tiles of a periodic ceiling."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ceilvo.daemon.relocalisation.lattice import CALM, SURPRISED, SURPRISED_MAPPING, WARY, Tiles, lattice, periods
from ceilvo.daemon.relocalisation.pose_search import Bank
from ceilvo.daemon.relocalisation.view_score import shifted_scores, unexplained
from ceilvo.daemon.slam.joint_filter import JointFilter
from ceilvo.daemon.slam.paper.fastslam import independent, usable
from ceilvo.daemon.slam.pose_filter import SURE, chi_square_bounds
from ceilvo.daemon.slam.spatial_index import KnownMap
from ceilvo.types import UNLABELLED, Array, Landmarks, Motion, Observations

CARRIED_AWAY = 1e-3
"""Chance that a robot whose view surprises is somewhere else; the view then speaks for itself."""
QUIET_UPDATES = 20
"""After rivals have lost, for so long features that nothing explains call for no new ones: the map may lack them."""


class Recovering(JointFilter):
    """Tracks; on a known map weighs rivals of its pose beside it; lost, searches. `_absorb` sets `_surprise`."""

    def reset(self, pose: Array, cov: Array, landmarks: Landmarks | None = None, known: bool = False) -> None:
        super().reset(pose, cov, landmarks, known)
        self._refused, self._surprise, self._surprises = 0, 0.0, 0
        self._tiles: tuple[int, KnownMap, Tiles] | None = None
        self._bank: Bank | None = None
        self._rivals: Bank | None = None
        self._settled, self._chance = 0, CALM
        if not np.all(np.isfinite(cov)):
            self._begin_search()

    def predict(self, motion: Motion) -> None:
        super().predict(motion)
        for bank in (self._bank, self._rivals):
            if bank is not None:
                bank.move(motion)

    def dominant(self) -> tuple[Array, Array, float]:
        """Pose, covariance and weight of the dominant mode."""
        pose, cov = self._joint.pose.copy(), self._joint.pose_cov.copy()
        if self._bank is not None:
            found = self._bank.best() if len(self._bank) else (pose, cov)
            return *found, self._bank.weight() * self._bank.agreed
        sure = 1.0 if self._tiles is None else float(self._tiles[2].weight[0])
        if self._rivals is not None and len(self._rivals):
            sure, there = self._rivals.weight_at(pose), self._rivals.weight()
            if there > max(sure, 0.5):
                return *self._rivals.best(), there * self._rivals.agreed
        return pose, cov, sure * (1.0 - max(self._refused - 1, 0) / self._settings.lost_updates)

    def update(self, obs: Observations) -> None:
        """Track; or, lost, search the map until one pose is left."""
        if self._bank is None:
            pose, cov = self._joint.pose.copy(), self._joint.pose_cov.copy()
            c = self._counters
            matched, refused = c["observations"], c["outliers"]
            super().update(obs)
            matched, refused = c["observations"] - matched, c["outliers"] - refused
            self._chance = self._chance_of_slip()
            self._watch_loss(obs, matched, matched - refused)
            if self._bank is None:
                self._watch_tiles(obs)
                self._watch_rivals(obs, pose, cov)
            return
        self._counters["updates"] += 1
        self._bank.update(usable(obs, self._size()))
        if self._bank.found:
            self._go_on_from(self._bank)
            self._counters["recoveries"] += 1

    def _go_on_from(self, bank: Bank) -> None:
        self._joint.put_pose(*bank.best())
        self._bank, self._rivals, self._tiles, self._refused = None, None, None, 0

    def _watch_rivals(self, obs: Observations, pose: Array, cov: Array) -> None:
        """When a view surprises on a known map: poses that the view allows, weighed beside the predicted one.

        They are dropped once the tracked pose has won; a rival that has won takes its place.
        """
        if self._known is None:
            return
        obs, reach = usable(obs, self._size()), self._settings.association_gate_m
        if self._rivals is not None:
            self._rivals.update(obs)
        elif self._suspicious(self._known, obs):
            self._rivals = Bank(self._known, reach, self._rng, pose)
            self._rivals.rival(obs, pose, cov, CARRIED_AWAY)
        if self._rivals is None or (self._rivals.agreed < 1.0 and len(self._rivals)):
            return
        if self._rivals.found and self._rivals.weight_at(self._joint.pose) < 0.5:
            periodic = self._tiles is not None and len(self._tiles[2].shifts) > 1
            self._counters["tile_slips" if periodic else "recoveries"] += 1
            self._go_on_from(self._rivals)
        else:
            self._rivals, self._tiles, self._settled = None, None, self._now

    def _suspicious(self, known: KnownMap, obs: Observations) -> bool:
        """Whether the pose may be another: what matched surprises, is refused, or too much has no landmark."""
        elsewhere = self._tiles is not None and self._tiles[2].weight[0] < SURE
        if self._refused or self._chance > CALM or elsewhere:
            return True
        quiet = self._now - self._settled <= QUIET_UPDATES
        return not quiet and unexplained(known, self._joint.pose, obs, self._settings.association_gate_m)

    def _watch_loss(self, obs: Observations, matched: int, believed: int) -> None:
        """Count updates that contradict the map; too many in a row begin a search.

        Of a map in the making, features that nobody labelled may be new: those that lie at a landmark count.
        """
        told = int(np.count_nonzero((obs.label >= 0) | (obs.label == UNLABELLED) & (self._known is not None)))
        if told or matched:
            told = max(told, matched)
            self._refused = self._refused + 1 if 2 * believed < told else 0
        if self._refused >= self._settings.lost_updates and self._size() >= 3:
            self._begin_search()

    def _begin_search(self) -> None:
        known = self._known or KnownMap(self.landmarks())
        self._bank = Bank(known, self._settings.association_gate_m, self._rng)
        self._refused, self._tiles, self._rivals = 0, None, None
        self._counters["searches"] += 1

    def _chance_of_slip(self) -> float:
        """That the pose is a tile further than at the last view, from how much this one surprises."""
        dof = self._nis_dof - 2
        if dof <= 0:
            return CALM
        self._surprises = self._surprises + 1 if self._surprise > chi_square_bounds(dof, 2.0)[1] else 0
        if not self._surprises:
            return CALM
        if self._known is None:
            return SURPRISED_MAPPING
        again = self._surprises > 1
        return SURPRISED if again or self._surprise > chi_square_bounds(dof, 3.0)[1] else WARY

    def _watch_tiles(self, obs: Observations) -> None:
        """Belief in this tile against its neighbours, where association was left to the filter."""
        free = obs.label == UNLABELLED
        size = self._size()
        if not np.any(free) or size < 12:
            return
        if self._tiles is None or size > 1.25 * self._tiles[0]:
            known = self._known or KnownMap(self.landmarks())
            self._tiles = size, known, Tiles(lattice(periods(known.landmarks)))
        _, known, tiles = self._tiles
        if len(tiles.shifts) < 2:
            return
        poses = np.tile(self._joint.pose, (len(tiles.shifts), 1))
        poses[:, :2] += tiles.shifts
        seen = replace(obs, xy_base_m=obs.xy_base_m[free], var_m2=obs.var_m2[free], kind=obs.kind[free])
        seen = replace(seen, label=obs.label[free])
        k = len(seen)
        inflation = k / independent(k, self._settings.feature_independence, 0.0)
        score = shifted_scores(known, poses, seen, self._settings.association_gate_m, inflation)
        tiles.weigh(score, self._chance)
        if self._known is None:
            tiles.settle()
