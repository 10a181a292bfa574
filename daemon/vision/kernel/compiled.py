"""The functions of kernel_numpy, done by the compiled kernel. ImportError where that was not built."""

from __future__ import annotations

import math

import cv2
import numpy as np
from numpy.typing import NDArray

from ceilvo.daemon.vision.kernel import _kernel
from ceilvo.daemon.vision.kernel.reference import Array, Array32, Bools, Ends, Grids, Int16s, Int32s, Int64s, Look


def level_points(
    mask: NDArray[np.uint8], dx: Int16s, dy: Int16s, lookup: Array32, rank: NDArray[np.uint16], limit: int
) -> tuple[Array32, Array32]:
    """See kernel_numpy."""
    most = cv2.countNonZero(mask)
    uv, phi = np.empty((most, 2), np.float32), np.empty(most, np.float32)
    height, width = mask.shape
    n = _kernel.level_points(mask, dx, dy, lookup, rank, width, height, lookup.shape[1], limit, uv, phi)
    return uv[:n], phi[:n]


def follow(
    dx: Int16s, dy: Int16s, grids: Grids, lines: Array, tilt_rad: Array, focal_px: float, look: Look
) -> tuple[Array32, Array32, Int32s, Int64s]:
    """See kernel_numpy."""
    most = int(np.sum(np.clip((lines[:, 4] - lines[:, 3]) / look.stride_px, 0.0, 1e6)))
    x, y, line = np.empty(most, np.float32), np.empty(most, np.float32), np.empty(most, np.int32)
    looked = np.zeros(len(lines), np.int64)
    n = _kernel.follow(
        dx, dy, grids.lookup, grids.raw_of_level, lines, dx.shape[1], dx.shape[0], grids.lookup.shape[1],
        grids.raw_of_level.shape[1], grids.raw_of_level.shape[0], *grids.low_px, grids.cell_px,
        float(tilt_rad[0]), float(tilt_rad[1]), focal_px, look.stride_px, look.reach_px, look.floor,
        look.gate, look.strongest, x, y, line, looked,
    )  # fmt: skip
    return x[:n], y[:n], line[:n], looked


def split(uv: Array32, phi: Array32, psi_deg: float, gate_deg: float, scale: float) -> tuple[Array32, Array32, Ends]:
    """See kernel_numpy."""
    x, y = np.empty(len(phi), np.float32), np.empty(len(phi), np.float32)
    ends = _kernel.split(uv, phi, psi_deg, gate_deg, scale, x, y, np.empty(len(phi), np.int8))
    return x[: ends[4]], y[: ends[4]], ends


def vote(
    x: Array32, y: Array32, ends: Ends, angles_rad: tuple[float, float], scale: float, half: int, stride: int = 1
) -> Int64s:
    """See kernel_numpy."""
    votes = np.zeros((4, 2 * half), np.int64)
    c0, s0, c1, s1 = (scale * f(angle) for angle in angles_rad for f in (math.cos, math.sin))
    _kernel.vote(x, y, ends, c0, s0, c1, s1, -float(half), 2 * half, stride, votes)
    return votes


def project(x: Array32, y: Array32, half: int, psi_rad: float, tilt_rad: Array) -> tuple[Array32, Array32]:
    """See kernel_numpy."""
    rho, tangent = np.empty_like(x), np.empty_like(x)
    c, s = math.cos(psi_rad), math.sin(psi_rad)
    _kernel.project(x, y, half, c, s, float(tilt_rad[0]), float(tilt_rad[1]), rho, tangent)
    return rho, tangent


def assign(
    x: Array32, y: Array32, rho: Array32, tangent: Array32, ends: Ends, offset: Array, counts: Int64s, gate: float
) -> tuple[Array32, Array32, Array32, Array32, Int32s, Ends]:
    """See kernel_numpy."""
    x, y, rho, tangent = x.copy(), y.copy(), rho.copy(), tangent.copy()
    line = np.empty(len(x), np.int32)
    ends = _kernel.assign(x, y, rho, tangent, ends, offset, counts, gate, line)
    n = ends[4]
    return x[:n], y[:n], rho[:n], tangent[:n], line[:n], ends


def sums(rho: Array32, tangent: Array32, line: Int32s, half: int, lines: int) -> tuple[Int64s, Array, Array]:
    """See kernel_numpy."""
    count, total, product = np.zeros(lines, np.int64), np.zeros((lines, 4)), np.empty((4, 4))
    _kernel.sums(rho, tangent, line, half, count, total, product)
    return count, total, product


def extents(tangent: Array32, line: Int32s, lines: int) -> tuple[Array, Array]:
    """See kernel_numpy."""
    low, high = np.full(lines, np.inf), np.full(lines, -np.inf)
    _kernel.extents(tangent, line, low, high)
    return low, high


def means(rho: Array32, line: Int32s, lines: int) -> Array:
    """See kernel_numpy."""
    count, total = np.zeros(lines, np.int64), np.zeros(lines)
    _kernel.means(rho, line, count, total)
    with np.errstate(invalid="ignore"):
        return total / count


def hits(points: Array32, row: Int32s, normal: Array, low: float, bin_px: float, shape: tuple[int, int]) -> Bools:
    """See kernel_numpy."""
    out = np.zeros(shape, bool)
    x, y = (normal / bin_px).tolist()
    _kernel.hits(points, row, x, y, low / bin_px, *shape, out)
    return out
