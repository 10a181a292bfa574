"""Whether an offer was measured on the fleet's map: what it says of landmarks that are known. Pure."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ceilvo.daemon.fleet.offers import Measured, covariances_of, places_of
from ceilvo.types import Array, Ints, Landmarks

GATE_CHI2 = 9.21
"""99 % of two degrees of freedom."""
SLACK_M = 0.002
"""Added to every standard deviation; chosen: what calibrations of two robots differ by over a view."""
FEWEST = 8
"""Known landmarks that an offer is checked by; chosen: five of them wrong would not pass for a frame."""
SURE_M = 0.05
"""A measurement that is vaguer checks nothing; chosen."""
LEAST_SHARE = 0.8
"""Of the known landmarks that must be where the map has them; chosen: a fifth of a hall may have been rebuilt."""
MOST_BENT_M = 0.05
"""The offer's frame may lie beside the map's by so much at any of its landmarks; chosen: a sixth of a tile."""
SIGMAS = 3.0
"""An offer that seems bent by less of its own doubt is not refused for good."""
FURTHEST_M = 20.0
"""From a new landmark to the next known one that was measured as well; chosen."""


@dataclass(frozen=True)
class Verdict:
    """
    Attributes:
        problem: why the offer cannot be taken, "" where it can.
        later: it may be once the map has grown.
        stale: how many landmarks it names that are on the map no more.
    """

    problem: str
    stale: int = 0
    later: bool = False


def judged(rows: Measured, known: Landmarks, furthest_m: float = FURTHEST_M) -> Verdict:
    """What is wrong with an offer, by a map that has landmarks.

    Args:
        furthest_m: from a new landmark to the next known one.
    """
    at = indices_of(rows["ref"], known.ids)
    stale = int(np.count_nonzero((rows["ref"] >= 0) & (at < 0)))
    cov = covariances_of(rows)
    sure = np.linalg.eigvalsh(cov)[:, 1] <= SURE_M**2
    checks = (at >= 0) & (rows["seen"] > 0) & sure
    there = np.flatnonzero(checks)
    if len(there) < FEWEST:
        return Verdict(f"measures {len(there)} known landmarks, expected {FEWEST} or more to check it by", stale, True)
    xy = places_of(rows)
    on_map = known.xy_map_m[at[there]]
    off = xy[there] - on_map
    kinds = rows["kind"][there] == known.crossing_type[at[there]]
    agree = kinds & (distance_chi2(off, cov[there] + known.cov_m2[at[there]]) <= GATE_CHI2)
    count = int(np.count_nonzero(agree))
    fit = _fitted(on_map, xy[there], xy, np.trace(cov[there], axis1=1, axis2=2))
    if count < LEAST_SHARE * len(there) or fit.bent_m > MOST_BENT_M:
        return Verdict(
            f"{count} of {len(there)} known landmarks agree; it lies {fit.shift_m:.3f} m beside the map, turned by "
            f"{np.degrees(fit.turn_rad):+.2f} deg, {100.0 * (fit.scale - 1.0):+.2f} % larger, up to {fit.bent_m:.3f} m "
            f"off, expected {100.0 * LEAST_SHARE:.0f} % and {MOST_BENT_M:g} m",
            stale,
            later=count >= LEAST_SHARE * len(there) and fit.bent_m < SIGMAS * fit.doubt_m,
        )
    new = np.flatnonzero(rows["ref"] < 0)
    away = _furthest(xy[new], xy[there])
    if away > furthest_m:
        return Verdict(
            f"a new landmark is {away:.0f} m from the next known one, expected {furthest_m:g} m", stale, True
        )
    return Verdict("", stale)


def distance_chi2(off_m: Array, cov_m2: Array) -> Array:
    """(N,) squared distances of (N, 2) by covariances (N, 2, 2), with the slack of calibrations."""
    inverse = np.linalg.inv(cov_m2 + SLACK_M**2 * np.eye(2))
    return np.asarray(np.einsum("ni,nij,nj->n", off_m, inverse, off_m))


def indices_of(wanted: Ints, ids: Ints) -> Ints:
    """(N,) where ids, which ascend, have what is wanted; -1 where they have not."""
    if not len(ids):
        return np.full(len(wanted), -1, np.int64)
    at = np.minimum(np.searchsorted(ids, wanted), len(ids) - 1)
    return np.where(ids[at] == wanted, at, -1).astype(np.int64)


@dataclass(frozen=True)
class _Fit:
    """The similarity that brings places on the map to where an offer has them.

    Attributes:
        shift_m: at their middle.
        bent_m: how far it moves any of the offer's landmarks, and doubt_m the standard deviation of that.
    """

    shift_m: float
    turn_rad: float
    scale: float
    bent_m: float
    doubt_m: float


def _fitted(here: Array, there: Array, all_there: Array, variance_m2: Array) -> _Fit:
    """Of places (N, 2) on the map and measured, with variances (N,); all of the offer's are (M, 2)."""
    c, d = here.mean(axis=0), there.mean(axis=0)
    a, b, z = ((xy - m) @ np.array([1.0, 1j]) for xy, m in ((here, c), (there, d), (all_there, d)))
    size = max(float(np.sum(np.abs(a) ** 2)), 1e-12)
    factor = complex(np.sum(np.conj(a) * b)) / size
    moved = z - z / factor if abs(factor) > 1e-6 else np.full(len(z), np.inf)
    bent = np.abs(moved + complex(*(d - c)))
    worst = int(np.argmax(bent))
    doubt = np.sqrt(np.mean(variance_m2) * (1.0 / len(a) + np.abs(z[worst]) ** 2 / size))
    return _Fit(float(np.hypot(*(d - c))), float(np.angle(factor)), abs(factor), float(bent[worst]), float(doubt))


def _furthest(points: Array, others: Array) -> float:
    """Largest distance of any of (N, 2) to the nearest of (M, 2); 0 without any."""
    nearest = (np.hypot(*(others - p).T).min() for p in points)
    return float(max(nearest, default=0.0))
