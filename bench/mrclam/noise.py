"""Bias and noise of range, bearing and odometry, fitted on training robots against their ground truth."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace

import numpy as np

from ceilvo.bench.mrclam.data import Run, World
from ceilvo.errors import FileFormatError
from ceilvo.robust import MAD_TO_SIGMA
from ceilvo.se2 import between, wrap_array
from ceilvo.types import Array

BINS = 12  # of distance, with as many observations each; chosen: a line through them has two coefficients
WINDOW_S = 1.0
"""Odometry is compared with the truth over windows of this length."""
NEAR_M = 0.3  # m; chosen: nearer than this the bearing's sigma grows no more, 1 / r has no bound
SIGMA_FACTORS = (1.5, 2.0, 3.0, 4.0, 6.0, 8.0, 12.0, 16.0)
"""Chosen grid, from little to far too much; the winner is fitted, see inflated()."""
ODOMETRY_FACTORS = (2.0, 4.0, 8.0, 16.0)  # of variances; chosen grid, likewise
_MIN_WINDOWS = 20  # chosen: below it three rates cannot be told from chance; a run has hundreds
LATENCIES_S = np.arange(-10, 16) * 0.01
"""Chosen grid: -0.10 to 0.15 s in steps of 10 ms; the winner is fitted, see bias_of()."""
TRIM = 0.97
"""Share of the smallest bearing errors by which latencies are compared."""
CLIP_SIGMAS, CLIP_ROUNDS = 3.0, 8
"""Robust sigmas, usual for outliers; rounds: chosen, enough for the kept set to settle."""


@dataclass(frozen=True)
class Noise:
    """Standard deviations and variances as fitted, and the factors that make up for their correlation in time.

    sigma_r = range_m[0] + range_m[1] r; sigma_b = bearing_rad[0] + bearing_rad[1] / max(r, 0.3); variance of a motion:
    forward_var and lateral_var per metre, heading_var per radian turned and per metre, all with a floor per second.
    """

    range_m: tuple[float, float]
    bearing_rad: tuple[float, float]
    forward_var: tuple[float, float]
    lateral_var: tuple[float, float]
    heading_var: tuple[float, float, float]
    sigma_factor: float = 1.0
    odometry_factor: float = 1.0

    def sigmas(self, range_m: Array) -> tuple[Array, Array]:
        """sigma of range (m) and bearing (rad), inflated."""
        r = np.asarray(range_m, np.float64)
        across = self.bearing_rad[0] + self.bearing_rad[1] / np.maximum(r, NEAR_M)
        return self.sigma_factor * (self.range_m[0] + self.range_m[1] * r), self.sigma_factor * across

    def motion_cov(self, motion: Array, seconds: float) -> Array:
        """(3, 3) covariance of a displacement that took some seconds, inflated."""
        path_m, turn = float(np.hypot(motion[0], motion[1])), abs(float(motion[2]))
        forward = self.forward_var[0] * path_m + self.forward_var[1] * seconds
        lateral = self.lateral_var[0] * path_m + self.lateral_var[1] * seconds
        heading = self.heading_var[0] * turn + self.heading_var[1] * path_m + self.heading_var[2] * seconds
        return self.odometry_factor * np.diag([forward, lateral, heading])

    def as_dict(self) -> dict[str, object]:
        return asdict(self)


@dataclass(frozen=True)
class Bias:
    """What observations and odometry are wrong by on average: a camera's ranges depend on the direction it looks in.

    latency_s: how much older a measurement is than its stamp; range_share: relative error of the range, bearing_rad:
    error of the bearing, both as c0 + c1 b + c2 b^2 of the bearing b; odometry: factors of speed and turn rate.
    """

    latency_s: float = 0.0
    range_share: tuple[float, ...] = (0.0, 0.0, 0.0)
    bearing_rad: tuple[float, ...] = (0.0, 0.0, 0.0)
    odometry: tuple[float, float] = (1.0, 1.0)


def bias_of(runs: Sequence[Run], world: World) -> Bias:
    """Least squares without what is beyond 3 robust sigmas; the latency is the one with the least bearing error."""

    def bearing_error(latency_s: float) -> float:
        off = np.sort(residuals([without(run, Bias(latency_s)) for run in runs], world)[2] ** 2)
        return float(np.mean(off[: int(TRIM * len(off))]))

    latency = min(LATENCIES_S, key=bearing_error)
    late = [without(run, Bias(float(latency))) for run in runs]
    r, off_range, off_bearing, bearing = residuals(late, world)
    basis = _powers(bearing)
    return Bias(float(latency), _clipped(basis, off_range / r), _clipped(basis, off_bearing), odometry_scale(runs))


def without(run: Run, bias: Bias) -> Run:
    """The run as it would be without the bias."""
    basis = _powers(run.bearing_rad)
    return replace(
        run,
        odometry=run.odometry * [1.0, *bias.odometry],
        seen_s=np.clip(run.seen_s - bias.latency_s, run.begin_s, run.end_s),
        range_m=run.range_m / (1.0 + basis @ np.array(bias.range_share)),
        bearing_rad=run.bearing_rad - basis @ np.array(bias.bearing_rad),
    )


def _powers(bearing: Array) -> Array:
    return np.column_stack([np.ones_like(bearing), bearing, bearing**2])


def _clipped(basis: Array, values: Array) -> tuple[float, ...]:
    keep = np.ones(len(values), bool)
    found: Array = np.zeros(basis.shape[1])
    for _ in range(CLIP_ROUNDS):
        found = np.asarray(np.linalg.lstsq(basis[keep], values[keep], rcond=None)[0], np.float64)
        off = np.abs(values - basis @ found)
        keep = off <= CLIP_SIGMAS * MAD_TO_SIGMA * float(np.median(off))
    return tuple(float(x) for x in found)


def fit(runs: Sequence[Run], world: World) -> Noise:
    """Spread of the residuals by distance (median absolute deviation: outliers do not count), lines through it."""
    r, off_range, off_bearing, _ = residuals(runs, world)
    at, range_sigma = _spread_by_bin(r, off_range)
    _, bearing_sigma = _spread_by_bin(r, off_bearing)
    motion, error, seconds = odometry_errors(runs)
    path_m, turn = np.hypot(motion[:, 0], motion[:, 1]), np.abs(motion[:, 2])
    return Noise(
        _line(np.column_stack([np.ones(len(at)), at]), range_sigma),  # type: ignore[arg-type]
        _line(np.column_stack([np.ones(len(at)), 1.0 / np.maximum(at, NEAR_M)]), bearing_sigma),  # type: ignore[arg-type]
        _variances(error[:, 0], np.column_stack([path_m, seconds])),  # type: ignore[arg-type]
        _variances(error[:, 1], np.column_stack([path_m, seconds])),  # type: ignore[arg-type]
        _variances(error[:, 2], np.column_stack([turn, path_m, seconds])),  # type: ignore[arg-type]
    )


def residuals(runs: Sequence[Run], world: World) -> tuple[Array, Array, Array, Array]:
    """True distances, errors of range and bearing, and bearings (each (K,)) of all observations that have a truth."""
    out = []
    for run in runs:
        truth = run.truth_at(run.seen_s)
        index = np.searchsorted(world.subject, run.subject, sorter=np.argsort(world.subject))
        at = world.xy_m[np.argsort(world.subject)[index]] - truth[:, :2]
        distance = np.hypot(*at.T)
        bearing = wrap_array(run.bearing_rad - np.arctan2(at[:, 1], at[:, 0]) + truth[:, 2])
        good = np.isfinite(distance)
        out.append(np.stack([distance, run.range_m - distance, bearing, run.bearing_rad])[:, good])
    r, off_range, off_bearing, at_bearing = np.concatenate(out, axis=1)
    if len(r) < 5 * BINS:
        raise FileFormatError(f"training runs: found {len(r)} observations with a truth, expected at least {5 * BINS}")
    return r, off_range, off_bearing, at_bearing


def odometry_errors(runs: Sequence[Run]) -> tuple[Array, Array, Array]:
    """Displacements by odometry (W, 3), their errors in the robot's frame (W, 3), durations (W,)."""
    motions, errors = [], []
    for run in runs:
        t = np.arange(run.begin_s, run.end_s, WINDOW_S)
        reported, true = run.dead_reckoning(t), run.truth_at(t)
        motion, real = between(reported[:-1], reported[1:]), between(true[:-1], true[1:])
        good = np.all(np.isfinite(real), axis=1)
        motions.append(motion[good])
        errors.append(between(real, motion)[good])
    motion, error = np.concatenate(motions), np.concatenate(errors)
    if len(motion) < _MIN_WINDOWS:
        raise FileFormatError(
            f"training runs: found {len(motion)} s of odometry with a truth, expected at least {_MIN_WINDOWS}"
        )
    return motion, error, np.full(len(motion), WINDOW_S)


