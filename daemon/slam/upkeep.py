"""What a view teaches a map besides positions: sightings, births, merges, and what is no longer there."""

from __future__ import annotations

from dataclasses import fields, replace

import numpy as np
from numpy.typing import NDArray

from ceilvo.crossing_types import JOINTS, quarter_turns, turned_type
from ceilvo.daemon.slam.association import CANDIDATE_GATE_CHI2, DUPLICATE_FRACTION, EXPIRES_UPDATES
from ceilvo.daemon.slam.joint_map import JointMap
from ceilvo.daemon.slam.spatial_index import landmarks_near, packed, unpacked
from ceilvo.se2 import inverse, rotation, transform
from ceilvo.types import Array, Ints, Landmarks, Observations

DUPLICATES_EVERY = 4
"""Updates in which every landmark in view is looked at once, whether it is there twice; chosen, to share the cost."""
GONE_RATE = 1e-4
"""Chance per view that a landmark which is there is taken for gone; chosen: a lap of a room is some 300 views."""
CHANCE_SIGHTING = 0.05
"""How often a landmark that is gone seems to be seen: something of its type near enough; chosen."""
USEFUL, SUREST = 0.3, 0.9
"""Bounds of the visibility that a landmark is held to. One seen more seldom than the first is of little use; above the
second misses come in runs, for what hides a landmark hides it for a while; chosen."""
VIEW_WORTH = 1.0 / 3.0
"""Of independent evidence in a view: what hides a landmark often hides it 5 cm further on as well; chosen."""
SAME_CORNER_M = 0.02
"""Landmarks of two types so near each other, neither a crossing of joints, may be one corner by two names; mistaken
names lay 0 to 5 mm from the right one after three laps of a room (`bench.place renovated --seed 68400`, the first)."""
NAME_SHARE = 0.5
"""Of two names of a corner the one seen less often than this share of the other is a mistaken one; chosen."""
NAMES_BEFORE = 2.0, 20.0
"""Sightings and views that each name of a corner is held to have had before; chosen: a mistaken name comes several
views in a row, a lamp that is another one since is told after some ten sightings."""
SELDOM, SELDOM_DOUBT = 0.2, 1.5
"""A landmark seen less often than this share of the median of those in view, and missed in some twenty views, is a
chance crossing; chosen: one that is there but USEFUL at least is seen twice as often. Frames alone do not count: below
what hides a landmark a robot may stand for hours."""
SAME_M = 0.1
"""A carried landmark so near one of its type is that one; chosen: as far as places are told apart."""
APART_M = 0.04
"""Views nearer to the last one show the same again; chosen: less than filter.update_travel_m."""


def count(j: JointMap, seen: Ints, visible_m: Array) -> Ints:
    """Count a view: landmarks that were seen, and those that should have been; returns the labels of the latter.

    At the rim of the view, where nothing need be seen, what is seen is not counted either, but of newborn landmarks:
    else a corner that was often passed there seemed to be seen in every view, by each of its mistaken names.

    Args:
        seen: labels of landmarks that are where they should be.
        visible_m: (V, 2) as in Observations; empty: what was not seen says nothing.
    """
    missed = np.empty(0, np.int64)
    if len(visible_m):
        corners = transform(j.pose, visible_m)
        near = j.near(np.min(corners, axis=0), np.max(corners, axis=0))
        in_view = near[inside(visible_m, transform(inverse(j.pose), j.xy(near)))]
        seen, missed = seen[np.isin(seen, in_view) | (seen >= j.size)], in_view[~np.isin(in_view, seen)]
    j.sightings[seen] += 1
    j.expected[seen] += 1
    j.expected[missed] += 1
    return missed


def gone(j: JointMap, seen: Ints, missed: Ints) -> Ints:
    """Weigh a view; returns the labels of confirmed landmarks that are no longer there, and of any that never were.

    Page's test ("Continuous inspection schemes", 1954) of each landmark: the log-likelihood ratio of "gone, seen by
    chance only" against "there, seen as often as before" is summed and never falls below 0, so that the latest views
    decide, however often it was seen before. At log(1 / GONE_RATE) it is gone: one that is there comes to that less
    than once in 1 / GONE_RATE independent views (Lorden 1971). A picture that shows few of all landmarks (dim,
    blurred, covered) is held to show each more seldom.
    """
    was = [(j.sightings[labels] + 1.0) / (j.expected[labels] + 2.0) for labels in (seen, missed)]
    share = min((len(seen) + 1.0) / (np.sum(was[0]) + np.sum(was[1]) + 1.0), 1.0)
    for labels, before, shown in ((seen, was[0], True), (missed, was[1], False)):
        p = np.maximum(np.clip(before, USEFUL, SUREST) * share, CHANCE_SIGHTING)
        step = np.log(CHANCE_SIGHTING / p) if shown else np.log((1.0 - CHANCE_SIGHTING) / (1.0 - p))
        j.doubt[labels] = np.maximum(j.doubt[labels] + VIEW_WORTH * step, 0.0)
    confirmed = missed < j.size
    out: Ints = missed[confirmed & (j.doubt[missed] >= -np.log(GONE_RATE)) | _seldom_seen(j, seen, missed)]
    return out


