"""The loops in NumPy: what the compiled ones compute, and what runs where there are none."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from ceilvo.daemon.vision.kernel.arguments import (
    LOOKUP_STEP_PX,
    MOST_PLACES,
    SEGMENT_PX,
    Array32,
    Bools,
    Ends,
    Grids,
    Int16s,
    Int32s,
    Int64s,
    Look,
    check_lookup,
    check_search,
)
from ceilvo.types import Array


def level_points(
    mask: NDArray[np.uint8],
    dx: Int16s,
    dy: Int16s,
    lookup: Array32,
    rank: NDArray[np.uint16],
    limit: int,
) -> tuple[Array32, Array32]:
    """Edge points (P, 2) in the level view, px, to sub-pixel, and where their gradients point (P,), deg in [0, 360).

    Args:
        mask: (H, W) nonzero at edges; the border counts as empty.
        dx, dy: (H, W) gradient.
        lookup: (rows, columns, 2) level pixel of every LOOKUP_STEP_PX-th pixel, for bilinear interpolation.
        rank: (H, W) pixels of this rank or above are left out.
        limit: see rank.
    """
    check_lookup(lookup.shape, (mask.shape[0], mask.shape[1]))
    inner = np.zeros_like(mask)
    inner[1:-1, 1:-1] = mask[1:-1, 1:-1]
    at = np.flatnonzero(inner)
    at = at[rank.take(at) < limit]
    width = mask.shape[1]
    dx, dy = dx.reshape(-1), dy.reshape(-1)
    gx, gy = dx.take(at).astype(np.float32), dy.take(at).astype(np.float32)
    shift, horizontal = _subpixel_shift(at, width, gx, gy, dx, dy)
    level, along_x, along_y = _level(at, width, lookup)
    uv = level + shift[:, None] * np.where(horizontal[:, None], along_x, along_y)
    # a gradient is a covector: it turns with the inverse transpose of the look-up's Jacobian
    right, up = along_y[:, 1] * gx - along_x[:, 1] * gy, along_x[:, 0] * gy - along_y[:, 0] * gx
    phi = np.degrees(np.arctan2(up, right)) % np.float32(360.0)
    return uv.astype(np.float32), np.where(phi >= 360.0, np.float32(0.0), phi.astype(np.float32))


def _level(at: Int64s, width: int, lookup: Array32) -> tuple[Array32, Array32, Array32]:
    """(P, 2) level pixels of raw ones, and their change per raw pixel along x and y."""
    step, columns = LOOKUP_STEP_PX, lookup.shape[1]
    y, x = np.divmod(at, width)
    fx, fy = (((v % step) / step).astype(np.float32)[:, None] for v in (x, y))
    table, corner = lookup.reshape(-1, 2), (y // step) * columns + x // step
    low, right, up, both = (table.take(corner + d, axis=0) for d in (0, 1, columns, columns + 1))
    along_x = (1 - fy) * (right - low) + fy * (both - up)
    along_y = (1 - fx) * (up - low) + fx * (both - right)
    level = (1 - fy) * (low + fx * (right - low)) + fy * (up + fx * (both - up))
    scale = np.float32(1.0 / step)
    return level, along_x * scale, along_y * scale


def _subpixel_shift(
    at: Int64s, width: int, gx: Array32, gy: Array32, dx: Int16s, dy: Int16s
) -> tuple[Array32, NDArray[np.bool_]]:
    """Peak of the parabola through the gradient magnitude and its neighbours along the steeper image axis."""
    horizontal = np.abs(gx) >= np.abs(gy)
    return _shift_along(at, np.where(horizontal, 1, width), gx, gy, dx, dy), horizontal


def _shift_along(at: Int64s, step: Int64s, gx: Array32, gy: Array32, dx: Int16s, dy: Int16s) -> Array32:
    here = np.hypot(gx, gy)
    before = np.hypot(dx.take(at - step).astype(np.float32), dy.take(at - step).astype(np.float32))
    after = np.hypot(dx.take(at + step).astype(np.float32), dy.take(at + step).astype(np.float32))
    curvature = np.maximum(2.0 * here - before - after, np.float32(1e-3))
    return np.asarray(np.clip(0.5 * (after - before) / curvature, -0.5, 0.5), np.float32)


def follow(
    dx: Int16s, dy: Int16s, grids: Grids, lines: Array, tilt_rad: Array, focal_px: float, look: Look
) -> tuple[Array32, Array32, Int32s, Int64s]:
    """Edge points (P,), (P,) as rays, line after line, near where straight edges should be.

    Args:
        dx, dy: (H, W) gradient.
        lines: (L, 5) cos and sin of the normal along which brightness rises, offset, start and end (counted along the
            normal turned by +90 deg), px of a level robot.
        tilt_rad: (2,) of the robot.

    Returns:
        x, y, the line of every point, and at how many places each line was looked for (L,).
    """
    height, width = dx.shape
    check_search(grids, look, (height, width))
    line, raw, across = _places(grids, lines, tilt_rad, focal_px, look.stride_px)
    horizontal = np.abs(across[:, 0]) >= np.abs(across[:, 1])
    fixed, free = (np.where(horizontal, raw[:, a], raw[:, b]) for a, b in ((1, 0), (0, 1)))
    with np.errstate(divide="ignore", invalid="ignore"):
        slope = np.where(horizontal, across[:, 1] / across[:, 0], across[:, 0] / across[:, 1])
    major: Int64s = np.floor(fixed + np.float32(0.5)).astype(np.int64)
    centre = free - (major.astype(np.float32) - fixed) * slope
    first, last = np.ceil(centre - np.float32(look.reach_px)), np.floor(centre + np.float32(look.reach_px))
    inside = (fixed > 0) & (major >= 1) & (major <= np.where(horizontal, height - 2, width - 2))
    inside &= (first >= 1) & (last <= np.where(horizontal, width - 2, height - 2))
    key = np.where(inside, 2 * major + horizontal, -1)
    chosen = np.flatnonzero(inside)
    again = (key[chosen[1:]] == key[chosen[:-1]]) & (line[chosen[1:]] == line[chosen[:-1]])
    chosen = chosen[np.concatenate([[True], ~again])] if len(chosen) else chosen
    line, across, horizontal = line[chosen], across[chosen], horizontal[chosen]
    major, centre = major[chosen], centre[chosen]
    found, at = _peaks_near(dx, dy, across, horizontal, major, centre, look)
    looked = np.bincount(line, minlength=len(lines)).astype(np.int64)
    line, horizontal = line[found], horizontal[found]
    gx, gy = dx.reshape(-1).take(at).astype(np.float32), dy.reshape(-1).take(at).astype(np.float32)
    shift = _shift_along(at, np.where(horizontal, 1, width), gx, gy, dx.reshape(-1), dy.reshape(-1))
    level, along_x, along_y = _level(at, width, grids.lookup)
    uv = (level + shift[:, None] * np.where(horizontal[:, None], along_x, along_y)) * np.float32(1.0 / focal_px)
    known = np.isfinite(uv).all(axis=1)
    x, y = np.ascontiguousarray(uv[known, 0], np.float32), np.ascontiguousarray(uv[known, 1], np.float32)
    return x, y, line[known].astype(np.int32), looked


def _places(
    grids: Grids, lines: Array, tilt_rad: Array, focal_px: float, stride_px: float
) -> tuple[Int64s, Array32, Array32]:
    """Line (K,), raw pixel (K, 2) and normal (K, 2) in the raw picture of even places along the lines.

    Lines are straight in the raw picture for SEGMENT_PX: the lens bends them by nothing along so little.
    """
    per = max(int(SEGMENT_PX / stride_px), 1)
    length = (lines[:, 4] - lines[:, 3]) / stride_px
    counts = np.where((length > 0.0) & (length < MOST_PLACES), length, 0.0).astype(np.int64)
    segments = -(-counts // per)
    line = np.repeat(np.arange(len(lines)), segments)
    k = per * (np.arange(len(line)) - np.repeat(np.cumsum(segments) - segments, segments))
    begin, end = (_to_raw(grids, lines[line], tilt_rad, focal_px, stride_px, k + d) for d in (0, per))
    by = (end - begin) / np.float32(per)
    good = np.isfinite(by).all(axis=1)
    line, k, begin, by = line[good], k[good], begin[good], by[good]
    mine = np.minimum(counts[line] - k, per)
    segment = np.repeat(np.arange(len(line)), mine)
    within = (np.arange(len(segment)) - np.repeat(np.cumsum(mine) - mine, mine)).astype(np.float32)
    by = by[segment]
    return line[segment], begin[segment] + within[:, None] * by, np.column_stack([by[:, 1], -by[:, 0]])


def _to_raw(grids: Grids, lines: Array, tilt_rad: Array, focal_px: float, stride_px: float, k: Int64s) -> Array32:
    """(K, 2) raw pixel of the k-th place along a line each, nan where the look-up does not reach."""
    c, s, offset, start = lines.T[:4].astype(np.float32)
    along = ((start + np.float32(0.5 * stride_px)) + np.float32(stride_px) * k.astype(np.float32)) / np.float32(
        focal_px
    )
    offset = offset / np.float32(focal_px)
    x, y = offset * c - along * s, offset * s + along * c
    a, b = np.float32(tilt_rad[0]), np.float32(tilt_rad[1])
    z = np.float32(focal_px / grids.cell_px) / (1 - a * y + b * x)
    gx = (x - b) * z - np.float32(grids.low_px[0] / grids.cell_px)
    gy = (y + a) * z - np.float32(grids.low_px[1] / grids.cell_px)
    rows, columns = grids.raw_of_level.shape[:2]
    inside = (gx >= 0) & (gy >= 0) & (gx < columns - 1) & (gy < rows - 1)
    gx, gy = np.where(inside, gx, 0), np.where(inside, gy, 0)
    i, j = gx.astype(np.int64), gy.astype(np.int64)
    fx, fy = np.float32(gx - i)[:, None], np.float32(gy - j)[:, None]
    table = grids.raw_of_level
    low, right, up, both = table[j, i], table[j, i + 1], table[j + 1, i], table[j + 1, i + 1]
    raw = (1 - fy) * (low + fx * (right - low)) + fy * (up + fx * (both - up))
    return np.asarray(np.where(inside[:, None], raw, np.nan), np.float32)


def _peaks_near(
    dx: Int16s, dy: Int16s, across: Array32, horizontal: Bools, major: Int64s, centre: Array32, look: Look
) -> tuple[Int64s, Int64s]:
    """Which places (F,) have a local maximum of the gradient within reach, and its flat pixel (F,)."""
    width = dx.shape[1]
    reach = np.float32(look.reach_px)
    first = np.ceil(centre - reach).astype(np.int64)
    p = first[:, None] + np.arange(int(2 * look.reach_px) + 1)
    within = p <= np.floor(centre + reach)[:, None]
    p = np.where(within, p, first[:, None])
    at = np.where(horizontal[:, None], major[:, None] * width + p, p * width + major[:, None])
    beside = np.where(horizontal, 1, width)[:, None]
    gx, gy = dx.reshape(-1).astype(np.int64), dy.reshape(-1).astype(np.int64)
    square = gx * gx + gy * gy
    here = square[at]
    rise = gx[at] * across[:, :1] + gy[at] * across[:, 1:]
    narrow = np.float32(look.gate**2) * np.sum(across**2, axis=1, keepdims=True)
    good = within & (here >= np.ceil(look.floor**2)) & (here >= square[at - beside]) & (here > square[at + beside])
    good &= (rise > 0) & (rise * rise >= narrow * here)
    score = np.where(good, here if look.strongest else reach + 1 - np.abs(p.astype(np.float32) - centre[:, None]), -1.0)
    best = np.argmax(score, axis=1)
    found = np.flatnonzero(good[np.arange(len(best)), best])
    return found, at[found, best[found]]


def split(uv: Array32, phi: Array32, psi_deg: float, gate_deg: float, scale: float) -> tuple[Array32, Array32, Ends]:
    """Points (x, y) = scale * uv whose gradient is within the gate of psi or of one of its quarter turns, in groups."""
    turns = (phi - np.float32(psi_deg)) * np.float32(1 / 90.0)
    nearest = np.rint(turns)
    quarter = np.where(np.abs(turns - nearest) < np.float32(gate_deg / 90.0), nearest.astype(np.int8) & 3, 4)
    members = [np.flatnonzero(quarter == q) for q in (2, 0, 3, 1)]
    chosen = uv[np.concatenate(members)] * np.float32(scale)
    ends = np.cumsum([0, *(len(m) for m in members)])
    return np.ascontiguousarray(chosen[:, 0]), np.ascontiguousarray(chosen[:, 1]), _ends(ends)


def vote(
    x: Array32, y: Array32, ends: Ends, angles_rad: tuple[float, float], scale: float, half: int, stride: int = 1
) -> Int64s:
    """(4, 2 half) votes of each group: how many points' scale * (cos x + sin y) + half fall into each unit bin.

    Args:
        angles_rad: of the normal, for the two groups of axis 0 and for the two of axis 1.
        stride: every stride-th point of a group votes.
    """
    votes = np.zeros((4, 2 * half), np.int64)
    for g, (begin, end) in enumerate(pairwise(ends)):
        angle = angles_rad[g // 2]
        c, s = np.float32(scale * np.cos(angle)), np.float32(scale * np.sin(angle))
        cell = c * x[begin:end:stride] + s * y[begin:end:stride] + np.float32(half)
        inside = cell[(cell >= 0) & (cell < 2 * half)]
        votes[g] = np.bincount(inside.astype(np.int64), minlength=2 * half)
    return votes


def project(x: Array32, y: Array32, half: int, psi_rad: float, tilt_rad: Array) -> tuple[Array32, Array32]:
    """(rho, tangent) of rays (x, y, 1) that a robot tilted by (a, b) saw, as a level one would see them.

    Args:
        half: points before this one belong to axis 0, the others to axis 1.
    """
    a, b = np.float32(tilt_rad[0]), np.float32(tilt_rad[1])
    c, s = np.float32(np.cos(psi_rad)), np.float32(np.sin(psi_rad))
    scale = np.float32(1.0) / (np.float32(1.0) + a * y - b * x)
    x, y = (x + b) * scale, (y - a) * scale
    rho, tangent = c * x + s * y, c * y - s * x
    swap = rho[half:].copy()
    rho[half:] = tangent[half:]
    tangent[half:] = -swap
    return rho, tangent


def assign(
    x: Array32, y: Array32, rho: Array32, tangent: Array32, ends: Ends, offset: Array, counts: Int64s, gate: float
) -> tuple[Array32, Array32, Array32, Array32, Int32s, Ends]:
    """Points within the gate of a line of their group, the index of the nearest one, and the groups' new bounds.

    Args:
        offset: (L,) of the lines, group after group, rising within each group.
        counts: (4,) lines in each group.
    """
    first = np.concatenate([[0], np.cumsum(counts)])
    keep, line, new_ends = [], [], [0]
    for g in range(4):
        mine = offset[first[g] : first[g + 1]]
        r = rho[ends[g] : ends[g + 1]].astype(np.float64)
        nearest = np.searchsorted(0.5 * (mine[1:] + mine[:-1]), r) if len(mine) else np.zeros(0, np.int64)
        near = np.flatnonzero(np.abs(r - mine[nearest]) < gate) if len(mine) else np.zeros(0, np.int64)
        keep.append(near + ends[g])
        line.append(nearest[near] + first[g])
        new_ends.append(new_ends[-1] + len(near))
    at = np.concatenate(keep)
    return x[at], y[at], rho[at], tangent[at], np.concatenate(line).astype(np.int32), _ends(np.array(new_ends))


def sums(rho: Array32, tangent: Array32, line: Int32s, half: int, lines: int) -> tuple[Int64s, Array, Array]:
    """Points of every line (L,), sums (L, 4) and products (4, 4) of rho, tangent, d rho / d tilt about either normal.

    A ray r seen by a tilted robot moves by -w x r, for small w about the normal of axis 0 and of axis 1.
    """
    r, t = rho.astype(np.float64), tangent.astype(np.float64)
    across, own = r * t, 1.0 + r * r
    about_0 = np.concatenate([-across[:half], -own[half:]])
    about_1 = np.concatenate([own[:half], -across[half:]])
    rows = np.stack([r, t, about_0, about_1])
    total: Array = np.stack([np.bincount(line, row, lines) for row in rows], axis=1).astype(np.float64)
    return np.bincount(line, minlength=lines).astype(np.int64), total, np.asarray(rows @ rows.T)


def means(rho: Array32, line: Int32s, lines: int) -> Array:
    """(L,) mean rho of every line's points, nan without any."""
    with np.errstate(invalid="ignore"):
        return np.bincount(line, rho, lines) / np.bincount(line, minlength=lines)


def extents(tangent: Array32, line: Int32s, lines: int) -> tuple[Array, Array]:
    """Least and greatest tangent (L,) of every line's points; inf and -inf without any."""
    low, high = np.full(lines, np.inf), np.full(lines, -np.inf)
    np.minimum.at(low, line, tangent)
    np.maximum.at(high, line, tangent)
    return low, high


def hits(points: Array32, row: Int32s, normal: Array, low: float, bin_px: float, shape: tuple[int, int]) -> Bools:
    """(rows, bins) which bins of floor((normal . point - low) / bin_px) hold a point of a row; row -1 is none."""
    rows, bins = shape
    mine = np.flatnonzero(row >= 0)
    along = points[mine] @ (normal / bin_px).astype(np.float32) - np.float32(low / bin_px)
    inside = (along >= 0) & (along < bins)
    out = np.zeros(rows * bins, bool)
    out[row[mine[inside]] * bins + along[inside].astype(np.int64)] = True
    return out.reshape(shape)


def _ends(ends: Int64s) -> Ends:
    a, b, c, d, e = ends.tolist()
    return a, b, c, d, e
