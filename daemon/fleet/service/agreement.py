"""What robots agree on becomes the map: known landmarks better known or gone, new ones. Pure."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ceilvo.daemon.fleet.learnt import MISSED_VIEWS
from ceilvo.daemon.fleet.service.claims import Claims, combined, is_placed, places_and_covariances
from ceilvo.daemon.fleet.service.grouping import Group, groups
from ceilvo.daemon.fleet.service.judge import GATE_CHI2, distance_chi2, indices_of
from ceilvo.daemon.map.database.rows import ROW, Rows, rows_of
from ceilvo.daemon.slam.spatial_index import IndexedMap
from ceilvo.types import Array, Ints, Landmarks

SAME_M = 0.08
"""A landmark of one kind so near to one of the map, within its doubt, is that one; chosen as in refinement."""
SUREST_M = 1.5e-3
"""No landmark of the map is surer; chosen: errors that all robots share do not go away by averaging."""
MOVED_SIGMAS, SURER, COUNTED = 0.25, 0.8, 0.5
"""A landmark is written again where it moves by so many sigmas, its largest variance falls to this share, or its
sightings grow by this share: every change is fetched by the whole fleet. Chosen."""
MISSED_SHARE = 0.25
"""Of the views that should show a landmark; what is seen more seldom is gone. Chosen."""


@dataclass(frozen=True)
class Changes:
    """What becomes of a map.

    Attributes:
        rows: landmarks that are new or other than before; their times are the service's business.
        removed: (R,) ids.
        used: (C,) claims that have done their work, or can do none.
        confirmed, added: how many landmarks; the rows, in this order.
        doubled: claims of new landmarks that the map has already, elsewhere within SAME_M.
    """

    rows: Rows
    removed: Ints
    used: NDArray[np.bool_]
    confirmed: int
    added: int
    doubled: int

    def __bool__(self) -> bool:
        return bool(len(self.rows) or len(self.removed))


def agreed(known: Landmarks, claims: Claims, quorum: int, next_id: int, room: int) -> Changes:
    """Changes that so many different keys agree on, or a claim that needs nobody else's.

    Args:
        known: the map, by ascending id.
        next_id: of the first new landmark; ids are never used twice.
        room: how many new landmarks the map can take.
    """
    names, doubled = _known_names(known, claims)
    used = doubled | ((claims["ref"] >= 0) & (names < 0))  # of a landmark that is gone
    here = np.flatnonzero((names >= 0) & ~used)
    rows, removed, done = _known(known, claims[here], names[here], quorum)
    used[here[np.isin(names[here], done)]] = True
    new = np.flatnonzero((names < 0) & ~used & is_placed(claims))
    found, thinned = groups(claims[new], SAME_M, quorum)
    used[new[thinned]] = True
    added: list[Rows] = []
    for group in found[: max(room, 0)]:
        added.append(_new_row(claims[new[group.members]], group, next_id + len(added)))
        used[new[group.members]] = True
    both = np.concatenate([rows, *added])
    return Changes(both, removed, used, len(rows), len(added), int(np.count_nonzero(doubled)))


def _known_names(known: Landmarks, claims: Claims) -> tuple[Ints, NDArray[np.bool_]]:
    """(C,) index on the map of the landmark that each claim is about, -1 for none; and which robots' own ones lie so
    near to one of the map that they are it, but not where it is."""
    at = indices_of(claims["ref"], known.ids)
    own = np.flatnonzero((claims["ref"] < 0) & is_placed(claims))
    doubled = np.zeros(len(claims), bool)
    if len(own) and len(known):
        xy, cov = places_and_covariances(claims[own])
        near, _ = IndexedMap(known).nearest(xy, claims["kind"][own], SAME_M)
        there = near >= 0
        fits = np.zeros(len(own), bool)
        fits[there] = distance_chi2(
            xy[there] - known.xy_map_m[near[there]], cov[there] + known.cov_m2[near[there]]
        ) <= (GATE_CHI2)
        at[own[fits]] = near[fits]
        doubled[own[there & ~fits]] = True
    return at, doubled


def _known(known: Landmarks, claims: Claims, at: Ints, quorum: int) -> tuple[Rows, Ints, Ints]:
    """Rows of landmarks that are better known, ids of those that are gone, and indices of all whose claims are used."""
    c = claims.copy()
    c["ref"] = at
    c = combined(c)
    missed = (c["expected"] - c["seen"] >= MISSED_VIEWS) & (c["seen"] <= MISSED_SHARE * c["expected"])
    agree = is_placed(c) & ~missed
    placed = np.flatnonzero(agree)
    xy, cov = places_and_covariances(c[placed])
    on_map = c["ref"][placed]
    agree[placed] = distance_chi2(xy - known.xy_map_m[on_map], cov + known.cov_m2[on_map]) <= GATE_CHI2
    gone = _enough(c, missed, quorum, len(known)) & (_votes(c, missed, len(known)) > _votes(c, agree, len(known)))
    better = _enough(c, agree, quorum, len(known)) & ~gone
    kept = agree[placed] & better[on_map]
    rows = _fused(known, c[placed][kept], xy[kept], cov[kept])
    written = indices_of(rows["id"], known.ids)
    removed = np.flatnonzero(gone)
    return rows, known.ids[removed], np.concatenate([written, removed])


def _votes(c: Claims, which: NDArray[np.bool_], size: int) -> Ints:
    """(size,) keys that say so; a key has one claim of each landmark."""
    return np.bincount(c["ref"][which], minlength=size)


def _enough(c: Claims, which: NDArray[np.bool_], quorum: int, size: int) -> NDArray[np.bool_]:
    alone = np.bincount(c["ref"][which], weights=c["alone"][which], minlength=size) > 0
    return np.asarray(alone | (_votes(c, which, size) >= quorum))


def _fused(known: Landmarks, c: Claims, xy: Array, cov: Array) -> Rows:
    """The landmarks that claims (C,) at (C, 2) with (C, 2, 2) change enough to be written."""
    order = np.argsort(c["ref"], kind="stable")
    c, xy, cov = c[order], xy[order], cov[order]
    label, first, count = np.unique(c["ref"], return_index=True, return_counts=True)
    if not len(label):
        return np.empty(0, ROW)
    information = np.linalg.inv(_fair(cov, first, count))
    before = np.linalg.inv(_floored(known.cov_m2[label]))
    off = xy - np.repeat(known.xy_map_m[label], count, axis=0)
    total = before + np.add.reduceat(information, first, axis=0)
    after = np.linalg.inv(total)
    pulled = np.add.reduceat(np.einsum("nij,nj->ni", information, off), first, axis=0)
    moved = np.einsum("nij,nj->ni", after, pulled)
    after = _floored(after)
    seen, expected = (_fair_counts(c[name], first, count) for name in ("seen", "expected"))
    largest = [np.linalg.eigvalsh(m)[:, 1] for m in (known.cov_m2[label], after)]
    news = np.hypot(*moved.T) > MOVED_SIGMAS * np.sqrt(largest[0])
    news |= largest[1] < SURER * largest[0]
    news |= seen > COUNTED * np.maximum(known.sightings[label], 1)
    m = known.of(label[news])
    sightings = m.sightings + seen[news]
    out = Landmarks(
        ids=m.ids,
        xy_map_m=m.xy_map_m + moved[news],
        cov_m2=after[news],
        crossing_type=m.crossing_type,
        sightings=sightings,
        expected=np.maximum(m.expected + expected[news], sightings),
    )
    return rows_of(out, np.zeros((len(out), 2)))


def _fair(cov: Array, first: Ints, count: Ints) -> Array:
    """No claim counts for more than the middle one of its landmark: who boasts gains nothing."""
    size = np.trace(cov, axis1=1, axis2=2)
    middle = np.array([np.median(size[i : i + n]) for i, n in zip(first, count, strict=True)])
    return np.asarray(cov * np.maximum(1.0, np.repeat(middle, count) / size)[:, None, None])


def _fair_counts(values: Ints, first: Ints, count: Ints) -> Ints:
    """Sums by landmark, of none more than twice the middle one."""
    middle = [np.median(values[i : i + n]) for i, n in zip(first, count, strict=True)]
    most = np.ceil(2.0 * np.repeat(middle, count)).astype(np.int64)
    return np.asarray(np.add.reduceat(np.minimum(values, most), first), np.int64)


def _floored(cov: Array) -> Array:
    values, axes = np.linalg.eigh(cov)
    out = np.einsum("nij,nj,nkj->nik", axes, np.maximum(values, SUREST_M**2), axes)
    return np.asarray(0.5 * (out + np.swapaxes(out, 1, 2)))


def _new_row(c: Claims, group: Group, new_id: int) -> Rows:
    first, count = np.array([0]), np.array([len(c)])
    cov = _fair(group.cov_m2, first, count)
    information = np.linalg.inv(cov)
    after = np.linalg.inv(information.sum(axis=0))
    xy = after @ np.einsum("nij,nj->i", information, group.xy_m)
    seen, expected = (_fair_counts(c[name], first, count) for name in ("seen", "expected"))
    m = Landmarks(
        ids=np.array([new_id]),
        xy_map_m=xy[None],
        cov_m2=_floored(after[None]),
        crossing_type=c["kind"][:1],
        sightings=seen,
        expected=np.maximum(expected, seen),
    )
    return rows_of(m, np.zeros((1, 2)))
