"""Where anchors are, from ranges along a drive whose poses are known."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ceilvo.daemon.relocalisation.beacons.anchors import BIAS_M, OFFSET_MOST_M
from ceilvo.daemon.relocalisation.beacons.range_errors import direct_share, log_density
from ceilvo.senses.beacons import Anchor
from ceilvo.types import Array

APART_M = 0.25
"""Ranges from nearer together count as one: they err alike; chosen."""
FEWEST = 12
"""Spots from which an anchor must have been heard."""
OFFSET_SIGMA_M = 0.15
"""Of an anchor's ranges before anything is known; chosen: an antenna's delay as delivered."""
HEIGHT_SIGMA_M = 0.5
"""Of an anchor's height above the floor around what was told; chosen."""
TWO_M, SURER = 0.5, 8.0
"""Another place so far off must be less likely by so much, as a logarithm: from one straight line there are two."""
WORST_M = 0.3
"""A place that is not known to so much, one standard deviation, is none: the drive was too short or too straight."""
_CELLS, _ROUNDS, _STARTS = 25, 30, 8
_STEP = 1e-6
"""Change of the place, m, at which rounds end."""


@dataclass(frozen=True, slots=True)
class Located:
    """An anchor, or why there is none.

    Attributes:
        spots: that it was heard from; rms_m: of its direct ranges.
    """

    name: str
    anchor: Anchor | None
    spots: int
    rms_m: float = 0.0
    problem: str = ""


def thinned(tags_m: Array, ranges_m: Array) -> tuple[Array, Array]:
    """(M, 2) spots that are apart and (M,) the median range from each, of tags (N, 2) in order and ranges (N,)."""
    spots: list[list[int]] = []
    for k, at in enumerate(tags_m):
        if not spots or np.hypot(*(at - tags_m[spots[-1][0]])) >= APART_M:
            spots.append([])
        spots[-1].append(k)
    at = np.array([np.mean(tags_m[own], axis=0) for own in spots]).reshape(-1, 2)
    return at, np.array([float(np.median(ranges_m[own])) for own in spots])


def locate(name: str, tags_m: Array, ranges_m: Array, tag_z_m: float, height_m: float, noise_m: float) -> Located:
    """From tags (N, 2) in map in the order of the drive.

    Args:
        tag_z_m: of the tag above the floor; height_m: of the anchor, about.
        noise_m: standard deviation of one range.
    """
    at, r = thinned(tags_m, ranges_m)
    if len(at) < FEWEST:
        return Located(name, None, len(at), problem=f"heard from {len(at)} spots, {FEWEST} are needed; drive further")
    sigma = float(np.hypot(noise_m, BIAS_M))
    found = [_refined(s, at, r, tag_z_m, height_m, sigma) for s in _starts(at, r, sigma)]
    place, cov, value = max(found, key=lambda f: f[2])
    others = [f for f in found if np.hypot(*(f[0] - place)[:2]) > TWO_M and f[2] > value - SURER]
    if others:
        x, y = others[0][0][:2].tolist()
        why = f"({place[0]:.1f}, {place[1]:.1f}) and ({x:.1f}, {y:.1f}) fit as well; drive on more than one line"
        return Located(name, None, len(at), problem=why)
    plane = float(np.sqrt(np.max(np.linalg.eigvalsh(cov[:2, :2]))))
    if plane > WORST_M:
        why = f"its place is known to {plane:.1f} m only; drive on more than one line, and around it"
        return Located(name, None, len(at), problem=why)
    error = r - _expected(place, at, tag_z_m)
    direct = error[direct_share(error, sigma) > 0.5]
    rms = float(np.sqrt(np.mean(direct**2))) if len(direct) else np.inf
    x, y, z, offset = place.tolist()
    anchor = Anchor(name, x, y, max(z, -10.0), max(plane, 0.01), offset, float(np.sqrt(cov[3, 3])))
    return Located(name, anchor, len(at), rms)


def _starts(at: Array, r: Array, sigma: float) -> list[Array]:
    """Likeliest cells (3,) of a grid that the ranges bound."""
    reach = float(np.median(r)) + 2.0
    middle = np.mean(at, axis=0)
    axis = np.linspace(-reach, reach, _CELLS)
    grid = middle + np.stack(np.meshgrid(axis, axis), axis=-1).reshape(-1, 2)
    d = np.hypot(*(grid[:, None] - at).transpose(2, 0, 1))
    cell = 2.0 * reach / _CELLS
    value = np.sum(log_density(r - d, float(np.hypot(sigma, 0.5 * cell))), axis=1)
    out: list[Array] = []
    for k in np.argsort(-value).tolist():
        if all(np.hypot(*(grid[k] - other)) > 2.0 * cell for other in out):
            out.append(grid[k])
        if len(out) == _STARTS:
            break
    return out


def _refined(
    start: Array, at: Array, r: Array, tag_z_m: float, height_m: float, sigma: float
) -> tuple[Array, Array, float]:
    """x, y, z and offset (4,), their covariance (4, 4) and log-likelihood: Gauss and Newton's steps, reweighted."""
    place = np.array([*start, height_m, 0.0])
    prior = np.array([0.0, 0.0, 1.0 / HEIGHT_SIGMA_M**2, 1.0 / OFFSET_SIGMA_M**2])
    begun = np.array([0.0, 0.0, height_m, 0.0])
    normal = np.diag(prior)
    for k in range(_ROUNDS):
        d = _expected(place, at, tag_z_m) - place[3]
        h = np.column_stack([(place[:2] - at) / d[:, None], (place[2] - tag_z_m) / d, np.ones(len(at))])
        error = r - d - place[3]
        # wide at first, so that a start some metres off is drawn in
        weight = direct_share(error, sigma + 2.0 * 0.6**k) / sigma**2
        normal = (h * weight[:, None]).T @ h + np.diag(prior)
        step = np.linalg.solve(normal + 1e-9 * np.eye(4), h.T @ (weight * error) + prior * (begun - place))
        place = place + step
        place[3] = np.clip(place[3], -OFFSET_MOST_M, OFFSET_MOST_M)
        if np.max(np.abs(step)) < _STEP:
            break
    error = r - _expected(place, at, tag_z_m)
    value = float(np.sum(log_density(error, sigma)) - 0.5 * np.sum(prior * (place - begun) ** 2))
    return place, np.asarray(np.linalg.inv(normal + 1e-9 * np.eye(4)), np.float64), value


def _expected(place: Array, at: Array, tag_z_m: float) -> Array:
    """(M,) ranges from spots (M, 2) to a place (4,)."""
    off = place[:2] - at
    return np.asarray(np.sqrt(off[:, 0] ** 2 + off[:, 1] ** 2 + (place[2] - tag_z_m) ** 2) + place[3])


def locate_all(
    heard: Sequence[tuple[str, Array, float]], tag_z_m: float, height_m: float, noise_m: float
) -> list[Located]:
    """Of (name, tag (2,), range) in the order of the drive, by name."""
    out = []
    for name in sorted({h[0] for h in heard}):
        own = [h for h in heard if h[0] == name]
        tags, ranges = np.array([h[1] for h in own]), np.array([h[2] for h in own])
        out.append(locate(name, tags, ranges, tag_z_m, height_m, noise_m))
    return out
