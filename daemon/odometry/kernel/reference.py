"""The loops over matched points in NumPy: what the compiled ones compute, and what runs where there are none."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from ceilvo.daemon.odometry.kernel.arguments import (
    CORNER_SIGMA_M,
    DEGREES_OF_FREEDOM,
    GATE_MEDIANS,
    MAX_ROUNDS,
    Bools,
    Gate,
    Limits,
    RatioNoise,
    check_pairs,
)
from ceilvo.robust import MAD_TO_SIGMA, median
from ceilvo.se2 import rotation, transform
from ceilvo.types import Array, Ints

_MIN_SPREAD = 1e-12
"""px or m; points closer together count as one, and are not divided by 0."""


def mutual_nearest(a: Array, kind_a: Ints, b: Array, kind_b: Ints, radius: float) -> tuple[Ints, Ints]:
    """Index pairs (i, j) of points (N, 2) and (M, 2) that are each other's nearest of their kind within a radius."""
    if len(a) == 0 or len(b) == 0:
        none = np.zeros(0, np.int64)
        return none, none
    d2 = np.subtract.outer(a[:, 0], b[:, 0]) ** 2 + np.subtract.outer(a[:, 1], b[:, 1]) ** 2
    d2[kind_a[:, None] != kind_b[None, :]] = np.inf
    j = np.argmin(d2, axis=1)
    i = np.arange(len(a))
    good = (np.argmin(d2, axis=0)[j] == i) & (d2[i, j] < radius * radius)
    return i[good], j[good]


def median_translation(a: Array, b: Array, theta_rad: float, axis_rad: float) -> Array:
    """(3,) b_from_a when its rotation is known: medians of the displacements (N >= 1) along and across two axes."""
    check_pairs(a.shape, b.shape)
    to_axes = rotation(-axis_rad)
    off = (b - a @ rotation(theta_rad).T) @ to_axes.T
    t = to_axes.T @ np.median(off, axis=0)
    return np.array([t[0], t[1], theta_rad])


def median_radius(xy: Array) -> float:
    """Median distance of points (N >= 1, 2) from their centre."""
    return float(np.median(np.hypot(*(xy - xy.mean(axis=0)).T)))


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


def refined(
    a: Array, b: Array, start: Array | None, gate: Gate, own_sigma_m: Array | None = None
) -> tuple[Array, Bools, float, Array, float] | None:
    """rigid_motion() with the residual rejection and re-estimation of eq. 16; None where too few points remain.

    Args:
        start: (3,) b_from_a that the first residuals are judged by; None: the fit to all points.
        own_sigma_m: (N,) of points that are not alike: they weigh as much as that says, none is rejected within a few
            of its own, and the fit is no surer than they are; None: they are alike.

    Returns:
        b_from_a (3,), points used (N,), their rms residual, (3, 3) covariance, variance of one coordinate.
    """
    check_pairs(a.shape, b.shape)
    weight = None if own_sigma_m is None else 1.0 / np.maximum(own_sigma_m, CORNER_SIGMA_M) ** 2
    fit, used = rigid_motion(a, b, weight) if start is None else start, np.zeros(len(a), bool)
    for _ in range(MAX_ROUNDS):
        eta = np.hypot(*(b - transform(fit, a)).T)  # eq. 16
        keep = _kept(gate, eta, own_sigma_m)
        if np.count_nonzero(keep) < max(gate.min_points, 2):
            return None
        if np.array_equal(keep, used):
            break
        used = keep
        fit = rigid_motion(a[used], b[used], None if weight is None else weight[used])
    residual = b[used] - transform(fit, a[used])
    if not _fits(gate, np.hypot(residual[:, 0], residual[:, 1]), None if own_sigma_m is None else own_sigma_m[used]):
        return None
    dof = max(2 * len(residual) - DEGREES_OF_FREEDOM, 1)
    square = np.sum(residual**2, axis=1)
    rms = float(np.sqrt(np.mean(square)))
    if weight is None:
        variance = float(np.sum(square)) / dof
        return fit, used, rms, _covariance(a[used], fit, variance), variance
    w = weight[used]
    worse = max(float(w @ square) / dof, 1.0)
    return fit, used, rms, _covariance(a[used], fit, worse, w), worse * len(w) / float(np.sum(w))


def _kept(gate: Gate, eta: Array, own_sigma_m: Array | None) -> Bools:
    """(N,) which residuals are kept.

    While many outliers still pull the fit, the least gate lets the half that agrees best take it over.
    """
    middle = median(eta)
    most = max(min(gate.max_m, gate.sigmas * max(MAD_TO_SIGMA * middle, gate.sigma_m)), GATE_MEDIANS * middle)
    return np.asarray(eta < (most if own_sigma_m is None else np.maximum(most, gate.sigmas * own_sigma_m)))


