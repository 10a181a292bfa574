"""Anchors as they are known: places, and what their ranges are off by, which is learnt while the pose is sure."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from ceilvo.daemon.relocalisation.beacons.range_errors import direct_share
from ceilvo.senses.beacons import Anchor
from ceilvo.types import Array, Ints

OFFSET_MOST_M, SCALE_MOST = 1.0, 0.02
"""Bounds of what is learnt; chosen: an antenna delay that was never set is off by half a metre, a module's clock by
20 ppm and its bias with distance by 1 %."""
BIAS_M = 0.05
"""Standard deviation of what offset and scale leave of an anchor's error at one place: it changes with distance and
direction, and standing does not average it out; chosen: Decawave's APS011 has 4 cm around its curve."""
NOISE_LEAST_M, NOISE_MOST_M = 0.03, 0.5
"""Bounds of the noise that is learnt."""
_NOISE_RATE = 0.01
"""Of the variance, that a range changes it by; chosen: a hundred ranges, ten seconds."""
_LEARN_M = 0.25
"""Way between two ranges of an anchor that teach its offset: nearer ones err alike; chosen."""
_DIRECT = 0.5
"""A range teaches where it came straight with this probability at least; chosen."""


@dataclass(slots=True)
class AnchorTable:
    """A anchors.

    Attributes:
        names: as modules say them.
        xyz_m: (A, 3), x and y in map, z above the floor.
        sigma_m: (A,) of the position.
        fit: (A, 2) offset in m and scale; cov: (A, 2, 2) of them.
        noise_m: standard deviation of one direct range.
        taught_at: (A, 2) where the tag was when each was taught last, nan before.
    """

    names: list[str] = field(default_factory=list)
    xyz_m: Array = field(default_factory=lambda: np.empty((0, 3)))
    sigma_m: Array = field(default_factory=lambda: np.empty(0))
    fit: Array = field(default_factory=lambda: np.empty((0, 2)))
    cov: Array = field(default_factory=lambda: np.empty((0, 2, 2)))
    noise_m: float = 0.1
    taught_at: Array = field(default_factory=lambda: np.empty((0, 2)))

    @staticmethod
    def of(anchors: tuple[Anchor, ...], noise_m: float) -> AnchorTable:
        """noise_m: what to begin with."""
        n = len(anchors)
        cov = np.zeros((n, 2, 2))
        cov[:, 0, 0] = [a.offset_sigma_m**2 for a in anchors]
        cov[:, 1, 1] = [a.scale_sigma**2 for a in anchors]
        return AnchorTable(
            [a.name for a in anchors],
            np.array([(a.x_m, a.y_m, a.z_m) for a in anchors], np.float64).reshape(n, 3),
            np.array([a.sigma_m for a in anchors], np.float64),
            np.array([(a.offset_m, a.scale) for a in anchors], np.float64).reshape(n, 2),
            cov,
            noise_m,
            np.full((n, 2), np.nan),
        )

    def anchors(self) -> tuple[Anchor, ...]:
        """As a file has them, with what was learnt."""
        sigma = np.sqrt(np.maximum(np.diagonal(self.cov, axis1=1, axis2=2), 0.0))
        return tuple(
            Anchor(n, x, y, z, float(s), float(f[0]), float(o[0]), float(f[1]), float(o[1]))
            for n, (x, y, z), s, f, o in zip(
                self.names, self.xyz_m.tolist(), self.sigma_m, self.fit, sigma, strict=True
            )
        )

    def distances(self, which: Ints, xy_m: Array, z_m: float) -> tuple[Array, Array]:
        """(..., N) distances and (..., N, 2) unit vectors in the plane from anchors (N,) to tags (..., N, 2)."""
        off = xy_m - self.xyz_m[which, :2]
        flat2 = off[..., 0] ** 2 + off[..., 1] ** 2
        d = np.sqrt(flat2 + (self.xyz_m[which, 2] - z_m) ** 2)
        return d, off / np.maximum(d, 1e-6)[..., None]

    def expected(self, which: Ints, distance_m: Array) -> Array:
        """What ranges to anchors (N,) read at distances (..., N)."""
        return np.asarray(self.fit[which, 0] + (1.0 + self.fit[which, 1]) * distance_m)

    def bias_sigma(self, which: Ints, distance_m: Array) -> Array:
        """(..., N) standard deviations of what stays the same at one place: offset, scale, position and the rest."""
        c = self.cov[which]
        var = c[:, 0, 0] + 2.0 * c[:, 0, 1] * distance_m + c[:, 1, 1] * distance_m**2
        return np.sqrt(np.maximum(var, 0.0) + self.sigma_m[which] ** 2 + BIAS_M**2)

    def learn(self, which: Ints, xy_m: Array, z_m: float, range_m: Array) -> None:
        """Ranges (N,) from tags (N, 2) whose place is sure."""
        d, _ = self.distances(which, xy_m, z_m)
        error = range_m - self.expected(which, d)
        spread = np.sqrt(self.noise_m**2 + self.bias_sigma(which, d) ** 2)
        direct = direct_share(error, spread)
        for i in np.flatnonzero(direct >= _DIRECT).tolist():
            a = int(which[i])
            if float(np.hypot(*(xy_m[i] - self.taught_at[a]))) < _LEARN_M:
                continue
            self.taught_at[a] = xy_m[i]
            self._teach(a, float(d[i]), float(error[i]))

    def _teach(self, a: int, distance_m: float, error_m: float) -> None:
        """Kalman's update of offset and scale, within bounds."""
        h = np.array([1.0, distance_m])
        cross = self.cov[a] @ h
        total = float(h @ cross) + self.noise_m**2 + BIAS_M**2
        self.fit[a] += cross * (error_m / total)
        self.cov[a] -= np.outer(cross, cross) / total
        self.fit[a] = np.clip(self.fit[a], [-OFFSET_MOST_M, -SCALE_MOST], [OFFSET_MOST_M, SCALE_MOST])
        after = error_m * (1.0 - float(h @ cross) / total)
        var = self.noise_m**2 + _NOISE_RATE * (after * after - self.noise_m**2 - BIAS_M**2)
        self.noise_m = float(np.sqrt(np.clip(var, NOISE_LEAST_M**2, NOISE_MOST_M**2)))
