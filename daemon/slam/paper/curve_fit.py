"""Resampling along a curve fitted to the particles' weights (eqs. 21-25), and the systematic kind it falls back to."""

from __future__ import annotations

import numpy as np
from numpy.polynomial.legendre import legval, legvander

from ceilvo.se2 import wrap_array
from ceilvo.types import Array, Ints

BINS = 128
"""Cells of the density that poses are drawn from, over the cloud and its margins; chosen."""
MARGIN = 0.5
"""Standard deviations by which redrawn particles may lie outside the old cloud."""
_FLAT = 1e-12
"""m or rad: a cloud narrower than this has no shape to fit."""


def fit(x: Array, f: Array, degree: int) -> Array:
    """Coefficients a* of eq. 21 in the Legendre basis over [min x, max x], least squares with omega = 1 (eqs. 23-25).

    The degree is lowered where eq. 21's n < m would not hold. x, f: (m,).
    """
    basis = legvander(_unit(x, x), min(degree, len(x) - 1))
    return np.asarray(np.linalg.lstsq(basis, f, rcond=None)[0], np.float64)


def evaluate(coefficients: Array, x: Array, at: Array) -> Array:
    """S* of eq. 21 at `at`, for coefficients fitted over x."""
    return np.asarray(legval(_unit(at, x), coefficients), np.float64)


def _unit(at: Array, x: Array) -> Array:
    low, high = float(np.min(x)), float(np.max(x))
    return (2.0 * at - (low + high)) / max(high - low, _FLAT)


def redraw(poses: Array, weights: Array, degree: int, rng: np.random.Generator) -> tuple[Array, float] | None:
    """As many poses drawn anew from the fitted curves, and the rms residual of eq. 22; None when there is no curve.

    Per axis the curve S* over the scaled coordinate u estimates likelihood against position; times the cloud's own
    Gaussian it is the posterior's density. Poses (N, 3) must have carried equal weights before the likelihood.
    """
    centre = _centre(poses)
    offset = np.column_stack([poses[:, :2] - centre[:2], wrap_array(poses[:, 2] - centre[2])])
    scale = np.std(offset, axis=0)
    f = len(poses) * weights
    if not np.all(np.isfinite(f)) or not np.any(scale > _FLAT):
        return None
    drawn = np.tile(centre, (len(poses), 1))
    residuals = []
    for axis in range(3):
        if not scale[axis] > _FLAT:
            continue  # nothing to fit: every particle stands on the centre
        u = offset[:, axis] / scale[axis]
        a = fit(u, f, degree)
        new = _draw(a, u, rng)
        if new is None:
            return None
        residuals.append(evaluate(a, u, u) - f)  # eq. 22
        drawn[:, axis] += scale[axis] * new
    drawn[:, 2] = wrap_array(drawn[:, 2])
    return drawn, float(np.sqrt(np.mean(np.square(residuals))))


def _centre(poses: Array) -> Array:
    c, s = np.mean(np.cos(poses[:, 2])), np.mean(np.sin(poses[:, 2]))
    return np.array([np.mean(poses[:, 0]), np.mean(poses[:, 1]), np.arctan2(s, c)])


def _draw(coefficients: Array, u: Array, rng: np.random.Generator) -> Array | None:
    """Stratified inverse-CDF draws from max(S*, 0) exp(-u^2 / 2), in random order."""
    edges = np.linspace(np.min(u) - MARGIN, np.max(u) + MARGIN, BINS + 1)
    middle = 0.5 * (edges[1:] + edges[:-1])
    density = np.maximum(evaluate(coefficients, u, middle), 0.0) * np.exp(-0.5 * middle**2)
    cdf = np.concatenate([[0.0], np.cumsum(density)])
    if not np.isfinite(cdf[-1]) or cdf[-1] <= 0.0:
        return None
    strata = (rng.permutation(len(u)) + rng.random(len(u))) / len(u)
    return np.interp(strata, cdf / cdf[-1], edges)


def nearest(poses: Array, ancestors: Array, scale: Array, block: int = 1024) -> Ints:
    """(N,) index of the ancestor nearest to each pose, (N, 3) and (M, 3), axes divided by scale (3,)."""
    p, a = poses - ancestors[0], ancestors - ancestors[0]
    p[:, 2], a[:, 2] = wrap_array(p[:, 2]), wrap_array(a[:, 2])
    wide = max(np.max(p[:, 2]), np.max(a[:, 2])) - min(np.min(p[:, 2]), np.min(a[:, 2])) >= np.pi
    p, a = p / scale, a / scale
    half, out = 0.5 * np.sum(a * a, axis=1), np.empty(len(poses), np.int64)
    for start in range(0, len(poses), block):
        part = p[start : start + block]
        near = half - part @ a.T
        if wide:  # the shorter way round
            d = part[:, None, 2] - a[None, :, 2]
            near += 0.5 * ((wrap_array(d * scale[2]) / scale[2]) ** 2 - d * d)
        out[start : start + block] = np.argmin(near, axis=1)
    return out
