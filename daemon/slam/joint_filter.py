"""What filters with one joint map share: association, gates, births, the bookkeeping of a PoseFilter."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from ceilvo.config import Filter
from ceilvo.daemon.odometry.matching import mutual_nearest
from ceilvo.daemon.slam.joint_map import JointMap
from ceilvo.daemon.slam.paper.fastslam import independent, usable
from ceilvo.daemon.slam.pose_filter import COUNTERS
from ceilvo.daemon.slam.spatial_index import KnownMap
from ceilvo.errors import CeilvoError
from ceilvo.se2 import rotation, transform
from ceilvo.types import NO_LANDMARK, UNLABELLED, Array, Depletion, Ints, Landmarks, Motion, Observations

EXPIRES_UPDATES = 20
DUPLICATE_SHARE = 0.25
"""No landmark is born nearer to one of its kind than this share of the association gate."""
TWINS_EVERY = 4
"""Updates in which every landmark in view is looked at once, whether it is there twice."""
VAR_FLOOR = 1e-12
NIS_CAP = 50.0
CANDIDATE_GATE = 25.0
_POSE = np.arange(3)


@dataclass(frozen=True, slots=True)
class View:
    """Features of one update with the landmarks that explain them.

    xy, var: (K, 2) features in base and their variances; landmark: (K, 2) means in map; joint: (3 + 2 K, 3 + 2 K)
    covariance of pose and landmarks; heading: measured, with its variance; inflation: of var, because features of a
    frame share errors.
    """

    xy: Array
    var: Array
    landmark: Array
    joint: Array
    heading: float
    heading_var: float
    inflation: float

    def __len__(self) -> int:
        return len(self.xy)

    def of(self, which: Ints, inflation: float) -> View:
        """The features `which` in that order, with another inflation."""
        rows = np.concatenate([_POSE, np.column_stack([3 + 2 * which, 4 + 2 * which]).ravel()])
        joint = self.joint[rows[:, None], rows]
        return replace(
            self,
            xy=self.xy[which],
            var=self.var[which],
            landmark=self.landmark[which],
            joint=joint,
            inflation=inflation,
        )


def noise_in_map(theta: float, var: Array) -> Array:
    """(K, 2, 2) of variances (K, 2) along base x and y."""
    r = rotation(theta)
    return np.asarray((r * var[:, None, :]) @ r.T, np.float64)


class JointFilter:
    """A PoseFilter but for `_absorb`."""

    def __init__(self, settings: Filter, rng: np.random.Generator) -> None:
        self._settings = settings
        self._rng = rng
        self._counters = dict.fromkeys(COUNTERS, 0)
        self.reset(np.zeros(3), np.zeros((3, 3)))

    def reset(self, pose: Array, cov: Array, landmarks: Landmarks | None = None, known: bool = False) -> None:
        somewhere = bool(np.all(np.isfinite(cov)))
        if not somewhere and (landmarks is None or not len(landmarks)):
            raise CeilvoError("filter: the pose is not known and there is no map; give a finite covariance or a map")
        self._joint = JointMap(np.asarray(pose, np.float64), np.asarray(cov, np.float64) if somewhere else np.eye(3))
        self._known = KnownMap(landmarks) if known and landmarks is not None and len(landmarks) else None
        if self._known is None and landmarks is not None and len(landmarks):
            self._joint.load(landmarks)
        self._now = 0
        self._summary: tuple[Ints, Landmarks] | None = None
        self._nis, self._nis_dof = 0.0, 0

    def predict(self, motion: Motion) -> None:
        if not (np.all(np.isfinite(motion.prev_from_curr)) and np.all(np.isfinite(motion.cov))):
            raise CeilvoError(
                f"filter: motion {motion.prev_from_curr} is not finite, expected metres and radians with a finite "
                "covariance; report a failed motion with its prediction instead"
            )
        self._joint.move(motion)

    def update(self, obs: Observations) -> None:
        """Associate, absorb, then births and deaths of landmarks."""
        obs = usable(obs, self._size())
        self._now += 1
        self._counters["updates"] += 1
        obs = self._associated(obs)
        matched = np.flatnonzero(obs.label >= 0)
        inliers = self._absorb(self._view(obs, matched), self._rows(obs.label[matched]))
        self._count(len(matched), int(np.count_nonzero(inliers)))
        if self._known is None:
            labels = obs.label[matched]
            self._joint.seen_at[labels] = self._now
            self._joint.sightings[labels[inliers]] += 1
            self._confirm()
            self._be_born(obs, np.flatnonzero(obs.label == NO_LANDMARK))
            self._merge_twins(labels[inliers])
            self._joint.bound()
        self._summary = None

    def _absorb(self, view: View, rows: Ints) -> np.ndarray:
        """Update pose and map with a view; rows of the joint state of its landmarks; (K,) which were believed."""
        raise NotImplementedError

    def _count(self, matched: int, inliers: int) -> None:
        c = self._counters
        c["observations"] += matched
        c["outliers"] += matched - inliers
        c["rejected_updates"] += int(2 * inliers < matched)

    def estimate(self) -> tuple[Array, Array, Depletion]:
        n = self._settings.particles
        return (
            self._joint.pose.copy(),
            self._joint.pose_cov.copy(),
            Depletion(n, float(n), n, float("nan"), self._nis, self._nis_dof),
        )

    def landmarks(self) -> Landmarks:
        if self._known is not None:
            return self._known.landmarks
        return self._public()[1]

    def _public(self) -> tuple[Ints, Landmarks]:
        """Labels of the joint map that are confirmed, and they as seen from outside."""
        if self._summary is None:
            labels = np.flatnonzero(self._joint.confirmed)
            self._summary = labels, self._joint.summary(labels)
        return self._summary

    def _size(self) -> int:
        return len(self._known) if self._known is not None else len(self._public()[0])

    def counters(self) -> Mapping[str, int]:
        return dict(self._counters)

    # -- association

    def _associated(self, obs: Observations) -> Observations:
        """Labels of the joint map instead of those of landmarks(); unconfirmed landmarks and free features included."""
        label = obs.label.copy()
        if self._known is None:
            told = label >= 0
            label[told] = self._public()[0][label[told]]
        free = np.flatnonzero(label < 0)
        if self._known is not None:
            free = free[obs.label[free] == UNLABELLED]
        label[free] = NO_LANDMARK
        pose = self._joint.pose
        xy = transform(pose, obs.xy_base_m[free])
        gate = self._settings.association_gate_m
        if self._known is not None:
            near = self._known.near(xy, gate)
            at, kind = self._known.landmarks.xy_map_m[near], self._known.landmarks.kind[near]
        else:
            near = self._candidates_near(xy, gate, label, obs.label[free])
            at, kind = self._joint.xy(near), self._joint.kind[near]
        seen, which = mutual_nearest(xy, obs.kind[free], at, kind, gate)
        label[free[seen]] = near[which]
        return usable(replace(obs, label=label), 1 << 60)

    def _candidates_near(self, xy: Array, gate: float, taken: Ints, told: Ints) -> Ints:
        """Labels that features without a landmark may belong to: unconfirmed ones, and all if the labels are ours."""
        if not len(xy):
            return np.empty(0, np.int64)
        open_ = ~self._joint.confirmed if not np.any(told == UNLABELLED) else np.ones(len(self._joint), bool)
        open_[taken[taken >= 0]] = False
        labels = np.flatnonzero(open_)
        at = self._joint.xy(labels)
        low, high = np.min(xy, axis=0) - gate, np.max(xy, axis=0) + gate
        return labels[np.all((at >= low) & (at <= high), axis=1)]

    def _view(self, obs: Observations, matched: Ints) -> View:
        labels = obs.label[matched]
        if self._known is not None:
            at, joint = self._known.landmarks.xy_map_m[labels], np.zeros((3 + 2 * len(labels),) * 2)
            joint[:3, :3] = self._joint.pose_cov
            for i, block in enumerate(self._known.landmarks.cov_m2[labels]):
                joint[3 + 2 * i : 5 + 2 * i, 3 + 2 * i : 5 + 2 * i] = block
        else:
            self._joint.bring_in(labels)
            rows = np.concatenate([np.arange(3), self._joint.rows(labels)])
            at, joint = self._joint.xy(labels), self._joint.cov[np.ix_(rows, rows)]
        var = obs.var_m2[matched]
        k = max(len(matched), 1)
        correlation = obs.common_var_m2 / float(np.mean(var)) if len(matched) else 0.0
        inflation = k / independent(k, self._settings.feature_independence, correlation)
        var_heading = obs.heading_var_rad2 if np.isfinite(obs.heading_rad) and obs.heading_var_rad2 > 0 else np.inf
        return View(obs.xy_base_m[matched], var, at, joint, obs.heading_rad, max(var_heading, VAR_FLOOR), inflation)

    def _rows(self, labels: Ints) -> Ints:
        return np.empty(0, np.int64) if self._known is not None else self._joint.rows(labels)

    # -- landmarks

    def _merge_twins(self, labels: Ints) -> None:
        """At most one pair per update: two landmarks of one kind whose difference is zero within the gate are one."""
        j = self._joint
        labels = labels[labels < len(j)][self._now % TWINS_EVERY :: TWINS_EVERY]
        xy, reach = j.xy(labels), DUPLICATE_SHARE * self._settings.association_gate_m
        near = self._candidates_near(xy, reach, np.empty(0, np.int64), np.array([UNLABELLED]))
        apart = np.hypot(*(xy[:, None] - j.xy(near)[None]).transpose(2, 0, 1))
        twins = (apart < reach) & (j.kind[labels][:, None] == j.kind[near]) & (labels[:, None] != near)
        pairs = np.argwhere(twins)
        if len(pairs):
            a, b = int(labels[pairs[0, 0]]), int(near[pairs[0, 1]])
            keep, drop = (a, b) if (j.sightings[a], b) >= (j.sightings[b], a) else (b, a)
            self._counters["merges"] += int(j.merge(keep, drop, self._settings.gate_chi2))

    def _confirm(self) -> None:
        j, cfg = self._joint, self._settings
        j.confirmed |= j.sightings >= cfg.birth_sightings
        j.forget(np.flatnonzero(~j.confirmed & (self._now - j.seen_at > EXPIRES_UPDATES)))

    def _be_born(self, obs: Observations, which: Ints) -> None:
        j, cfg = self._joint, self._settings
        xy, kind = transform(j.pose, obs.xy_base_m[which]), obs.kind[which]
        near = self._candidates_near(xy, cfg.association_gate_m, np.empty(0, np.int64), np.array([UNLABELLED]))
        apart = np.hypot(*(xy[:, None] - j.xy(near)[None]).transpose(2, 0, 1))
        apart[kind[:, None] != j.kind[near]] = np.inf
        fresh = np.min(apart, axis=1, initial=np.inf) > DUPLICATE_SHARE * cfg.association_gate_m
        if len(near):  # nor where it may be one that is known, seen badly
            off = apart**2 / (np.max(obs.var_m2[which], axis=1)[:, None] + np.max(j.packed(near)[:, [0, 2]], axis=1))
            fresh &= np.min(off, axis=1) > CANDIDATE_GATE
        which = which[fresh]
        over = len(j) + len(which) - cfg.max_landmarks
        if over > 0:
            j.forget(np.sort(np.argsort(j.sightings, kind="stable")[:over]))
        if len(which):
            j.give_birth(obs.xy_base_m[which], obs.var_m2[which], kind[fresh], self._now)
            self._counters["births"] += len(which)
            self._confirm()
