"""A log-quadratic curve through the particles' weights: the least squares of eqs. 21-25 on ln w, all axes together.

f = exp(S*), S* = a0 + b'u + u'Hu / 2 with ten coefficients: a curve that is a Gaussian, so that it can be narrower than
the cloud and lie outside it.
"""

from __future__ import annotations

import numpy as np

from ceilvo.types import Array

RIDGE = 0.003
"""Of the mean diagonal of the normal equations; chosen: keeps ten coefficients of few effective draws finite."""
STEEPEST = 1e6
FLATTEST = 0.5
"""Bounds of the posterior's precision over the proposal's."""
_PAIRS = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))
_I = np.array([p[0] for p in _PAIRS])
_J = np.array([p[1] for p in _PAIRS])
_FACTOR = np.where(_I == _J, 0.5, 1.0)


def fit(u: Array, log_f: Array) -> tuple[Array, Array, float] | None:
    """Gradient b (3,) and Hessian H (3, 3) at u = 0 of the curve through log_f (N,) at whitened u (N, 3).

    Weighted by omega = sqrt(f), with a ridge on all but the intercept. The third is the rms residual of eq. 22 in f,
    relative to the largest. None when there is nothing to fit.
    """
    top = float(np.max(log_f, initial=-np.inf))
    if len(u) < 10 or not np.isfinite(top):
        return None
    log_f = np.maximum(log_f - top, -60.0)
    omega = np.exp(0.5 * log_f)
    basis = np.empty((len(u), 10))
    basis[:, 0], basis[:, 1:4], basis[:, 4:] = 1.0, u, u[:, _I] * u[:, _J]
    weighted = basis.T * omega
    gram = weighted @ basis  # eq. 25
    ridge = RIDGE * np.trace(gram) / 10.0
    gram[np.arange(1, 10), np.arange(1, 10)] += ridge
    a = np.linalg.solve(gram, weighted @ log_f)
    if not np.all(np.isfinite(a)):
        return None
    h = np.empty((3, 3))
    h[_I, _J] = h[_J, _I] = a[4:] / _FACTOR
    residual = np.exp(np.minimum(basis @ a, 1.0)) - np.exp(log_f)
    return a[1:4], h, float(np.sqrt(np.mean(residual * residual)))


def posterior(centre: Array, root: Array, b: Array, h: Array) -> tuple[Array, Array]:
    """Mean (3,) and root (3, 3) of the product of the proposal N(centre, root root') and the curve."""
    values, vectors = np.linalg.eigh(np.eye(3) - h)
    values = np.clip(values, FLATTEST, STEEPEST)
    step = vectors @ ((vectors.T @ b) / values)
    return centre + root @ step, root @ (vectors / np.sqrt(values))
