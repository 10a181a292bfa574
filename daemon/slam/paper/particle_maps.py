"""One landmark map per particle, and the candidates from which landmarks are born."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ceilvo.types import Array, Ints, Landmarks, frozen

_CHUNK = 64
_REFRESH = 64
"""Landmarks out of view whose summary is renewed per update, so that its cost does not grow with the map."""


class ParticleMaps:
    """Means and covariances of every landmark in every particle's map.

    Landmark-major, so that the landmarks in view are contiguous: mean (L, 2, N), covariance packed xx, xy, yy
    (L, 3, N). Resampling does not copy maps: `_row` (L, N) says which column holds a particle's version, and a
    landmark is put in order when it is next written.
    """

    def __init__(self, particles: int) -> None:
        self._particles = particles
        self._next_id = 0
        self._size = 0
        self._turn = 0
        self.ids: Ints = np.empty(0, np.int64)
        self.kind: Ints = np.empty(0, np.int64)
        self.sightings: Ints = np.empty(0, np.int64)
        self._mean: Array = np.empty((0, 2, particles))
        self._cov: Array = np.empty((0, 3, particles))
        self._row: NDArray[np.int32] = np.empty((0, particles), np.int32)
        self._xy: Array = np.empty((0, 2))
        self._packed: Array = np.empty((0, 3))

    def __len__(self) -> int:
        return self._size

    def gather(self, labels: Ints) -> tuple[Array, Array]:
        """(K, 2, N) means and (K, 3, N) covariances of the landmarks `labels`."""
        row = self._row[labels][:, None, :]
        return (
            np.take_along_axis(self._mean[labels], row, axis=2),
            np.take_along_axis(self._cov[labels], row, axis=2),
        )

    def scatter(self, labels: Ints, mean: Array, cov: Array) -> None:
        """Write back what gather() gave; labels must be distinct."""
        self._mean[labels], self._cov[labels] = mean, cov
        self._row[labels] = np.arange(self._particles, dtype=np.int32)

    def add(self, mean: Array, cov: Array, kind: Ints, sightings: Ints, limit: int, ids: Ints | None = None) -> Ints:
        """Append landmarks (M, 2, N), (M, 3, N) and return their labels (M,).

        Beyond `limit` each takes the place of the one seen least.
        """
        labels = np.empty(len(kind), np.int64)
        for i in range(len(kind)):
            label = labels[i] = self._free_slot(limit)
            self.ids[label] = self._next_id if ids is None else ids[i]
            self._next_id = max(self._next_id, int(self.ids[label]) + 1)
            self.kind[label], self.sightings[label] = kind[i], sightings[i]
            self.scatter(labels[i : i + 1], mean[i], cov[i])
        return labels

    def _free_slot(self, limit: int) -> int:
        if self._size >= limit:
            return int(np.argmin(self.sightings[: self._size]))
        if self._size == len(self.ids):
            self._grow(max(_CHUNK, self._size // 2))
        self._size += 1
        return self._size - 1

    def _grow(self, more: int) -> None:
        n = self._particles
        blank = np.zeros(more, np.int64)
        self.ids = np.concatenate([self.ids, blank])
        self.kind = np.concatenate([self.kind, blank])
        self.sightings = np.concatenate([self.sightings, blank])
        self._mean = np.concatenate([self._mean, np.zeros((more, 2, n))])
        self._cov = np.concatenate([self._cov, np.zeros((more, 3, n))])
        self._row = np.concatenate([self._row, np.zeros((more, n), np.int32)])
        self._xy = np.concatenate([self._xy, np.zeros((more, 2))])
        self._packed = np.concatenate([self._packed, np.zeros((more, 3))])

    def resample(self, ancestors: Ints) -> None:
        """Particle i goes on with the map of particle ancestors[i]."""
        self._row[: self._size] = self._row[: self._size, ancestors]

    def refresh(self, weights: Array, labels: Ints) -> None:
        """Renew the summary of the landmarks `labels`, and of the next few in turn, for changed weights."""
        if not self._size:
            return
        turn = (self._turn + np.arange(min(_REFRESH, self._size))) % self._size
        self._turn = int((self._turn + len(turn)) % self._size)
        labels = np.union1d(labels, turn)
        mean, cov = self.gather(labels)
        xy = mean @ weights
        x, y = mean[:, 0] - xy[:, :1], mean[:, 1] - xy[:, 1:]
        self._xy[labels] = xy
        self._packed[labels] = cov @ weights + np.stack([x * x, x * y, y * y], axis=1) @ weights

    def summary(self) -> Landmarks:
        """Means over the particles; covariance = mean of theirs + spread of their means, as of the last refresh."""
        size = self._size
        return Landmarks(
            ids=self.ids[:size].copy(),
            xy_map_m=frozen(self._xy[:size].copy()),
            cov_m2=frozen(unpacked(self._packed[:size])),
            kind=self.kind[:size].copy(),
            sightings=self.sightings[:size].copy(),
        )


def unpacked(packed: Array) -> Array:
    """(M, 2, 2) from (M, 3)."""
    return packed[:, [0, 1, 1, 2]].reshape(-1, 2, 2)


class Candidates:
    """Features seen but not yet believed: one list for all particles, in the map at the mean pose."""

    def __init__(self, expire_updates: int) -> None:
        self._expire = expire_updates
        self.xy: Array = np.empty((0, 2))
        self.cov: Array = np.empty((0, 3))
        self.kind: Ints = np.empty(0, np.int64)
        self.count: Ints = np.empty(0, np.int64)
        self._age: Ints = np.empty(0, np.int64)

    def __len__(self) -> int:
        return len(self.kind)

    def merge(self, which: NDArray[np.intp], xy: Array, cov: Array) -> None:
        """Average sightings (M, 2), (M, 3) into the candidates `which`, each weighted by its information."""
        gain_cov = self.cov[which] + cov
        self.xy[which], self.cov[which] = fused(self.xy[which], self.cov[which], xy - self.xy[which], gain_cov)
        self.count[which] += 1
        self._age[which] = 0

    def append(self, xy: Array, cov: Array, kind: Ints) -> None:
        fresh = np.ones(len(kind), np.int64)
        self.xy, self.cov = np.concatenate([self.xy, xy]), np.concatenate([self.cov, cov])
        self.kind, self.count = np.concatenate([self.kind, kind]), np.concatenate([self.count, fresh])
        self._age = np.concatenate([self._age, 0 * fresh])

    def remove(self, which: NDArray[np.intp]) -> None:
        keep = np.ones(len(self), bool)
        keep[which] = False
        self._keep(keep)

    def grow_older(self) -> None:
        """One update has passed: forget the candidates that were not seen for too many."""
        self._age += 1
        self._keep(self._age <= self._expire)

    def _keep(self, keep: NDArray[np.bool_]) -> None:
        self.xy, self.cov, self.kind = self.xy[keep], self.cov[keep], self.kind[keep]
        self.count, self._age = self.count[keep], self._age[keep]


def fused(mean: Array, cov: Array, innovation: Array, innovation_cov: Array) -> tuple[Array, Array]:
    """Kalman update of 2-D points observed directly (H = I); coordinates on axis 1, covariances packed there.

    mean, innovation: (M, 2, ...); cov, innovation_cov = cov + R: (M, 3, ...).
    """
    pxx, pxy, pyy = cov[:, 0], cov[:, 1], cov[:, 2]
    sxx, sxy, syy = innovation_cov[:, 0], innovation_cov[:, 1], innovation_cov[:, 2]
    det = sxx * syy - sxy * sxy
    kxx, kxy = (pxx * syy - pxy * sxy) / det, (pxy * sxx - pxx * sxy) / det
    kyx, kyy = (pxy * syy - pyy * sxy) / det, (pyy * sxx - pxy * sxy) / det
    nx, ny = innovation[:, 0], innovation[:, 1]
    new_mean = mean + np.stack([kxx * nx + kxy * ny, kyx * nx + kyy * ny], axis=1)
    new_cov = cov - np.stack([kxx * pxx + kxy * pxy, kxx * pxy + kxy * pyy, kyx * pxy + kyy * pyy], axis=1)
    return new_mean, new_cov
