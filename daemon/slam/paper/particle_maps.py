"""One landmark map per particle, and the candidates from which landmarks are born."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from ceilvo.daemon.odometry.matching import mutual_nearest
from ceilvo.daemon.slam.association import CANDIDATE_GATE_CHI2
from ceilvo.daemon.slam.spatial_index import unpacked
from ceilvo.se2 import rotation
from ceilvo.types import Array, Ints, Landmarks, frozen

_CHUNK = 64
"""Landmarks that arrays grow by at least; chosen."""
_REFRESH = 64
"""Landmarks out of view whose summary is renewed per update, so that its cost does not grow with the map."""
LOG_2PI = float(np.log(2.0 * np.pi))


@dataclass(slots=True)
class ParticleMaps:
    """Means and covariances of every landmark in every particle's map.

    Landmark-major, so that the landmarks in view are contiguous. Resampling does not copy maps: `row` says which column
    holds a particle's version, and a landmark is put in order when it is next written. Arrays have room for more than
    `size` landmarks.

    Attributes:
        ids, crossing_type, sightings: (L,) as in Landmarks.
        mean, cov: (L, 2, N) and (L, 3, N) packed xx, xy, yy.
        row: (L, N).
        xy, packed: (L, 2) and (L, 3), the summary over the particles.
        size: landmarks there are.
        next_id: for the next landmark.
        turn: where the next renewal of the summary begins.
    """

    ids: Ints
    crossing_type: Ints
    sightings: Ints
    mean: Array
    cov: Array
    row: NDArray[np.int32]
    xy: Array
    packed: Array
    size: int = 0
    next_id: int = 0
    turn: int = 0

    @staticmethod
    def of(particles: int) -> ParticleMaps:
        """Empty maps."""
        none, n = np.empty(0, np.int64), particles
        mean, cov, row = np.empty((0, 2, n)), np.empty((0, 3, n)), np.empty((0, n), np.int32)
        return ParticleMaps(none, none, none, mean, cov, row, np.empty((0, 2)), np.empty((0, 3)))

    def __len__(self) -> int:
        return self.size

    def gather(self, labels: Ints) -> tuple[Array, Array]:
        """(K, 2, N) means and (K, 3, N) covariances of the landmarks `labels`."""
        row = self.row[labels][:, None, :]
        return (
            np.take_along_axis(self.mean[labels], row, axis=2),
            np.take_along_axis(self.cov[labels], row, axis=2),
        )

    def scatter(self, labels: Ints, mean: Array, cov: Array) -> None:
        """Write back what gather() gave; labels must be distinct."""
        self.mean[labels], self.cov[labels] = mean, cov
        self.row[labels] = np.arange(self.row.shape[1], dtype=np.int32)

    def add(self, mean: Array, cov: Array, kind: Ints, sightings: Ints, ids: Ints | None = None) -> Ints:
        """Append landmarks (M, 2, N), (M, 3, N) and return their labels (M,)."""
        labels = self.size + np.arange(len(kind))
        self.size += len(kind)
        if self.size > len(self.ids):
            self._grow(max(_CHUNK, self.size // 2, len(kind)))
        self.ids[labels] = self.next_id + np.arange(len(kind)) if ids is None else ids
        self.next_id = max(self.next_id, int(np.max(self.ids[labels], initial=-1)) + 1)
        self.crossing_type[labels], self.sightings[labels] = kind, sightings
        self.scatter(labels, mean, cov)
        return labels

    def _grow(self, more: int) -> None:
        n = self.row.shape[1]
        blank = np.zeros(more, np.int64)
        self.ids = np.concatenate([self.ids, blank])
        self.crossing_type = np.concatenate([self.crossing_type, blank])
        self.sightings = np.concatenate([self.sightings, blank])
        self.mean = np.concatenate([self.mean, np.zeros((more, 2, n))])
        self.cov = np.concatenate([self.cov, np.zeros((more, 3, n))])
        self.row = np.concatenate([self.row, np.zeros((more, n), np.int32)])
        self.xy = np.concatenate([self.xy, np.zeros((more, 2))])
        self.packed = np.concatenate([self.packed, np.zeros((more, 3))])

    def forget(self, ids: Ints) -> None:
        """Drop landmarks by their ids; the order of the others stays."""
        keep = np.flatnonzero(~np.isin(self.ids[: self.size], ids))
        if len(keep) == self.size:
            return
        self.size, self.turn = len(keep), 0
        for name in ("ids", "crossing_type", "sightings", "mean", "cov", "row", "xy", "packed"):
            setattr(self, name, getattr(self, name)[keep])

    def resample(self, ancestors: Ints) -> None:
        """Particle i goes on with the map of particle ancestors[i]."""
        self.row[: self.size] = self.row[: self.size, ancestors]

    def refresh(self, weights: Array, labels: Ints, learnt_from: int = 0) -> None:
        """Renew the summary of the landmarks `labels`, and of the next few in turn, for changed weights.

        That of landmarks with ids below learnt_from waits.
        """
        if not self.size:
            return
        turn = (self.turn + np.arange(min(_REFRESH, self.size))) % self.size
        self.turn = int((self.turn + len(turn)) % self.size)
        labels = np.union1d(labels, turn)
        labels = labels[self.ids[labels] >= learnt_from]
        mean, cov = self.gather(labels)
        xy = mean @ weights
        x, y = mean[:, 0] - xy[:, :1], mean[:, 1] - xy[:, 1:]
        self.xy[labels] = xy
        self.packed[labels] = cov @ weights + np.stack([x * x, x * y, y * y], axis=1) @ weights

    def summary(self) -> Landmarks:
        """Means over the particles; covariance = mean of theirs + spread of their means, as of the last refresh."""
        size = self.size
        return Landmarks(
            ids=self.ids[:size].copy(),
            xy_map_m=frozen(self.xy[:size].copy()),
            cov_m2=frozen(unpacked(self.packed[:size])),
            crossing_type=self.crossing_type[:size].copy(),
            sightings=self.sightings[:size].copy(),
        )


@dataclass(slots=True)
class Candidates:
    """Features seen but not yet believed: one list for all particles, in the map at the mean pose.

    Attributes:
        expire_updates: a candidate not seen for so many is forgotten.
        xy, cov: (C, 2) and (C, 3) packed.
        crossing_type, count, age: (C,) type of crossing, sightings, updates since the last.
    """

    expire_updates: int
    xy: Array = field(default_factory=lambda: np.empty((0, 2)))
    cov: Array = field(default_factory=lambda: np.empty((0, 3)))
    crossing_type: Ints = field(default_factory=lambda: np.empty(0, np.int64))
    count: Ints = field(default_factory=lambda: np.empty(0, np.int64))
    age: Ints = field(default_factory=lambda: np.empty(0, np.int64))

    def __len__(self) -> int:
        return len(self.crossing_type)

    def sight(self, xy: Array, cov: Array, kind: Ints, gate_m: float) -> tuple[Ints, Ints]:
        """Take sightings (M, 2), (M, 3) of types (M,); in another order (M,) of them, the candidates they are of."""
        seen, which = mutual_nearest(xy, kind, self.xy, self.crossing_type, gate_m)
        off = mahalanobis(xy[seen] - self.xy[which], cov[seen] + self.cov[which])
        seen, which = seen[off <= CANDIDATE_GATE_CHI2], which[off <= CANDIDATE_GATE_CHI2]
        first = np.setdiff1d(np.arange(len(kind)), seen)
        self.merge(which, xy[seen], cov[seen])
        self.append(xy[first], cov[first], kind[first])
        new = np.arange(len(self) - len(first), len(self))
        return np.concatenate([seen, first]), np.concatenate([which, new])

    def merge(self, which: NDArray[np.intp], xy: Array, cov: Array) -> None:
        """Average sightings (M, 2), (M, 3) into the candidates `which`, each weighted by its information."""
        gain_cov = self.cov[which] + cov
        self.xy[which], self.cov[which] = fused(self.xy[which], self.cov[which], xy - self.xy[which], gain_cov)
        self.count[which] += 1
        self.age[which] = 0

    def append(self, xy: Array, cov: Array, kind: Ints) -> None:
        fresh = np.ones(len(kind), np.int64)
        self.xy, self.cov = np.concatenate([self.xy, xy]), np.concatenate([self.cov, cov])
        self.crossing_type, self.count = np.concatenate([self.crossing_type, kind]), np.concatenate([self.count, fresh])
        self.age = np.concatenate([self.age, 0 * fresh])

    def remove(self, which: NDArray[np.intp]) -> None:
        keep = np.ones(len(self), bool)
        keep[which] = False
        self._keep(keep)

    def grow_older(self) -> None:
        """One update has passed: forget the candidates that were not seen for too many."""
        self.age += 1
        self._keep(self.age <= self.expire_updates)

    def _keep(self, keep: NDArray[np.bool_]) -> None:
        self.xy, self.cov, self.crossing_type = self.xy[keep], self.cov[keep], self.crossing_type[keep]
        self.count, self.age = self.count[keep], self.age[keep]


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


def turned(var: Array, theta: float) -> Array:
    """(M, 3) packed covariances in map from (M, 2) variances in base."""
    r = rotation(theta)
    return np.column_stack([var @ (r[0] ** 2), var @ (r[0] * r[1]), var @ (r[1] ** 2)])


def gaussian_log(innovation: Array, cov: Array) -> Array:
    """log N(innovation; 0, cov): (K, 2, ...) and packed (K, 3, ...) to (K, ...)."""
    det = cov[:, 0] * cov[:, 2] - cov[:, 1] * cov[:, 1]
    return np.asarray(-0.5 * (mahalanobis(innovation, cov) + np.log(det)) - LOG_2PI, np.float64)


def mahalanobis(innovation: Array, cov: Array) -> Array:
    """Squared: (K, 2, ...) and packed (K, 3, ...) to (K, ...)."""
    x, y = innovation[:, 0], innovation[:, 1]
    xx, xy, yy = cov[:, 0], cov[:, 1], cov[:, 2]
    return np.asarray((yy * x * x - 2.0 * xy * x * y + xx * y * y) / (xx * yy - xy * xy), np.float64)
