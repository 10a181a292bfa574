"""The sums over the points of lines in NumPy: what the compiled ones compute, and what runs where there are none; and
what is asked for so seldom that it is not compiled."""

from __future__ import annotations

import numpy as np

from ceilvo.daemon.vision.kernel.arguments import Arm, Array32, Bools, Int32s, Int64s, Step, Widths
from ceilvo.types import Array, LineKind

_ONE_PX = 1.0
"""Pieces whose offsets differ by less are of one line; chosen: twice what a piece's own is off by."""


def align(
    rho: Array32,
    tangent: Array32,
    line: Int32s,
    half: int,
    offset_px: Array,
    psi_rad: float,
    focal_px: float,
    info: Array,
    gates_px: Array,
    likelihood: Array,
) -> Array:
    """(5,) the shift along either normal, px, turn and tilt, rad, off the offsets expected, that most points share.

    Args:
        half: points before this one belong to axis 0, the others to axis 1.
        info: (5,) inverse variances of what is found beforehand, when it is 0.
        gates_px: of a point's distance from what most share, round by round.
        likelihood: of shifts beforehand, one a px; the middle one is of no shift.
    """
    r, t = rho.astype(np.float64), tangent.astype(np.float64)
    off_px = r * focal_px - offset_px[line]
    fitted, found = np.empty(len(line)), np.zeros(5)
    model = np.zeros((len(line), 5))
    for axis, part in enumerate((slice(0, half), slice(half, None))):
        fitted[part] = _likely_shift(off_px[part], likelihood)
        model[part, axis] = 1.0
        model[part, 2:] = _jacobian(psi_rad + 0.5 * np.pi * axis, r[part], t[part])
    model[:, 2:] *= -focal_px
    for gate_px in gates_px:
        use = np.abs(off_px - fitted) < gate_px
        m = model[use]
        found = np.linalg.solve(m.T @ m + np.diag(info), m.T @ off_px[use])
        fitted = model @ found
    return found


def _jacobian(angle_rad: float, rho: Array, tangent: Array) -> Array:
    """(K, 3) how rho of a ray as a level robot sees it grows with the direction and with the tilt taken off it.

    Args:
        angle_rad: of the normal that rho is counted along.
    """
    nx, ny = np.cos(angle_rad), np.sin(angle_rad)
    x, y = rho * nx - tangent * ny, rho * ny + tangent * nx
    about_x = -nx * x * y - ny * (1.0 + y * y)
    about_y = nx * (1.0 + x * x) + ny * x * y
    return np.column_stack([tangent, about_x, about_y])


def _likely_shift(off_px: Array, likelihood: Array) -> float:
    """The shift that most points share; small ones are likelier beforehand."""
    if len(off_px) == 0:
        return 0.0
    reach = len(likelihood) // 2
    cell = np.clip(np.rint(off_px).astype(np.int64) + reach, 0, 2 * reach)
    votes = np.bincount(cell, minlength=len(likelihood))
    three = votes.copy()
    three[1:] += votes[:-1]
    three[:-1] += votes[1:]
    return float(np.argmax(three * likelihood) - reach)


def fit(
    rho: Array32,
    tangent: Array32,
    line: Int32s,
    half: int,
    lines: int,
    psi_rad: float,
    tilt_rad: Array,
    step: Step,
) -> tuple[Int64s, float, Array, Array]:
    """One Gauss-Newton step on direction and tilt; the lines' offsets are eliminated by centring every line.

    Returns:
        Points of every line (L,), their standard deviation about the lines, px, the step (3,) and its (3, 3) covariance
        in direction and tilt about base x and y.
    """
    support, total, product = _sums(rho, tangent, line, half, lines)
    means = total / np.maximum(support, 1)[:, None]
    # sums of products about every line's own mean
    scatter = (product - total.T @ means) * step.focal_px**2
    mean_square = scatter[0, 0] / max(len(line), 1)
    noise_px = max(float(np.sqrt(max(mean_square, 0.0))), step.least_noise_px)
    weight = 1.0 / (noise_px**2 * step.correlated)
    c, s = np.cos(psi_rad), np.sin(psi_rad)
    to_base = np.array([[1.0, 0.0, 0.0], [0.0, c, -s], [0.0, s, c]])  # from tilt about the two lines' normals
    gradient = weight * scatter[0, 1:]
    if not step.held:
        gradient[1:] += to_base[1:, 1:].T @ tilt_rad * step.tilt_info
    info = weight * scatter[1:, 1:] + np.diag([step.direction_info, step.tilt_info, step.tilt_info])
    covariance = to_base @ np.linalg.inv(info)
    return support, noise_px, -covariance @ gradient, np.asarray(covariance @ to_base.T)


