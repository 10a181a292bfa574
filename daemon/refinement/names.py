"""Which landmark a feature shows, looked up again on a better map: two names of one landmark become one."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from ceilvo.daemon.map.key_poses import KeyPoses
from ceilvo.daemon.refinement.survey import index_of
from ceilvo.types import Array, Ints, Landmarks

_SAME_M = 0.08
"""Landmarks of one type this close are one, unless views show both; chosen: joints of lamps and tiles are nearer to
each other, but of several types, or seen together."""
_TOGETHER = 0.1
"""Share of the views of the rarer one that may show both: a false crossing now and then."""


def united(landmarks: Landmarks, sessions: Sequence[KeyPoses]) -> tuple[Landmarks, Ints]:
    """Landmarks of which each is there once, by ascending id, and the id (L,) that each of those given has then."""
    pairs = cKDTree(landmarks.xy_map_m).query_pairs(_SAME_M, output_type="ndarray")
    pairs = pairs[landmarks.crossing_type[pairs[:, 0]] == landmarks.crossing_type[pairs[:, 1]]]
    index = [index_of(s.landmark, landmarks.ids) for s in sessions]
    pairs = pairs[_share_together(pairs, index, sessions, len(landmarks)) < _TOGETHER]
    graph = coo_array((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), shape=(len(landmarks),) * 2)
    _, group = connected_components(graph, directed=False)
    most = np.lexsort((-landmarks.sightings, group))
    first = most[np.flatnonzero(np.diff(group[most], prepend=-1))]  # the one seen most often stands for its group
    total = np.bincount(group, landmarks.sightings).astype(np.int64)
    expected = np.bincount(group, landmarks.expected).astype(np.int64)
    kept = replace(landmarks.of(first), sightings=total, expected=expected)
    return kept.of(np.argsort(kept.ids)), kept.ids[group]


def _share_together(pairs: Ints, index: list[Ints], sessions: Sequence[KeyPoses], count: int) -> Array:
    """(P,) of the views of the rarer landmark of each pair, how many show the other as well."""
    views = [set[tuple[int, int]]() for _ in range(count)] if len(pairs) else []
    wanted = np.zeros(count + 1, bool)
    wanted[pairs.ravel()] = True
    for number, (s, at) in enumerate(zip(sessions, index, strict=True)):
        for o in np.flatnonzero(wanted[at]):
            views[at[o]].add((number, int(s.view[o])))
    return np.array([len(views[a] & views[b]) / max(min(len(views[a]), len(views[b])), 1) for a, b in pairs])


def names_on(sessions: Sequence[KeyPoses], landmarks: Landmarks, gate_m: float) -> list[Ints]:
    """For each session the ids (O,) of the nearest landmark of each feature's type, -1 where there is none so near."""
    trees = {
        int(t): (which, cKDTree(landmarks.xy_map_m[which]))
        for t in np.unique(landmarks.crossing_type)
        for which in (np.flatnonzero(landmarks.crossing_type == t),)
    }
    out = []
    for s in sessions:
        xy = s.xy_map_m
        name = np.full(s.features, -1)
        for kind, (which, tree) in trees.items():
            mine = np.flatnonzero(s.crossing_type == kind)
            off, nearest = tree.query(xy[mine], distance_upper_bound=gate_m)
            near = np.isfinite(off)
            name[mine[near]] = landmarks.ids[which[nearest[near]]]
        out.append(name)
    return out
