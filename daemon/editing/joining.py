"""Two maps in one frame: which landmarks are the same, what differs between them, and one made of both."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ceilvo.crossing_types import quarter_turns, turned_type
from ceilvo.daemon.map.database.content import MapContent
from ceilvo.daemon.map.key_poses import KeyPoses
from ceilvo.daemon.slam.spatial_index import IndexedMap
from ceilvo.errors import CeilvoError
from ceilvo.se2 import wrap
from ceilvo.types import NO_LANDMARK, Array, Ints, Landmarks

GATE_CHI2 = 9.21
"""99 % of two degrees of freedom: two landmarks nearer than that by their covariances are one."""
REACH_M = 0.3
"""No pair is further apart, whatever its covariances; chosen: half of a small tile."""
MOST_AXES_APART_RAD = np.radians(5.0)
"""Between the axes of two maps of one frame, modulo quarter turns; chosen: at 30 m it is as much as 2.6 m."""
_SAME_SHARE = 0.5
"""Of common ids, that are of one type and within _SAME_M: then ids mean the same in both maps. Chosen."""
_SAME_M = 1.0


@dataclass(frozen=True)
class Matches:
    """Landmarks of two maps that are the same: indices into them, and what is left.

    Attributes:
        a, b: (P,).
        chi2: (P,) squared distance by both covariances.
        only_a, only_b: without a partner.
        by_id: their ids paired them, not their places.
    """

    a: Ints
    b: Ints
    chi2: Array
    only_a: Ints
    only_b: Ints
    by_id: bool

    def moved(self, sigmas: float) -> NDArray[np.bool_]:
        """(P,) which are further apart than so many sigmas."""
        return np.asarray(self.chi2 > sigmas**2)


def in_axes_of(b: MapContent, axis_rad: float) -> Landmarks:
    """b's landmarks with their types by another axis.

    Raises:
        CeilvoError: the axes are no quarter turns apart, so the maps are in different frames.
    """
    turns = quarter_turns(b.axis_rad, axis_rad)
    apart = wrap(4.0 * (axis_rad - b.axis_rad)) / 4.0
    if abs(apart) > MOST_AXES_APART_RAD:
        raise CeilvoError(
            f"the axes of the maps are {abs(np.degrees(apart)):.1f} deg apart, expected "
            f"{np.degrees(MOST_AXES_APART_RAD):.0f} or less in one frame; 'ceilvod map align' one of them first"
        )
    return replace(b.landmarks, crossing_type=turned_type(b.landmarks.crossing_type, turns))


def matches_by_id(a: Landmarks, b: Landmarks) -> Matches:
    """Of two states of one map; those whose type changed are no pair."""
    _, i, j = np.intersect1d(a.ids, b.ids, assume_unique=True, return_indices=True)
    same = a.crossing_type[i] == b.crossing_type[j]
    return _matches(a, b, i[same], j[same], by_id=True)


def matches_by_place(a: Landmarks, b: Landmarks, gate_chi2: float = np.inf) -> Matches:
    """Nearest to each other, of one type, within REACH_M and the gate."""
    to_b, _ = IndexedMap(b).nearest(a.xy_map_m, a.crossing_type, REACH_M)
    to_a, _ = IndexedMap(a).nearest(b.xy_map_m, b.crossing_type, REACH_M)
    i = np.flatnonzero(to_b >= 0)
    i = i[to_a[to_b[i]] == i]
    j = to_b[i]
    near = distance_chi2(a, b, i, j) <= gate_chi2
    return _matches(a, b, i[near], j[near], by_id=False)


def have_same_ids(a: Landmarks, b: Landmarks) -> bool:
    """Whether ids mean the same in both maps: most of those in common are of one type and near."""
    _, i, j = np.intersect1d(a.ids, b.ids, assume_unique=True, return_indices=True)
    near = np.hypot(*(a.xy_map_m[i] - b.xy_map_m[j]).T) < _SAME_M
    return bool(len(i)) and bool(np.mean(near & (a.crossing_type[i] == b.crossing_type[j])) >= _SAME_SHARE)


def _matches(a: Landmarks, b: Landmarks, i: Ints, j: Ints, by_id: bool) -> Matches:
    only_a, only_b = np.delete(np.arange(len(a)), i), np.delete(np.arange(len(b)), j)
    return Matches(i, j, distance_chi2(a, b, i, j), only_a, only_b, by_id)


def distance_chi2(a: Landmarks, b: Landmarks, i: Ints, j: Ints) -> Array:
    """(P,) of pairs; 0 apart is 0 also where neither is in doubt."""
    off = a.xy_map_m[i] - b.xy_map_m[j]
    inverse = np.linalg.pinv(a.cov_m2[i] + b.cov_m2[j], hermitian=True)
    known = np.einsum("ni,nij,nj->n", off, inverse, off)
    sure = np.all(a.cov_m2[i] + b.cov_m2[j] == 0.0, axis=(1, 2))
    return np.where(sure, np.where(np.any(off != 0.0, axis=1), np.inf, 0.0), known)


def merged(a: MapContent, b: MapContent) -> tuple[MapContent, Matches]:
    """a with what b knows. Landmarks that are the same are fused by their information, as if nobody had told one map
    what the other knows; the others of b are added, under new ids where theirs are taken. Sessions stay apart.

    Raises:
        CeilvoError: the maps are not in one frame.
    """
    theirs = in_axes_of(b, a.axis_rad)
    m = matches_by_place(a.landmarks, theirs, GATE_CHI2)
    fused = _fused(a.landmarks, theirs, m)
    new = theirs.of(m.only_b)
    ids = free_ids(new.ids, a.landmarks.ids)
    both = [(fused, a.landmarks.ids), (new, ids)]
    landmarks = Landmarks(
        ids=np.concatenate([i for _, i in both]),
        xy_map_m=np.concatenate([x.xy_map_m for x, _ in both]),
        cov_m2=np.concatenate([x.cov_m2 for x, _ in both]),
        crossing_type=np.concatenate([x.crossing_type for x, _ in both]),
        sightings=np.concatenate([x.sightings for x, _ in both]),
        expected=np.concatenate([x.expected for x, _ in both]),
    )
    seen_s = a.seen_s.copy()
    seen_s[m.a] = both_times(a.seen_s[m.a], b.seen_s[m.b])
    order = np.argsort(landmarks.ids, kind="stable")
    name = dict(zip(theirs.ids[m.b].tolist(), a.landmarks.ids[m.a].tolist(), strict=True))
    name |= dict(zip(new.ids.tolist(), ids.tolist(), strict=True))
    turns = quarter_turns(b.axis_rad, a.axis_rad)
    taken = {s.name for s in a.sessions}
    poses = tuple(renamed(k, name, turns) for k in b.key_poses if k.session not in taken)
    content = replace(
        a,
        landmarks=landmarks.of(order),
        seen_s=np.concatenate([seen_s, b.seen_s[m.only_b]])[order],
        key_poses=(*a.key_poses, *poses),
        sessions=(*a.sessions, *(s for s in b.sessions if s.name not in taken)),
        sides=(*a.sides, *(s for s in b.sides if s.name not in {own.name for own in a.sides})),
    )
    return content, m


def _fused(a: Landmarks, b: Landmarks, m: Matches) -> Landmarks:
    """a's landmarks, with what b says of its own ones of m."""
    ours, theirs = a.cov_m2[m.a], b.cov_m2[m.b]
    gain = ours @ np.linalg.pinv(ours + theirs, hermitian=True)
    xy, cov, sightings, expected = a.xy_map_m.copy(), a.cov_m2.copy(), a.sightings.copy(), a.expected.copy()
    xy[m.a] += np.einsum("nij,nj->ni", gain, b.xy_map_m[m.b] - a.xy_map_m[m.a])
    rest = np.eye(2) - gain
    both = rest @ ours @ np.swapaxes(rest, 1, 2) + gain @ theirs @ np.swapaxes(gain, 1, 2)
    cov[m.a] = 0.5 * (both + np.swapaxes(both, 1, 2))
    sightings[m.a] += b.sightings[m.b]
    expected[m.a] += b.expected[m.b]
    return replace(a, xy_map_m=xy, cov_m2=cov, sightings=sightings, expected=expected)


def both_times(a_s: Array, b_s: Array) -> Array:
    """(P, 2) first and last seen by either; 0 says nothing."""
    first = np.where(
        (a_s[:, 0] > 0) & (b_s[:, 0] > 0), np.minimum(a_s[:, 0], b_s[:, 0]), np.maximum(a_s[:, 0], b_s[:, 0])
    )
    return np.column_stack([first, np.maximum(a_s[:, 1], b_s[:, 1])])


def free_ids(wanted: Ints, taken: Ints, above: int = -1) -> Ints:
    """Their own where free, else beyond all that are in use and beyond another number."""
    clash = np.isin(wanted, taken)
    first = int(max(np.max(wanted, initial=above), np.max(taken, initial=above))) + 1
    return np.where(clash, first + np.cumsum(clash) - 1, wanted)


def renamed(k: KeyPoses, name: dict[int, int], turns: int) -> KeyPoses:
    """With other names for the landmarks, NO_LANDMARK where there is none, and axes so many quarter turns further."""
    landmark = np.array([name.get(i, NO_LANDMARK) for i in k.landmark.tolist()], np.int64)
    return replace(k, landmark=landmark, crossing_type=turned_type(k.crossing_type, turns))
