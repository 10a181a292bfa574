"""The loops in NumPy: what the compiled ones compute, and what runs where there are none."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from ceilvo.daemon.vision.kernel.arguments import Array32, Ends, Int32s, Int64s
from ceilvo.daemon.vision.kernel.in_picture import follow, level_points, slopes
from ceilvo.daemon.vision.kernel.of_lines import align, arms, fit, join, picture
from ceilvo.robust import median
from ceilvo.types import Array

__all__ = [
    "align",
    "arms",
    "assign",
    "crowd",
    "direction",
    "extents",
    "fit",
    "follow",
    "join",
    "level_points",
    "peaks",
    "picture",
    "project",
    "settle",
    "slope_quartiles",
    "split",
    "spread",
    "vote",
]


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


def peaks(votes: Int64s, need: float) -> tuple[Array, Int64s, Ends]:
    """Local maxima of three neighbouring bins that have the votes needed, group after group and rising within each.

    Args:
        votes: (4, B) as of vote().

    Returns:
        (M,) where they are, from their bins' moments, in bins from the middle; (M,) their votes; the groups' bounds.
    """
    three = np.zeros_like(votes)
    three[:, 1:-1] = votes[:, :-2] + votes[:, 1:-1] + votes[:, 2:]
    inner = three[:, 1:-1]
    group, at = np.nonzero((inner >= need) & (inner > three[:, :-2]) & (inner >= three[:, 2:]))
    at = at + 1
    strength = three[group, at]
    moment = (votes[group, at + 1] - votes[group, at - 1]) / strength
    ends = np.searchsorted(group, np.arange(5))
    return at - votes.shape[1] // 2 + 0.5 + moment, strength, _ends(ends)


def direction(phi: Array32, reach_deg: float, stride: int) -> float:
    """Modulo 90 deg, what most gradients share: the mean of those within reach of the fullest three bins of 1 deg.

    Args:
        phi: (P,) deg, P at least 1, of which every stride-th counts.
    """
    folded = _modulo_90(phi[::stride])
    votes = np.bincount(np.clip(folded.astype(np.int32), 0, 89), minlength=90)  # rounding may reach 90, or fall below 0
    peak = float(np.argmax(votes + np.roll(votes, 1) + np.roll(votes, -1))) + 0.5
    off = _modulo_90(folded - np.float32(peak - 45.0)) - np.float32(45.0)
    near = off[np.abs(off) < np.float32(reach_deg)]
    return peak + float(np.mean(near, dtype=np.float64))


def _modulo_90(degrees: Array32) -> Array32:
    return np.asarray(degrees - np.float32(90.0) * np.floor(degrees * np.float32(1 / 90.0)), np.float32)


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
    x: Array32, y: Array32, rho: Array32, tangent: Array32, ends: Ends, offset: Array, group: Int64s, gate: float
) -> tuple[Array32, Array32, Array32, Array32, Int32s, Ends]:
    """Points within the gate of a line of their group, the index of the nearest one, and the groups' new bounds.

    Args:
        offset, group: (L,) of the lines, in any order.
    """
    keep, line, new_ends = [], [], [0]
    for g in range(4):
        mine = np.flatnonzero(group == g)
        mine = mine[np.argsort(offset[mine], kind="stable")]
        at = offset[mine]
        r = rho[ends[g] : ends[g + 1]].astype(np.float64)
        nearest = np.searchsorted(0.5 * (at[1:] + at[:-1]), r) if len(mine) else np.zeros(0, np.int64)
        near = np.flatnonzero(np.abs(r - at[nearest]) < gate) if len(mine) else np.zeros(0, np.int64)
        keep.append(near + ends[g])
        line.append(mine[nearest[near]])
        new_ends.append(new_ends[-1] + len(near))
    kept = np.concatenate(keep)
    lines = np.concatenate(line).astype(np.int32)
    return x[kept], y[kept], rho[kept], tangent[kept], lines, _ends(np.array(new_ends))


def settle(
    x: Array32, y: Array32, line: Int32s, half: int, psi_rad: float, tilt_rad: Array, focal_px: float, offset_px: Array
) -> tuple[Array32, Array32, Array]:
    """project(), and the lines' offsets (L,) as the means of their points; as they were of lines without any."""
    rho, tangent = project(x, y, half, psi_rad, tilt_rad)
    count = np.bincount(line, minlength=len(offset_px))
    mean_px = np.bincount(line, rho, len(offset_px)) / np.maximum(count, 1) * focal_px
    return rho, tangent, np.where(count > 0, mean_px, offset_px)


def spread(rho: Array32, line: Int32s, offset_px: Array, focal_px: float, stride: int) -> float:
    """Upper median distance of every stride-th point from its line, px; 0 without points."""
    return median(np.abs(rho[::stride] * focal_px - offset_px[line[::stride]]))


def slope_quartiles(framed: NDArray[np.uint8], samples: Int64s) -> tuple[float, float]:
    """Lower quartile and upper median of |d/dx| (Sobel) of a picture's pixels `samples`, counted row after row; 0
    without any.

    Args:
        framed: as for follow().
    """
    size = np.sort(np.abs(slopes(framed)[0].reshape(-1)[samples]))
    n = len(size)
    return (float(size[n // 4]), float(size[n // 2])) if n else (0.0, 0.0)


def crowd(xy: Array32, within: float) -> Int64s:
    """(M,) how many other points are nearer than that to each of (M, 2)."""
    off2 = np.square(xy[:, None, 0] - xy[:, 0]) + np.square(xy[:, None, 1] - xy[:, 1])
    return np.asarray(np.count_nonzero(off2 < within**2, axis=1) - 1, np.int64)


def extents(tangent: Array32, line: Int32s, lines: int) -> tuple[Array, Array]:
    """Least and greatest tangent (L,) of every line's points; inf and -inf without any."""
    low, high = np.full(lines, np.inf), np.full(lines, -np.inf)
    np.minimum.at(low, line, tangent)
    np.maximum.at(high, line, tangent)
    return low, high


def _ends(ends: Int64s) -> Ends:
    a, b, c, d, e = ends.tolist()
    return a, b, c, d, e