def _fits(gate: Gate, eta: Array, own_sigma_m: Array | None) -> bool:
    """Whether the better half of the residuals that were kept are small."""
    if own_sigma_m is None:
        return median(eta) <= gate.max_m
    return median(eta / own_sigma_m) <= max(gate.sigmas, gate.max_m / median(own_sigma_m))


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


def homography(xy: Array, uv: Array) -> Array:
    """(3, 3) H with k [u v 1]^T = H [x y 1]^T and m9 = 1 (in normalised coordinates), for (N >= 4, 2) points.

    Raises:
        numpy.linalg.LinAlgError: the points do not determine H.
    """
    (sx, x0, y0), (su, u0, v0) = _normaliser(xy), _normaliser(uv)
    x, y, u, v = (xy[:, 0] - x0) * sx, (xy[:, 1] - y0) * sx, (uv[:, 0] - u0) * su, (uv[:, 1] - v0) * su
    k = np.zeros((2 * len(x), 8))  # eq. 3
    k[0::2, 0] = k[1::2, 3] = x
    k[0::2, 1] = k[1::2, 4] = y
    k[0::2, 2] = k[1::2, 5] = 1.0
    k[0::2, 6], k[0::2, 7], k[1::2, 6], k[1::2, 7] = -x * u, -y * u, -x * v, -y * v
    big_u = np.stack([u, v], axis=1).reshape(-1)  # eq. 2
    m = np.linalg.solve(k.T @ k, k.T @ big_u)  # eq. 4
    to_xy = np.array([[sx, 0, -sx * x0], [0, sx, -sx * y0], [0, 0, 1.0]])
    from_uv = np.array([[1 / su, 0, u0], [0, 1 / su, v0], [0, 0, 1.0]])
    h = from_uv @ np.append(m, 1.0).reshape(3, 3) @ to_xy
    return np.asarray(h / h[2, 2])


def _normaliser(p: Array) -> tuple[float, float, float]:
    """Scale to a mean distance of sqrt(2) from the centre, and that centre (Hartley 1997)."""
    x, y = p.mean(axis=0).tolist()
    spread = float(np.mean(np.hypot(p[:, 0] - x, p[:, 1] - y)))
    return math.sqrt(2.0) / max(spread, _MIN_SPREAD), x, y


def homography_residuals(xy: Array, uv: Array, kept: Bools) -> Array:
    """(N,) distance of uv from H xy, H the homography() of the points (N, 2) that are kept."""
    check_pairs(xy.shape, uv.shape)
    h = homography(xy[kept], uv[kept])
    p = xy @ h[:, :2].T + h[:, 2]  # eq. 1
    return np.asarray(np.hypot(p[:, 0] / p[:, 2] - uv[:, 0], p[:, 1] / p[:, 2] - uv[:, 1]))


def alike(new: NDArray[np.uint8], before: NDArray[np.uint8], most: float, black: int, glare: int) -> Ints:
    """(K,) how many of the samples (S,) differ by no more than `most` from those of pictures before (K, S).

    Samples that are `black` or darker, or `glare` or brighter, in either picture say nothing, and so differ from none.
    """
    near = np.abs(before.astype(np.int16) - new) <= most
    near |= (new <= black) | (new >= glare) | (before <= black) | (before >= glare)
    return np.asarray(np.count_nonzero(near, axis=1), np.int64)


def calm_difference(
    a: NDArray[np.uint8], b: NDArray[np.uint8], share: float, black: int, glare: int
) -> tuple[int, float]:
    """How many samples (S,) are neither black nor glaring in two pictures, and the mean difference of that share of
    them that differ least; 0 without any."""
    clear = (a > black) & (a < glare) & (b > black) & (b < glare)
    off = np.abs(a[clear].astype(np.int64) - b[clear])
    calm = round(share * len(off))
    return len(off), float(np.partition(off, calm - 1)[:calm].mean()) if calm else 0.0


