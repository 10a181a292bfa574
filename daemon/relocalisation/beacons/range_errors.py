"""How likely an error of a range is: direct, along a longer path because something stands in between, or nonsense."""

from __future__ import annotations

import numpy as np

from ceilvo.types import Array

OBSTRUCTED, OBSTRUCTED_M = 0.25, 1.0
"""Share of paths that go around something, and how much longer they are in the mean; chosen: 5 to 30 % and 0.2 to 2 m
are what halls show (issue 18). An exponential tail on a normal error is the usual model (B. Alavi and K. Pahlavan,
"Modeling of the TOA-based distance measurement error using UWB indoor radio measurements", 2006)."""
NONSENSE, NONSENSE_M = 0.02, 50.0
"""Share of ranges that say nothing, and over what length those are spread; chosen: a module's reach."""
MOVED = 0.001
"""Share of anchors that hang elsewhere than the file says: all their ranges are nonsense; chosen."""
_SQRT2 = float(np.sqrt(2.0))
_SQRT_2PI = float(np.sqrt(2.0 * np.pi))
_FAR = 6.0
"""Sigmas beyond which the tail has all of its weight."""
_ERFC = (0.254829592, -0.284496736, 1.421413741, -1.453152027, 1.061405429, 0.3275911)
"""Coefficients of formula 7.1.26 of Abramowitz and Stegun, "Handbook of Mathematical Functions": to 1.5e-7."""


def log_density(error_m: Array, sigma_m: Array | float, nonsense: float = NONSENSE) -> Array:
    """Logarithm of the density 1/m of errors (any shape) of a measured range less the expected one."""
    direct, obstructed, _ = _parts(error_m, sigma_m)
    return np.asarray(np.log(direct + obstructed + nonsense / NONSENSE_M))


def direct_share(error_m: Array, sigma_m: Array | float) -> Array:
    """Probability that a range with such an error came straight."""
    direct, obstructed, nonsense = _parts(error_m, sigma_m)
    return np.asarray(direct / (direct + obstructed + nonsense))


def _parts(error_m: Array, sigma_m: Array | float) -> tuple[Array, Array, float]:
    z = error_m / sigma_m
    direct = (1.0 - OBSTRUCTED - NONSENSE) * np.exp(-0.5 * z * z) / (_SQRT_2PI * sigma_m)
    k = sigma_m / OBSTRUCTED_M
    # an exponential of mean OBSTRUCTED_M, smeared by sigma
    tail = np.exp(np.minimum(0.5 * k * k - error_m / OBSTRUCTED_M, 0.5 * _FAR * _FAR)) * 0.5 * _erfc((k - z) / _SQRT2)
    return direct, OBSTRUCTED * tail / OBSTRUCTED_M, NONSENSE / NONSENSE_M


def _erfc(x: Array) -> Array:
    """Complementary error function."""
    *a, p = _ERFC
    t = 1.0 / (1.0 + p * np.abs(x))
    series = t * (a[0] + t * (a[1] + t * (a[2] + t * (a[3] + t * a[4]))))
    small = series * np.exp(-x * x)
    return np.asarray(np.where(x >= 0.0, small, 2.0 - small))
