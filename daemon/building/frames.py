"""How the frame of one map lies in that of another, found by the place index, or why that cannot be said."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from ceilvo.crossing_types import turned_type
from ceilvo.daemon.building.evidence import Counts, Evidence, as_view, false_alarm, likeness, scores
from ceilvo.daemon.map.database.content import MapContent
from ceilvo.daemon.odometry.rigid import rigid_motion
from ceilvo.se2 import compose, rotation, transform, wrap
from ceilvo.types import Array, Ints, Landmarks

ALARM = 1e-2
"""Stated chance of a wrong join, at most; chosen."""
FEWEST_THINGS = 6
"""Lamps, vents and the like in the overlap; chosen."""
MOST_CONTRADICTED = 0.3
"""Share of the overlap that may contradict: lamps that moved; chosen."""
RATIO = 1e3
"""The best place must be so much likelier than the second-best; chosen."""
_PATCH_M, _PITCH_M, _MOST_PATCHES, _FEWEST_IN_PATCH = 2.5, 2.5, 400, 12
"""Parts of the other map that are looked up: half their side, from one to the next, how many, their landmarks; chosen:
somewhat more than a view."""
_LISTED = 3000
"""Places of each that are taken; chosen: a raster of lamps has thousands."""
_MOST_PLACES = 20_000
"""That are weighed on all of both maps; chosen for time."""
_SAME_M = 0.3
"""Motions that lay the middle of the other map nearer to each other are one; chosen: half of a small tile."""
_BETTER = 400
"""Best of those proposed and of those drawn that are weighed thing by thing; chosen for time."""
_LIKE = 200
"""That look most like the right one, by which is told what wrong places show; chosen."""
_FIRST = 48
"""Of the best that are fitted; chosen."""
_WRONG, _PAIRS = 3000, 16
"""Lamps laid on lamps and the like, for what wrong places look like, of how many types and turns; chosen for time."""
_FITS, _REACH_M = 6, 0.25
"""Rounds of a fit to the nearest landmarks of their types, and how near they are; chosen: below a tile of .3 m."""


@dataclass(frozen=True)
class Frame:
    """What was found.

    Attributes:
        a_from_b: (3,) the motion; of the best place also where it was refused.
        things: lamps, vents and the like in the overlap, and those of them that are in one map only.
        false_alarm: chance that some wrong place looks as good.
        places: that were weighed.
        refused: why the maps are not to be joined by it; "" where they are.
    """

    a_from_b: Array
    things: tuple[int, int]
    false_alarm: float
    places: int
    refused: str = ""


def frame_of(a: MapContent, b: MapContent, seed: int = 0) -> Frame:
    """Where b lies in a; only their landmarks and axes are looked at.

    Args:
        seed: of the wrong places that are drawn.
    """
    nothing = Frame(np.zeros(3), (0, 0), 1.0, 0, "no part of one map looks like a part of the other")
    if not len(a.landmarks) or not len(b.landmarks):
        return nothing
    evidence = Evidence(a.landmarks, a.axis_rad, b.landmarks, b.axis_rad)
    middle = b.landmarks.xy_map_m.mean(axis=0)
    proposed = _apart(_proposed(evidence, b, a.axis_rad - b.axis_rad), middle)
    rng = np.random.default_rng(seed)
    drawn = _apart(_wrong(a.landmarks, b.landmarks, a.axis_rad - b.axis_rad, rng), middle)
    if not len(proposed):
        return nothing
    places = len(proposed)
    seen, wrong = evidence.of(proposed), evidence.of(drawn)
    large = np.flatnonzero(seen.looked_at >= FEWEST_THINGS)
    if not len(large):
        return Frame(proposed[0], (0, 0), 1.0, places, "the maps overlap too little, or not at all")
    proposed, seen = proposed[large], seen.of(large)
    told = np.flatnonzero(wrong.looked_at >= FEWEST_THINGS)
    drawn, wrong = drawn[told], wrong.of(told)
    every, counts = np.concatenate([proposed, drawn]), Counts.all_of([seen, wrong])
    alike = np.argsort(-likeness(counts), kind="stable")[:_LIKE]
    weighed, rate = evidence.weighed(every[alike]), counts.of(alike).rate()
    proposed = proposed[np.argsort(-scores(seen, rate), kind="stable")[:_BETTER]]
    drawn = drawn[np.argsort(-scores(wrong, rate), kind="stable")[:_BETTER]]
    score = weighed.scores(proposed)
    order = np.argsort(-score, kind="stable")
    first = np.array([_fitted(a, b, proposed[k]) for k in order[:_FIRST]])
    fitted = weighed.scores(first)
    best = int(np.argmax(fitted))
    found = first[best]
    others, rest = ~_near(first, found, middle), order[_FIRST:][~_near(proposed[order[_FIRST:]], found, middle)]
    rivals = np.concatenate([fitted[others], score[rest]])
    wrong_scores = np.append(rivals, weighed.scores(drawn[~_near(drawn, found, middle)]))
    return _judged(found, evidence.of(found[None]), float(fitted[best]), rivals, wrong_scores, places)


def _judged(found: Array, own: Counts, score: float, rivals: Array, wrong: Array, places: int) -> Frame:
    """The decision: rare by chance, alone, and not contradicted."""
    alarm, n, k = false_alarm(score, wrong), round(float(own.looked_at[0])), round(float(own.contradicted[0]))
    ahead = score - float(np.max(rivals, initial=-np.inf))
    refused = ""
    if n < FEWEST_THINGS:
        refused = f"the overlap has {n} lamps, vents and the like, expected {FEWEST_THINGS} or more"
    elif k > MOST_CONTRADICTED * n:
        refused = f"{k} of {n} lamps, vents and the like of the overlap are in one map only"
    elif ahead < np.log(RATIO):
        refused = (
            f"ambiguous: it is only {np.exp(ahead):.2g} times as likely as another place, expected {RATIO:g} times"
        )
    elif alarm > ALARM:
        refused = f"a wrong place looks as good with a chance of {alarm:.2g}, expected {ALARM:g} or less"
    return Frame(found, (n, k), alarm, places, refused)


def _proposed(evidence: Evidence, b: MapContent, heading_rad: float) -> Array:
    """(M, 3) motions from the places that the index lists for parts of b."""
    tree, found = cKDTree(b.landmarks.xy_map_m), [np.empty((0, 3))]
    for centre in _centres(b.landmarks):
        which = np.array(sorted(tree.query_ball_point(centre, _PATCH_M, p=np.inf)), np.int64)
        if len(which) < _FEWEST_IN_PATCH:
            continue
        view = as_view(b.landmarks.of(which), heading_rad, centre)
        poses = evidence.index.candidates(view, most=_LISTED).pose
        shift = np.append(-centre, 0.0)
        found.append(np.asarray(compose(poses, shift)))
    return np.concatenate(found)


def _centres(b: Landmarks) -> Array:
    """(P, 2) middles of squares that have landmarks, evenly fewer where there are very many."""
    square = np.unique(np.floor(b.xy_map_m / _PITCH_M).astype(np.int64), axis=0)
    return np.asarray((square[:: max(1, -(-len(square) // _MOST_PATCHES))] + 0.5) * _PITCH_M)


def _apart(motions: Array, middle: Array) -> Array:
    """Each place once: the first of those that lay b's middle in one cell, those found most often first."""
    if not len(motions):
        return motions
    at = _laid(motions, middle)
    turn = np.round(motions[:, 2] / (0.5 * np.pi)).astype(np.int64) % 4
    cell = np.column_stack([np.floor(at / _SAME_M).astype(np.int64), turn])
    _, first, count = np.unique(cell, axis=0, return_index=True, return_counts=True)
    return np.asarray(motions[first[np.argsort(-count, kind="stable")][:_MOST_PLACES]])


