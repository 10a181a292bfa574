"""Which landmark a feature shows, looked up again on a better map: two names of one landmark become one."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from ceilvo.daemon.map.key_poses import KeyPoses
from ceilvo.types import Array, Ints, Landmarks

_SAME_M = 0.08
"""Landmarks of one type this close are one, unless views show both; chosen: joints of lamps and tiles are nearer to
each other, but of several types, or seen together."""
_TOGETHER = 0.1
"""Share of the views of the rarer one that may show both: a false crossing now and then."""


def united(landmarks: Landmarks, sessions: Sequence[KeyPoses]) -> tuple[Landmarks, int]:
    """Landmarks of which each is there once, and how many names were too many."""
    pairs = cKDTree(landmarks.xy_map_m).query_pairs(_SAME_M, output_type="ndarray")
    pairs = pairs[landmarks.crossing_type[pairs[:, 0]] == landmarks.crossing_type[pairs[:, 1]]]
    index = _indices(landmarks, sessions)
    pairs = pairs[_share_together(pairs, index, sessions, len(landmarks)) < _TOGETHER]
    graph = coo_array((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), shape=(len(landmarks),) * 2)
    _, group = connected_components(graph, directed=False)
    most = np.lexsort((-landmarks.sightings, group))
    first = most[np.flatnonzero(np.diff(group[most], prepend=-1))]  # the one seen most often stands for its group
    total = np.bincount(group, landmarks.sightings).astype(np.int64)
    expected = np.bincount(group, landmarks.expected).astype(np.int64)
    kept = replace(landmarks.of(first), sightings=total, expected=expected)
    return kept, len(landmarks) - len(kept)


def _indices(landmarks: Landmarks, sessions: Sequence[KeyPoses]) -> list[Ints]:
    """Of each session's features in the landmarks, -1 for none."""
    order = np.argsort(landmarks.ids)
    found = []
    for s in sessions:
        at = order[np.minimum(np.searchsorted(landmarks.ids[order], s.landmark), len(order) - 1)]
        found.append(np.where(landmarks.ids[at] == s.landmark, at, -1))
    return found


def _share_together(pairs: Ints, index: list[Ints], sessions: Sequence[KeyPoses], count: int) -> Array:
    """(P,) of the views of the rarer landmark of each pair, how many show the other as well."""
    views = [set[tuple[int, int]]() for _ in range(count)] if len(pairs) else []
    wanted = np.zeros(count + 1, bool)
    wanted[pairs.ravel()] = True
    for number, (s, at) in enumerate(zip(sessions, index, strict=True)):
        for o in np.flatnonzero(wanted[at]):
            views[at[o]].add((number, int(s.view[o])))
    return np.array([len(views[a] & views[b]) / max(min(len(views[a]), len(views[b])), 1) for a, b in pairs])


def names_on(sessions: Sequence[KeyPoses], poses: Array, landmarks: Landmarks, gate_m: float) -> list[Ints]:
    """For each session the ids (O,) of the nearest landmark of each feature's type, as poses (K, 3) of all place it."""
    trees = {
        int(t): (which, cKDTree(landmarks.xy_map_m[which]))
        for t in np.unique(landmarks.crossing_type)
        for which in (np.flatnonzero(landmarks.crossing_type == t),)
    }
    out, at = [], 0
    for s in sessions:
        pose = poses[at : at + len(s)][s.view]
        at += len(s)
        cos, sin = np.cos(pose[:, 2]), np.sin(pose[:, 2])
        xy = pose[:, :2] + np.column_stack(
            [cos * s.xy_base_m[:, 0] - sin * s.xy_base_m[:, 1], sin * s.xy_base_m[:, 0] + cos * s.xy_base_m[:, 1]]
        )
        name = np.full(s.features, -1)
        for kind, (which, tree) in trees.items():
            mine = np.flatnonzero(s.crossing_type == kind)
            off, nearest = tree.query(xy[mine], distance_upper_bound=gate_m)
            near = np.isfinite(off)
            name[mine[near]] = landmarks.ids[which[nearest[near]]]
        out.append(name)
    return out