def _sums(rho: Array32, tangent: Array32, line: Int32s, half: int, lines: int) -> tuple[Int64s, Array, Array]:
    """Points of every line (L,), sums (L, 4) and products (4, 4) of rho, tangent, d rho / d tilt about either
    normal."""
    rows = _by_point(rho, tangent, half)
    total: Array = np.stack([np.bincount(line, row, lines) for row in rows], axis=1).astype(np.float64)
    return np.bincount(line, minlength=lines).astype(np.int64), total, np.asarray(rows @ rows.T)


def _by_point(rho: Array32, tangent: Array32, half: int) -> Array:
    """(4, P) rho, tangent, d rho / d tilt about either normal.

    A ray r seen by a tilted robot moves by -w x r, for small w about the normal of axis 0 and of axis 1.
    """
    r, t = rho.astype(np.float64), tangent.astype(np.float64)
    across, own = r * t, 1.0 + r * r
    about_0 = np.concatenate([-across[:half], -own[half:]])
    about_1 = np.concatenate([own[:half], -across[half:]])
    return np.stack([r, t, about_0, about_1])


def picture(
    rho: Array32, tangent: Array32, line: Int32s, half: int, psi_rad: float, focal_px: float, new_of_old: Int64s
) -> tuple[Array32, Int64s]:
    """(Q, 2) px of the points as a level robot would see them, and (Q,) the new number of each one's line.

    Args:
        new_of_old: (L,) of each line; -1 leaves its points out.
    """
    c, s = np.float32(np.cos(psi_rad)), np.float32(np.sin(psi_rad))
    first, second = rho.copy(), tangent.copy()
    first[half:], second[half:] = -tangent[half:], rho[half:]
    uv = np.column_stack([c * first - s * second, s * first + c * second]) * np.float32(focal_px)
    number = new_of_old[line]
    return np.asarray(uv[number >= 0], np.float32), number[number >= 0]


