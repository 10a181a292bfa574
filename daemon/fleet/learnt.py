"""What a robot learnt since: its map against the one that it has told of before. Pure."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ceilvo.daemon.fleet.offers import (
    LEAST_SIGMA_M,
    MOST_COUNT,
    MOST_ROWS,
    MOST_SIGMA_M,
    Measured,
    covariances_of,
    measured,
    places_of,
)
from ceilvo.types import Array, Ints, Landmarks

TOLD_SHARE = 0.2
"""A known landmark is told of again when this share of what is known of it is new, or as large a share of its
sightings; chosen: 15 drives through a hall tell of a landmark about as often as it takes to make it twice as sure."""
MISSED_VIEWS = 20
"""Views that do not show what should be there before that is told; chosen: a landmark that is there is missed now and
then (daemon/slam/upkeep.py)."""
WITNESSES, WITNESS_SIGMA_M = 60, 0.05
"""Known landmarks that go with an offer so that it can be checked, and how well they must be measured; chosen."""
GONE_REF = -(2**62)
"""Of a landmark that the robot has told to be gone."""
_SECOND = 2**40
"""Taken from the names of the robot's own landmarks that are in use already."""


@dataclass(frozen=True)
class Told:
    """Landmarks as the fleet knows them from its map, or from what the robot told.

    Attributes:
        landmarks: by ascending id of the robot.
        refs: (L,) what the fleet calls them: their ids on its map, -1 - id for the robot's own, or GONE_REF.
    """

    landmarks: Landmarks
    refs: Ints

    def of_none(self) -> Told:
        return Told(self.landmarks.of(np.arange(0)), np.empty(0, np.int64))

    def with_(self, newer: Told) -> Told:
        """Those of `newer` in the place of those of their ids."""
        keep = ~np.isin(self.landmarks.ids, newer.landmarks.ids)
        both = joined_landmarks(self.landmarks.of(keep), newer.landmarks)
        refs = np.concatenate([self.refs[keep], newer.refs])
        order = np.argsort(both.ids, kind="stable")
        return Told(both.of(order), refs[order])


@dataclass(frozen=True)
class Gained:
    """
    Attributes:
        rows: (N,) what the robot measured.
        is_news: (N,) worth an offer; the others may be witnesses of one.
        now: (N,) of the same landmarks, as they are to be told.
    """

    rows: Measured
    is_news: NDArray[np.bool_]
    now: Told


def joined_landmarks(a: Landmarks, b: Landmarks) -> Landmarks:
    """One after the other."""
    names = ("ids", "xy_map_m", "cov_m2", "crossing_type", "sightings", "expected")
    return Landmarks(*(np.concatenate([getattr(a, n), getattr(b, n)]) for n in names))


def gained(told: Told, now: Landmarks) -> Gained:
    """What the robot measured itself since it last told, landmark by landmark: what is known now less what was known.

    Landmarks that its map has no more are told as missed.
    """
    was = told.landmarks
    _, i, j = np.intersect1d(was.ids, now.ids, assume_unique=True, return_indices=True)
    same = was.crossing_type[i] == now.crossing_type[j]
    i, j = i[same], j[same]
    lost = (told.refs >= 0) & ~np.isin(was.ids, now.ids[j])
    new = ~np.isin(now.ids, was.ids)
    again, is_news = _again(was.of(i), told.refs[i], now.of(j))
    first, missed = _first(now.of(new), told.refs), _missed(was.of(lost), told.refs[lost])
    rows = np.concatenate([again, first, missed])
    after = joined_landmarks(joined_landmarks(now.of(j), now.of(new)), was.of(lost))
    refs = np.concatenate([told.refs[i], first["ref"], np.full(len(missed), GONE_REF)])
    known = rows["expected"] > 0
    news = np.concatenate([is_news, np.ones(len(first) + len(missed), bool)])
    return Gained(rows[known], news[known], Told(after.of(known), refs[known]))


