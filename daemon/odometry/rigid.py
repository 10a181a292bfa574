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
    """b_from_a (3,), points used (N,), their rms residual, (3, 3) covariance and the variance of one coordinate."""

    b_from_a: Array
    used: Bools
    rms_m: float
    cov: Array
    variance_m2: float

    def with_rotation(self, theta_rad: float, theta_sigma_rad: float) -> RigidFit:
        """This fit with the rotation to report, when the translation was found for its own."""
        cov = self.cov.copy()
        cov[2, 2] = max(theta_sigma_rad**2, cov[2, 2])
        return replace(self, b_from_a=np.array([*self.b_from_a[:2], theta_rad]), cov=cov)


def rigid_motion(a: Array, b: Array) -> Array:
    """(3,) b_from_a with b_i = R a_i + T in the least-squares sense, R a rotation; a, b (N >= 2, 2) metres."""
    a_mean, b_mean = a.mean(axis=0), b.mean(axis=0)  # eq. 9
    da, db = a - a_mean, b - b_mean  # eq. 11
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
) -> RigidFit | None:
    """rigid_motion with the residual rejection and re-estimation of eq. 16; None when too few points remain.

    Args:
        starts: (3,) b_from_a each, other motions to judge the first residuals by than the fit to all points, which
            gross outliers pull; the result that explains the points best is returned, or the first that explains most.
        sigma_m: standard deviation of the points by their own covariances; no residual below a few of it is rejected.
    """
    if len(a) < max(min_points, 2):
        return None
    scale = max(sigma_m, _CORNER_SIGMA_M)
    found: list[RigidFit] = []
    for start in (*starts, None):
        fit = _refined(a, b, rigid_motion(a, b) if start is None else start, sigmas, max_m, min_points, scale)
        if fit is not None:
            found.append(fit)
            if np.count_nonzero(fit.used) >= _CLEAR_FRACTION * len(a):
                break
    return min(found, key=lambda f: _robust_cost(a, b, f.b_from_a, scale)) if found else None


def _robust_cost(a: Array, b: Array, b_from_a: Array, scale_m: float) -> float:
    """Heavy-tailed (Cauchy) cost of all residuals: a few gross ones weigh little, many small ones do."""
    return float(np.sum(np.log1p(np.sum((b - transform(b_from_a, a)) ** 2, axis=1) / scale_m**2)))


def _refined(
    a: Array, b: Array, start: Array, sigmas: float, max_m: float, min_points: int, scale_m: float
) -> RigidFit | None:
    fit, used = start, np.zeros(len(a), bool)
    for _ in range(_MAX_ROUNDS):
        eta = np.hypot(*(b - transform(fit, a)).T)  # eq. 16
        keep = eta < _gate(eta, sigmas, max_m, scale_m)
        if np.count_nonzero(keep) < max(min_points, 2):
            return None
        if np.array_equal(keep, used):
            break
        used = keep
        fit = rigid_motion(a[used], b[used])
    residual = b[used] - transform(fit, a[used])
    if median(np.hypot(residual[:, 0], residual[:, 1])) > max_m:
        return None
    dof = max(2 * len(residual) - _DEGREES_OF_FREEDOM, 1)
    variance = float(np.sum(residual**2)) / dof
    rms = float(np.sqrt(np.mean(np.sum(residual**2, axis=1))))
    return RigidFit(fit, used, rms, _covariance(a[used], fit, variance), variance)


def with_known_rotation(fit: RigidFit, a: Array, b: Array, theta_rad: float, theta_sigma_rad: float) -> RigidFit:
    """The fit with a rotation that is known better than from the points: the translation of eq. 12 for that rotation.

    Crossings of lines hold no more of the rotation than the lines' common direction does. What their residuals seem to
    add is noise, or points of another height, and adds up over a drive; errors of the direction do not.
    """
    centre = rotation(theta_rad) @ a[fit.used].mean(axis=0)
    t = b[fit.used].mean(axis=0) - centre  # eq. 12
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


def _gate(eta: Array, sigmas: float, max_m: float, sigma_m: float) -> float:
    """Largest residual kept: a few sigma of the better half, and never so tight that the better half would go.

    While many outliers still pull the fit, the second rule lets the half that agrees best take it over.
    """
    middle = median(eta)
    return max(min(max_m, sigmas * max(MAD_TO_SIGMA * middle, sigma_m)), _GATE_MEDIANS * middle)


def _covariance(a: Array, fit: Array, variance_m2: float) -> Array:
    """(3, 3) of the fit, from the variance of one coordinate: inverse of the normal matrix of eq. 8."""
    turned = a @ rotation(float(fit[2])).T
    n, (sx, sy) = float(len(a)), turned.sum(axis=0).tolist()
    info = np.array([[n, 0.0, -sy], [0.0, n, sx], [-sy, sx, float(np.vdot(turned, turned))]])
    try:
        return np.asarray(variance_m2 * np.linalg.inv(info))
    except np.linalg.LinAlgError:  # all points in one place: any rotation fits
        return np.asarray(variance_m2 * np.linalg.pinv(info))
