"""The loops in NumPy: what the compiled ones compute, and what runs where there are none."""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from ceilvo.daemon.vision.kernel.arguments import Array32, Bools, Ends, Int32s, Int64s
from ceilvo.daemon.vision.kernel.in_picture import follow, level_points
from ceilvo.types import Array

__all__ = ["assign", "extents", "follow", "hits", "level_points", "means", "project", "split", "sums", "vote"]


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
