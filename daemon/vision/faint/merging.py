"""Lines of edge points and faint lines as one set, in one direction and with one tilt."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ceilvo.daemon.vision.angles import pixels
from ceilvo.daemon.vision.line_pairing import fold_direction, turn_axes
from ceilvo.daemon.vision.tilt_prior import TELLS_RAD
from ceilvo.types import Array, Ints, LineKind, Lines

_SAME_DEG = 0.35
"""A faint line and one of edge points this near are one, 2.5 px at a focal length of 410 px; chosen: half a groove's
sides, for of some only one was found."""

_BESIDE_DEG = 0.9
"""A faint line this near to one of edge points, along most of it, is what the filter for ridges answers beside an edge:
8 px at a focal length of 500 px, its reach; chosen."""
_MOSTLY = 0.5


def merged(edge_lines: Lines, faint: Lines, focal_px: float, groove_deg: float) -> Lines:
    """Both, each line once.

    Where both see a line it is where the one with more support has it, and seen wherever either saw it; a groove of
    which edge points show one side is where the faint one is.

    Args:
        groove_deg: a groove's sides are at most so far apart, so its middle is within half of that of either.
    """
    faint = named_alike(faint, edge_lines.psi_rad)
    if faint.psi_sigma_rad < edge_lines.psi_sigma_rad:
        edge_lines, free = seen_at(edge_lines, faint, focal_px), faint
    else:
        faint, free = seen_at(faint, edge_lines, focal_px), edge_lines
    if np.max(free.free_tilt_sigma_rad) > TELLS_RAD:
        free = min(edge_lines, faint, key=lambda lines: float(np.max(lines.free_tilt_sigma_rad)))
    partner, off = _nearest(faint, edge_lines)
    same = off < pixels(_SAME_DEG, focal_px)
    longer = faint.support > edge_lines.support[partner]
    groove = (faint.kind == LineKind.GROOVE) & (edge_lines.kind[partner] != LineKind.GROOVE)
    mine = np.flatnonzero(same & (longer | groove))
    offset, sigma, kind = (v.copy() for v in (edge_lines.offset_px, edge_lines.sigma_px, edge_lines.kind))
    for of_line, of_faint in ((offset, faint.offset_px), (sigma, faint.sigma_px), (kind, faint.kind)):
        of_line[partner[mine]] = of_faint[mine]
    beside_px = pixels(_BESIDE_DEG, focal_px)
    apart = (off <= 0.5 * pixels(groove_deg, focal_px)) | (off >= beside_px)
    new = ~same & (apart | (_along_with(faint, edge_lines, partner, beside_px) < _MOSTLY))
    count = len(edge_lines.axis)
    used = (same | new)[faint.point_line]
    target = np.where(same, partner, count + np.cumsum(new) - 1)
    point_line = target[faint.point_line[used]]
    support = np.append(edge_lines.support, np.zeros(np.count_nonzero(new), np.int64))
    support += np.bincount(point_line, minlength=len(support))
    lines = replace(
        edge_lines,
        axis=np.append(edge_lines.axis, faint.axis[new]),
        offset_px=np.append(offset, faint.offset_px[new]),
        sigma_px=np.append(sigma, faint.sigma_px[new]),
        kind=np.append(kind, faint.kind[new]),
        support=support,
        free_tilt_rad=free.free_tilt_rad,
        free_tilt_sigma_rad=free.free_tilt_sigma_rad,
        points=np.concatenate([edge_lines.points, faint.points[used]]),
        point_line=np.append(edge_lines.point_line, point_line),
    )
    return folded(lines)


def folded(lines: Lines) -> Lines:
    """With its direction in [-pi/4, pi/4), and the axes named by it."""
    psi, turned = fold_direction(lines.psi_rad)
    return turn_axes(replace(lines, psi_rad=psi), turned)


def named_alike(lines: Lines, psi_rad: float) -> Lines:
    """With its axes named so that its direction is the nearest to psi_rad."""
    turned = round((lines.psi_rad - psi_rad) / (0.5 * np.pi))
    return turn_axes(replace(lines, psi_rad=lines.psi_rad - turned * 0.5 * np.pi), turned)


def seen_at(lines: Lines, other: Lines, focal_px: float) -> Lines:
    """The same lines by the direction and the tilt of others, with their errors."""
    x, y = (np.asarray(lines.points, np.float64) / focal_px).T
    a, b = (other.tilt_rad - lines.tilt_rad).tolist()
    scale = 1.0 + a * y - b * x
    moved = np.column_stack([(x + b) / scale, (y - a) / scale]) * focal_px
    before, after = (_across(p, psi, lines) for p, psi in ((lines.points, lines.psi_rad), (moved, other.psi_rad)))
    count = np.bincount(lines.point_line, minlength=len(lines.axis))
    by = np.bincount(lines.point_line, after - before, len(lines.axis)) / np.maximum(count, 1)
    return replace(
        lines,
        psi_rad=other.psi_rad,
        psi_sigma_rad=other.psi_sigma_rad,
        tilt_rad=other.tilt_rad,
        tilt_sigma_rad=other.tilt_sigma_rad,
        offset_px=lines.offset_px + by,
        points=moved.astype(np.float32),
    )


def _across(points: NDArray[Any], psi_rad: float, lines: Lines) -> Array:
    """(P,) of points (P, 2) along the normals of their lines."""
    angle = psi_rad + 0.5 * np.pi * lines.axis[lines.point_line]
    return np.asarray(np.cos(angle) * points[:, 0] + np.sin(angle) * points[:, 1], np.float64)


def _nearest(lines: Lines, others: Lines) -> tuple[Ints, Array]:
    """(L,) the nearest of the others along the same axis, and how far off it is, px."""
    off = np.abs(lines.offset_px[:, None] - others.offset_px[None])
    off[lines.axis[:, None] != others.axis[None]] = np.inf
    partner = np.argmin(off, axis=1)
    return np.asarray(partner, np.int64), np.asarray(off[np.arange(len(off)), partner], np.float64)


def _along_with(lines: Lines, others: Lines, partner: Ints, reach_px: float) -> Array:
    """(L,) share of each line's points that have points of its partner among the others beside them."""
    share = np.zeros(len(lines.axis))
    for k, of in enumerate(partner.tolist()):
        angle = lines.psi_rad + 0.5 * np.pi * int(lines.axis[k])
        tangent = np.array([-np.sin(angle), np.cos(angle)])
        mine = lines.points[lines.point_line == k] @ tangent
        theirs = np.sort(others.points[others.point_line == of] @ tangent)
        near = np.searchsorted(theirs, mine + reach_px) > np.searchsorted(theirs, mine - reach_px)
        share[k] = np.mean(near) if len(mine) else 0.0
    return share