def odometry_scale(runs: Sequence[Run]) -> tuple[float, float]:
    """What to multiply speed and turn rate by, least squares of the true displacements on those of odometry."""
    motion, error, _ = odometry_errors(runs)
    real = motion - error
    forward, turn = (float(motion[:, i] @ real[:, i] / (motion[:, i] @ motion[:, i])) for i in (0, 2))
    return forward, turn


def _spread_by_bin(r: Array, off: Array) -> tuple[Array, Array]:
    """Median distance and spread about zero of bins of equal count."""
    order = np.array_split(np.argsort(r), BINS)
    at = np.array([np.median(r[i]) for i in order])
    return at, np.array([MAD_TO_SIGMA * np.median(np.abs(off[i])) for i in order])


def _line(basis: Array, values: Array) -> tuple[float, ...]:
    """Least squares with coefficients that are not negative."""
    best, least = np.zeros(basis.shape[1]), np.inf
    for mask in range(1, 1 << basis.shape[1]):
        use = [i for i in range(basis.shape[1]) if mask >> i & 1]
        found = np.linalg.lstsq(basis[:, use], values, rcond=None)[0]
        cost = float(np.sum((basis[:, use] @ found - values) ** 2))
        if np.all(found >= 0.0) and cost < least:
            best, least = np.zeros(basis.shape[1]), cost
            best[use] = found
    return tuple(float(x) for x in best)


def _variances(error: Array, drivers: Array) -> tuple[float, ...]:
    """Variance as a sum of rates times drivers; errors beyond 5 robust sigmas are left out."""
    keep = np.abs(error) <= 5.0 * MAD_TO_SIGMA * max(float(np.median(np.abs(error))), 1e-9)
    rates = _line(drivers[keep], error[keep] ** 2)
    floor = 1e-8
    return (*rates[:-1], max(rates[-1], floor))


def inflated(noise: Noise, score: Callable[[float, float], float]) -> tuple[Noise, list[dict[str, float]]]:
    """The factors with the least score (mean negative log-likelihood of the truth), and all that were tried."""
    tried = []
    for s in SIGMA_FACTORS:
        for q in ODOMETRY_FACTORS:
            tried.append({"sigma_factor": s, "odometry_factor": q, "score": score(s, q)})
    best = min(tried, key=lambda row: row["score"])
    return replace(noise, sigma_factor=best["sigma_factor"], odometry_factor=best["odometry_factor"]), tried