def line_ratios(sums: Array, noise: RatioNoise) -> tuple[Array, Array, Array]:
    """How fast lines (T,) move past, over the camera; the standard deviation of that, infinite where not measured; and
    what a straight line through the measurements leaves, m^2.

    Args:
        sums: (T, 6) of the measurements: 1, camera, apparent, camera squared, camera times apparent, apparent squared.
    """
    count, s, a, ss, sa, aa = sums.T
    n = np.maximum(count, 1.0)
    spread = ss - s * s / n
    known = spread > noise.step_m**2
    safe = np.where(known, spread, 1.0)
    ratio = np.where(known, -(sa - s * a / n) / safe, 1.0)
    bent = np.maximum(aa - a * a / n - ratio**2 * spread, 0.0) / np.maximum(n - 2.0, 1.0)
    error = np.maximum(noise.sigma_m, np.sqrt(bent)) / np.sqrt(safe * np.minimum(noise.independent / n, 1.0))
    return ratio, np.where(known, np.hypot(error, noise.sigma_ratio), np.inf), bent


def _grouped(value: Array, kind: Ints, same: float) -> tuple[Ints, Ints]:
    """(M,) number of the group of each value, and (L,) the first one of each group: of one kind, each nearer than
    `same` to the next; groups are counted by kind, then by value."""
    order = np.lexsort((value, kind))
    begins = np.ones(len(order), bool)
    begins[1:] = (np.diff(value[order]) > same) | (np.diff(kind[order]) != 0)
    number = np.empty(len(order), np.int64)
    number[order] = np.cumsum(begins) - 1
    return number, order[begins]


def lines_seen(from_camera: Array, crossing_type: Ints, quarters: int, same: float) -> tuple[Ints, Ints, Array, Ints]:
    """The lines that crossings (M, 2), as seen from the camera along a frame's normals, lie on.

    Args:
        quarters: turns of the fixed normals against the frame's.
        same: crossings of a kind that follow each other so closely across a line are on one.

    Returns:
        (L,) axis 0 or 1 of the fixed normals, kind and distance along it, and (M, 2) the two lines of each crossing.
    """
    kinds = np.divmod(crossing_type, 3)
    axis, kind, apparent, of_crossing = [], [], [], np.zeros((len(from_camera), 2), np.int64)
    first = 0
    for own in (0, 1):
        number, at = _grouped(from_camera[:, own], kinds[own], same)
        of_crossing[:, own] = first + number
        turned = (own + quarters) % 4
        sign = 1 if turned < 2 else -1
        apparent.append(sign * from_camera[at, own])
        kind.append(sign * (kinds[own][at] - 1))
        axis.append(np.full(len(at), turned % 2))
        first += len(at)
    return np.concatenate(axis), np.concatenate(kind), np.concatenate(apparent), of_crossing


def lines_followed(
    seen_axis: Ints, seen_kind: Ints, seen_m: Array, axis: Ints, kind: Ints, expected_m: Array, gate_m: float
) -> Ints:
    """(L,) which of the lines (T,) that are expected each of those seen is, or -1: the nearest of its axis and kind, if
    it is the nearest to that one as well, and within the gate."""
    off = np.abs(seen_m[:, None] - expected_m)
    off[(seen_axis[:, None] != axis) | (seen_kind[:, None] != kind)] = np.inf
    found = np.full(len(seen_m), -1, np.int64)
    if off.size:
        near, every = np.argmin(off, axis=1), np.arange(len(seen_m))
        good = (off[every, near] < gate_m) & (np.argmin(off, axis=0)[near] == every)
        found[good] = near[good]
    return found


def lines_measured(
    row: Ints,
    camera_m: Array,
    apparent_m: Array,
    measured_m: Array,
    sums: Array,
    strange: Ints,
    noise: RatioNoise,
    limits: Limits,
) -> Ints:
    """Take in where lines `row`, each once, were seen last, as far as that is news, in place; those that are others.

    Args:
        camera_m, apparent_m, measured_m: (T,) where the camera was along a line's normal, where the line was seen, and
            where the camera was at its last measurement, nan before the first.
        sums: (T, 6) as of line_ratios().
        strange: (T,) measurements in a row that were of another line.
    """
    s, a = camera_m[row], apparent_m[row]
    news = ~(np.abs(s - measured_m[row]) < noise.step_m)
    row, s, a = row[news], s[news], a[news]
    n = np.maximum(sums[row, 0], 1.0)
    ratio, sigma, _ = line_ratios(sums[row], noise)
    ahead = s - sums[row, 1] / n
    off = np.abs(a - sums[row, 2] / n + ratio * ahead)
    allowed = limits.outlier_m + limits.outlier_sigmas * np.minimum(sigma, 1.0) * np.abs(ahead)
    take = (n < limits.fewest) | (off < allowed)
    strange[row] = np.where(take, 0, strange[row] + 1)
    measured_m[row] = s
    anew = row[strange[row] >= limits.strange]
    row, s, a = row[take], s[take], a[take]
    sums[row] += np.column_stack([np.ones(len(row)), s, a, s * s, s * a, a * a])
    return anew
