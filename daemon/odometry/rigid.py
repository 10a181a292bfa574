"""Planar motion between two matched point sets by constrained least squares (eqs. 8-16)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ceilvo.robust import MAD_TO_SIGMA, median
from ceilvo.se2 import rotation, transform

Array = NDArray[np.float64]
Bools = NDArray[np.bool_]

_MAX_ROUNDS = 10
"""Of rejection and estimation again; chosen; it ends once the kept points stay the same."""
_GATE_MEDIANS = 1.2
"""Least gate in median residuals; chosen: above 1, so that the better half is always kept."""
_CLEAR_FRACTION = 0.8
"""A fit that uses this fraction of the points is not compared with others; chosen: saves time."""
_CORNER_SIGMA_M = 0.0005
"""Least error of a crossing that residuals are measured in; chosen: .14 px (p95, docs/bench.md) and more."""
_DEGREES_OF_FREEDOM = 3
"""Of a planar motion."""


@dataclass(frozen=True, slots=True)
class RigidFit:
    """b_from_a (3,), points used (N,), their rms residual, (3, 3) covariance and the variance of one coordinate.

    Attributes:
        weight: (N,) of the points, 1 / m^2; None where all weigh the same.
    """

    b_from_a: Array
    used: Bools
    rms_m: float
    cov: Array
    variance_m2: float
    weight: Array | None = None

    def middle(self, points: Array) -> Array:
        """(2,) centroid of the points (N, 2) that are used."""
        if self.weight is None:
            return np.asarray(points[self.used].mean(axis=0))
        return np.asarray(np.average(points[self.used], axis=0, weights=self.weight[self.used]))

    def with_rotation(self, theta_rad: float, theta_sigma_rad: float) -> RigidFit:
        """This fit with the rotation to report, when the translation was found for its own."""
        cov = self.cov.copy()
        cov[2, 2] = max(theta_sigma_rad**2, cov[2, 2])
        return replace(self, b_from_a=np.array([*self.b_from_a[:2], theta_rad]), cov=cov)


def rigid_motion(a: Array, b: Array, weight: Array | None = None) -> Array:
    """(3,) b_from_a with b_i = R a_i + T in the least-squares sense, R a rotation; a, b (N >= 2, 2) metres.

    Args:
        weight: (N,); None: all alike.
    """
    if weight is None:
        a_mean, b_mean = a.mean(axis=0), b.mean(axis=0)  # eq. 9
        da, db = a - a_mean, b - b_mean  # eq. 11
    else:
        a_mean, b_mean = (np.average(p, axis=0, weights=weight) for p in (a, b))
        da, db = (a - a_mean) * weight[:, None], b - b_mean
    sine = float(np.sum(da[:, 0] * db[:, 1] - da[:, 1] * db[:, 0]))
    cosine = float(np.sum(da * db))
    theta = float(np.arctan2(sine, cosine))  # eq. 15: the minimum of eq. 14, in the right quadrant
    t = b_mean - rotation(theta) @ a_mean  # eqs. 10, 12
    return np.array([t[0], t[1], theta])


def robust_rigid_motion(
    a: Array,
    b: Array,
    sigmas: float,
    max_m: float,
    min_points: int,
    starts: Sequence[Array] = (),
    sigma_m: float = 0.0,
    own_sigma_m: Array | None = None,
) -> RigidFit | None:
    """rigid_motion with the residual rejection and re-estimation of eq. 16; None when too few points remain.

    Args:
        starts: (3,) b_from_a each, other motions to judge the first residuals by than the fit to all points, which
            gross outliers pull; the result that explains the points best is returned, or the first that explains
            most.
        sigma_m: standard deviation of the points by their own covariances; no residual below a few of it is rejected.
        own_sigma_m: (N,) of points that are not alike: they weigh as much as that says, none is rejected within a few
            of its own, and the fit is no surer than they are, however well a few fit; None: they are alike.
    """
    if len(a) < max(min_points, 2):
        return None
    scale = max(sigma_m, _CORNER_SIGMA_M)
    gate = _Gate(sigmas, max_m, scale, own_sigma_m)
    weight = None if own_sigma_m is None else 1.0 / np.maximum(own_sigma_m, _CORNER_SIGMA_M) ** 2
    found: list[RigidFit] = []
    for start in (*starts, None):
        fit = _refined(a, b, rigid_motion(a, b, weight) if start is None else start, gate, min_points, weight)
        if fit is not None:
            found.append(fit)
            if np.count_nonzero(fit.used) >= _CLEAR_FRACTION * len(a):
                break
    return min(found, key=lambda f: _robust_cost(a, b, f.b_from_a, scale)) if found else None


def _robust_cost(a: Array, b: Array, b_from_a: Array, scale_m: float) -> float:
    """Heavy-tailed (Cauchy) cost of all residuals: a few gross ones weigh little, many small ones do."""
    return float(np.sum(np.log1p(np.sum((b - transform(b_from_a, a)) ** 2, axis=1) / scale_m**2)))


@dataclass(frozen=True, slots=True)
class _Gate:
    """Residuals kept, see robust_rigid_motion."""

    sigmas: float
    max_m: float
    sigma_m: float
    own_sigma_m: Array | None

    def keeps(self, eta: Array) -> Bools:
        """(N,) which residuals are kept: a few sigma of the better half, and never so tight that that would go.

        While many outliers still pull the fit, the second rule lets the half that agrees best take it over.
        """
        middle = median(eta)
        usual = self.sigmas * max(MAD_TO_SIGMA * middle, self.sigma_m)
        gate = max(min(self.max_m, usual), _GATE_MEDIANS * middle)
        return eta < (gate if self.own_sigma_m is None else np.maximum(gate, self.sigmas * self.own_sigma_m))

    def fits(self, eta: Array, used: Bools) -> bool:
        """Whether the better half of the residuals that were kept are small."""
        if self.own_sigma_m is None:
            return median(eta) <= self.max_m
        return median(eta / self.own_sigma_m[used]) <= max(self.sigmas, self.max_m / median(self.own_sigma_m[used]))


def _refined(a: Array, b: Array, start: Array, gate: _Gate, min_points: int, weight: Array | None) -> RigidFit | None:
    fit, used = start, np.zeros(len(a), bool)
    for _ in range(_MAX_ROUNDS):
        eta = np.hypot(*(b - transform(fit, a)).T)  # eq. 16
        keep = gate.keeps(eta)
        if np.count_nonzero(keep) < max(min_points, 2):
            return None
        if np.array_equal(keep, used):
            break
        used = keep
        fit = rigid_motion(a[used], b[used], None if weight is None else weight[used])
    residual = b[used] - transform(fit, a[used])
    if not gate.fits(np.hypot(residual[:, 0], residual[:, 1]), used):
        return None
    dof = max(2 * len(residual) - _DEGREES_OF_FREEDOM, 1)
    rms = float(np.sqrt(np.mean(np.sum(residual**2, axis=1))))
    if weight is None:
        variance = float(np.sum(residual**2)) / dof
        return RigidFit(fit, used, rms, _covariance(a[used], fit, variance), variance)
    w = weight[used]
    worse = max(float(w @ np.sum(residual**2, axis=1)) / dof, 1.0)
    return RigidFit(fit, used, rms, _covariance(a[used], fit, worse, w), worse * len(w) / float(np.sum(w)), weight)


def with_known_rotation(fit: RigidFit, a: Array, b: Array, theta_rad: float, theta_sigma_rad: float) -> RigidFit:
    """The fit with a rotation that is known better than from the points: the translation of eq. 12 for that rotation.

    Crossings of lines hold no more of the rotation than the lines' common direction does. What their residuals seem to
    add is noise, or points of another height, and adds up over a drive; errors of the direction do not.
    """
    centre = rotation(theta_rad) @ fit.middle(a)
    t = fit.middle(b) - centre  # eq. 12
    n = max(int(np.count_nonzero(fit.used)), 1)
    lever = np.array([centre[1], -centre[0], 1.0])
    cov = theta_sigma_rad**2 * np.outer(lever, lever)
    cov[[0, 1], [0, 1]] += fit.variance_m2 / n
    return RigidFit(np.array([t[0], t[1], theta_rad]), fit.used, fit.rms_m, cov, fit.variance_m2)


def median_translation(a: Array, b: Array, theta_rad: float, axis_rad: float) -> Array:
    """(3,) b_from_a when its rotation is known: medians of the displacements along and across the ceiling's lines.

    A line that was taken for its neighbour displaces all its crossings across itself and none along, so each of the
    two medians holds while more than half of the crossings are right in that one direction.
    """
    to_axes = rotation(-axis_rad)
    off = (b - a @ rotation(theta_rad).T) @ to_axes.T
    t = to_axes.T @ np.median(off, axis=0)
    return np.array([t[0], t[1], theta_rad])


def _covariance(a: Array, fit: Array, variance_m2: float, weight: Array | None = None) -> Array:
    """(3, 3) of the fit, from the variance of one coordinate: inverse of the normal matrix of eq. 8.

    Args:
        weight: (N,) of the points; variance_m2 is then of a point of weight 1.
    """
    turned = a @ rotation(float(fit[2])).T
    weighted, n = (turned, float(len(a))) if weight is None else (turned * weight[:, None], float(np.sum(weight)))
    sx, sy = weighted.sum(axis=0).tolist()
    info = np.array([[n, 0.0, -sy], [0.0, n, sx], [-sy, sx, float(np.vdot(turned, weighted))]])
    try:
        return np.asarray(variance_m2 * np.linalg.inv(info))
    except np.linalg.LinAlgError:  # all points in one place: any rotation fits
        return np.asarray(variance_m2 * np.linalg.pinv(info))
