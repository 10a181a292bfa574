"""Planar motion between two matched point sets by constrained least squares (eqs. 8-16)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ceilvo.daemon.odometry import kernel
from ceilvo.daemon.odometry.kernel.arguments import CORNER_SIGMA_M, Gate
from ceilvo.daemon.odometry.kernel.reference import rigid_motion
from ceilvo.se2 import rotation, transform

__all__ = ["RigidFit", "median_translation", "rigid_motion", "robust_rigid_motion", "with_known_rotation"]

Array = NDArray[np.float64]
Bools = NDArray[np.bool_]

_CLEAR_FRACTION = 0.8
"""A fit that uses this fraction of the points is not compared with others; chosen: saves time."""


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
    scale = max(sigma_m, CORNER_SIGMA_M)
    gate = Gate(sigmas, max_m, scale, min_points)
    weight = None if own_sigma_m is None else 1.0 / np.maximum(own_sigma_m, CORNER_SIGMA_M) ** 2
    found: list[RigidFit] = []
    for start in (*starts, None):
        fit = kernel.refined(a, b, start, gate, own_sigma_m)
        if fit is not None:
            found.append(RigidFit(*fit, weight))
            if np.count_nonzero(found[-1].used) >= _CLEAR_FRACTION * len(a):
                break
    if len(found) < 2:
        return found[0] if found else None
    return min(found, key=lambda f: _robust_cost(a, b, f.b_from_a, scale))


def _robust_cost(a: Array, b: Array, b_from_a: Array, scale_m: float) -> float:
    """Heavy-tailed (Cauchy) cost of all residuals: a few gross ones weigh little, many small ones do."""
    return float(np.sum(np.log1p(np.sum((b - transform(b_from_a, a)) ** 2, axis=1) / scale_m**2)))


def with_known_rotation(fit: RigidFit, a: Array, b: Array, theta_rad: float, theta_sigma_rad: float) -> RigidFit:
    """The fit with a rotation that is known better than from the points: the translation of eq. 12 for that rotation.

    Crossings of lines hold no more of the rotation than the lines' common direction does. What their residuals seem to
    add is noise, or points of another height, and adds up over a drive; errors of the direction do not.
    """
    centre = rotation(theta_rad) @ fit.middle(a)
    t = fit.middle(b) - centre  # eq. 12
    n = max(int(np.count_nonzero(fit.used)), 1)
    cov = cov_of_turn(centre, theta_sigma_rad**2)
    cov[[0, 1], [0, 1]] += fit.variance_m2 / n
    return RigidFit(np.array([t[0], t[1], theta_rad]), fit.used, fit.rms_m, cov, fit.variance_m2)


def cov_of_turn(centre: Array, var_rad2: float) -> Array:
    """(3, 3) of a motion whose rotation errs, and which puts the point (2,) that turns to `centre` where it is."""
    lever = np.array([centre[1], -centre[0], 1.0])
    return var_rad2 * np.outer(lever, lever)


def median_translation(a: Array, b: Array, theta_rad: float, axis_rad: float) -> Array:
    """(3,) b_from_a when its rotation is known: medians of the displacements along and across the ceiling's lines.

    A line that was taken for its neighbour displaces all its crossings across itself and none along, so each of the
    two medians holds while more than half of the crossings are right in that one direction.
    """
    found: Array = kernel.median_translation(a, b, theta_rad, axis_rad)
    return found
