"""All that is refined together: views of every session, landmarks, and what else is known of the building."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from ceilvo.calibration import Calibration
from ceilvo.daemon.map.key_poses import KeyPoses
from ceilvo.types import Array, Ints, Landmarks

_FLOOR_M = 5e-4
"""Least standard deviation of a feature; chosen: what a lens model leaves, which no view averages out."""
_FEWEST_VIEWS = 2
"""Of a landmark; seen from one place only it tells nothing of it."""


@dataclass(frozen=True)
class Anchors:
    """What was measured by other means.

    Attributes:
        between: (D, 2) indices of landmarks, a tape's length apart.
        distance_m, distance_sigma_m: (D,).
        mark: (A,) indices of landmarks that a surveyor saw.
        mark_xy_m: (A, 2) where.
        mark_sigma_m: (A,).
    """

    between: Ints = field(default_factory=lambda: np.zeros((0, 2), np.int64))
    distance_m: Array = field(default_factory=lambda: np.zeros(0))
    distance_sigma_m: Array = field(default_factory=lambda: np.zeros(0))
    mark: Ints = field(default_factory=lambda: np.zeros(0, np.int64))
    mark_xy_m: Array = field(default_factory=lambda: np.zeros((0, 2)))
    mark_sigma_m: Array = field(default_factory=lambda: np.zeros(0))


@dataclass(frozen=True)
class Survey:
    """Views of all sessions one after the other, and the landmarks that they show.

    Attributes:
        pose: (K, 3) map_from_base.
        linked: (K,) whether motion tells how it was reached from the one before.
        motion, motion_cov: (K, 3), (K, 3, 3).
        direction_rad, direction_sigma_rad: (K,).
        view: (O,) ascending; (view, landmark) are pairs that occur once.
        seen_m: (O, 2) in base.
        root_info: (O, 2, 2) W with W^T W the inverse of a feature's covariance.
        landmark: (O,) index.
        ids, crossing_type: (L,) of the landmarks.
        xy_m: (L, 2) where they are believed to be.
        axis_rad: direction of their axis 0 in map.
        calibration: by which they were seen.
    """

    pose: Array
    linked: Ints
    motion: Array
    motion_cov: Array
    direction_rad: Array
    direction_sigma_rad: Array
    view: Ints
    seen_m: Array
    root_info: Array
    landmark: Ints
    ids: Ints
    crossing_type: Ints
    xy_m: Array
    axis_rad: float
    calibration: Calibration


def survey_of(
    sessions: Sequence[KeyPoses], landmarks: Landmarks, map_axis_rad: float, calibration: Calibration
) -> Survey:
    """Sessions on one map. Landmarks that fewer than two views show are left out, and features of none.

    Raises:
        ValueError: nothing is left.
    """
    offsets = np.cumsum([0, *(len(s) for s in sessions)])
    view = np.concatenate([s.view + at for s, at in zip(sessions, offsets, strict=False)])
    name = np.concatenate([s.landmark for s in sessions])
    order = np.argsort(landmarks.ids)
    at = np.searchsorted(landmarks.ids[order], name)
    at = order[np.minimum(at, len(order) - 1)]
    known = landmarks.ids[at] == name
    _, first = np.unique(np.column_stack([view, at]), axis=0, return_index=True)
    once = np.zeros(len(view), bool)
    once[first] = True
    used = known & once
    used &= np.bincount(at[used], minlength=len(landmarks))[at] >= _FEWEST_VIEWS
    if not np.any(used):
        raise ValueError("no landmark was seen from two key poses")
    kept, index = np.unique(at[used], return_inverse=True)
    cov = np.concatenate([s.cov_base_m2 for s in sessions])[used] + _FLOOR_M**2 * np.eye(2)
    linked = np.ones(offsets[-1], np.int64)
    linked[offsets[:-1][offsets[:-1] < offsets[-1]]] = 0
    motion_cov = np.concatenate([s.motion_cov for s in sessions])
    linked &= np.all(np.isfinite(motion_cov), axis=(1, 2))
    return Survey(
        pose=np.concatenate([s.pose for s in sessions]),
        linked=linked,
        motion=np.concatenate([s.motion for s in sessions]),
        motion_cov=motion_cov,
        direction_rad=np.concatenate([s.direction_rad for s in sessions]),
        direction_sigma_rad=np.concatenate([s.direction_sigma_rad for s in sessions]),
        view=view[used],
        seen_m=np.concatenate([s.xy_base_m for s in sessions])[used],
        root_info=_root_info(cov),
        landmark=index.astype(np.int64),
        ids=landmarks.ids[kept],
        crossing_type=landmarks.crossing_type[kept],
        xy_m=landmarks.xy_map_m[kept],
        axis_rad=map_axis_rad,
        calibration=calibration,
    )


def _root_info(cov: Array) -> Array:
    """(O, 2, 2) W with W^T W = cov^-1."""
    return np.asarray(np.linalg.inv(np.linalg.cholesky(cov)), np.float64)
