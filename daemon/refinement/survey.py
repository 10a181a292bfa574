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
class Floor:
    """A map and the sessions that saw it.

    Attributes:
        landmarks: ids are of this floor only.
        axis_rad: direction in the map of axis 0 of the types.
        sessions: their poses are on this map.
        eyes: which calibration placed each session's features; () where there is only one.
    """

    landmarks: Landmarks
    axis_rad: float
    sessions: tuple[KeyPoses, ...]
    eyes: tuple[int, ...] = ()


@dataclass(frozen=True)
class Survey:
    """Views of all sessions of all floors one after the other, and the landmarks that they show.

    Attributes:
        pose: (K, 3) map_from_base.
        linked: (K,) whether motion tells how it was reached from the one before.
        motion, motion_cov: (K, 3), (K, 3, 3).
        direction_rad, direction_sigma_rad: (K,).
        floor, eye: (K,) which floor a view is of, and which calibration placed its features.
        view: (O,) ascending; (view, landmark) are pairs that occur once.
        seen_m: (O, 2) in base.
        root_info: (O, 2, 2) W with W^T W the inverse of a feature's covariance.
        landmark: (O,) index.
        ids, crossing_type: (L,) of the landmarks.
        xy_m: (L, 2) where they are believed to be.
        landmark_floor: (L,) ascending.
        axis_rad: (F,) direction of axis 0 in the map of each floor.
        calibrations: (C,) by which they were seen.
    """

    pose: Array
    linked: Ints
    motion: Array
    motion_cov: Array
    direction_rad: Array
    direction_sigma_rad: Array
    floor: Ints
    eye: Ints
    view: Ints
    seen_m: Array
    root_info: Array
    landmark: Ints
    ids: Ints
    crossing_type: Ints
    xy_m: Array
    landmark_floor: Ints
    axis_rad: Array
    calibrations: tuple[Calibration, ...]


def survey_of(floors: Sequence[Floor], calibrations: Sequence[Calibration]) -> Survey:
    """Sessions on their maps. Landmarks that fewer than two views show are left out, and features of none.

    Raises:
        ValueError: nothing is left.
    """
    sessions = [s for f in floors for s in f.sessions]
    offsets = np.cumsum([0, *(len(s) for s in sessions)])
    view = np.concatenate([s.view + at for s, at in zip(sessions, offsets, strict=False)])
    at = np.concatenate(_named(floors))
    known = at >= 0
    _, first = np.unique(view * (int(at.max(initial=0)) + 2) + at, return_index=True)
    once = np.zeros(len(view), bool)
    once[first] = True
    used = known & once
    used &= np.bincount(at[used], minlength=int(at.max(initial=0)) + 1)[at] >= _FEWEST_VIEWS
    if not np.any(used):
        raise ValueError("no landmark was seen from two key poses")
    kept, index = np.unique(at[used], return_inverse=True)
    cov = np.concatenate([s.cov_base_m2 for s in sessions])[used] + _FLOOR_M**2 * np.eye(2)
    linked = np.ones(offsets[-1], np.int64)
    linked[offsets[:-1][offsets[:-1] < offsets[-1]]] = 0
    motion_cov = np.concatenate([s.motion_cov for s in sessions])
    linked &= np.all(np.isfinite(motion_cov), axis=(1, 2))
    lengths = [len(s) for s in sessions]
    maps = [f.landmarks for f in floors]
    return Survey(
        pose=np.concatenate([s.pose for s in sessions]),
        linked=linked,
        motion=np.concatenate([s.motion for s in sessions]),
        motion_cov=motion_cov,
        direction_rad=np.concatenate([s.direction_rad for s in sessions]),
        direction_sigma_rad=np.concatenate([s.direction_sigma_rad for s in sessions]),
        floor=np.repeat([k for k, f in enumerate(floors) for _ in f.sessions], lengths),
        eye=np.repeat([e for f in floors for e in f.eyes or [0] * len(f.sessions)], lengths),
        view=view[used],
        seen_m=np.concatenate([s.xy_base_m for s in sessions])[used],
        root_info=_root_info(cov),
        landmark=index.astype(np.int64),
        ids=np.concatenate([m.ids for m in maps])[kept],
        crossing_type=np.concatenate([m.crossing_type for m in maps])[kept],
        xy_m=np.concatenate([m.xy_map_m for m in maps])[kept],
        landmark_floor=np.repeat(np.arange(len(floors)), [len(m) for m in maps])[kept],
        axis_rad=np.array([f.axis_rad for f in floors]),
        calibrations=tuple(calibrations),
    )


def _named(floors: Sequence[Floor]) -> list[Ints]:
    """For each session the index of each feature's landmark in those of all floors, -1 for none."""
    out, start = [], 0
    for f in floors:
        out += [np.where((i := index_of(s.landmark, f.landmarks.ids)) < 0, -1, i + start) for s in f.sessions]
        start += len(f.landmarks)
    return out


def index_of(name: Ints, ids: Ints) -> Ints:
    """(N,) where names are in ids that occur once, -1 where they are not."""
    if not len(ids):
        return np.full(len(name), -1)
    order = np.argsort(ids)
    at = order[np.minimum(np.searchsorted(ids[order], name), len(ids) - 1)]
    return np.where(ids[at] == name, at, -1)


def _root_info(cov: Array) -> Array:
    """(O, 2, 2) W with W^T W = cov^-1."""
    return np.asarray(np.linalg.inv(np.linalg.cholesky(cov)), np.float64)