def _laid(motions: Array, point: Array) -> Array:
    """(M, 2) where motions lay a point."""
    return np.asarray(compose(motions, np.append(point, 0.0))[:, :2])


def _near(motions: Array, other: Array, middle: Array) -> np.ndarray:
    off = _laid(motions, middle) - transform(other, middle[None])
    turned = np.abs((motions[:, 2] - other[2] + np.pi) % (2.0 * np.pi) - np.pi) < 0.5
    return np.asarray((np.hypot(*off.T) < 2.0 * _SAME_M) & turned)


def _wrong(a: Landmarks, b: Landmarks, heading_rad: float, rng: np.random.Generator) -> Array:
    """(M, 3) motions that lay a rare landmark of b on one of its type."""
    pairs: list[tuple[int, Ints, Ints]] = []
    for turn in range(4):
        kinds = turned_type(b.crossing_type, turn)
        pairs += [
            (turn, np.flatnonzero(a.crossing_type == k), np.flatnonzero(kinds == k))
            for k in np.unique(a.crossing_type)
            if np.any(kinds == k)
        ]
    pairs.sort(key=lambda p: len(p[1]) * len(p[2]))
    out, some = [np.empty((0, 3))], _WRONG // _PAIRS
    for turn, own, theirs in pairs[:_PAIRS]:
        i, j = rng.choice(own, some), rng.choice(theirs, some)
        theta = wrap(heading_rad - 0.5 * np.pi * turn)
        out.append(np.column_stack([a.xy_map_m[i] - b.xy_map_m[j] @ rotation(theta).T, np.full(some, theta)]))
    return np.concatenate(out)


def _fitted(a: MapContent, b: MapContent, start: Array) -> Array:
    """A motion fitted to all landmarks that lie near one of their type, b stretched to fit best: maps are bent and off
    in scale before they are refined."""
    turn = round((a.axis_rad - b.axis_rad - float(start[2])) / (0.5 * np.pi)) % 4
    types, motion = turned_type(b.landmarks.crossing_type, turn), start
    at = transform(start, b.landmarks.xy_map_m)
    for _ in range(_FITS):
        i, j = pairs(a.landmarks, at, types)
        if len(i) < FEWEST_THINGS:
            break
        motion = rigid_motion(b.landmarks.xy_map_m[j], a.landmarks.xy_map_m[i])
        at = _stretched(b.landmarks.xy_map_m, j, a.landmarks.xy_map_m[i], motion)
    return motion


def pairs(a: Landmarks, at_m: Array, types: Ints) -> tuple[Ints, Ints]:
    """Of a and b, nearest of their type within reach."""
    first, second = [np.empty(0, np.int64)], [np.empty(0, np.int64)]
    for kind in np.unique(types):
        own, mine = np.flatnonzero(a.crossing_type == kind), np.flatnonzero(types == kind)
        if len(own):
            off, which = cKDTree(a.xy_map_m[own]).query(at_m[mine], distance_upper_bound=_REACH_M)
            near = np.isfinite(off)
            first.append(own[which[near]])
            second.append(mine[near])
    return np.concatenate(first), np.concatenate(second)


def _stretched(b_m: Array, j: Ints, onto_m: Array, motion: Array) -> Array:
    """(L, 2) b's places by the similarity about the pairs' middle."""
    turned = b_m @ rotation(float(motion[2])).T
    own, other = turned[j] - turned[j].mean(axis=0), onto_m - onto_m.mean(axis=0)
    scale = float(np.clip(np.sum(own * other) / max(float(np.sum(own**2)), 1e-9), 0.98, 1.02))
    return np.asarray(onto_m.mean(axis=0) + scale * (turned - turned[j].mean(axis=0)))
