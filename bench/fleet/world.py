"""A building as it is, and what a robot's filter would make of driving through a part of it."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from ceilvo.crossing_types import CORNER, JOINTS, LAMP, SPOT
from ceilvo.daemon.fleet.learnt import joined_landmarks
from ceilvo.daemon.slam.spatial_index import IndexedMap
from ceilvo.types import Array, Ints, Landmarks

TILE_M = 0.6
KINDS = (0, 1, 2, 3, 5, 6, 7, 8, LAMP, SPOT, CORNER)
"""Of what is not a joint."""
VIEW_SIGMA_M = 0.006
"""Of a landmark's place in one independent view."""
BIAS_M = 0.001
"""Of a robot's calibration: it shifts all that the robot sees; standard deviation."""
SAME_M = 0.05
VIEWS = (2, 7)
"""Independent views of a landmark in one drive through its place."""


@dataclass(frozen=True)
class Building:
    """
    Attributes:
        xy_m: (T, 2) of what is on the ceiling.
        kind: (T,).
    """

    size_m: tuple[float, float]
    xy_m: Array
    kind: Ints

    @staticmethod
    def new(size_m: tuple[float, float], rng: np.random.Generator) -> Building:
        """Joints of a raster, and as many edges, lamps and spots anywhere between: 5.6 a square metre."""
        x, y = (np.arange(0.3, side, TILE_M) for side in size_m)
        joints = np.stack(np.meshgrid(x, y, indexing="ij"), axis=-1).reshape(-1, 2)
        others = joints + 0.5 * TILE_M + rng.uniform(-0.1, 0.1, joints.shape)
        kinds = np.concatenate([np.full(len(joints), JOINTS), rng.choice(KINDS, len(others))])
        return Building(size_m, np.vstack([joints, others]), kinds)

    def renovated(self, share: float, rng: np.random.Generator) -> Building:
        """Some of the lamps, spots and edges are elsewhere, 20 to 25 cm from where they were."""
        loose = np.flatnonzero(self.kind != JOINTS)
        moved = rng.choice(loose, int(share * len(loose)), replace=False)
        xy, angle = self.xy_m.copy(), rng.uniform(-np.pi, np.pi, len(moved))
        xy[moved] += rng.uniform(0.2, 0.25, (len(moved), 1)) * np.column_stack([np.cos(angle), np.sin(angle)])
        return replace(self, xy_m=xy)

    def within(self, low_m: Array, high_m: Array) -> Ints:
        return np.flatnonzero(np.all((self.xy_m >= low_m) & (self.xy_m <= high_m), axis=1))

    def as_map(self, which: Ints, sigma_m: float, rng: np.random.Generator) -> Landmarks:
        """As a survey has it."""
        n = len(which)
        cov = covariances(np.full(n, sigma_m**2), rng)
        views = rng.integers(10, 30, n)
        xy = self.xy_m[which] + drawn(cov, rng)
        return Landmarks(np.arange(n), xy, cov, self.kind[which], views, views + 1)


def covariances(variance_m2: Array, rng: np.random.Generator) -> Array:
    """(N, 2, 2) about variances (N,): no two views are alike."""
    low, high = (
        variance_m2 * rng.uniform(0.7, 1.0, len(variance_m2)),
        variance_m2 * rng.uniform(1.0, 1.4, len(variance_m2)),
    )
    angle = rng.uniform(0.0, np.pi, len(variance_m2))
    axis = np.column_stack([np.cos(angle), np.sin(angle)])
    return np.asarray(
        low[:, None, None] * np.eye(2) + (high - low)[:, None, None] * axis[:, :, None] * axis[:, None, :]
    )


def drawn(cov_m2: Array, rng: np.random.Generator) -> Array:
    """(N, 2) errors of (N, 2, 2)."""
    return np.asarray(np.einsum("nij,nj->ni", np.linalg.cholesky(cov_m2), rng.normal(0.0, 1.0, (len(cov_m2), 2))))


@dataclass(frozen=True)
class Region:
    """A box that a robot drives through; corners (2,)."""

    low_m: Array
    high_m: Array

    @staticmethod
    def anywhere(size_m: tuple[float, float], side_m: tuple[float, float], rng: np.random.Generator) -> Region:
        low = rng.uniform(0.0, np.maximum(np.array(size_m) - side_m, 1e-9))
        return Region(low, low + side_m)


def driven(learnt: Landmarks, building: Building, region: Region, bias_m: Array, rng: np.random.Generator) -> Landmarks:
    """The robot's map after a drive: what is there is seen some times and fused by its information or new, what is not
    there any more is missed."""
    there = building.within(region.low_m, region.high_m)
    views = rng.integers(*VIEWS, len(there))
    cov = covariances(VIEW_SIGMA_M**2 / views, rng)
    seen, kind = building.xy_m[there] + bias_m + drawn(cov, rng), building.kind[there]
    known, _ = IndexedMap(learnt).nearest(seen, kind, SAME_M)
    old = np.flatnonzero(known >= 0)
    out = _fused(learnt, known[old], seen[old], cov[old], views[old])
    inside = np.all((out.xy_map_m >= region.low_m + 0.1) & (out.xy_map_m <= region.high_m - 0.1), axis=1)
    missed = inside & ~np.isin(np.arange(len(out)), known[old])
    out = replace(out, expected=out.expected + missed * rng.integers(*VIEWS, len(out)) * 5)
    new = np.flatnonzero(known < 0)
    first = int(np.max(out.ids, initial=-1)) + 1
    ids = first + np.arange(len(new))
    return joined_landmarks(out, Landmarks(ids, seen[new], cov[new], kind[new], views[new], views[new]))


def _fused(m: Landmarks, which: Ints, seen: Array, noise_m2: Array, views: Ints) -> Landmarks:
    xy, cov, sightings, expected = m.xy_map_m.copy(), m.cov_m2.copy(), m.sightings.copy(), m.expected.copy()
    before, gain = np.linalg.inv(cov[which]), np.linalg.inv(noise_m2)
    after = np.linalg.inv(before + gain)
    pulled = np.einsum("nij,njk,nk->ni", after, gain, seen - xy[which])
    xy[which] += pulled
    cov[which] = 0.5 * (after + np.swapaxes(after, 1, 2))
    sightings[which] += views
    expected[which] += views
    return replace(m, xy_map_m=xy, cov_m2=cov, sightings=sightings, expected=expected)
