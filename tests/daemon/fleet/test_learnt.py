"""What a robot tells of: what it measured itself, when it is worth an offer, and what an offer is checked by."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from fleet_parts import HALL, KNOWN_M, SIZE_M

from ceilvo.daemon.fleet.learnt import MISSED_VIEWS, WITNESSES, Told, gained, parts
from ceilvo.daemon.fleet.offers import MOST_ROWS, covariances_of, places_of
from ceilvo.daemon.fleet.service.judge import FEWEST
from ceilvo.types import Landmarks


def fused(told: Landmarks, at: np.ndarray, sigma: float, views: int) -> Landmarks:
    """As a filter would, of independent measurements."""
    information = np.linalg.inv(told.cov_m2) + np.eye(2) / sigma**2
    cov = np.linalg.inv(information)
    xy = told.xy_map_m + np.einsum("nij,nj->ni", cov, (at - told.xy_map_m) / sigma**2)
    more = told.sightings + views
    return replace(told, xy_map_m=xy, cov_m2=cov, sightings=more, expected=told.expected + views)


def test_what_is_told_is_what_was_measured_and_not_what_was_known() -> None:
    rng = np.random.default_rng(4)
    which = HALL.within(np.zeros(2), np.array([KNOWN_M, SIZE_M[1]]))
    told = HALL.as_map(which, 0.005, rng)
    at = told.xy_map_m + rng.normal(0.0, 0.004, told.xy_map_m.shape)
    rows = gained(Told(told, told.ids), fused(told, at, 0.004, 9)).rows
    assert np.abs(places_of(rows) - at).max() < 1e-4
    assert np.abs(np.sqrt(covariances_of(rows)[:, 0, 0]) - 0.004).max() < 1e-5
    assert np.all(rows["seen"] == 9) and np.array_equal(rows["ref"], told.ids)


def test_what_says_little_makes_no_offer_and_what_is_missed_is_told_once() -> None:
    told = HALL.as_map(np.arange(100), 0.003, np.random.default_rng(4))
    assert parts(gained(Told(told, told.ids), told)) == []
    little = fused(told, told.xy_map_m, 0.02, 1)
    assert parts(gained(Told(told, told.ids), little)) == []
    missed = replace(told, expected=told.expected + np.where(np.arange(100) < 5, MISSED_VIEWS, 0))
    g = gained(Told(told, told.ids), missed)
    assert np.count_nonzero(g.is_news) == 5
    assert not gained(Told(told, told.ids).with_(g.now), missed).is_news.any()
    lost = gained(Told(told, told.ids), told.of(np.arange(3, 100)))
    assert lost.rows["ref"][lost.is_news].tolist() == [0, 1, 2]
    assert not gained(Told(told, told.ids).with_(lost.now), told.of(np.arange(3, 100))).is_news.any()


def test_no_landmark_is_in_two_offers_and_each_has_what_it_is_checked_by() -> None:
    rng = np.random.default_rng(4)
    told = HALL.as_map(np.arange(400), 0.003, rng)
    seen = fused(told, told.xy_map_m, 0.01, 3)
    n = 4000
    new = Landmarks(
        10_000 + np.arange(n),
        rng.uniform(0.0, 40.0, (n, 2)),
        np.tile(1e-5 * np.eye(2), (n, 1, 1)),
        np.zeros(n, np.int64),
        np.full(n, 5),
        np.full(n, 5),
    )
    both = replace(
        seen,
        **{name: np.concatenate([getattr(seen, name), getattr(new, name)]) for name in Landmarks.__dataclass_fields__},
    )
    g = gained(Told(told, told.ids), both)
    chunks = parts(g)
    assert len(chunks) == 3 and all(len(c) <= MOST_ROWS for c in chunks)
    every = np.concatenate(chunks)
    assert len(np.unique(every)) == len(every) and set(np.flatnonzero(g.is_news)) <= set(every.tolist())
    assert all(np.count_nonzero(g.rows["ref"][c[-WITNESSES:]] >= 0) >= FEWEST for c in chunks)