def _seldom_seen(j: JointMap, seen: Ints, missed: Ints) -> NDArray[np.bool_]:
    """Which of the missed landmarks are seen far less often than those in view."""
    if not len(missed):
        return np.zeros(0, bool)
    of_view, mine = (
        (j.sightings[at] + 1.0) / (j.expected[at] + 2.0) for at in (np.concatenate([seen, missed]), missed)
    )
    return np.asarray((mine < SELDOM * np.median(of_view)) & (j.doubt[missed] >= SELDOM_DOUBT))


def inside(polygon: Array, xy: Array) -> NDArray[np.bool_]:
    """(N,) whether points (N, 2) are in a convex polygon (V, 2), counter-clockwise."""
    side = np.roll(polygon, -1, axis=0) - polygon
    off = xy[:, None] - polygon[None]
    return np.asarray(np.all(side[:, 0] * off[..., 1] >= side[:, 1] * off[..., 0], axis=1))


def near_points(j: JointMap, xy: Array, reach_m: float) -> Ints:
    """Labels, in order, of the landmarks within reach of the box around points (M, 2)."""
    if not len(xy):
        return np.empty(0, np.int64)
    return j.near(np.min(xy, axis=0) - reach_m, np.max(xy, axis=0) + reach_m)


def duplicates(j: JointMap, seen: Ints, now: int, gate_m: float) -> tuple[int, int] | None:
    """Two landmarks of one type, one of them in `seen`, that are so near that they may be one; the better one first."""
    labels = seen[now % DUPLICATES_EVERY :: DUPLICATES_EVERY]
    xy, reach = j.xy(labels), DUPLICATE_FRACTION * gate_m
    near = near_points(j, xy, reach)
    apart = np.hypot(*(xy[:, None] - j.xy(near)[None]).transpose(2, 0, 1))
    same = (apart < reach) & (j.crossing_type[labels][:, None] == j.crossing_type[near]) & (labels[:, None] != near)
    pairs = np.argwhere(same)
    if not len(pairs):
        return None
    a, b = int(labels[pairs[0, 0]]), int(near[pairs[0, 1]])
    return (a, b) if (j.sightings[a], j.ids[b]) >= (j.sightings[b], j.ids[a]) else (b, a)


def mistaken_names(j: JointMap, labels: Ints) -> Ints:
    """Those of the landmarks `labels` that lie where one of another type is, which is seen more than twice as often.

    A lamp's edge that crosses a joint, or lies near one, is called by another type now and then. Maps that were made
    before this was asked have such names: relocalisation/place_index/names.py tells them from the right ones.
    """
    labels = labels[j.crossing_type[labels] != JOINTS]
    if not len(labels):
        return labels
    near = near_points(j, j.xy(labels), SAME_CORNER_M)
    near = near[j.crossing_type[near] != JOINTS]
    apart = np.hypot(*(j.xy(labels)[:, None] - j.xy(near)[None]).transpose(2, 0, 1))
    other = (apart < SAME_CORNER_M) & (j.crossing_type[labels][:, None] != j.crossing_type[near])
    seen, views = NAMES_BEFORE
    mine, theirs = ((j.sightings[at] + seen) / (j.expected[at] + views) for at in (labels, near))
    out: Ints = labels[np.any(other & (mine[:, None] < NAME_SHARE * theirs), axis=1)]
    return out


def settle(j: JointMap, now: int, birth_sightings: int, learnt_from: int = 0) -> int:
    """Show the newborn landmarks that were seen often enough, and forget those that were not for too long; how many.

    Those with ids below learnt_from wait.
    """
    newborn = _newborn(j, learnt_from)
    often = newborn[j.sightings[newborn] >= birth_sightings]
    j.confirm(np.setdiff1d(often, mistaken_names(j, often)))
    newborn = _newborn(j, learnt_from)
    never_again = newborn[now - j.seen_at[newborn] > EXPIRES_UPDATES]
    j.forget(never_again)
    return len(never_again)


def _newborn(j: JointMap, learnt_from: int) -> Ints:
    labels = np.arange(j.size, len(j))
    return labels[j.ids[labels] >= learnt_from]


