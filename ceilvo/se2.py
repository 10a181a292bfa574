"""Planar rigid motions as arrays [x m, y m, theta rad]; `a_from_b` maps coordinates in b to coordinates in a."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

_ROUNDING = 1e-9
"""Of a covariance's largest entry, that its symmetry and its smallest eigenvalue may be off by."""


def wrap(angle_rad: float) -> float:
    """Angle in [-pi, pi)."""
    return (float(angle_rad) + math.pi) % (2.0 * math.pi) - math.pi


def wrap_array(angle_rad: Array) -> Array:
    """Angles in [-pi, pi), any shape, a new array."""
    return np.asarray((angle_rad + np.pi) % (2.0 * np.pi) - np.pi, dtype=np.float64)


def rotation(theta_rad: float) -> Array:
    """(2, 2) rotation matrix of eq. 13."""
    c, s = math.cos(theta_rad), math.sin(theta_rad)
    return np.array([[c, -s], [s, c]])


def compose(a_from_b: Array, b_from_c: Array) -> Array:
    """a_from_c; either argument may be (..., 3) and they broadcast."""
    a, b = np.asarray(a_from_b, np.float64), np.asarray(b_from_c, np.float64)
    if a.ndim == 1 and b.ndim == 1:
        return _compose_one(a, b)
    c, s = np.cos(a[..., 2]), np.sin(a[..., 2])
    out = np.empty(np.broadcast_shapes(a.shape, b.shape))
    out[..., 0] = a[..., 0] + c * b[..., 0] - s * b[..., 1]
    out[..., 1] = a[..., 1] + s * b[..., 0] + c * b[..., 1]
    out[..., 2] = wrap_array(a[..., 2] + b[..., 2])
    return out


def _compose_one(a_from_b: Array, b_from_c: Array) -> Array:
    """As compose; plain numbers are several times faster than arrays of three."""
    (x0, y0, turn0), (x1, y1, turn1) = a_from_b.tolist(), b_from_c.tolist()
    c, s = math.cos(turn0), math.sin(turn0)
    return np.array([x0 + c * x1 - s * y1, y0 + s * x1 + c * y1, wrap(turn0 + turn1)])


def inverse(a_from_b: Array) -> Array:
    """b_from_a, shape (..., 3)."""
    a = np.asarray(a_from_b, np.float64)
    if a.ndim == 1:
        x, y, turn = a.tolist()
        cosine, sine = math.cos(turn), math.sin(turn)
        return np.array([-cosine * x - sine * y, sine * x - cosine * y, wrap(-turn)])
    c, s = np.cos(a[..., 2]), np.sin(a[..., 2])
    out = np.empty_like(a)
    out[..., 0] = -c * a[..., 0] - s * a[..., 1]
    out[..., 1] = s * a[..., 0] - c * a[..., 1]
    out[..., 2] = wrap_array(-a[..., 2])
    return out


def between(a_from_b: Array, a_from_c: Array) -> Array:
    """b_from_c."""
    return compose(inverse(a_from_b), a_from_c)


def driven(twist: Array, duration_s: Array) -> Array:
    """(N, 3) start_from_end after (N,) seconds at a constant twist (3,) [m/s, m/s, rad/s]."""
    t = np.asarray(duration_s, np.float64)
    turn = twist[2] * t
    half = 0.5 * turn
    chord = t * np.sinc(half / np.pi)  # of an arc, over the speed
    c, s = np.cos(half), np.sin(half)
    return np.column_stack([chord * (c * twist[0] - s * twist[1]), chord * (s * twist[0] + c * twist[1]), turn])


def mean_twist(start_from_end: Array, duration_s: float) -> Array:
    """(3,) the constant twist that drives start_from_end (3,) in so many seconds; the inverse of driven()."""
    x, y, turn = start_from_end.tolist()
    half = 0.5 * turn
    c, s, chord = math.cos(half), math.sin(half), math.sin(half) / half if half else 1.0
    return np.array([(c * x + s * y) / chord, (c * y - s * x) / chord, turn]) / duration_s


def transform(a_from_b: Array, xy_b: Array) -> Array:
    """(N, 2) points of b expressed in a."""
    return np.asarray(xy_b @ rotation(float(a_from_b[2])).T + a_from_b[:2], dtype=np.float64)


def compose_cov(a_from_b: Array, cov_ab: Array, b_from_c: Array, cov_bc: Array) -> Array:
    """(3, 3) covariance of compose(a_from_b, b_from_c) to first order, the two being independent."""
    theta, (x, y, _) = float(a_from_b[2]), b_from_c.tolist()
    c, s = math.cos(theta), math.sin(theta)
    f = np.array([[1.0, 0.0, -s * x - c * y], [0.0, 1.0, c * x - s * y], [0.0, 0.0, 1.0]])
    g = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    return np.asarray(f @ cov_ab @ f.T + g @ cov_bc @ g.T, dtype=np.float64)


def lever(before: Array, after: Array) -> Array:
    """(3, 3) by which an error of a pose goes on to one after it, in their frame: its turn moves what is ahead."""
    f = np.eye(3)
    f[0, 2], f[1, 2] = before[1] - after[1], after[0] - before[0]
    return f


def covariance_problem(cov: Array) -> str:
    """What keeps finite matrices (K, n, n) from being covariances, "" where nothing does."""
    if not len(cov):
        return ""
    scale = np.abs(cov).max(axis=(1, 2), keepdims=True)
    if np.any(np.abs(cov - np.swapaxes(cov, 1, 2)) > _ROUNDING * scale):
        return "is not symmetric"
    lowest = np.linalg.eigvalsh(cov)[:, 0]
    if np.any(lowest < -_ROUNDING * scale[:, 0, 0]):
        return f"is not a covariance: an eigenvalue is negative ({lowest.min():.3g})"
    return ""


def greatest_variance(cov: Array) -> float:
    """Of a (2, 2) covariance, along whichever direction: its greater eigenvalue."""
    a, b, d = float(cov[0, 0]), float(cov[0, 1]), float(cov[1, 1])
    return 0.5 * (a + d) + math.hypot(0.5 * (a - d), b)
