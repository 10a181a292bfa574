"""Views worth keeping of a drive: one every so far, with what was seen there by the names of the map."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from itertools import compress

import numpy as np

from ceilvo import se2
from ceilvo.daemon.map.key_poses import KeyPoses
from ceilvo.daemon.pipeline import Pipeline
from ceilvo.daemon.relocalisation.evidence.admission import FARTHEST_M
from ceilvo.se2 import transform
from ceilvo.types import GOOD, NO_DIRECTION_RAD, Array, Crossings, Estimate, Ints, Observations, Pose

EVERY_M, EVERY_RAD = 0.25, np.radians(15.0)
"""From one to the next; chosen: a view is 2 m wide and more, so each landmark is in ten of them."""
_UNKNOWN = np.full((3, 3), np.nan)
"""Covariance of a motion that nobody saw."""


class KeyPoseTaker:
    """Takes key poses from a pipeline that drives."""

    def __init__(self, session: str, most: int | None = None) -> None:
        """most: that are held; the oldest go where nobody takes them."""
        self._session, self._most = session, most
        self._poses: list[tuple[int, Array, Array, Array, float, float]] = []
        self._floors: list[str] = []
        self._views: list[tuple[Array, Array, Ints, Ints]] = []
        self._motion, self._motion_cov = np.zeros(3), _UNKNOWN

    def add(self, pipeline: Pipeline, estimate: Estimate, crossings: Crossings | None) -> None:
        """After a step of the pipeline: what it saw and what came out."""
        if self._floors and estimate.floor != self._floors[-1]:
            self._motion, self._motion_cov = np.zeros(3), _UNKNOWN
        self._motion_cov = se2.compose_cov(
            self._motion, self._motion_cov, estimate.motion.prev_from_curr, estimate.motion.cov
        )
        self._motion = se2.compose(self._motion, estimate.motion.prev_from_curr)
        if crossings is None or not self._wanted(pipeline, estimate):
            return
        if self._most is not None and len(self._poses) >= self._most:
            self._forget(1)
            self._cut()
        view = pipeline.relocaliser.observed(pipeline.relocaliser.tells(crossings))
        ids = _names(pipeline, view)
        self._floors.append(estimate.floor)
        self._views.append((view.xy_base_m, _squares(view.var_m2), view.crossing_type, ids))
        directed = crossings.directed
        self._poses.append(
            (
                estimate.stamp_ns,
                np.array(estimate.pose),
                self._motion,
                self._motion_cov,
                crossings.psi_rad if directed else 0.0,
                crossings.psi_sigma_rad if directed else NO_DIRECTION_RAD,
            )
        )
        self._motion, self._motion_cov = np.zeros(3), np.zeros((3, 3))

    def _wanted(self, pipeline: Pipeline, estimate: Estimate) -> bool:
        if estimate.state not in GOOD or not estimate.motion.ok or not pipeline.relocaliser.sure:
            return False
        return not self._poses or bool(
            np.hypot(*self._motion[:2]) >= EVERY_M or abs(float(self._motion[2])) >= EVERY_RAD
        )

    def kept(self, key_poses: KeyPoses) -> None:
        """Those of taken() are kept elsewhere now."""
        self._keep([p[0] not in set(key_poses.stamp_ns.tolist()) for p in self._poses])

    def restart(self) -> None:
        """Forget all: the robot began on another map, and nobody knows how it got there."""
        self._forget(len(self._poses))
        self._motion, self._motion_cov = np.zeros(3), _UNKNOWN

    def _forget(self, count: int) -> None:
        self._keep([n >= count for n in range(len(self._poses))])

    def _keep(self, which: Sequence[bool]) -> None:
        self._poses, self._views = list(compress(self._poses, which)), list(compress(self._views, which))
        self._floors = list(compress(self._floors, which))

    def _cut(self) -> None:
        """The way to the first one is not known any more."""
        stamp_ns, pose, _, _, direction, sigma = self._poses[0]
        self._poses[0] = (stamp_ns, pose, np.zeros(3), _UNKNOWN, direction, sigma)

    def taken(self, floor: str = "") -> KeyPoses:
        """Those of a floor that are not forgotten."""
        here = [f == floor for f in self._floors]
        taken, seen = list(compress(self._poses, here)), list(compress(self._views, here))
        k = len(taken)
        stamps, poses, motions, covs, directions, sigmas = ([p[i] for p in taken] for i in range(6))
        cov = np.array(covs).reshape(k, 3, 3)
        cov[np.isnan(cov).any(axis=(1, 2))] = np.diag([np.inf] * 3)
        return KeyPoses(
            session=self._session,
            stamp_ns=np.array(stamps, np.int64),
            pose=np.array(poses).reshape(k, 3),
            motion=np.array(motions).reshape(k, 3),
            motion_cov=cov,
            direction_rad=np.array(directions, np.float64),
            direction_sigma_rad=np.array(sigmas, np.float64),
            view=np.repeat(np.arange(k), [len(v[3]) for v in seen]).astype(np.int64),
            xy_base_m=_joined((v[0] for v in seen), (2,)),
            cov_base_m2=_joined((v[1] for v in seen), (2, 2)),
            crossing_type=_joined((v[2] for v in seen), ()).astype(np.int64),
            landmark=_joined((v[3] for v in seen), ()).astype(np.int64),
        )


def _names(pipeline: Pipeline, view: Observations) -> Ints:
    """(M,) ids of the landmarks that features are, -1 for none."""
    ids, named = np.full(len(view), -1), view.label >= 0
    labels, landmarks = pipeline.filter.landmarks_near(
        transform(Pose(pipeline.filter.estimate()[0]), view.xy_base_m), FARTHEST_M
    )
    ids[named] = landmarks.ids[np.searchsorted(labels, view.label[named])]
    tracker = pipeline.relocaliser.floor_tracker
    return tracker.floors.ids_on(tracker.name_at(pipeline.filter.estimate()[0]), ids) if tracker.floors else ids


def _squares(var_m2: Array) -> Array:
    """(M, 2, 2) diagonal matrices."""
    return np.asarray(var_m2[:, :, None] * np.eye(2))


def _joined(parts: Iterable[Array] | Iterable[Ints], shape: tuple[int, ...]) -> Array:
    return np.concatenate([np.zeros((0, *shape)), *parts])