def _again(told: Landmarks, ref: Ints, now: Landmarks) -> tuple[Measured, NDArray[np.bool_]]:
    """Rows (N,), of which those that say nothing expect nothing; and which are news."""
    seen, expected = now.sightings - told.sightings, now.expected - told.expected
    before, after = np.linalg.inv(_least(told.cov_m2)), np.linalg.inv(_least(now.cov_m2))
    gain = after - before
    values, axes = np.linalg.eigh(0.5 * (gain + np.swapaxes(gain, 1, 2)))
    cov = np.einsum("nij,nj,nkj->nik", axes, 1.0 / np.clip(values, MOST_SIGMA_M**-2, LEAST_SIGMA_M**-2), axes)
    # The measurement z that leads from one to the other: before x_told + gain z = (before + gain) x_now.
    off = now.xy_map_m - told.xy_map_m
    beyond = np.einsum("nij,njk,nk->ni", cov, before, off)
    most = np.hypot(*off.T) / TOLD_SHARE  # where hardly anything was gained, neighbours moved it
    beyond *= np.minimum(1.0, most / np.maximum(np.hypot(*beyond.T), 1e-12))[:, None]
    valid = (seen >= 0) & (expected >= seen)
    seen, expected = np.where(valid, seen, 0), np.where(valid, expected, 0)
    news = values[:, 1] > TOLD_SHARE * np.linalg.eigvalsh(before)[:, 1]
    news = (seen > 0) & (news | (seen > TOLD_SHARE * np.maximum(told.sightings, 1)))
    news |= (expected - seen >= MISSED_VIEWS) & (seen <= 0.25 * expected)
    return _rows(ref, now.xy_map_m + beyond, cov, now.crossing_type, seen, expected), news


def _first(now: Landmarks, taken: Ints) -> Measured:
    cov = _least(now.cov_m2)
    expected = np.where(np.linalg.eigvalsh(cov)[:, 1] < MOST_SIGMA_M**2, now.expected, 0)
    ref = -1 - now.ids
    ref = np.where(np.isin(ref, taken), ref - _SECOND, ref)
    return _rows(ref, now.xy_map_m, cov, now.crossing_type, np.minimum(now.sightings, expected), expected)


def _missed(told: Landmarks, ref: Ints) -> Measured:
    vague = np.tile(MOST_SIGMA_M**2 * np.eye(2), (len(told), 1, 1))
    none, views = np.zeros(len(told), np.int64), np.full(len(told), MISSED_VIEWS)
    return _rows(ref, told.xy_map_m, vague, told.crossing_type, none, views)


def _rows(ref: Ints, xy_m: Array, cov_m2: Array, kind: Ints, seen: Ints, expected: Ints) -> Measured:
    most = np.minimum(expected, MOST_COUNT)
    return measured(ref, xy_m, cov_m2, kind, np.minimum(seen, most), most)


def _least(cov_m2: Array) -> Array:
    """Covariances (N, 2, 2) that can be inverted."""
    return np.asarray(cov_m2 + LEAST_SIGMA_M**2 * np.eye(2))


def parts(g: Gained) -> list[Ints]:
    """Indices of the rows of one offer each: news by place, and known landmarks beside them to check them by. No row
    is in two: it would count twice."""
    news = np.flatnonzero(g.is_news)
    if not len(news):
        return []
    xy = places_of(g.rows)
    size = MOST_ROWS - WITNESSES
    strip = np.floor(xy[news, 0] / 8.0)
    order = news[np.lexsort((xy[news, 1] * np.where(strip % 2, -1.0, 1.0), strip))]
    sure = np.linalg.eigvalsh(covariances_of(g.rows))[:, 1] <= WITNESS_SIGMA_M**2
    free = ~g.is_news & (g.rows["ref"] >= 0) & (g.rows["seen"] > 0) & sure
    chunks = [order[i : i + size] for i in range(0, len(order), size)]
    share = min(WITNESSES, -(-int(np.count_nonzero(free)) // len(chunks)))
    out = []
    for chunk in chunks:
        left = np.flatnonzero(free)
        near = left[np.argsort(np.hypot(*(xy[left] - xy[chunk].mean(axis=0)).T), kind="stable")[:share]]
        free[near] = False
        out.append(np.concatenate([chunk, near]))
    return out
