"""Observation noise sigma_x(r), sigma_y(r), sigma_theta (eqs. 26-27): the paper's experiment on concentric circles."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.polynomial.polynomial import polyval, polyvander
from numpy.typing import NDArray

from ceilvo.calibration import NoiseCurves
from ceilvo.errors import CalibrationError

Array = NDArray[np.float64]

MIN_CIRCLES = 3
MIN_PER_CIRCLE = 6
MAX_ORDER = 3
CONFIDENCE = 0.95
_FOLDS = 5
_DRAWS = 4000
_FLOOR_M = 1e-5
_SMALL_M = 1e-3
"""Smaller sigmas need not be known to a factor: the crossings' own covariance is added to them."""
_BINS = 8


@dataclass(frozen=True)
class Errors:
    """Seen minus true, in base: r_m (N,) from the point below the camera, dx_m, dy_m (N,), and dtheta_rad (K,)."""

    r_m: Array
    dx_m: Array
    dy_m: Array
    dtheta_rad: Array


@dataclass(frozen=True)
class Curve:
    """One fitted polynomial with its band.

    Attributes:
        coefficients: lowest power first, m against m.
        order_scores: held-out log-likelihood a sample of each order tried.
        r_m, low_m, high_m: (G,) the 95 % confidence band, for the curve as a whole.
        circle_r_m, circle_sigma_m, circle_n: what was measured on each circle.
    """

    coefficients: Array
    order_scores: tuple[float, ...]
    r_m: Array
    low_m: Array
    high_m: Array
    circle_r_m: Array
    circle_sigma_m: Array
    circle_n: Array

    @property
    def order(self) -> int:
        return len(self.coefficients) - 1

    def covers(self, sigma_m: Array) -> bool:
        """Whether a curve, given at r_m, is inside the band everywhere."""
        return bool(np.all((sigma_m >= self.low_m) & (sigma_m <= self.high_m)))


@dataclass(frozen=True)
class Noise:
    """Both curves and the heading's sigma with its own standard deviation, and biases (x, y) m."""

    x: Curve
    y: Curve
    sigma_theta_rad: float
    sigma_theta_sigma: float
    bias_m: Array
    bias_sigma_m: Array

    @property
    def curves(self) -> NoiseCurves:
        def numbers(c: Curve) -> tuple[float, ...]:
            return tuple(float(k) for k in c.coefficients)

        return NoiseCurves(
            numbers(self.x), numbers(self.y), self.sigma_theta_rad, float(self.x.r_m[0]), float(self.x.r_m[-1])
        )


def fit(errors: Errors, seed: int = 1) -> Noise:
    """Curves by weighted least squares on the scatter of each circle, their order by cross-validation.

    Args:
        errors: at three or more distances with six or more each; where r is spread it is cut into equal parts.
        seed: of the folds and of the bands' quantile.

    Raises:
        CalibrationError: too few circles or samples, or no scatter at all.
    """
    circle = circles(errors.r_m)
    _enough(errors, circle)
    rng = np.random.default_rng([seed, 0x516])
    x, y = (_curve(errors.r_m, e, circle, rng) for e in (errors.dx_m, errors.dy_m))
    theta = float(np.sqrt(np.mean(errors.dtheta_rad**2)))
    n = len(errors.r_m)
    bias = np.array([errors.dx_m.mean(), errors.dy_m.mean()])
    scatter = np.array([errors.dx_m.std(), errors.dy_m.std()]) / np.sqrt(n)
    return Noise(x, y, theta, theta / np.sqrt(2.0 * len(errors.dtheta_rad)), bias, scatter)