def forget(j: JointMap, ids: Ints, newborn: bool = False) -> None:
    """Drop landmarks by id, see PoseFilter.forget."""
    gone = np.isin(j.ids, ids)
    gone[j.size :] |= newborn
    j.forget(np.flatnonzero(gone))


def carry(j: JointMap, first_id: int, there_from_here: Array) -> Landmarks:
    """Move the landmarks with ids from first_id on, see PoseFilter.carry."""
    own = np.flatnonzero(j.ids >= first_id)
    _move(j, own, there_from_here)
    near = near_points(j, j.xy(own), SAME_M)
    near = near[j.ids[near] < first_id]
    j.forget(own[_known(j.xy(own), j.kinds(own), j.xy(near), j.kinds(near))])
    return j.summary(np.flatnonzero(j.ids[: j.size] >= first_id))


def _move(j: JointMap, labels: Ints, there_from_here: Array) -> None:
    """By a pose (3,), rigidly: means, their covariance with all, and the names of types."""
    out, turn = labels[j.slot[labels] < 0], rotation(float(there_from_here[2]))
    j.crossing_type[labels] = _named_anew(j.kinds(labels), there_from_here)
    j.index.remove(out, j.table_xy[out])
    j.table_xy[out] = transform(there_from_here, j.table_xy[out])
    j.table_packed[out] = packed(turn @ unpacked(j.table_packed[out]) @ turn.T)
    j.index.add(out, j.table_xy[out])
    rows, size = j.rows(labels[j.slot[labels] >= 0]), len(j.mean)
    j.mean[rows] = transform(there_from_here, j.mean[rows].reshape(-1, 2)).ravel()
    j.cov[rows] = (turn @ j.cov[rows].reshape(-1, 2, size)).reshape(-1, size)
    j.cov[:, rows] = (turn @ j.cov[:, rows].T.reshape(-1, 2, size)).reshape(-1, size).T


def _named_anew(kind: Ints, there_from_here: Array) -> Ints:
    """(K,) types of landmarks that a pose (3,) turns, named by the map's axes again."""
    return turned_type(kind, -quarter_turns(0.0, float(there_from_here[2])))


def carried(landmarks: Landmarks, first_id: int, there_from_here: Array) -> Landmarks:
    """A whole map, as carry() leaves it: for filters that hold it in no table."""
    own = landmarks.ids >= first_id
    new, old, turn = landmarks.of(own), landmarks.of(~own), rotation(float(there_from_here[2]))
    new = replace(
        new,
        xy_map_m=transform(there_from_here, new.xy_map_m),
        cov_m2=turn @ new.cov_m2 @ turn.T,
        crossing_type=_named_anew(new.crossing_type, there_from_here),
    )
    near = landmarks_near(old, new.xy_map_m, SAME_M)[1]
    new = new.of(~_known(new.xy_map_m, new.crossing_type, near.xy_map_m, near.crossing_type))
    return Landmarks(*(np.concatenate([getattr(old, f.name), getattr(new, f.name)]) for f in fields(Landmarks)))


def _known(xy: Array, kind: Ints, others: Array, their_kind: Ints) -> NDArray[np.bool_]:
    """(N,) which of (N, 2) are within SAME_M of others (M, 2) of their type."""
    close = np.hypot(*(xy[:, None] - others).transpose(2, 0, 1)) < SAME_M
    return np.asarray(np.any(close & (kind[:, None] == their_kind), axis=1))


def make_room(j: JointMap, most: int, now: int, learnt_from: int = 0) -> int:
    """Forget the least certain newborn landmarks that are not in view, so many at most; returns how many there were."""
    newborn = _newborn(j, learnt_from)
    newborn = newborn[j.seen_at[newborn] < now]
    gone = newborn[np.lexsort((j.seen_at[newborn], j.sightings[newborn]))][:most]
    j.forget(gone)
    return len(gone)


def fresh(j: JointMap, obs: Observations, which: Ints, gate_m: float) -> Ints:
    """Those of the features `which` that are far enough from all landmarks of their type to be others."""
    xy, kind = transform(j.pose, obs.xy_base_m[which]), obs.crossing_type[which]
    near = near_points(j, xy, gate_m)
    apart = np.hypot(*(xy[:, None] - j.xy(near)[None]).transpose(2, 0, 1))
    apart[kind[:, None] != j.crossing_type[near]] = np.inf
    new = np.min(apart, axis=1, initial=np.inf) > DUPLICATE_FRACTION * gate_m
    if len(near):  # nor where it may be one that is known, seen badly
        off = apart**2 / (np.max(obs.var_m2[which], axis=1)[:, None] + np.max(j.packed(near)[:, [0, 2]], axis=1))
        new &= np.min(off, axis=1) > CANDIDATE_GATE_CHI2
    out: Ints = which[new]
    return out
