"""The loops over pixels in NumPy: what the compiled ones compute, and what runs where there are none."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from ceilvo.daemon.vision.kernel.arguments import (
    LOOKUP_STEP_PX,
    MOST_PLACES,
    SEGMENT_PX,
    Array32,
    Bools,
    Grids,
    Int16s,
    Int32s,
    Int64s,
    Look,
    check_lookup,
    check_rows,
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
    rows: Array32 | None = None,
) -> tuple[Array32, Array32]:
    """Edge points (P, 2) in the level view, px, to sub-pixel, and where their gradients point (P,), deg in [0, 360).

    Args:
        mask: (H, W) nonzero at edges; the border counts as empty.
        dx, dy: (H, W) gradient.
        lookup: (rows, columns, 2) level pixel of every LOOKUP_STEP_PX-th pixel, for bilinear interpolation.
        rank: (H, W) pixels of this rank or above are left out.
        limit: see rank.
        rows: (H + 1, 4) of a rolling shutter: what takes level pixels from the time of a row to the picture's, as
            cosine and sine of the turn and the shift that follows it, px; None where all rows are of one instant.
    """
    check_lookup(lookup.shape, (mask.shape[0], mask.shape[1]))
    check_rows(None if rows is None else rows.shape, mask.shape[0])
    inner = np.zeros_like(mask)
    inner[1:-1, 1:-1] = mask[1:-1, 1:-1]
    at = np.flatnonzero(inner)
    at = at[rank.take(at) < limit]
    width = mask.shape[1]
    dx, dy = dx.reshape(-1), dy.reshape(-1)
    gx, gy = dx.take(at).astype(np.float32), dy.take(at).astype(np.float32)
    shift, horizontal = _subpixel_shift(at, width, gx, gy, dx, dy)
    level, along_x, along_y = _level(at, width, lookup)
    if rows is not None:
        level, along_x, along_y = _to_one_instant(rows, at // width, level, along_x, along_y)
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


def _to_one_instant(
    rows: Array32, row: Int64s, level: Array32, along_x: Array32, along_y: Array32
) -> tuple[Array32, Array32, Array32]:
    """What _level() gives, from the time of the points' rows to the picture's."""
    here, step = rows.take(row, axis=0), rows.take(row + 1, axis=0) - rows.take(row, axis=0)
    across = _turned(step, level) + step[:, 2:]
    return _turned(here, level) + here[:, 2:], _turned(here, along_x), _turned(here, along_y) + across


def _turned(row: Array32, xy: Array32, back: bool = False) -> Array32:
    """(P, 2) vectors turned by the angles whose cosines and sines rows (P, 4) begin with."""
    c, s = row[:, 0], -row[:, 1] if back else row[:, 1]
    return np.column_stack([c * xy[:, 0] - s * xy[:, 1], s * xy[:, 0] + c * xy[:, 1]])


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
    framed: NDArray[np.uint8],
    grids: Grids,
    lines: Array,
    tilt_rad: Array,
    focal_px: float,
    look: Look,
    rows: Array32 | None = None,
) -> tuple[Array32, Array32, Int32s, Int64s]:
    """Edge points (P,), (P,) as rays, line after line, near where straight edges should be.

    Args:
        framed: (H + 2, W + 2) the smoothed picture with a frame of one pixel, for Sobel's gradient.
        lines: (L, 5) cos and sin of the normal along which brightness rises, offset, start and end (counted along the
            normal turned by +90 deg), px of a level robot.
        tilt_rad: (2,) of the robot.
        rows: as for level_points.

    Returns:
        x, y, the line of every point, and at how many places each line was looked for (L,).
    """
    height, width = framed.shape[0] - 2, framed.shape[1] - 2
    check_search(grids, look, (height, width))
    dx, dy = slopes(framed)
    check_rows(None if rows is None else rows.shape, height)
    line, raw, across = _places(grids, lines, tilt_rad, focal_px, look.stride_px, rows)
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
    if rows is not None:
        level, along_x, along_y = _to_one_instant(rows, at // width, level, along_x, along_y)
    uv = (level + shift[:, None] * np.where(horizontal[:, None], along_x, along_y)) * np.float32(1.0 / focal_px)
    known = np.isfinite(uv).all(axis=1)
    x, y = np.ascontiguousarray(uv[known, 0], np.float32), np.ascontiguousarray(uv[known, 1], np.float32)
    return x, y, line[known].astype(np.int32), looked


def slopes(framed: NDArray[np.uint8]) -> tuple[Int16s, Int16s]:
    """(H, W) each: Sobel's gradient of a picture with a frame of one pixel (H + 2, W + 2)."""
    dx, dy = (np.ascontiguousarray(d[1:-1, 1:-1], np.int16) for d in cv2.spatialGradient(framed))
    return dx, dy


def _places(
    grids: Grids, lines: Array, tilt_rad: Array, focal_px: float, stride_px: float, rows: Array32 | None
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
    begin, end = (_to_raw(grids, lines[line], tilt_rad, focal_px, stride_px, k + d, rows) for d in (0, per))
    by = (end - begin) / np.float32(per)
    good = np.isfinite(by).all(axis=1)
    line, k, begin, by = line[good], k[good], begin[good], by[good]
    mine = np.minimum(counts[line] - k, per)
    segment = np.repeat(np.arange(len(line)), mine)
    within = (np.arange(len(segment)) - np.repeat(np.cumsum(mine) - mine, mine)).astype(np.float32)
    by = by[segment]
    return line[segment], begin[segment] + within[:, None] * by, np.column_stack([by[:, 1], -by[:, 0]])


def _to_raw(
    grids: Grids,
    lines: Array,
    tilt_rad: Array,
    focal_px: float,
    stride_px: float,
    k: Int64s,
    rows: Array32 | None,
) -> Array32:
    """(K, 2) raw pixel of the k-th place along a line each, nan where the look-up does not reach."""
    c, s, offset, start = lines.T[:4].astype(np.float32)
    along = ((start + np.float32(0.5 * stride_px)) + np.float32(stride_px) * k.astype(np.float32)) / np.float32(
        focal_px
    )
    offset = offset / np.float32(focal_px)
    x, y = offset * c - along * s, offset * s + along * c
    a, b = np.float32(tilt_rad[0]), np.float32(tilt_rad[1])
    z = np.float32(focal_px / grids.cell_px) / (1 - a * y + b * x)
    cells = np.column_stack([(x - b) * z, (y + a) * z])
    raw = _raw_at(grids, cells)
    if rows is None:
        return raw
    # the row that a place is on hardly depends on when that is read: once is enough
    known = (raw[:, 1] >= 0) & (raw[:, 1] < len(rows) - 1)
    row = rows.take(np.where(known, raw[:, 1], 0).astype(np.int64), axis=0)
    moved = _turned(row, cells - row[:, 2:] * np.float32(1.0 / grids.cell_px), back=True)
    return np.where(known[:, None], _raw_at(grids, moved), raw)


def _raw_at(grids: Grids, cells: Array32) -> Array32:
    """(K, 2) raw pixel at cells (K, 2) of the look-up, nan where it does not reach."""
    gx = cells[:, 0] - np.float32(grids.low_px[0] / grids.cell_px)
    gy = cells[:, 1] - np.float32(grids.low_px[1] / grids.cell_px)
    height, columns = grids.raw_of_level.shape[:2]
    inside = (gx >= 0) & (gy >= 0) & (gx < columns - 1) & (gy < height - 1)
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