def join(
    offset_px: Array,
    sigma_px: Array,
    group: Int64s,
    support: Int64s,
    start_px: Array,
    end_px: Array,
    least: float,
    widths: Widths,
) -> tuple[Int64s, Int64s, Int64s, Array, Array, Int64s, Int64s]:
    """Edges (L,) that lie close together made one: those of one polarity the stronger, two sides a groove.

    Args:
        group: of each edge, as the groups of points.
        support: points of each edge, `least` of them at the least.
        start_px, end_px: where each edge begins and ends.

    Returns:
        (K,) the edges that are left, by axis and offset, and (L,) the line that each became, or -1; then of the lines
        (N,) their axis, offset and standard deviation, px, LineKind and points. None where fewer than two edges have
        enough points.
    """
    keep = np.flatnonzero(support >= least)
    keep = keep if len(keep) >= 2 else keep[:0]
    order = keep[np.lexsort((offset_px[keep], group[keep] // 2))]
    order = order[_distinct(offset_px[order], group[order], support[order], widths.same_px)]
    offset, sigma, axis, count = offset_px[order], sigma_px[order], group[order] // 2, support[order]
    own, partner = np.arange(len(order)), _pairs(offset, group[order], count, start_px[order], end_px[order], widths)
    paired = partner >= 0
    other = np.where(paired, partner, own)
    first = other >= own  # one entry a pair
    new_of_old = np.full(len(offset_px), -1, np.int64)
    new_of_old[order] = (np.cumsum(first) - 1)[np.minimum(other, own)]
    edge_kind = np.where(group[order] % 2 == 1, LineKind.RISING, LineKind.FALLING)
    return (
        order,
        new_of_old,
        axis[first],
        np.where(paired, 0.5 * (offset + offset[other]), offset)[first],
        np.where(paired, 0.5 * np.hypot(sigma, sigma[other]), sigma)[first],
        np.where(paired, LineKind.GROOVE, edge_kind)[first].astype(np.int64),
        np.where(paired, count + count[other], count)[first],
    )


def _distinct(offset_px: Array, group: Int64s, support: Int64s, same_px: float) -> Bools:
    """False for an edge close to a stronger one of its own axis and polarity."""
    good = np.ones(len(offset_px), bool)
    for g in range(4):
        ids = np.flatnonzero(group == g)
        for k in np.flatnonzero(np.diff(offset_px[ids]) < same_px):
            a, b = ids[k], ids[k + 1]
            good[a if support[a] < support[b] else b] = False
    return good


def _pairs(offset_px: Array, group: Int64s, support: Int64s, start_px: Array, end_px: Array, widths: Widths) -> Int64s:
    """Index of every line's partner, or -1: neighbours of opposite polarity, narrow and well supported pairs first.

    Where three edges could pair in two ways, the gap alone must not decide: where both are alike it would flip from
    frame to frame, and the line would jump.
    """
    partner = np.full(len(offset_px), -1, np.int64)
    gap = np.diff(offset_px)
    fits = (np.diff(group // 2) == 0) & (np.diff(group) != 0) & (gap < widths.groove_px)
    fits &= np.minimum(end_px[1:], end_px[:-1]) > np.maximum(start_px[1:], start_px[:-1])
    score = np.minimum(support[1:], support[:-1]) / np.maximum(gap, widths.narrow_px)
    for k in np.argsort(-score, kind="stable"):
        if fits[k] and partner[k] < 0 and partner[k + 1] < 0:
            partner[k], partner[k + 1] = k + 1, k
    return partner


def arms(points: Array32, point_line: Int64s, row: Int32s, normal: Array, at_px: Array, arm: Arm) -> Bools:
    """(rows, N) whether lines have points along most of an arm that begins at a position (N,) along them.

    One arm is enough: at the corner of a lamp both lines have but one.

    Args:
        row: (L,) in the result of each line, -1 for lines that are not asked for.
        normal: (2,) along the lines.
    """
    rows = int(row.max(initial=-1)) + 1
    if rows == 0 or len(at_px) == 0:
        return np.zeros((rows, len(at_px)), bool)
    margin = arm.reach_px + 2.0 * arm.bin_px
    low = float(at_px.min()) - margin
    bins = int((float(at_px.max()) - low + margin) / arm.bin_px) + 2
    hit = _hits(points, row[point_line], normal, low, arm.bin_px, (rows, bins))
    total = np.concatenate([np.zeros((rows, 1), np.int64), np.cumsum(hit, axis=1)], axis=1)
    begins = (-arm.reach_px, -arm.corner_px, arm.corner_px, arm.reach_px)
    cells = [((at_px + d - low) / arm.bin_px).astype(np.int64) for d in begins]
    before = total[:, cells[2] + 1] - total[:, cells[0]]
    after = total[:, cells[3] + 1] - total[:, cells[1]]
    return np.asarray(np.maximum(before, after) >= arm.need)


def _hits(points: Array32, row: Int32s, normal: Array, low: float, bin_px: float, shape: tuple[int, int]) -> Bools:
    """(rows, bins) which bins of floor((normal . point - low) / bin_px) hold a point of a row; row -1 is none."""
    rows, bins = shape
    mine = np.flatnonzero(row >= 0)
    x, y = (normal / bin_px).astype(np.float32)
    along = x * points[mine, 0] + y * points[mine, 1] - np.float32(low / bin_px)
    inside = (along >= 0) & (along < bins)
    out = np.zeros(rows * bins, bool)
    out[row[mine[inside]] * bins + along[inside].astype(np.int64)] = True
    return out.reshape(shape)


def centred(rho: Array32, tangent: Array32, line: Int32s, half: int, lines: int, more: Array) -> Array:
    """(P, 4 + K) of points: rho, what direction and tilt add to it, the latter about axes that are turned by the
    direction, and what more does, (P, K); each about the mean of its line, of so many lines.

    Args:
        half: points before this one belong to axis 0, the others to axis 1.
    """
    model = np.column_stack([_by_point(rho, tangent, half).T, more])
    count = np.maximum(np.bincount(line, minlength=lines), 1)
    for k in range(model.shape[1]):
        model[:, k] -= (np.bincount(line, model[:, k], lines) / count)[line]
    return np.asarray(model)


def neighbours(offset: Array, axis: Int64s, apart: float) -> Int64s:
    """(L,) number of what each is part of: neighbours of an axis that are less than `apart` off belong together."""
    order = np.lexsort((offset, axis))
    begins = (np.diff(axis[order]) != 0) | (np.diff(offset[order]) > apart)
    number = np.zeros(len(order), np.int64)
    number[order[1:]] = np.cumsum(begins)
    return number


def merged(offset_px: Array) -> Array:
    """Offsets of one axis, of those that are one the mean."""
    number = neighbours(offset_px, np.zeros(len(offset_px), np.int64), _ONE_PX)
    return np.asarray(np.bincount(number, offset_px) / np.maximum(np.bincount(number), 1))
