"""Planar motion between two matched point sets by constrained least squares (eqs. 8-16)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ceilvo.se2 import rotation, transform

Array = NDArray[np.float64]
Bools = NDArray[np.bool_]

_ROUNDS = 10
_HALF = 1.2
_CORNER_SIGMA_M = 0.0005


@dataclass(frozen=True, slots=True)
class RigidFit:
    """b_from_a (3,), which points were used (N,), their rms residual and the (3, 3) covariance."""

    b_from_a: Array
    used: Bools
    rms_m: float
    cov: Array


def rigid_motion(a: Array, b: Array) -> Array:
    """(3,) b_from_a with b_i = R a_i + T in the least-squares sense, R a rotation; a, b (N >= 2, 2) metres."""
    a_mean, b_mean = a.mean(axis=0), b.mean(axis=0)  # eq. 9
    da, db = a - a_mean, b - b_mean  # eq. 11
    sine = float(np.sum(da[:, 0] * db[:, 1] - da[:, 1] * db[:, 0]))
    cosine = float(np.sum(da * db))
    theta = float(np.arctan2(sine, cosine))  # eq. 15, in the right quadrant
    t = b_mean - rotation(theta) @ a_mean  # eq. 12
    return np.array([t[0], t[1], theta])


def robust_rigid_motion(a: Array, b: Array, sigmas: float, max_m: float, min_points: int) -> RigidFit | None:
    """rigid_motion with the residual rejection and re-estimation of eq. 16; None when too few points remain."""
    used = np.ones(len(a), bool)
    for _ in range(_ROUNDS):
        if np.count_nonzero(used) < max(min_points, 2):
            return None
        eta = np.hypot(*(b - transform(rigid_motion(a[used], b[used]), a)).T)  # eq. 16
        keep = eta < _gate(eta, sigmas, max_m)
        if np.array_equal(keep, used):
            break
        used = keep
    else:
        used &= eta < max_m
    if np.count_nonzero(used) < max(min_points, 2):
        return None
    fit = rigid_motion(a[used], b[used])
    if np.median(np.hypot(*(b[used] - transform(fit, a[used])).T)) > max_m:
        return None
    residual = b[used] - transform(fit, a[used])
    dof = max(2 * len(residual) - 3, 1)
    variance = float(np.sum(residual**2)) / dof
    return RigidFit(
        fit, used, float(np.sqrt(np.mean(np.sum(residual**2, axis=1)))), _covariance(a[used], fit, variance)
    )


def _gate(eta: Array, sigmas: float, max_m: float) -> float:
    """Largest residual kept: a few sigma of the better half, and never so tight that the better half would go.

    While many outliers still pull the fit, the second rule lets the half that agrees best take it over.
    """
    median = float(np.median(eta))
    return max(min(max_m, sigmas * max(1.4826 * median, _CORNER_SIGMA_M)), _HALF * median)


def _covariance(a: Array, fit: Array, variance: float) -> Array:
    turned = a @ rotation(float(fit[2])).T
    jac = np.zeros((2 * len(a), 3))
    jac[0::2, 0] = jac[1::2, 1] = 1.0
    jac[0::2, 2], jac[1::2, 2] = -turned[:, 1], turned[:, 0]
    return np.asarray(variance * np.linalg.pinv(jac.T @ jac))