def circles(r_m: Array) -> NDArray[np.int64]:
    """(N,) which circle each sample is of: radii that stand apart, else parts of equal number."""
    order = np.argsort(r_m, kind="stable")
    gaps = np.diff(r_m[order])
    span = float(np.ptp(r_m))
    label = np.zeros(len(r_m), np.int64)
    label[order[1:]] = np.cumsum(gaps > max(0.04 * span, 1e-6))
    counts = np.bincount(label)
    widest = max((float(np.ptp(r_m[label == k])) for k in range(len(counts))), default=0.0)
    spread = widest > 0.25 * span or len(counts) * MIN_PER_CIRCLE > len(r_m) >= MIN_CIRCLES * MIN_PER_CIRCLE
    if span > 0 and spread:
        bins = min(_BINS, max(len(r_m) // MIN_PER_CIRCLE, 1))
        for k, rows in enumerate(np.array_split(order, bins)):
            label[rows] = k
    return label


def _enough(errors: Errors, circle: NDArray[np.int64]) -> None:
    counts = np.bincount(circle)
    if len(counts) < MIN_CIRCLES:
        raise CalibrationError(
            f"sigma: found samples on {len(counts)} circles, at least {MIN_CIRCLES} needed; measure at other distances"
        )
    if counts.min() < MIN_PER_CIRCLE:
        at = float(np.mean(errors.r_m[circle == int(np.argmin(counts))]))
        raise CalibrationError(
            f"sigma: found {counts.min()} samples at r = {at:.2f} m, "
            f"at least {MIN_PER_CIRCLE} needed; measure more there"
        )
    if len(errors.dtheta_rad) < MIN_PER_CIRCLE:
        raise CalibrationError(
            f"sigma: found {len(errors.dtheta_rad)} headings, at least {MIN_PER_CIRCLE} needed; "
            "measure the robot's heading too"
        )
    for name, e in (("x", errors.dx_m), ("y", errors.dy_m), ("theta", errors.dtheta_rad)):
        if not np.isfinite(e).all() or float(np.abs(e).max()) < 1e-9:
            raise CalibrationError(f"sigma: found errors in {name} that are zero or no numbers: right column?")


def _scatter(r: Array, e: Array, circle: NDArray[np.int64]) -> tuple[Array, Array, Array]:
    """Distance, sigma and number of samples of each circle; the bias of a root of a mean square is taken out."""
    counts = np.bincount(circle).astype(np.float64)
    at = np.bincount(circle, r) / counts
    s = np.sqrt(np.bincount(circle, e * e) / counts) * (1.0 + 1.0 / (4.0 * counts))
    return at, s, counts


def _wls(at: Array, s: Array, n: Array, order: int) -> tuple[Array, Array]:
    """Coefficients and covariance; var(s) = sigma^2 / 2n with sigma from the fit itself, in a few rounds."""
    v = polyvander(at, order)
    sigma = np.maximum(s, _FLOOR_M)
    for _ in range(8):
        w = 2.0 * n / sigma**2
        info = v.T @ (v * w[:, None])
        c = np.linalg.solve(info, v.T @ (w * s))
        sigma = np.maximum(v @ c, 0.2 * s.mean())
    return c, np.linalg.inv(info)


def _curve(r: Array, e: Array, circle: NDArray[np.int64], rng: np.random.Generator) -> Curve:
    at, s, n = _scatter(r, e, circle)
    most = min(MAX_ORDER, len(at) - 1)
    grid = np.linspace(float(r.min()), float(r.max()), 81)
    scores = _scores(r, e, circle, most, rng)
    order = _choose(scores)
    while order and polyval(grid, _wls(at, s, n, order)[0]).min() <= _FLOOR_M:
        order -= 1
    c, _ = _wls(at, s, n, order)
    low, high = _band(at, s, n, min(order + 1, most), grid, rng)
    fitted = polyval(grid, c)
    return Curve(
        coefficients=c,
        order_scores=tuple(float(np.mean(row)) for row in scores),
        r_m=grid,
        low_m=np.maximum(np.minimum(low, fitted), 0.0),
        high_m=np.maximum(high, fitted),
        circle_r_m=at,
        circle_sigma_m=s,
        circle_n=n,
    )


def _scores(r: Array, e: Array, circle: NDArray[np.int64], most: int, rng: np.random.Generator) -> Array:
    """(orders, N) log-likelihood of each sample under the curve that was fitted without its fold."""
    fold = np.empty(len(r), np.int64)
    for k in np.unique(circle):
        rows = np.flatnonzero(circle == k)
        fold[rows] = rng.permutation(len(rows)) % _FOLDS
    out = np.zeros((most + 1, len(r)))
    for k in range(_FOLDS):
        held, rest = fold == k, fold != k
        at, s, n = _scatter(r[rest], e[rest], circle[rest])
        for order in range(most + 1):
            sigma = np.maximum(polyval(r[held], _wls(at, s, n, order)[0]), 0.1 * s.mean())
            out[order, held] = -np.log(sigma) - 0.5 * (e[held] / sigma) ** 2
    return out


def _choose(scores: Array) -> int:
    """The lowest order that is not clearly worse than the best, by the paired differences' own standard error."""
    best = int(np.argmax(scores.mean(axis=1)))
    for order in range(best):
        worse = scores[best] - scores[order]
        if worse.mean() <= worse.std() / np.sqrt(len(worse)):
            return order
    return best


def _band(at: Array, s: Array, n: Array, order: int, grid: Array, rng: np.random.Generator) -> tuple[Array, Array]:
    """A band for the whole curve, of one order more than chosen, so that a wrong choice costs width and not truth."""
    c, cov = _wls(at, s, n, order)
    v = polyvander(grid, order)
    sd = np.sqrt(np.einsum("gi,ij,gj->g", v, cov, v))
    draws = rng.standard_normal((_DRAWS, order + 1)) @ np.linalg.cholesky(cov).T
    worst = np.max(np.abs(draws @ v.T) / sd, axis=1)
    reach = float(np.quantile(worst, CONFIDENCE))
    reach *= 1.0 + 2.0 / float(n.mean())  # the weights come from the same few samples
    middle = v @ c
    # on a logarithmic scale: the scatter of a scatter is not symmetric
    relative = reach * sd / np.maximum(middle, _FLOOR_M)
    return middle * np.exp(-relative), middle * np.exp(relative)


def problems(noise: Noise) -> list[str]:
    """What keeps the result from a PASS, with what to do."""
    out = []
    for name, curve, bias, sigma in zip("xy", (noise.x, noise.y), noise.bias_m, noise.bias_sigma_m, strict=True):
        wide = float(np.max(curve.high_m / np.maximum(polyval(curve.r_m, curve.coefficients), _SMALL_M)))
        if wide > 2.5:
            out.append(f"sigma_{name} is known to a factor of {wide:.1f} only, 2.5 allowed: more samples a circle")
        if polyval(curve.r_m, curve.coefficients).max() > 0.15:
            out.append(
                f"sigma_{name} reaches {1e3 * curve.high_m.max():.0f} mm, 150 allowed: were the poses measured well?"
            )
        if abs(bias) > 5.0 * sigma and abs(bias) > 0.01:
            out.append(f"errors in {name} have a mean of {1e3 * bias:+.0f} mm: check the mount and the measured poses")
    if noise.sigma_theta_rad > np.radians(3.0):
        out.append(
            f"sigma_theta is {np.degrees(noise.sigma_theta_rad):.1f} deg, at most 3 expected: check the headings"
        )
    return out
